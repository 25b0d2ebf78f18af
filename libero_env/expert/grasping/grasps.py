"""Grasps from one side, usually from above: around the body, or at a wall with room for a finger on either side."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from libero_env.errors import LiberoError
from libero_env.expert.arm.gripper import GRIPPER
from libero_env.expert.arm.servo import downward
from libero_env.expert.grasping import collision_kernels, kernels

TURN_COST = 0.25  # for each [rad] that the hand rotates
MISALIGNMENT_COST = 0.4  # for each [rad] between the fingers and the sides of the body
WIDTH_COST = 8.0  # for each [m] of width
HEIGHT_COST = 4.0  # for each [m] of height from the middle of the body
SHIFT_COST = 3.0  # for each [m] from the middle of the body in the ground plan
WALL_COST = 0.5  # for a grasp at a wall
DEPTH_COST, COLLISION_COST = 20.0, 0.3  # for each [m] of a collision's depth, and for any collision
_NUM_YAWS, _NUM_TILTED_YAWS = 18, 8  # yaws that are tried, from above and from another side
_NUM_HEIGHTS = 4
_SHIFTS = np.array([0.0, 0.01, -0.01, 0.02, -0.02, 0.03, -0.03, 0.045, -0.045])  # [m] along the pads
_SPARE = 0.006  # [m] between an open finger and the body where the hand is off-centre
_WALL_STEP = 0.012  # [m] between grasps along a wall
_MIN_WALL_OVERLAP = 0.005  # [m] of a wall between the pads
_MAX_WALL_SLOPE = 0.4  # of the faces of a wall against the pads
_MAX_WALL_THICKNESS = 0.045  # [m]
_WALL_FINGER_THICKNESS = 0.021  # [m] of a finger, averaged over the height beside a wall
_FACE_TOLERANCE = 0.0025  # [m] by which a face may recede over the height of the pads


class GraspError(LiberoError):
    """No part of a body fits between the fingers; the message states what was tried."""


@dataclass(frozen=True)
class Grasp:
    """Pose of the grip site at which the fingers close on a body.

    Attributes:
        pos_world: Position of the grip site, (3,), [m].
        mat: Orientation of the grip site, (3, 3).
        width: Width of the body between the fingers, [m].
        cost: Cost of the grasp; lower is better.
    """

    pos_world: np.ndarray
    mat: np.ndarray
    width: float
    cost: float

    @property
    def yaw(self) -> float:
        """Direction in which the fingers close in the ground plan, from the world's x axis, modulo pi, [rad]."""
        return float(np.arctan2(self.mat[1, 0], self.mat[0, 0]))


def find_grasps(
    cloud: np.ndarray,
    surface_height: float,
    finger_axis: np.ndarray,
    *,
    tilt: np.ndarray | None = None,
    name: str = "body",
    max_count: int = 10_000,
    spacing: float = 0.0,
) -> list[Grasp]:
    """Return the feasible grasps from one side, best first; the result is deterministic.

    A grasp is feasible where the body fits between the open fingers, and where neither the fingertips hit the surface
    below nor the palm hits the body. Preferred are small rotations of the hand, narrow grasps (a wide one forgives no
    error), and heights near the middle of the body. Walls come after grasps around the whole body.

    Args:
        cloud: Points on the body, world frame, (N, 3).
        surface_height: Height of the surface that the body stands on, [m].
        finger_axis: Direction in which the fingers open now, world frame, (3,).
        tilt: Rotation (3, 3) from straight down to the direction of the approach; None for straight down.
        name: Name of the body, for messages.
        max_count: Largest number of grasps that is returned.
        spacing: Distance between grasps below which only the best is kept, [m]; 0 keeps all.

    Raises:
        GraspError: No part of the body is narrow enough.
    """
    rotation = np.eye(3) if tilt is None else tilt
    points = cloud @ rotation
    axis = finger_axis @ rotation
    yaw_now = float(np.arctan2(axis[1], axis[0]))
    if tilt is None:
        candidates = list(_candidates(points, surface_height, yaw_now, _NUM_YAWS))
    else:
        candidates = list(_candidates(points, -np.inf, yaw_now, _NUM_TILTED_YAWS))
    feasible = sorted((c for c in candidates if c[3] <= GRIPPER.max_grasp_width), key=lambda c: c[0])
    if not feasible:
        raise too_wide(name, min((c[3] for c in candidates), default=np.inf))
    kept: dict[tuple, Grasp] = {}
    for cost, pos, yaw, width in feasible:
        cell = (*np.round(pos / spacing).astype(int), round(yaw / 0.35)) if spacing else (len(kept),)
        if cell not in kept and (tilt is None or _meets_upright_faces(points, pos, yaw)):
            kept[cell] = Grasp(rotation @ pos, rotation @ downward(yaw, axis), width, cost)
        if len(kept) == max_count:
            break
    if not kept:
        raise GraspError(f"{name} has no faces that the finger pads meet squarely from this side")
    return list(kept.values())


