"""Where to take hold of something from straight above: chosen from the shape of the body alone."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from libero_env.expert.arm.gripper import (
    FINGER_HALF_WIDTH,
    FINGER_THICKNESS,
    HAND_HALF_LENGTH,
    HAND_HALF_WIDTH,
    MAX_OPENING,
    PAD_ABOVE,
    PAD_BELOW,
    PALM_ABOVE,
    TIP_BELOW,
    WIDEST,
)
from libero_env.expert.grasping.grasps import GraspError, aligned_yaws, turn_between, whole_holds

_YAWS = 18
_HEIGHTS = 4


@dataclass(frozen=True)
class TopGrasp:
    """The fingers close along `yaw` (rad, from the world's x axis, modulo pi) around `pos_world` (3,), m."""

    pos_world: np.ndarray
    yaw: float
    width: float  # m between the fingers


def choose_top_grasp(
    cloud: np.ndarray, obstacles: np.ndarray, floor: float, finger_axis: np.ndarray, name: str = "body"
) -> TopGrasp:
    """The best top-down grasp; the same input gives the same grasp.

    Feasible is what fits between the open fingers, is not too low for the finger tips nor too high for the palm, and
    keeps fingers and palm out of the obstacles. Among those the choice is for little turning of the hand, a narrow
    hold (a wide one forgives no error), and a height near the middle of the body.

    Args:
        cloud: points on the body, world frame, (N, 3).
        obstacles: points on everything else, world frame, (M, 3).
        floor: height of what the body stands on, m.
        finger_axis: direction in which the fingers open now, world frame, (3,).
        name: for messages.

    Raises:
        GraspError: no grasp is feasible.
    """
    now = np.arctan2(finger_axis[1], finger_axis[0])
    candidates = sorted(_candidates(cloud, floor, now), key=lambda candidate: candidate[0])
    best: tuple[float, TopGrasp] | None = None
    for cost, grasp in candidates:
        if grasp.width > WIDEST:
            continue
        if best is not None and cost >= best[0]:
            break
        crowd = _crowding(obstacles, grasp)
        cost += 20.0 * crowd + 0.3 * (crowd > 0)
        if best is None or cost < best[0]:
            best = cost, grasp
    if best is None:
        narrowest = min((grasp.width for _, grasp in candidates), default=np.inf)
        raise GraspError(
            f"{name} cannot be grasped from above: its narrowest part is {100 * narrowest:.1f} cm wide, "
            f"the gripper opens {100 * MAX_OPENING:.0f} cm and takes {100 * WIDEST:.1f} cm"
        )
    return best[1]


def _candidates(cloud: np.ndarray, floor: float, now: float) -> Iterator[tuple[float, TopGrasp]]:
    """(cost, grasp) of all holds within reach of fingers and palm, obstacles not yet considered."""
    bottom, top = cloud[:, 2].min(), cloud[:, 2].max()
    lowest = max(floor + TIP_BELOW + 0.004, top - PALM_ABOVE)
    for height in np.linspace(lowest, max(lowest, top - 0.006), _HEIGHTS):
        slab = cloud[(cloud[:, 2] > height - PAD_BELOW) & (cloud[:, 2] < height + PAD_ABOVE), :2]
        slab = np.unique(np.round(slab, 3), axis=0)
        if len(slab) < 4:
            continue
        aligned = aligned_yaws(slab, now)
        away_from_middle = abs(height - 0.5 * (bottom + top))
        for yaw in aligned + [now + np.pi * k / _YAWS for k in range(_YAWS)]:
            askew = min((turn_between(yaw, other) for other in aligned), default=0.0)
            for x, y, width, shift in whole_holds(slab, yaw):
                cost = (
                    0.25 * turn_between(yaw, now)
                    + 8.0 * width
                    + 4.0 * away_from_middle
                    + 3.0 * shift
                    + 0.4 * askew
                )
                yield cost, TopGrasp(np.array([x, y, height]), float(yaw), width)


def _crowding(obstacles: np.ndarray, grasp: TopGrasp) -> float:
    """How deep obstacles reach into the open fingers and the palm, m; 0 where the way is free."""
    if not len(obstacles):
        return 0.0
    c, s = np.cos(grasp.yaw), np.sin(grasp.yaw)
    along, across = np.array([c, s]), np.array([-s, c])
    offset = obstacles - grasp.pos_world
    u, v, z = np.abs(offset[:, :2] @ along), np.abs(offset[:, :2] @ across), offset[:, 2]
    outer = 0.5 * MAX_OPENING + FINGER_THICKNESS + 0.003
    fingers = (z > -TIP_BELOW) & (v < FINGER_HALF_WIDTH + 0.005)
    palm = (z > PALM_ABOVE - 0.01) & (v < HAND_HALF_WIDTH)
    depth = np.maximum(np.where(fingers, outer - u, 0.0), np.where(palm, HAND_HALF_LENGTH - u, 0.0))
    return float(max(depth.max(), 0.0))
