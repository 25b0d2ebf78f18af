"""Samplers of placements, name -> (pos (3,) m, quat wxyz (4,), object).

They are for clients that place objects themselves; the environments sample with `libero_env.init_states.placement`.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from libero._adapters.lookup import alias_modules
from libero_env.errors import PlacementError
from libero_env.objects.model import rest_quat

Placements = dict[str, tuple[tuple[float, float, float], np.ndarray, Any]]
_TRIES = 5000


class MultiRegionRandomSampler:
    """Samples placements in rectangles, of the x and y ranges of the same index, without overlap.

    Args:
        name: Name of the sampler in messages.
        mujoco_objects: One or several objects with `name`, `bottom_offset`, `top_offset` and `horizontal_radius`.
        x_ranges, y_ranges: Ranges (low, high) relative to `reference_pos`, m.
        rotation: Rotation about `rotation_axis`, rad: a range (low, high), a number, or None for any.
        ensure_object_boundary_in_range: Whether the whole object stays in the rectangle.
        ensure_valid_placement: Whether objects do not overlap.
        reference_pos: Origin in the world frame, (3,) m.
        z_offset: Height above the origin, m.
        rng: Generator of the placements, by default of NumPy's global seed.
    """

    def __init__(
        self,
        name: str,
        mujoco_objects: Any = None,
        x_ranges: Sequence[Sequence[float]] | None = None,
        y_ranges: Sequence[Sequence[float]] | None = None,
        rotation: Any = None,
        rotation_axis: str = "z",
        ensure_object_boundary_in_range: bool = True,
        ensure_valid_placement: bool = True,
        reference_pos: Sequence[float] = (0.0, 0.0, 0.0),
        z_offset: float = 0.0,
        rng: np.random.Generator | None = None,
    ):
        self.name, self.rng = name, rng or np.random.default_rng(np.random.randint(2**31))  # noqa: NPY002
        self.mujoco_objects: list[Any] = []
        self.add_objects(() if mujoco_objects is None else mujoco_objects)
        self.rotation, self.rotation_axis = rotation, rotation_axis
        self.x_ranges, self.y_ranges = x_ranges or [(0.0, 0.0)], y_ranges or [(0.0, 0.0)]
        self.whole, self.apart = ensure_object_boundary_in_range, ensure_valid_placement
        self.reference_pos, self.z_offset = np.asarray(reference_pos, np.float64), z_offset
        self.idx = 0  # of the rectangle that is sampled

    def add_objects(self, mujoco_objects: Any) -> None:
        """Add objects."""
        self.mujoco_objects += mujoco_objects if isinstance(mujoco_objects, Iterable) else [mujoco_objects]

    def reset(self) -> None:
        """Remove all objects."""
        self.mujoco_objects = []

    def sample(self, fixtures: Any = None, reference: Any = None, on_top: bool = True) -> Placements:
        """Return placements of all objects, and those of the fixtures.

        Args:
            fixtures: Placements that exist already.
            reference: Name of one of them, or a position (3,), m, as the origin instead of `reference_pos`.
            on_top: Whether objects stand on the reference, or have their origin at its height.

        Raises:
            PlacementError: There was no free placement in 5000 tries.
        """
        placed: Placements = dict(fixtures or {})
        origin = self._origin(placed, reference, on_top)
        for item in self.mujoco_objects:
            height = self.z_offset - on_top * item.bottom_offset[-1]
            placed[item.name] = self._place(item, origin, height, placed)
        return placed

    def _origin(self, placed: Placements, reference: Any, on_top: bool) -> np.ndarray:
        if reference is None:
            return self.reference_pos
        if not isinstance(reference, str):
            return np.asarray(reference, np.float64)
        if reference not in placed:
            raise PlacementError(f"{self.name}: {reference!r} is not placed yet; placed: {', '.join(placed)}")
        pos, _, item = placed[reference]
        return np.asarray(pos) + (np.array([0.0, 0.0, item.top_offset[-1]]) if on_top else 0.0)

    def _place(self, item: Any, origin: np.ndarray, height: float, placed: Placements) -> Any:
        margin = item.horizontal_radius if self.whole else 0.0
        for _ in range(_TRIES):
            self.idx = int(self.rng.integers(len(self.x_ranges)))
            xy = (self._draw(ranges[self.idx], margin) for ranges in (self.x_ranges, self.y_ranges))
            pos = origin + (*xy, height)
            if not self.apart or all(self._clear(item, pos, other) for other in placed.values()):
                return tuple(pos), self._sample_quat(), item
        raise PlacementError(
            f"{self.name}: no free placement for {item.name} in {_TRIES} tries. (1) Make the ranges larger, (2) use "
            "fewer or smaller objects"
        )

    def _draw(self, limits: Sequence[float], margin: float) -> float:
        low, high = min(limits) + margin, max(limits) - margin
        return self.rng.uniform(low, high) if low <= high else (low + high) / 2

    @staticmethod
    def _clear(item: Any, pos: np.ndarray, other: Any) -> bool:
        """Return whether the circles of the two do not overlap, or the one is above the other."""
        other_pos, _, other_item = other
        distance = np.hypot(*(pos[:2] - np.asarray(other_pos)[:2]))
        apart = distance > item.horizontal_radius + other_item.horizontal_radius
        return bool(apart or pos[2] + item.bottom_offset[-1] >= other_pos[2] + other_item.top_offset[-1])

    def _sample_quat(self) -> np.ndarray:
        return np.roll(rest_quat(self._ranges(), self.rng), 1)

    def _ranges(self) -> dict[str, tuple[float, float]]:
        """Return the range of the rotation about each axis, rad."""
        if isinstance(self.rotation, Mapping):
            return dict(self.rotation)
        rotation = (0.0, 2 * np.pi) if self.rotation is None else np.broadcast_to(self.rotation, 2).tolist()
        return {self.rotation_axis: (min(rotation), max(rotation))}


alias_modules(__name__, "base_region_sampler")