def choose_grasp(
    cloud: np.ndarray,
    obstacles: np.ndarray,
    surface_height: float,
    finger_axis: np.ndarray,
    name: str = "body",
) -> Grasp:
    """Return the best grasp from straight above that keeps fingers and palm out of the obstacles.

    Args:
        cloud: Points on the body, world frame, (N, 3).
        obstacles: Points on everything else, world frame, (M, 3).
        surface_height: Height of the surface that the body stands on, [m].
        finger_axis: Direction in which the fingers open now, world frame, (3,).
        name: Name of the body, for messages.

    Raises:
        GraspError: No part of the body is narrow enough.
    """
    best: tuple[float, Grasp] | None = None
    for grasp in find_grasps(cloud, surface_height, finger_axis, name=name):
        if best is not None and grasp.cost >= best[0]:
            break
        depth = collision_depth(obstacles, grasp.pos_world, grasp.mat)
        cost = grasp.cost + DEPTH_COST * depth + COLLISION_COST * (depth > 0)
        if best is None or cost < best[0]:
            best = cost, grasp
    assert best is not None
    return best[1]


def collision_depth(obstacles: np.ndarray, pos_world: np.ndarray, mat: np.ndarray) -> float:
    """Return how deep obstacles (M, 3) reach into the open fingers and the palm, [m]; 0 without a collision."""
    hand = GRIPPER
    return collision_kernels.open_hand_collision_depth(
        obstacles,
        pos_world,
        mat,
        hand.tip_below,
        hand.tip_thickness,
        hand.finger_taper,
        hand.finger_thickness,
        hand.half_opening,
        hand.finger_half_width + 0.005,
        hand.palm_above - 0.01,
        hand.palm_half_width,
        hand.palm_half_length,
        hand.hand_length,
    )


def too_wide(name: str, width: float) -> GraspError:
    """Return the error for a body whose narrowest part has this width, [m]."""
    return GraspError(
        f"{name} cannot be grasped from above: its narrowest part is {100 * width:.1f} cm wide, "
        f"the gripper opens {100 * GRIPPER.max_opening:.0f} cm and takes {100 * GRIPPER.max_grasp_width:.1f} cm"
    )


def grasp_heights(cloud: np.ndarray, surface_height: float) -> np.ndarray:
    """Return heights of the grip site that suit a body (N, 3): fingertips above the surface, palm above the body."""
    top = cloud[:, 2].max()
    lowest = max(surface_height + GRIPPER.tip_below + 0.004, top - GRIPPER.palm_above)
    return np.linspace(lowest, max(lowest, top - 0.006), _NUM_HEIGHTS)


def cross_section(cloud: np.ndarray, height: float) -> np.ndarray:
    """Return the ground plan (M, 2) of the points (N, 3) that are at the height of the finger pads."""
    low, high = height - GRIPPER.pad_below, height + GRIPPER.pad_above
    return np.unique(np.round(cloud[(cloud[:, 2] > low) & (cloud[:, 2] < high), :2], 3), axis=0)


def yaw_grid(start: float, number: int = _NUM_YAWS) -> list[float]:
    """Return equally spaced yaws over half a turn, [rad]."""
    return [start + np.pi * k / number for k in range(number)]


def yaw_distance(yaw: float, other: float) -> float:
    """Return the angle between two directions of the fingers, which are the same after half a turn, [rad]."""
    return abs((yaw - other + np.pi / 2) % np.pi - np.pi / 2)


