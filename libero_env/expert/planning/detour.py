"""The way of an object over the table, around what stands there."""

from itertools import product

import numpy as np

from libero_env.sim.predicates import Box

CELL, HALF_SIZE = 0.01, 0.5  # [m] of the grid
CLEARANCE = 0.03  # [m] that is kept where there is room
TOUCHING = 0.008  # [m], below which it counts as touching
NEAR_COST, TOUCH_COST = 2.0, 100.0  # factors on the length of the way there
INSIDE = 0.006  # [m] from the edge of the region at the end
AHEAD = 4  # cells
_STEPS = [np.array(step) for step in product((-1, 0, 1), repeat=2) if step != (0, 0)]


class Detour:
    """Shortest way to a region, as the length that is left from each cell of a grid.

    Args:
        start: Middle of the object, (2,), [m].
        obstacles: Points of what stands there, (N, 2), [m].
        radii: Distance at which the object touches each of them, or the hand does, (N,), [m].
        boxes: Boxes of the region.
    """

    def __init__(self, start: np.ndarray, obstacles: np.ndarray, radii: np.ndarray, boxes: list[Box]):
        self._low = start - HALF_SIZE
        axis = CELL * (np.arange(round(2 * HALF_SIZE / CELL)) + 0.5)
        cells = self._low + np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
        room = np.full(cells.shape[:2], np.inf)
        for point, radius in zip(obstacles, radii, strict=True):
            room = np.minimum(room, np.linalg.norm(cells - point, axis=-1) - radius)
        cost = np.select([room < TOUCHING, room < CLEARANCE], [TOUCH_COST, NEAR_COST], 1.0) * CELL
        inside = np.zeros(room.shape, bool)
        for centre, mat, size in boxes:
            inside |= (np.abs(cells - centre[:2]) < np.abs(mat @ size)[:2] - INSIDE).all(axis=-1)
        free = inside & (room >= TOUCHING)
        self._left, before = np.where(free if free.any() else inside, 0.0, np.inf), None
        while before is None or (self._left != before).any():
            before = self._left
            around = np.pad(before, 1, constant_values=np.inf)
            for i, j in _STEPS:
                shifted = around[1 + i : 1 + i + len(axis), 1 + j : 1 + j + len(axis)]
                self._left = np.minimum(self._left, shifted + np.hypot(i, j) * cost)

    def path(self, pos: np.ndarray) -> np.ndarray:
        """Return the next part of the way from a position (2,), (2,); zero at its end, or where there is none."""
        cell = np.floor((pos - self._low) / CELL).astype(int)
        for _ in range(AHEAD):
            around = [cell, *(cell + step for step in _STEPS)]
            cell = min(around, key=lambda c: float(self._left[tuple(np.clip(c, 0, len(self._left) - 1))]))
        return self._low + CELL * (cell + 0.5) - pos
