"""Where to take hold of something: a top-down grasp chosen from the shape of the body alone."""

from dataclasses import dataclass

import numpy as np

from libero_env.errors import LiberoError

# The Panda gripper, measured from the grip site along the fingers, m.
MAX_OPENING = 0.08
WIDEST = 0.072  # what still goes between the fingers with room to spare
PAD_BELOW, PAD_ABOVE = 0.004, 0.012  # the pads reach from below to above the site
TIP_BELOW = 0.0105  # the finger tips reach that far below it
PALM_ABOVE = 0.0285  # and the palm begins there, with a little room
FINGER_HALF_WIDTH = 0.011
FINGER_THICKNESS = 0.022
HAND_HALF_LENGTH, HAND_HALF_WIDTH = 0.105, 0.035  # of the palm, along and across the direction of the fingers
_YAWS = 24
_HEIGHTS = 7


class GraspError(LiberoError):
    """Nothing of a body fits between the fingers; the message says what was tried."""


@dataclass(frozen=True)
class Grasp:
    """The fingers close along `yaw` (rad, from the world's x axis, modulo pi) around `pos_world` (3,), m."""

    pos_world: np.ndarray
    yaw: float
    width: float  # m between the fingers


def choose_grasp(
    cloud: np.ndarray, obstacles: np.ndarray, floor: float, finger_axis: np.ndarray, name: str = "body"
) -> Grasp:
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
    bottom, top = cloud[:, 2].min(), cloud[:, 2].max()
    lowest = max(floor + TIP_BELOW + 0.002, top - PALM_ABOVE)
    heights = np.linspace(lowest, max(lowest, top - 0.006), _HEIGHTS)
    now = np.arctan2(finger_axis[1], finger_axis[0])
    best: tuple[float, Grasp] | None = None
    narrowest = np.inf
    for yaw in now + np.pi * np.arange(_YAWS) / _YAWS:
        along, across = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
        turn = abs((yaw - now + np.pi / 2) % np.pi - np.pi / 2)
        for height in heights:
            held = _between(cloud, height, along, across)
            if held is None:
                continue
            center, width = held
            narrowest = min(narrowest, width)
            if width > WIDEST:
                continue
            crowd = _crowding(obstacles, center, height, along, across, width)
            cost = 0.25 * turn + 8.0 * width + 4.0 * abs(height - 0.5 * (bottom + top)) + 20.0 * crowd
            if best is None or cost < best[0] - 1e-9:
                best = cost, Grasp(np.array([*center, height]), float(yaw), float(width))
    if best is None:
        raise GraspError(
            f"{name} cannot be grasped from above: its narrowest part is {100 * narrowest:.1f} cm wide, "
            f"the gripper opens {100 * MAX_OPENING:.0f} cm and takes {100 * WIDEST:.1f} cm"
        )
    return best[1]


def _between(
    cloud: np.ndarray, height: float, along: np.ndarray, across: np.ndarray
) -> tuple[np.ndarray, float] | None:
    """Centre (2,) and width of what the pads would enclose at a height, or None where there is nothing."""
    slab = cloud[(cloud[:, 2] > height - PAD_BELOW) & (cloud[:, 2] < height + PAD_ABOVE), :2]
    if len(slab) < 4:
        return None
    v = slab @ across
    middle = 0.5 * (v.min() + v.max())
    strip = slab[np.abs(v - middle) < FINGER_HALF_WIDTH]
    if len(strip) < 2:
        return None
    u = strip @ along
    return 0.5 * (u.min() + u.max()) * along + middle * across, float(u.max() - u.min())


def _crowding(
    obstacles: np.ndarray, center: np.ndarray, height: float, along: np.ndarray, across: np.ndarray, width: float
) -> float:
    """How deep obstacles reach into the open fingers and the palm, m; 0 where the way is free."""
    if not len(obstacles):
        return 0.0
    offset = obstacles[:, :2] - center
    u, v, z = np.abs(offset @ along), np.abs(offset @ across), obstacles[:, 2] - height
    outer = 0.5 * MAX_OPENING + FINGER_THICKNESS
    fingers = (z > -TIP_BELOW) & (v < FINGER_HALF_WIDTH + 0.005)
    palm = (z > PALM_ABOVE - 0.01) & (v < HAND_HALF_WIDTH)
    depth = np.maximum(np.where(fingers, outer - u, 0.0), np.where(palm, HAND_HALF_LENGTH - u, 0.0))
    return float(max(depth.max(), 0.0))