def aligned_yaws(section: np.ndarray, start: float) -> list[float]:
    """Return yaws at which the fingers meet a cross-section (N, 2) squarely: local minima of its width."""
    grid = np.pi * np.arange(_NUM_YAWS) / _NUM_YAWS
    widths = np.array([_central_width(section, start + yaw) for yaw in grid])
    neighbours = np.stack([np.roll(widths, k) for k in (-3, -2, -1, 1, 2, 3)]).min(axis=0)
    yaws = []
    for yaw in grid[widths <= neighbours + 1e-3]:
        fine = start + yaw + np.pi / _NUM_YAWS * np.linspace(-1, 1, 9)
        fine_widths = np.array([_central_width(section, angle) for angle in fine])
        # of equally narrow ones the one in the middle, which is no rotation at all for a round body
        yaws.append(float(np.mean(fine[fine_widths <= fine_widths.min() + 2e-4])))
    return yaws


def body_grasps(section: np.ndarray, yaw: float) -> np.ndarray:
    """Return rows (x, y, width, distance from the middle) of grasps around the whole body at a yaw, (K, 4)."""
    return kernels.body_grasps(
        section, np.cos(yaw), np.sin(yaw), _SHIFTS, GRIPPER.finger_half_width, GRIPPER.max_opening, _SPARE
    )


def _candidates(
    cloud: np.ndarray, surface_height: float, yaw_now: float, num_yaws: int
) -> Iterator[tuple[float, np.ndarray, float, float]]:
    """Yield (cost, position, yaw, width) of all grasps whose height suits fingers and palm."""
    bottom, top = cloud[:, 2].min(), cloud[:, 2].max()
    for height in grasp_heights(cloud, surface_height):
        section = cross_section(cloud, height)
        if len(section) < 4:
            continue
        aligned = aligned_yaws(section, yaw_now)
        off_centre = abs(height - 0.5 * (bottom + top)) + 5.0 * max(0.010 - top + height, 0.0)
        for yaw in aligned + yaw_grid(yaw_now, num_yaws):
            misalignment = min((yaw_distance(yaw, other) for other in aligned), default=0.0)
            turn = yaw_distance(yaw, yaw_now)
            cost = TURN_COST * turn + HEIGHT_COST * off_centre + MISALIGNMENT_COST * misalignment
            for x, y, width, shift in body_grasps(section, yaw):
                yield (
                    cost + WIDTH_COST * width + SHIFT_COST * shift,
                    np.array([x, y, height]),
                    float(yaw),
                    width,
                )
        # what is below the highest point of a cell makes no difference to fingers
        column = kernels.highest_per_cell(cloud[cloud[:, 2] > height - GRIPPER.tip_below], 0.004)
        for yaw in yaw_grid(yaw_now, num_yaws):
            cost = WALL_COST + TURN_COST * yaw_distance(yaw, yaw_now)
            for x, y, width, wall_cost in _wall_grasps(section, column, height, yaw):
                yield cost + wall_cost, np.array([x, y, height]), float(yaw), width


def _wall_grasps(section: np.ndarray, column: np.ndarray, height: float, yaw: float) -> np.ndarray:
    """Return rows (x, y, thickness, cost) of grasps at walls across the fingers, (K, 4)."""
    return kernels.wall_grasps(
        section,
        column,
        height,
        np.cos(yaw),
        np.sin(yaw),
        _WALL_STEP,
        GRIPPER.finger_half_width,
        _MAX_WALL_THICKNESS,
        _MIN_WALL_OVERLAP,
        _MAX_WALL_SLOPE,
        GRIPPER.max_opening,
        _SPARE,
        _WALL_FINGER_THICKNESS,
    )


def _central_width(section: np.ndarray, yaw: float) -> float:
    """Return the width between the fingers in the middle of a cross-section, [m]."""
    return kernels.central_width(section, np.cos(yaw), np.sin(yaw), GRIPPER.finger_half_width)


def _meets_upright_faces(points: np.ndarray, pos: np.ndarray, yaw: float) -> bool:
    """Return whether both pads meet faces that stand along the approach, and not slanted ones."""
    return kernels.pads_meet_upright_faces(
        points,
        pos,
        np.cos(yaw),
        np.sin(yaw),
        GRIPPER.finger_half_width,
        GRIPPER.pad_above,
        GRIPPER.max_opening,
        _FACE_TOLERANCE,
        0.6 * GRIPPER.pad_above,
    )
