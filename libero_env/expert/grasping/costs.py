"""What speaks against a hold: others in the hand's way, and little of the body between the pads."""

import numpy as np

from libero_env.expert.arm.gripper import FINGER_HALF_WIDTH, MAX_OPENING, PAD_ABOVE, PAD_BELOW
from libero_env.expert.clearance import Voxels, hand_points
from libero_env.expert.grasping.grasps import Grasp, crowding

HAND = hand_points(MAX_OPENING + 0.012)  # points of the hand, with room beside the fingers, (N, 3), m
_BITE = 0.010  # m of a body, along and across the pads, that make a firm hold
_BEFORE = (0.04, 0.08, 0.13)  # m, before a hold, where the hand must have room too


def finger_offset(cloud: np.ndarray, pos: np.ndarray, mat: np.ndarray) -> float:
    """How far the middle of what open fingers close on is from the middle between them, m along their opening."""
    u = _between_pads(cloud, pos, mat)[:, 0]
    return 0.5 * float(u.min() + u.max()) if len(u) else 0.0


def _between_pads(cloud: np.ndarray, pos: np.ndarray, mat: np.ndarray) -> np.ndarray:
    """The points that open fingers have between their pads, in the hand's frame, (M, 3)."""
    local = (cloud - pos) @ mat
    u, v, depth = local.T
    pads = (np.abs(v) < FINGER_HALF_WIDTH) & (depth > -PAD_ABOVE) & (depth < PAD_BELOW)
    return local[pads & (np.abs(u) < 0.5 * MAX_OPENING)]


def grip_cost(cloud: np.ndarray, grasp: Grasp) -> float:
    """What it costs that the pads have little of the body between them, or meet its faces askew."""
    u, v, depth = _between_pads(cloud, grasp.pos_world, grasp.mat).T
    if not len(u):
        return 1.0
    price = 30.0 * max(_BITE - np.ptp(depth), 0.0) + 30.0 * max(_BITE - np.ptp(v), 0.0)
    parts = [u[np.abs(v - middle) < 0.004] for middle in (-0.007, 0.0, 0.007)]
    faces = np.array([(part.min(), part.max()) for part in parts if len(part)])
    askew = np.ptp(faces, axis=0).max() if len(faces) else 0.0
    return float(price + 30.0 * max(askew - 0.003, 0.0))


def collision_cost(voxels: Voxels, near: np.ndarray, grasp: Grasp) -> float:
    """What it costs that others are in the hand's way, at the hold and before it."""
    crowd = crowding(near, grasp.pos_world, grasp.mat)
    below = max(voxels.floor - float((grasp.pos_world + HAND @ grasp.mat.T)[:, 2].min()), 0.0)
    price = 20.0 * crowd + 0.3 * (crowd > 0) + 40.0 * below + 0.1 * (below > 0)
    ways = [crowding(near, grasp.pos_world - back * grasp.mat[:, 2], grasp.mat) for back in _BEFORE]
    return price + 5.0 * max(ways) + 0.1 * (max(ways) > 0)
