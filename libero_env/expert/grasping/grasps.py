"""Where to take hold of something: around it, or by a wall that leaves room for a finger on either side."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from libero_env.errors import LiberoError
from libero_env.expert.arm.gripper import (
    FINGER_HALF_WIDTH,
    FINGER_THICKNESS,
    HAND_HALF_LENGTH,
    HAND_HALF_WIDTH,
    HAND_LENGTH,
    MAX_OPENING,
    PAD_ABOVE,
    PAD_BELOW,
    PALM_ABOVE,
    TIP_BELOW,
    WIDEST,
)
from libero_env.expert.arm.servo import downward
from libero_env.expert.grasping import kernels as hold_kernels

_YAWS = 18
_HEIGHTS = 4
_SHIFTS = (0.0, 0.01, -0.01, 0.02, -0.02, 0.03, -0.03, 0.045, -0.045)  # of the hold along the jaws, m
WALL = 0.5  # cost of a hold by a wall, over one around the whole body
_WALL_STEP = 0.012  # m between such holds
_LEAST = 0.005  # m, that a wall must reach up between the pads
_STEEPEST = 0.4  # slope of the faces against the pads
_SLANT = 0.0025  # m, that a face may give way over the pads
_THICKEST = 0.045  # m, of a wall
_TIP, _WIDENS = 0.0145, 0.41  # m, thickness of a finger at its tip, and how much more of it each m further up
_TIP_THICKNESS = 0.021  # m, of a finger, on average over what is beside it in a wall hold
_SPARE = 0.006  # m, kept between an open finger and the body when the hand is moved to one side


class GraspError(LiberoError):
    """Nothing of a body fits between the fingers; the message says what was tried."""


@dataclass(frozen=True)
class Grasp:
    """The hand at `pos_world` (3,), m, turned by `mat` (3, 3), closes on something `width` m thick."""

    pos_world: np.ndarray
    mat: np.ndarray
    width: float  # m between the fingers
    cost: float  # of the hold alone

    @property
    def yaw(self) -> float:
        """Direction in which the fingers close over the ground, rad from the world's x axis, modulo pi."""
        return float(np.arctan2(self.mat[1, 0], self.mat[0, 0]))


def grasps(
    cloud: np.ndarray, floor: float, finger_axis: np.ndarray, *, tilt: np.ndarray | None = None, name: str = "body",
    number: int = 10_000, apart: float = 0.0,
) -> list[Grasp]:  # fmt: skip
    """All holds from one side, the best first; the same input gives the same list.

    Feasible is what fits between the open fingers, is not too low for the finger tips nor too high for the palm. The
    order prefers little turning of the hand, a narrow hold (a wide one forgives no error), and a height near the
    middle of the body. Walls, such as the rim of a bowl, come after holds around the whole body.

    Args:
        cloud: points on the body, world frame, (N, 3).
        floor: height of what the body stands on, m.
        finger_axis: direction in which the fingers open now, world frame, (3,).
        tilt: rotation (3, 3) from straight down to the direction of the approach; None for straight down.
        name: for messages.
        number: at most so many.
        apart: m, of holds that count as unlike each other; 0 for all.

    Raises:
        GraspError: nothing is narrow enough.
    """
    turn = np.eye(3) if tilt is None else tilt
    points = cloud @ turn
    axis = finger_axis @ turn
    now = float(np.arctan2(axis[1], axis[0]))
    candidates = list(
        _candidates(points, floor if tilt is None else -np.inf, now, _YAWS if tilt is None else 8)
    )
    narrow = sorted((c for c in candidates if c[3] <= WIDEST), key=lambda candidate: candidate[0])
    if not narrow:
        narrowest = min((c[3] for c in candidates), default=np.inf)
        raise GraspError(
            f"{name} cannot be grasped from above: its narrowest part is {100 * narrowest:.1f} cm wide, "
            f"the gripper opens {100 * MAX_OPENING:.0f} cm and takes {100 * WIDEST:.1f} cm"
        )
    kept: dict[tuple, Grasp] = {}
    for cost, pos, yaw, width in narrow:
        key = (*np.round(pos / apart).astype(int), round(yaw / 0.35)) if apart else (len(kept),)
        if key not in kept and (tilt is None or _faced(points, pos, yaw)):
            kept[key] = Grasp(turn @ pos, turn @ downward(yaw, axis), width, cost)
        if len(kept) == number:
            break
    if not kept:
        raise GraspError(f"{name} has no faces that the pads meet squarely from this side")
    return list(kept.values())


def _faced(points: np.ndarray, pos: np.ndarray, yaw: float) -> bool:
    """Whether the pads meet faces on both sides that stand along the approach, and not slanted ones."""
    return hold_kernels.faces_reach_up(
        points,
        pos,
        np.cos(yaw),
        np.sin(yaw),
        FINGER_HALF_WIDTH,
        PAD_ABOVE,
        MAX_OPENING,
        _SLANT,
        0.6 * PAD_ABOVE,
    )


