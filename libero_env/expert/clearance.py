"""Collision checks: voxels of the scene, points on the hand, and the height of obstacles on a path."""

import numpy as np

from libero_env.compilation import compiled
from libero_env.expert.arm import GRIPPER

_CELL, _COARSE_CELL = 0.006, 0.012  # [m] voxels for objects, and for the hand
_WALL_HEIGHT = 0.01  # [m] above a limit, up to which the lowest point of a column is a wall and no overhang
_HALF_SIZE = np.array([0.75, 0.9, 0.5])  # [m] of the space that is covered


class Voxels:
    """Occupied cells of a scene. Everything below the table's surface is occupied.

    Args:
        points: Points on the surfaces of objects and fixtures, (N, 3), [m].
        surface_height: Height of the table, [m].
        centre: Middle of the space that is covered, (3,); only x and y count.
    """

    def __init__(self, points: np.ndarray, surface_height: float, centre: np.ndarray):
        self.points, self.surface_height = points, surface_height
        self._low = np.array([*centre[:2], surface_height + _HALF_SIZE[2] - 0.05]) - _HALF_SIZE
        self._shape = np.ceil(2 * _HALF_SIZE / _CELL).astype(int)
        self._occupied = np.zeros(self._shape, bool)
        cells, inside = self._cells(points)
        self._cells_inside, self._heights_inside = cells[inside], points[inside, 2]
        self._occupied[tuple(self._cells_inside.T)] = True
        self._coarse = np.zeros(self._shape // 2 + 1, bool)
        self._coarse[tuple(self._cells_inside.T // 2)] = True
        self._columns: dict[tuple[np.ufunc, float], np.ndarray] = {}  # results of `_extremes`

    def count_occupied(self, points: np.ndarray) -> np.ndarray:
        """Return how many of the points (..., N, 3) are in occupied cells, (...)."""
        cells, inside = self._cells(points)
        cells = np.where(inside[..., None], cells, 0)
        occupied = self._occupied[cells[..., 0], cells[..., 1], cells[..., 2]] & inside
        return (occupied | (points[..., 2] < self.surface_height)).sum(axis=-1)

    def count_hand_collisions(self, hand: np.ndarray, pos: np.ndarray, mat: np.ndarray) -> np.ndarray:
        """Return how many of a hand's points collide at each of P poses, (P,).

        Args:
            hand: Points on the hand in the frame of the grip site, about 1 cm apart, (N, 3).
            pos: Positions of the grip site, (P, 3).
            mat: Orientations of the grip site, (P, 3, 3).
        """
        low = self._low + np.zeros(3)
        return _count_hand_collisions(
            self._coarse, low, self.surface_height, hand, pos, np.ascontiguousarray(mat)
        )

    def resting_heights(self, profile: np.ndarray, xy: np.ndarray, below: float) -> np.ndarray:
        """Return the heights at which the origin of a body comes to rest over each spot, (S,).

        Args:
            profile: Points of the body's underside relative to its origin, (N, 3).
            xy: Spots, (S, 2).
            below: Height above which nothing supports the body, [m].
        """
        heights = self._extremes(np.maximum, below)
        where = xy[:, None] + profile[None, :, :2]  # (S, N, 2)
        cells = np.clip(((where - self._low[:2]) / _CELL).astype(int), 0, self._shape[:2] - 1)
        return (heights[cells[..., 0], cells[..., 1]] - profile[:, 2]).max(axis=1)

    def overhang_overlap(self, profile: np.ndarray, origins: np.ndarray, above: float) -> np.ndarray:
        """Return the share of a body's columns that reach into an overhang, (S,).

        Args:
            profile: Points of the body's upper side relative to its origin, (N, 3).
            origins: Positions of the body's origin, (S, 3).
            above: Height from which on something counts as an overhang, [m].
        """
        where = origins[:, None] + profile
        cells = np.clip(((where[..., :2] - self._low[:2]) / _CELL).astype(int), 0, self._shape[:2] - 1)
        lowest = self._extremes(np.minimum, above)[cells[..., 0], cells[..., 1]]
        hangs = lowest >= above + _WALL_HEIGHT  # else a wall stands there
        return (hangs & (lowest < where[..., 2])).mean(axis=1)

    def is_covered(self, points: np.ndarray) -> np.ndarray:
        """Return which of the points (..., 3) have something above them, (...) bool."""
        cells = np.clip(np.floor((points - self._low) / _CELL).astype(int), 0, self._shape - 1)
        return self._extremes(np.maximum, np.inf)[cells[..., 0], cells[..., 1]] > points[..., 2] + 2 * _CELL

    def _extremes(self, extreme: np.ufunc, limit: float) -> np.ndarray:
        """Return the height of the highest point below a limit, or of the lowest above it, in each column, (X, Y)."""
        if (extreme, limit) not in self._columns:
            above = extreme is np.minimum
            keep = (self._heights_inside >= limit) == above
            heights = np.full(self._shape[:2], np.inf if above else self.surface_height)
            extreme.at(heights, tuple(self._cells_inside[keep, :2].T), self._heights_inside[keep])
            self._columns[extreme, limit] = heights
        return self._columns[extreme, limit]

    def _cells(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the cells of points, and which of the points are inside the space."""
        cells = np.floor((points - self._low) / _CELL).astype(int)
        return cells, ((cells >= 0) & (cells < self._shape)).all(axis=-1)


@compiled
def _count_hand_collisions(
    occupied: np.ndarray,
    low: np.ndarray,
    surface_height: float,
    hand: np.ndarray,
    pos: np.ndarray,
    mat: np.ndarray,
) -> np.ndarray:
    counts = np.zeros(len(pos), np.int64)
    nx, ny, nz = occupied.shape
    for p in range(len(pos)):
        m, o = mat[p], pos[p]
        for i in range(len(hand)):
            a, b, c = hand[i]
            z = o[2] + m[2, 0] * a + m[2, 1] * b + m[2, 2] * c
            if z < surface_height:
                counts[p] += 1
                continue
            x = int(np.floor((o[0] + m[0, 0] * a + m[0, 1] * b + m[0, 2] * c - low[0]) / _COARSE_CELL))
            y = int(np.floor((o[1] + m[1, 0] * a + m[1, 1] * b + m[1, 2] * c - low[1]) / _COARSE_CELL))
            k = int(np.floor((z - low[2]) / _COARSE_CELL))
            if 0 <= x < nx and 0 <= y < ny and 0 <= k < nz and occupied[x, y, k]:
                counts[p] += 1
    return counts


def lower_surface(points: np.ndarray) -> np.ndarray:
    """Return the lowest of the points (N, 3) in each cell of the ground plan, (M, 3)."""
    order = points[np.argsort(points[:, 2])]
    x, y = np.floor(order[:, :2] / _CELL).astype(int).T
    _, first = np.unique((x << 32) + y, return_index=True)  # one number for a cell: far faster than rows
    return order[first]


def upper_surface(points: np.ndarray) -> np.ndarray:
    """Return the highest of the points (N, 3) in each cell of the ground plan, (M, 3)."""
    return lower_surface(points * [1, 1, -1]) * [1, 1, -1]


def hand_points(opening: float = GRIPPER.max_opening) -> np.ndarray:
    """Return points in and on fingers, hand and wrist, in the frame of the grip site, (N, 3), [m].

    Args:
        opening: Distance between the fingers, [m].
    """
    inner, outer = 0.5 * opening, 0.5 * opening + GRIPPER.finger_thickness
    across, along = GRIPPER.finger_half_width, GRIPPER.palm_half_length
    finger = _box_points((inner + 0.002, outer), (-across, across), (-0.044, GRIPPER.tip_below))
    width = GRIPPER.palm_half_width
    blocks = [
        finger,
        finger * [-1, 1, 1],
        _box_points((-along, along), (-width, width), (-0.12, -GRIPPER.palm_above)),
        _box_points((-0.06, 0.06), (-0.06, 0.06), (-0.28, -0.13), 0.03),
    ]
    return np.concatenate(blocks)


def hand_extent_below(mat: np.ndarray) -> float:
    """Return how far fingers and palm of a hand with orientation (3, 3) reach below its grip site, [m]."""
    return float(-(_CORNERS @ mat[2]).min())


def obstacle_height(
    points: np.ndarray, start: np.ndarray, goal: np.ndarray, radius: float, default: float
) -> float:
    """Return the height of the highest obstacle near the next 10 cm of a straight path over the table, [m].

    Args:
        points: Points on obstacles, (N, 3).
        start: Start of the path; x and y count.
        goal: End of the path; x and y count.
        radius: Distance from the path that counts as near, [m].
        default: Height where there is no obstacle, such as that of the table, [m].
    """
    path = goal[:2] - start[:2]
    path = path * min(1.0, 0.10 / max(float(np.linalg.norm(path)), 1e-9))
    return float(_highest_near(points, start[:2], path, radius, default))


@compiled
def _highest_near(
    points: np.ndarray, start: np.ndarray, path: np.ndarray, radius: float, default: float
) -> float:
    squared = max(path[0] * path[0] + path[1] * path[1], 1e-12)
    highest = default
    for i in range(len(points)):
        x, y = points[i, 0] - start[0], points[i, 1] - start[1]
        along = min(max((x * path[0] + y * path[1]) / squared, 0.0), 1.0)
        x, y = x - along * path[0], y - along * path[1]
        if points[i, 2] > highest and np.sqrt(x * x + y * y) < radius:
            highest = points[i, 2]
    return highest


def overhang(points: np.ndarray, middle: np.ndarray, radius: float, low: float, high: float) -> np.ndarray:
    """Return the points near a spot that hang over it, (M, 3): what also stands below them is a wall.

    Args:
        points: Points on obstacles, (N, 3), [m].
        middle: The spot; x and y count.
        radius: Horizontal distance from the spot that counts as near, [m].
        low: Height below which a column with a point is a wall, [m]; the table is not among the points.
        high: Height up to which something counts, [m].
    """
    aside = points[:, :2] - middle[:2]
    near = (np.abs(aside) < radius + _COARSE_CELL).all(axis=1)
    points, aside = points[near], aside[near]
    if not len(points):
        return points
    _, column = np.unique(np.floor(points[:, :2] / _COARSE_CELL), axis=0, return_inverse=True)
    column = column.ravel()
    lowest = np.full(column.max() + 1, np.inf)
    np.minimum.at(lowest, column, points[:, 2])
    hangs = (lowest[column] > low) & (points[:, 2] < high) & (np.linalg.norm(aside, axis=1) < radius)
    return points[hangs]


def _box_points(x: tuple, y: tuple, z: tuple, spacing: float = _COARSE_CELL) -> np.ndarray:
    """Return points on the surface of a box with these (low, high) coordinates, (N, 3)."""
    axes = [np.linspace(a, b, max(2, int(np.ceil((b - a) / spacing)) + 1)) for a, b in (x, y, z)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    low, high = np.array([x, y, z], float).T
    return points[(np.isclose(points, low) | np.isclose(points, high)).any(axis=1)]


_CORNERS = np.array(  # of fingers and palm in the frame of the grip site, (8, 3), [m]
    [
        (x, y, z)
        for half, width, z in (
            (GRIPPER.half_opening + GRIPPER.finger_thickness, GRIPPER.finger_half_width, GRIPPER.tip_below),
            (GRIPPER.palm_half_length, GRIPPER.palm_half_width, -GRIPPER.palm_above),
        )
        for x in (-half, half)
        for y in (-width, width)
    ]
)
