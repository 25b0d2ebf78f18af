"""Where to take hold of something from straight above: chosen from the shape of the body alone."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from libero_env.expert.grasp import (
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
    GraspError,
)

_YAWS = 18
_HEIGHTS = 4
_SHIFTS = (0.0, 0.01, -0.01, 0.02, -0.02, 0.03, -0.03)  # of the hold along the jaws, m
_SPARE = 0.006  # m, kept between an open finger and the body when the hand is moved to one side


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
        aligned = _aligned_yaws(slab, now)
        away_from_middle = abs(height - 0.5 * (bottom + top))
        for yaw in aligned + [now + np.pi * k / _YAWS for k in range(_YAWS)]:
            askew = min((_turn(yaw, other) for other in aligned), default=0.0)
            for center, width, shift in _holds(slab, yaw):
                cost = (
                    0.25 * _turn(yaw, now) + 8.0 * width + 4.0 * away_from_middle + 3.0 * shift + 0.4 * askew
                )
                yield cost, TopGrasp(np.array([*center, height]), float(yaw), width)


def _turn(yaw: float, other: float) -> float:
    """Angle between two directions of the fingers, which have no front, rad."""
    return abs((yaw - other + np.pi / 2) % np.pi - np.pi / 2)


def _aligned_yaws(slab: np.ndarray, now: float) -> list[float]:
    """Yaws at which the fingers meet a cross-section (N, 2) squarely: where it is narrowest among the yaws nearby."""
    grid = np.pi * np.arange(_YAWS) / _YAWS
    width = np.array([_width(slab, now + yaw) for yaw in grid])
    near = np.stack([np.roll(width, k) for k in (-3, -2, -1, 1, 2, 3)]).min(axis=0)
    yaws = []
    for yaw in grid[width <= near + 1e-3]:
        fine = now + yaw + np.pi / _YAWS * np.linspace(-1, 1, 9)
        widths = np.array([_width(slab, angle) for angle in fine])
        # of equally narrow ones the one in the middle, which is no turn at all for a round body
        yaws.append(float(np.mean(fine[widths <= widths.min() + 2e-4])))
    return yaws


def _axes(yaw: float) -> tuple[np.ndarray, np.ndarray]:
    """Horizontal directions along and across the opening of the fingers, (2,) each."""
    return np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])


def _holds(slab: np.ndarray, yaw: float) -> Iterator[tuple[np.ndarray, float, float]]:
    """(centre (2,), width, distance from the middle) of holds at a yaw: along the jaws' length and, within what the
    open fingers leave free, to either side."""
    along, across = _axes(yaw)
    u, v = slab @ along, slab @ across
    low, high = v.min(), v.max()
    for shift in _SHIFTS:
        middle = 0.5 * (low + high) + shift
        strip = u[np.abs(v - middle) < FINGER_HALF_WIDTH]
        if len(strip) < 2 or shift and not low + 0.008 < middle < high - 0.008:
            continue
        width = float(strip.max() - strip.min())
        center = 0.5 * (strip.min() + strip.max()) * along + middle * across
        side = max(0.5 * (MAX_OPENING - width) - _SPARE, 0.0)
        for aside in (0.0, side, -side):
            yield center + aside * along, width, abs(shift) + abs(aside)


def _width(slab: np.ndarray, yaw: float) -> float:
    """Width of the hold in the middle, m."""
    along, across = _axes(yaw)
    v = slab @ across
    strip = slab[np.abs(v - 0.5 * (v.min() + v.max())) < FINGER_HALF_WIDTH] @ along
    return float(np.ptp(strip)) if len(strip) else 0.0


def _crowding(obstacles: np.ndarray, grasp: TopGrasp) -> float:
    """How deep obstacles reach into the open fingers and the palm, m; 0 where the way is free."""
    if not len(obstacles):
        return 0.0
    along, across = _axes(grasp.yaw)
    offset = obstacles - grasp.pos_world
    u, v, z = np.abs(offset[:, :2] @ along), np.abs(offset[:, :2] @ across), offset[:, 2]
    outer = 0.5 * MAX_OPENING + FINGER_THICKNESS + 0.003
    fingers = (z > -TIP_BELOW) & (v < FINGER_HALF_WIDTH + 0.005)
    palm = (z > PALM_ABOVE - 0.01) & (v < HAND_HALF_WIDTH)
    depth = np.maximum(np.where(fingers, outer - u, 0.0), np.where(palm, HAND_HALF_LENGTH - u, 0.0))
    return float(max(depth.max(), 0.0))
