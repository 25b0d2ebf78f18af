"""The grasp from straight above for dropping an object into a container, chosen from the object's shape alone."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from libero_env.expert.arm.gripper import GRIPPER
from libero_env.expert.grasping.grasps import (
    COLLISION_COST,
    DEPTH_COST,
    HEIGHT_COST,
    MISALIGNMENT_COST,
    SHIFT_COST,
    TURN_COST,
    WIDTH_COST,
    aligned_yaws,
    body_grasps,
    cross_section,
    grasp_heights,
    too_wide,
    yaw_distance,
    yaw_grid,
)


@dataclass(frozen=True)
class TopGrasp:
    """Grasp from straight above.

    Attributes:
        pos_world: Position of the grip site, (3,), [m].
        yaw: Direction in which the fingers close, from the world's x axis, modulo pi, [rad].
        width: Width of the body between the fingers, [m].
    """

    pos_world: np.ndarray
    yaw: float
    width: float


def choose_top_grasp(
    cloud: np.ndarray,
    obstacles: np.ndarray,
    surface_height: float,
    finger_axis: np.ndarray,
    name: str = "body",
) -> TopGrasp:
    """Return the best grasp from straight above; the result is deterministic.

    A grasp is feasible where the body fits between the open fingers, and where neither the fingertips hit the surface
    below nor the palm hits the body. Collisions with obstacles are avoided. Preferred are small rotations of the hand,
    narrow grasps (a wide one forgives no error), and heights near the middle of the body.

    Args:
        cloud: Points on the body, world frame, (N, 3).
        obstacles: Points on everything else, world frame, (M, 3).
        surface_height: Height of the surface that the body stands on, [m].
        finger_axis: Direction in which the fingers open now, world frame, (3,).
        name: Name of the body, for messages.

    Raises:
        GraspError: No grasp is feasible.
    """
    yaw_now = np.arctan2(finger_axis[1], finger_axis[0])
    candidates = sorted(_candidates(cloud, surface_height, yaw_now), key=lambda candidate: candidate[0])
    best: tuple[float, TopGrasp] | None = None
    for cost, grasp in candidates:
        if grasp.width > GRIPPER.max_grasp_width:
            continue
        if best is not None and cost >= best[0]:
            break
        depth = _collision_depth(obstacles, grasp)
        cost += DEPTH_COST * depth + COLLISION_COST * (depth > 0)
        if best is None or cost < best[0]:
            best = cost, grasp
    if best is None:
        raise too_wide(name, min((grasp.width for _, grasp in candidates), default=np.inf))
    return best[1]


def _candidates(cloud: np.ndarray, surface_height: float, yaw_now: float) -> Iterator[tuple[float, TopGrasp]]:
    """Yield (cost, grasp) of all grasps whose height suits fingers and palm, without obstacles."""
    bottom, top = cloud[:, 2].min(), cloud[:, 2].max()
    for height in grasp_heights(cloud, surface_height):
        section = cross_section(cloud, height)
        if len(section) < 4:
            continue
        aligned = aligned_yaws(section, yaw_now)
        off_centre = abs(height - 0.5 * (bottom + top))
        for yaw in aligned + yaw_grid(yaw_now):
            turn = yaw_distance(yaw, yaw_now)
            misalignment = min((yaw_distance(yaw, other) for other in aligned), default=0.0)
            for x, y, width, shift in body_grasps(section, yaw):
                cost = TURN_COST * turn + WIDTH_COST * width + HEIGHT_COST * off_centre + SHIFT_COST * shift
                cost += MISALIGNMENT_COST * misalignment
                yield cost, TopGrasp(np.array([x, y, height]), float(yaw), width)


def _collision_depth(obstacles: np.ndarray, grasp: TopGrasp) -> float:
    """Return how deep obstacles reach into the open fingers and the palm, [m]; 0 without a collision."""
    if not len(obstacles):
        return 0.0
    c, s = np.cos(grasp.yaw), np.sin(grasp.yaw)
    along, across = np.array([c, s]), np.array([-s, c])
    offset = obstacles - grasp.pos_world
    u, v, z = np.abs(offset[:, :2] @ along), np.abs(offset[:, :2] @ across), offset[:, 2]
    outer = GRIPPER.half_opening + GRIPPER.finger_thickness + 0.003
    fingers = (z > -GRIPPER.tip_below) & (v < GRIPPER.finger_half_width + 0.005)
    palm = (z > GRIPPER.palm_above - 0.01) & (v < GRIPPER.palm_half_width)
    depth = np.maximum(np.where(fingers, outer - u, 0.0), np.where(palm, GRIPPER.palm_half_length - u, 0.0))
    return float(max(depth.max(), 0.0))
