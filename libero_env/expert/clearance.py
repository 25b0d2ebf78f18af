"""What is in the way: voxels of the scene, the volume of the hand, and how high things reach."""

import numpy as np
from numba import njit

from libero_env.expert.arm.gripper import (
    FINGER_HALF_WIDTH,
    FINGER_THICKNESS,
    HAND_HALF_LENGTH,
    HAND_HALF_WIDTH,
    MAX_OPENING,
    PALM_ABOVE,
    TIP_BELOW,
)

_CELL, _COARSE = 0.006, 0.012  # m, for what stands close to others, and for the hand
_WALL = 0.01  # m, between points of what stands and does not hang
_HALF = np.array([0.75, 0.9, 0.5])  # m, of the space that is looked at


class Voxels:
    """Occupied cells, from points on surfaces; below the floor everything is occupied."""

    def __init__(self, points: np.ndarray, floor: float, centre: np.ndarray):
        self.points, self.floor = points, floor
        self._low = np.array([*centre[:2], floor + _HALF[2] - 0.05]) - _HALF
        self._shape = np.ceil(2 * _HALF / _CELL).astype(int)
        self._full = np.zeros(self._shape, bool)
        cells, inside = self._cells(points)
        self._full[tuple(cells[inside].T)] = True
        self._coarse = np.zeros(self._shape // 2 + 1, bool)
        self._coarse[tuple(cells[inside].T // 2)] = True
        self._tops: dict[float, np.ndarray] = {}  # heights by what lies below
        self._roofs: dict[float, np.ndarray] = {}  # and by what lies above

    def hits(self, points: np.ndarray) -> np.ndarray:
        """How many of the points (..., N, 3) lie in something, (...)."""
        cells, inside = self._cells(points)
        cells = np.where(inside[..., None], cells, 0)
        full = self._full[cells[..., 0], cells[..., 1], cells[..., 2]] & inside
        return (full | (points[..., 2] < self.floor)).sum(axis=-1)

    def touched(self, hand: np.ndarray, pos: np.ndarray, mat: np.ndarray) -> np.ndarray:
        """How many of a hand's points (N, 3), a centimetre apart, come near something; at P poses, (P,)."""
        low = self._low + np.zeros(3)
        return _touched(self._coarse, low, self.floor, hand, pos, np.ascontiguousarray(mat))

    def drop(self, profile: np.ndarray, xy: np.ndarray, below: float) -> np.ndarray:
        """Height at which a body's origin comes to stand, over each of the spots xy (S, 2); (S,).

        Args:
            profile: points of the underside relative to the origin, (N, 3).
            xy: spots.
            below: only what lies lower than this carries, m.
        """
        heights = self._heights(below)
        where = xy[:, None] + profile[None, :, :2]  # (S, N, 2)
        cells = np.clip(((where - self._low[:2]) / _CELL).astype(int), 0, self._shape[:2] - 1)
        return (heights[cells[..., 0], cells[..., 1]] - profile[:, 2]).max(axis=1)

    def overhead(self, profile: np.ndarray, origins: np.ndarray, above: float) -> np.ndarray:
        """Share of a body's columns that reach into what hangs over them, for origins (S, 3); (S,).

        Args:
            profile: points of the upper side relative to the origin, (N, 3).
            origins: where the body's origin is.
            above: what lies higher than this hangs, m.
        """
        if above not in self._roofs:
            cells, inside = self._cells(self.points)
            keep = inside & (self.points[:, 2] >= above)
            heights = np.full(self._shape[:2], np.inf)
            np.minimum.at(heights, (cells[keep, 0], cells[keep, 1]), self.points[keep, 2])
            heights[heights < above + _WALL] = np.inf  # a wall that stands there
            self._roofs[above] = heights
        where = origins[:, None] + profile
        cells = np.clip(((where[..., :2] - self._low[:2]) / _CELL).astype(int), 0, self._shape[:2] - 1)
        return (self._roofs[above][cells[..., 0], cells[..., 1]] < where[..., 2]).mean(axis=1)

    def roofed(self, points: np.ndarray) -> np.ndarray:
        """Which of the points (..., 3) have something over them, (...) bool."""
        cells = np.clip(np.floor((points - self._low) / _CELL).astype(int), 0, self._shape - 1)
        return self._heights(np.inf)[cells[..., 0], cells[..., 1]] > points[..., 2] + 2 * _CELL

    def _heights(self, below: float) -> np.ndarray:
        if below not in self._tops:
            cells, inside = self._cells(self.points)
            keep = inside & (self.points[:, 2] < below)
            heights = np.full(self._shape[:2], self.floor)
            np.maximum.at(heights, (cells[keep, 0], cells[keep, 1]), self.points[keep, 2])
            self._tops[below] = heights
        return self._tops[below]

    def _cells(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        cells = np.floor((points - self._low) / _CELL).astype(int)
        return cells, ((cells >= 0) & (cells < self._shape)).all(axis=-1)


@njit(cache=True, nogil=True)
def _touched(
    full: np.ndarray, low: np.ndarray, floor: float, points: np.ndarray, pos: np.ndarray, mat: np.ndarray
) -> np.ndarray:
    found = np.zeros(len(pos), np.int64)
    nx, ny, nz = full.shape
    for p in range(len(pos)):
        m, o = mat[p], pos[p]
        for i in range(len(points)):
            a, b, c = points[i]
            z = o[2] + m[2, 0] * a + m[2, 1] * b + m[2, 2] * c
            if z < floor:
                found[p] += 1
                continue
            x = int(np.floor((o[0] + m[0, 0] * a + m[0, 1] * b + m[0, 2] * c - low[0]) / _COARSE))
            y = int(np.floor((o[1] + m[1, 0] * a + m[1, 1] * b + m[1, 2] * c - low[1]) / _COARSE))
            k = int(np.floor((z - low[2]) / _COARSE))
            if 0 <= x < nx and 0 <= y < ny and 0 <= k < nz and full[x, y, k]:
                found[p] += 1
    return found


def underside(points: np.ndarray) -> np.ndarray:
    """The lowest point in each cell of the ground plan; (N, 3) -> (M, 3)."""
    order = points[np.argsort(points[:, 2])]
    x, y = np.floor(order[:, :2] / _CELL).astype(int).T
    _, first = np.unique((x << 32) + y, return_index=True)  # one number for a cell: far faster than rows
    return order[first]


def upper_side(points: np.ndarray) -> np.ndarray:
    """The highest point in each cell of the ground plan; (N, 3) -> (M, 3)."""
    return underside(points * [1, 1, -1]) * [1, 1, -1]


def hand_points(opening: float = MAX_OPENING) -> np.ndarray:
    """Points in and on fingers, hand and wrist, in the frame of the grip site, (N, 3), m."""
    inner, outer = 0.5 * opening, 0.5 * opening + FINGER_THICKNESS
    finger = _block((inner + 0.002, outer), (-FINGER_HALF_WIDTH, FINGER_HALF_WIDTH), (-0.044, TIP_BELOW))
    blocks = [
        finger,
        finger * [-1, 1, 1],
        _block(
            (-HAND_HALF_LENGTH, HAND_HALF_LENGTH), (-HAND_HALF_WIDTH, HAND_HALF_WIDTH), (-0.12, -PALM_ABOVE)
        ),
        _block((-0.06, 0.06), (-0.06, 0.06), (-0.28, -0.13), 0.03),
    ]
    return np.concatenate(blocks)


def lowest(mat: np.ndarray) -> float:
    """How far fingers and palm of a hand turned by (3, 3) reach below its grip site, m."""
    return float(-(_CORNERS @ mat[2]).min())


def _block(x: tuple, y: tuple, z: tuple, spacing: float = _COARSE) -> np.ndarray:
    axes = [np.linspace(a, b, max(2, int(np.ceil((b - a) / spacing)) + 1)) for a, b in (x, y, z)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    low, high = np.array([x, y, z], float).T
    return points[(np.isclose(points, low) | np.isclose(points, high)).any(axis=1)]


def obstacle_height(
    points: np.ndarray, start: np.ndarray, goal: np.ndarray, radius: float, floor: float
) -> float:
    """Height of the highest point near the next decimetre of the straight way over the ground, m."""
    way = goal[:2] - start[:2]
    way = way * min(1.0, 0.10 / max(float(np.linalg.norm(way)), 1e-9))
    along = np.clip((points[:, :2] - start[:2]) @ way / max(way @ way, 1e-12), 0.0, 1.0)
    near = np.linalg.norm(points[:, :2] - start[:2] - along[:, None] * way, axis=1) < radius
    return float(points[near, 2].max(initial=floor))


_CORNERS = np.array(
    [
        (x, y, z)
        for half, width, z in (
            (0.5 * MAX_OPENING + FINGER_THICKNESS, FINGER_HALF_WIDTH, TIP_BELOW),
            (HAND_HALF_LENGTH, HAND_HALF_WIDTH, -PALM_ABOVE),
        )
        for x in (-half, half)
        for y in (-width, width)
    ]
)  # of fingers and palm, in the frame of the grip site, m