def choose_grasp(
    cloud: np.ndarray, obstacles: np.ndarray, floor: float, finger_axis: np.ndarray, name: str = "body"
) -> Grasp:
    """The best hold from straight above that keeps fingers and palm out of the obstacles (M, 3); else as `grasps`.

    Raises:
        GraspError: nothing is narrow enough.
    """
    best: tuple[float, Grasp] | None = None
    for grasp in grasps(cloud, floor, finger_axis, name=name):
        if best is not None and grasp.cost >= best[0]:
            break
        crowd = crowding(obstacles, grasp.pos_world, grasp.mat)
        cost = grasp.cost + 20.0 * crowd + 0.3 * (crowd > 0)
        if best is None or cost < best[0]:
            best = cost, grasp
    assert best is not None
    return best[1]


def _candidates(
    cloud: np.ndarray, floor: float, now: float, yaws: int = _YAWS
) -> Iterator[tuple[float, np.ndarray, float, float]]:
    """(cost, position, yaw, width) of all holds within reach of fingers and palm."""
    bottom, top = cloud[:, 2].min(), cloud[:, 2].max()
    lowest = max(floor + TIP_BELOW + 0.004, top - PALM_ABOVE)
    for height in np.linspace(lowest, max(lowest, top - 0.006), _HEIGHTS):
        slab = _slab(cloud, height - PAD_BELOW, height + PAD_ABOVE)
        if len(slab) < 4:
            continue
        aligned = aligned_yaws(slab, now)
        away_from_middle = abs(height - 0.5 * (bottom + top)) + 5.0 * max(0.010 - top + height, 0.0)
        for yaw in aligned + [now + np.pi * k / yaws for k in range(yaws)]:
            askew = min((turn_between(yaw, other) for other in aligned), default=0.0)
            price = 0.25 * turn_between(yaw, now) + 4.0 * away_from_middle + 0.4 * askew
            for x, y, width, shift in whole_holds(slab, yaw):
                yield price + 8.0 * width + 3.0 * shift, np.array([x, y, height]), float(yaw), width
        # what is below the highest point of a cell makes no difference to fingers
        column = hold_kernels.highest_in_cells(cloud[cloud[:, 2] > height - TIP_BELOW], 0.004)
        for yaw in [now + np.pi * k / yaws for k in range(yaws)]:
            price = WALL + 0.25 * turn_between(yaw, now)
            for x, y, width, badness in _walls(slab, column, height, yaw):
                yield price + badness, np.array([x, y, height]), float(yaw), width


def _slab(cloud: np.ndarray, low: float, high: float) -> np.ndarray:
    """Ground plan (N, 2) of what lies between two heights."""
    return np.unique(np.round(cloud[(cloud[:, 2] > low) & (cloud[:, 2] < high), :2], 3), axis=0)


def _walls(slab: np.ndarray, column: np.ndarray, height: float, yaw: float) -> np.ndarray:
    """(x, y, thickness, badness) of walls across the fingers with room for both of them, (K, 4)."""
    return hold_kernels.wall_holds(
        slab, column, height, np.cos(yaw), np.sin(yaw), _WALL_STEP, FINGER_HALF_WIDTH, _THICKEST, _LEAST,
        _STEEPEST, MAX_OPENING, _SPARE, _TIP_THICKNESS,
    )  # fmt: skip


def turn_between(yaw: float, other: float) -> float:
    """Angle between two directions of the fingers, which have no front, rad."""
    return abs((yaw - other + np.pi / 2) % np.pi - np.pi / 2)


def aligned_yaws(slab: np.ndarray, now: float) -> list[float]:
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


def whole_holds(slab: np.ndarray, yaw: float) -> np.ndarray:
    """(x, y, width, distance from the middle) of holds around the whole body at a yaw, (K, 4)."""
    return hold_kernels.whole_holds(
        slab, np.cos(yaw), np.sin(yaw), np.array(_SHIFTS), FINGER_HALF_WIDTH, MAX_OPENING, _SPARE
    )


def _width(slab: np.ndarray, yaw: float) -> float:
    """Width of the hold in the middle, m."""
    return hold_kernels.width_in_the_middle(slab, np.cos(yaw), np.sin(yaw), FINGER_HALF_WIDTH)


def crowding(obstacles: np.ndarray, pos_world: np.ndarray, mat: np.ndarray) -> float:
    """How deep obstacles (M, 3) reach into the open fingers and the palm, m; 0 where the way is free."""
    return hold_kernels.depth_in_hand(
        obstacles, pos_world, mat, TIP_BELOW, _TIP, _WIDENS, FINGER_THICKNESS, 0.5 * MAX_OPENING,
        FINGER_HALF_WIDTH + 0.005, PALM_ABOVE - 0.01, HAND_HALF_WIDTH, HAND_HALF_LENGTH, HAND_LENGTH,
    )  # fmt: skip
