"""Costs of a grasp: collisions of the hand, and a poor grip on the body."""

import numpy as np

from libero_env.expert.arm import GRIPPER
from libero_env.expert.clearance import Voxels, hand_points
from libero_env.expert.grasping.grasps import COLLISION_COST, DEPTH_COST, Grasp
from libero_env.expert.grasping.kernels import open_hand_collision_depth

HAND = hand_points(
    GRIPPER.max_opening + 0.012
)  # points on the hand, with room beside the fingers, (N, 3), [m]
_FIRM_GRIP = 0.010  # [m] of a body between the pads, along and across them, that make a firm grip
_FACE_TOLERANCE = 0.003  # [m] by which a face may vary over the width of a pad
_APPROACH = (0.04, 0.08, 0.13)  # [m] before a grasp, where the hand must have room too


def finger_offset(cloud: np.ndarray, pos: np.ndarray, mat: np.ndarray) -> float:
    """Return the offset, along the fingers' motion, of what open fingers close on from the middle between them, [m].

    Args:
        cloud: Points on the body, world frame, (N, 3).
        pos: Position of the grip site, (3,).
        mat: Orientation of the grip site, (3, 3).
    """
    u = _between_pads(cloud, pos, mat)[:, 0]
    return 0.5 * float(u.min() + u.max()) if len(u) else 0.0


def grip_cost(cloud: np.ndarray, grasp: Grasp) -> float:
    """Return the cost of a poor grip: little of the body between the pads, or faces that the pads meet obliquely.

    Args:
        cloud: Points on the body, world frame, (N, 3).
        grasp: Grasp of the body.
    """
    u, v, depth = _between_pads(cloud, grasp.pos_world, grasp.mat).T
    if not len(u):
        return 1.0
    cost = 30.0 * max(_FIRM_GRIP - np.ptp(depth), 0.0) + 30.0 * max(_FIRM_GRIP - np.ptp(v), 0.0)
    parts = [u[np.abs(v - middle) < 0.004] for middle in (-0.007, 0.0, 0.007)]
    faces = np.array([(part.min(), part.max()) for part in parts if len(part)])
    misalignment = np.ptp(faces, axis=0).max() if len(faces) else 0.0
    return float(cost + 30.0 * max(misalignment - _FACE_TOLERANCE, 0.0))


def collision_cost(voxels: Voxels, obstacles: np.ndarray, grasp: Grasp) -> float:
    """Return the cost of collisions of the hand at a grasp and on its approach.

    Args:
        voxels: Voxels of the scene; only the height of the table counts.
        obstacles: Points on obstacles near the grasp, (M, 3).
        grasp: Grasp of a body.
    """
    depth = open_hand_collision_depth(obstacles, grasp.pos_world, grasp.mat)
    lowest = float((grasp.pos_world + HAND @ grasp.mat.T)[:, 2].min())
    below = max(voxels.surface_height - lowest, 0.0)
    cost = DEPTH_COST * depth + COLLISION_COST * (depth > 0) + 40.0 * below + 0.1 * (below > 0)
    depths = [
        open_hand_collision_depth(obstacles, grasp.pos_world - d * grasp.mat[:, 2], grasp.mat)
        for d in _APPROACH
    ]
    return cost + 5.0 * max(depths) + 0.1 * (max(depths) > 0)


def _between_pads(cloud: np.ndarray, pos: np.ndarray, mat: np.ndarray) -> np.ndarray:
    """Return the points between the pads of open fingers, in the frame of the grip site, (M, 3)."""
    local = (cloud - pos) @ mat
    u, v, depth = local.T
    inside = (np.abs(u) < GRIPPER.half_opening) & (np.abs(v) < GRIPPER.finger_half_width)
    return local[inside & (depth > -GRIPPER.pad_above) & (depth < GRIPPER.pad_below)]
