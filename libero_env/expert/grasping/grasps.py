"""Grasps from one side, usually from above: around the body, or at a wall with room for a finger on either side."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from libero_env.errors import LiberoError
from libero_env.expert.arm import GRIPPER, downward
from libero_env.expert.clearance import Voxels, hand_points
from libero_env.expert.grasping import kernels

T = TypeVar("T")

TURN_COST = 0.25  # for each [rad] that the hand rotates
MISALIGNMENT_COST = 0.4  # for each [rad] between the fingers and the sides of the body
WIDTH_COST = 8.0  # for each [m] of width
HEIGHT_COST = 4.0  # for each [m] of height from the middle of the body
SHIFT_COST = 3.0  # for each [m] from the middle of the body in the ground plan
WALL_COST = 0.5  # for a grasp at a wall
DEPTH_COST, COLLISION_COST = 20.0, 0.3  # for each [m] of a collision's depth, and for any collision
_NUM_YAWS, _NUM_TILTED_YAWS = 18, 8  # yaws that are tried, from above and from another side
_NUM_HEIGHTS = 4
# points on the hand, with room beside the fingers, (N, 3), [m]
HAND = hand_points(GRIPPER.max_opening + 0.012)
_FIRM_GRIP = 0.010  # [m] of a body between the pads, along and across them, that make a firm grip
_FACE_TOLERANCE = 0.003  # [m] by which a face may vary over the width of a pad
_APPROACH = (0.04, 0.08, 0.13)  # [m] before a grasp, where the hand must have room too


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
        raise _too_wide(name, min((c[3] for c in candidates), default=np.inf))
    by_cell: dict[tuple, Grasp] = {}
    for cost, pos, yaw, width in feasible:
        cell = (*np.round(pos / spacing).astype(int), round(yaw / 0.35)) if spacing else (len(by_cell),)
        if cell not in by_cell and (
            tilt is None or kernels.pads_meet_upright_faces(points, pos, np.cos(yaw), np.sin(yaw))
        ):
            by_cell[cell] = Grasp(rotation @ pos, rotation @ downward(yaw, axis), width, cost)
        if len(by_cell) == max_count:
            break
    if not by_cell:
        raise GraspError(f"{name} has no faces that the finger pads meet squarely from this side")
    return list(by_cell.values())


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
    candidates = [(grasp.cost, grasp) for grasp in find_grasps(cloud, surface_height, finger_axis, name=name)]
    return _cheapest(
        candidates, lambda grasp: kernels.open_hand_collision_depth(obstacles, grasp.pos_world, grasp.mat)
    )


def _cheapest(candidates: Sequence[tuple[float, T]], depth_of: Callable[[T], float]) -> T:
    """Return the best of candidates with their costs, sorted, after those of a collision of some depth."""
    least, best = np.inf, candidates[0][1]
    for own, candidate in candidates:
        if own >= least:
            break
        depth = depth_of(candidate)
        cost = own + DEPTH_COST * depth + COLLISION_COST * (depth > 0)
        if cost < least:
            least, best = cost, candidate
    return best


def choose_top_grasp(
    cloud: np.ndarray,
    obstacles: np.ndarray,
    surface_height: float,
    finger_axis: np.ndarray,
    name: str = "body",
) -> tuple[np.ndarray, float]:
    """Return the best grasp from straight above around the whole body, for dropping it into a container.

    It depends on the shape of the body alone, and avoids collisions with obstacles; the result is deterministic.
    Arguments as of `choose_grasp`.

    Returns:
        Position of the grip site, (3,), [m], and yaw in which the fingers close, from the world's x axis, modulo pi.

    Raises:
        GraspError: No grasp is feasible.
    """
    yaw_now = np.arctan2(finger_axis[1], finger_axis[0])
    candidates = sorted(_top_candidates(cloud, surface_height, yaw_now), key=lambda candidate: candidate[0])
    feasible = [
        (cost, (pos, yaw)) for cost, pos, yaw, width in candidates if width <= GRIPPER.max_grasp_width
    ]
    if not feasible:
        raise _too_wide(name, min((width for *_, width in candidates), default=np.inf))
    return _cheapest(feasible, lambda grasp: _top_collision_depth(obstacles, *grasp))


def _too_wide(name: str, width: float) -> GraspError:
    """Return the error for a body whose narrowest part has this width, [m]."""
    return GraspError(
        f"{name} cannot be grasped from above: its narrowest part is {100 * width:.1f} cm wide, "
        f"the gripper opens {100 * GRIPPER.max_opening:.0f} cm and takes {100 * GRIPPER.max_grasp_width:.1f} cm"
    )


def _candidates(
    cloud: np.ndarray, surface_height: float, yaw_now: float, num_yaws: int
) -> Iterator[tuple[float, np.ndarray, float, float]]:
    """Yield (cost, position, yaw, width) of all grasps whose height suits fingers and palm."""
    bottom, top = cloud[:, 2].min(), cloud[:, 2].max()
    for height, section in _sections(cloud, surface_height):
        off_centre = abs(height - 0.5 * (bottom + top)) + 5.0 * max(0.010 - top + height, 0.0)
        for yaw, turn, misalignment, rows in _body_grasps(section, yaw_now, num_yaws):
            cost = TURN_COST * turn + HEIGHT_COST * off_centre + MISALIGNMENT_COST * misalignment
            for x, y, width, shift in rows:
                total = cost + WIDTH_COST * width + SHIFT_COST * shift
                yield total, np.array([x, y, height]), yaw, width
        # what is below the highest point of a cell makes no difference to fingers
        column = kernels.highest_per_cell(cloud[cloud[:, 2] > height - GRIPPER.tip_below])
        for yaw in _yaw_grid(yaw_now, num_yaws):
            cost = WALL_COST + TURN_COST * _yaw_distance(yaw, yaw_now)
            rows = kernels.wall_grasps(section, column, height, np.cos(yaw), np.sin(yaw))
            for x, y, width, wall_cost in rows:
                yield cost + wall_cost, np.array([x, y, height]), float(yaw), width


def _top_candidates(
    cloud: np.ndarray, surface_height: float, yaw_now: float
) -> Iterator[tuple[float, np.ndarray, float, float]]:
    """Yield (cost, position, yaw, width) of all grasps around the body whose height suits fingers and palm."""
    bottom, top = cloud[:, 2].min(), cloud[:, 2].max()
    for height, section in _sections(cloud, surface_height):
        off_centre = abs(height - 0.5 * (bottom + top))
        for yaw, turn, misalignment, rows in _body_grasps(section, yaw_now, _NUM_YAWS):
            for x, y, width, shift in rows:  # the order of the sum decides between equally good grasps
                cost = TURN_COST * turn + WIDTH_COST * width + HEIGHT_COST * off_centre + SHIFT_COST * shift
                cost += MISALIGNMENT_COST * misalignment
                yield cost, np.array([x, y, height]), yaw, width


def _sections(cloud: np.ndarray, surface_height: float) -> Iterator[tuple[float, np.ndarray]]:
    """Yield heights of the grip site that suit fingers and palm, with the ground plan (M, 2) between the pads there."""
    top = cloud[:, 2].max()
    lowest = max(surface_height + GRIPPER.tip_below + 0.004, top - GRIPPER.palm_above)
    for height in np.linspace(lowest, max(lowest, top - 0.006), _NUM_HEIGHTS):
        low, high = height - GRIPPER.pad_below, height + GRIPPER.pad_above
        section = np.unique(np.round(cloud[(cloud[:, 2] > low) & (cloud[:, 2] < high), :2], 3), axis=0)
        if len(section) >= 4:
            yield height, section


def _body_grasps(
    section: np.ndarray, yaw_now: float, num_yaws: int
) -> Iterator[tuple[float, float, float, np.ndarray]]:
    """Yield (yaw, rotation of the hand, misalignment, rows of `kernels.body_grasps`) for all yaws that are tried."""
    aligned = _aligned_yaws(section, yaw_now)
    for yaw in aligned + _yaw_grid(yaw_now, num_yaws):
        misalignment = min((_yaw_distance(yaw, other) for other in aligned), default=0.0)
        rows = kernels.body_grasps(section, np.cos(yaw), np.sin(yaw))
        yield float(yaw), _yaw_distance(yaw, yaw_now), misalignment, rows


def _aligned_yaws(section: np.ndarray, start: float) -> list[float]:
    """Return yaws at which the fingers meet a cross-section (N, 2) squarely: local minima of its width."""

    def widths_at(yaws: np.ndarray) -> np.ndarray:
        return np.array([kernels.central_width(section, np.cos(yaw), np.sin(yaw)) for yaw in yaws])

    grid = np.pi * np.arange(_NUM_YAWS) / _NUM_YAWS
    widths = widths_at(start + grid)
    neighbours = np.stack([np.roll(widths, k) for k in (-3, -2, -1, 1, 2, 3)]).min(axis=0)
    aligned = []
    for yaw in grid[widths <= neighbours + 1e-3]:
        fine = start + yaw + np.pi / _NUM_YAWS * np.linspace(-1, 1, 9)
        fine_widths = widths_at(fine)
        # of equally narrow ones the one in the middle, which is no rotation at all for a round body
        aligned.append(float(np.mean(fine[fine_widths <= fine_widths.min() + 2e-4])))
    return aligned


def _yaw_grid(start: float, number: int) -> list[float]:
    """Return equally spaced yaws over half a turn, [rad]."""
    return [start + np.pi * k / number for k in range(number)]


def _yaw_distance(yaw: float, other: float) -> float:
    """Return the angle between two directions of the fingers, which are the same after half a turn, [rad]."""
    return abs((yaw - other + np.pi / 2) % np.pi - np.pi / 2)


def _top_collision_depth(obstacles: np.ndarray, pos: np.ndarray, yaw: float) -> float:
    """Return how deep obstacles reach into the open fingers and the palm, [m]; 0 without a collision."""
    c, s = np.cos(yaw), np.sin(yaw)
    along, across = np.array([c, s]), np.array([-s, c])
    offset = obstacles - pos
    u, v, z = np.abs(offset[:, :2] @ along), np.abs(offset[:, :2] @ across), offset[:, 2]
    outer = GRIPPER.half_opening + GRIPPER.finger_thickness + 0.003
    fingers = (z > -GRIPPER.tip_below) & (v < GRIPPER.finger_half_width + 0.005)
    palm = (z > GRIPPER.palm_above - 0.01) & (v < GRIPPER.palm_half_width)
    depth = np.maximum(np.where(fingers, outer - u, 0.0), np.where(palm, GRIPPER.palm_half_length - u, 0.0))
    return float(depth.max(initial=0.0))


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
    """
    depth = kernels.open_hand_collision_depth(obstacles, grasp.pos_world, grasp.mat)
    lowest = float((grasp.pos_world + HAND @ grasp.mat.T)[:, 2].min())
    below = max(voxels.surface_height - lowest, 0.0)
    cost = DEPTH_COST * depth + COLLISION_COST * (depth > 0) + 40.0 * below + 0.1 * (below > 0)
    depths = [
        kernels.open_hand_collision_depth(obstacles, grasp.pos_world - d * grasp.mat[:, 2], grasp.mat)
        for d in _APPROACH
    ]
    return cost + 5.0 * max(depths) + 0.1 * (max(depths) > 0)


def _between_pads(cloud: np.ndarray, pos: np.ndarray, mat: np.ndarray) -> np.ndarray:
    """Return the points between the pads of open fingers, in the frame of the grip site, (M, 3)."""
    local = (cloud - pos) @ mat
    u, v, depth = local.T
    inside = (np.abs(u) < GRIPPER.half_opening) & (np.abs(v) < GRIPPER.finger_half_width)
    return local[inside & (depth > -GRIPPER.pad_above) & (depth < GRIPPER.pad_below)]
