"""What is in the way: voxels of the scene, the volume of the hand, and how high things reach."""

import numpy as np

from libero_env.expert.grasp import (
    FINGER_HALF_WIDTH,
    FINGER_THICKNESS,
    HAND_HALF_LENGTH,
    HAND_HALF_WIDTH,
    MAX_OPENING,
    PALM_ABOVE,
    TIP_BELOW,
)  # fmt: skip

_CELL, _COARSE = 0.006, 0.012  # m, for what stands close to others, and for the hand
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

    def hits(self, points: np.ndarray) -> np.ndarray:
        """How many of the points (..., N, 3) lie in something, (...)."""
        cells, inside = self._cells(points)
        cells = np.where(inside[..., None], cells, 0)
        full = self._full[cells[..., 0], cells[..., 1], cells[..., 2]] & inside
        return (full | (points[..., 2] < self.floor)).sum(axis=-1)

    def touched(self, points: np.ndarray) -> np.ndarray:
        """How many of the points (..., N, 3), a centimetre apart, come near something, (...)."""
        cells = np.floor((points - self._low) * (1 / _COARSE)).astype(np.int32)
        shape = np.array(self._coarse.shape, np.int32)
        inside = ((cells >= 0) & (cells < shape)).all(axis=-1)
        flat = (cells[..., 0] * shape[1] + cells[..., 1]) * shape[2] + cells[..., 2]
        full = self._coarse.ravel()[np.where(inside, flat, 0)] & inside
        return (full | (points[..., 2] < self.floor)).sum(axis=-1)

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

    def roofed(self, points: np.ndarray) -> np.ndarray:
        """Which of the points (..., 3) have something over them, (...) bool."""
        cells = np.clip(np.floor((points - self._low) / _CELL).astype(int), 0, self._shape - 1)
        return self._heights(np.inf)[cells[..., 0], cells[..., 1]] > points[..., 2] + 2 * _CELL

    def _heights(self, below: float) -> np.ndarray:
        cells, inside = self._cells(self.points)
        keep = inside & (self.points[:, 2] < below)
        heights = np.full(self._shape[:2], self.floor)
        np.maximum.at(heights, (cells[keep, 0], cells[keep, 1]), self.points[keep, 2])
        return heights

    def _cells(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        cells = np.floor((points - self._low) / _CELL).astype(int)
        return cells, ((cells >= 0) & (cells < self._shape)).all(axis=-1)


def underside(points: np.ndarray) -> np.ndarray:
    """The lowest point in each cell of the ground plan; (N, 3) -> (M, 3)."""
    order = points[np.argsort(points[:, 2])]
    _, first = np.unique(np.floor(order[:, :2] / _CELL), axis=0, return_index=True)
    return order[first]


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
