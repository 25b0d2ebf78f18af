"""Samplers of placements, name -> (pos (3,) m, quat wxyz (4,), object), and of joint positions at the start.

They are for clients that place objects themselves; the environments sample with `libero_env.init_states.placement`.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from libero._adapters.lookup import alias_modules, lookup
from libero_env.assets.arena import load_workspace
from libero_env.errors import PlacementError, UnknownNameError
from libero_env.objects.model import rest_quat
from libero_env.parallel import send_to_workers
from libero_env.workspaces import BUILTIN_WORKSPACES

Placements = dict[str, tuple[tuple[float, float, float], np.ndarray, Any]]
_TRIES = 5000


class _Sampler:
    """Base of the samplers: a name in messages, objects, and a generator, by default of NumPy's global seed."""

    def __init__(self, name: str, mujoco_objects: Any, rng: np.random.Generator | None):
        self.name, self.rng = name, rng or np.random.default_rng(np.random.randint(2**31))  # noqa: NPY002
        self.mujoco_objects: list[Any] = []
        self.add_objects(() if mujoco_objects is None else mujoco_objects)

    def add_objects(self, mujoco_objects: Any) -> None:
        """Add objects."""
        self.mujoco_objects += mujoco_objects if isinstance(mujoco_objects, Iterable) else [mujoco_objects]

    def reset(self) -> None:
        """Remove all objects."""
        self.mujoco_objects = []


class MultiRegionRandomSampler(_Sampler):
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
        rng: Generator of the placements.
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
        super().__init__(name, mujoco_objects, rng)
        self.rotation, self.rotation_axis = rotation, rotation_axis
        self.x_ranges, self.y_ranges = x_ranges or [(0.0, 0.0)], y_ranges or [(0.0, 0.0)]
        self.whole, self.apart = ensure_object_boundary_in_range, ensure_valid_placement
        self.reference_pos, self.z_offset = np.asarray(reference_pos, np.float64), z_offset
        self.idx = 0  # of the rectangle that is sampled

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
            xy = self._sample_x(margin), self._sample_y(margin)
            pos = origin + (*xy, height)
            if not self.apart or all(self._clear(item, pos, other) for other in placed.values()):
                return tuple(pos), self._sample_quat(), item
        raise PlacementError(
            f"{self.name}: no free placement for {item.name} in {_TRIES} tries. (1) Make the ranges larger, (2) use "
            "fewer or smaller objects"
        )

    def _sample_x(self, object_horizontal_radius: float) -> float:
        return self._draw(self.x_ranges[self.idx], object_horizontal_radius)

    def _sample_y(self, object_horizontal_radius: float) -> float:
        return self._draw(self.y_ranges[self.idx], object_horizontal_radius)

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


class ObjectBasedSampler(MultiRegionRandomSampler):
    """Samples placements on another object: pass its name to `sample` as `reference`.

    `rotation` is as objects have it, also axis -> range; see `libero_env.objects.model.rest_quat`. Of a sampler of a
    workspace, the default of `reference_pos` is the origin of the workspace.
    """

    category: ClassVar[str | None] = None  # of the workspace
    whole_object: ClassVar[bool] = True  # default of ensure_object_boundary_in_range

    def __init__(
        self,
        object_name: str,
        mujoco_objects: Any = None,
        x_ranges: Sequence[Sequence[float]] | None = None,
        y_ranges: Sequence[Sequence[float]] | None = None,
        rotation: Any = (np.pi / 2, np.pi / 2),
        rotation_axis: str = "z",
        ensure_object_boundary_in_range: bool | None = None,
        ensure_valid_placement: bool = True,
        reference_pos: Sequence[float] | None = None,
        z_offset: float = 0.01,
        rng: np.random.Generator | None = None,
    ):
        whole = ensure_object_boundary_in_range
        super().__init__(
            object_name, mujoco_objects, x_ranges, y_ranges, rotation, rotation_axis,
            self.whole_object if whole is None else whole, ensure_valid_placement, z_offset=z_offset, rng=rng,
        )  # fmt: skip
        if reference_pos is None and self.category is not None:
            reference_pos = load_workspace(self.category).offset
        if reference_pos is not None:
            self.reference_pos = np.asarray(reference_pos, np.float64)

    def _sample_quat(self) -> np.ndarray:
        return rest_quat(self._ranges(), self.rng)


class TableRegionSampler(ObjectBasedSampler):
    """Samples placements on the table; `rotation` as in `ObjectBasedSampler`."""

    category = "table"


class Libero100TableRegionSampler(TableRegionSampler):
    """Samples placements on the tables of LIBERO-100; objects may extend beyond the rectangles."""

    category, whole_object = "kitchen_table", False


class SiteRegionRandomSampler(MultiRegionRandomSampler):
    """Samples placements around a site: pass its position to `sample` as `reference`."""

    _sample_quat = ObjectBasedSampler._sample_quat


class InSiteRegionRandomSampler(SiteRegionRandomSampler):
    """Samples placements in the box of a site."""


class SiteSequentialCompositeSampler:
    """Runs samplers in turn; each gets the placements of those before it."""

    def __init__(self, name: str):
        self.name = name
        self.samplers: dict[str, tuple[MultiRegionRandomSampler, dict[str, Any]]] = {}

    def append_sampler(self, sampler: MultiRegionRandomSampler, sample_args: Any = None) -> None:
        """Add a sampler at the end, with arguments for its `sample`."""
        self.samplers[sampler.name] = sampler, dict(sample_args or {})

    def sample(self, fixtures: Mapping[str, Any] | None = None, **_: Any) -> Placements:
        """Return all placements."""
        placed: Placements = dict(fixtures or {})
        for sampler, arguments in self.samplers.values():
            placed = sampler.sample(fixtures=placed, **arguments)
        return placed


class ObjectPropertySampler(_Sampler):
    """Samples a joint position from a range.

    Args:
        name: Name of the sampler in messages.
        state_type: State that the position stands for, such as `open`.
        joint_ranges: Range (low, high), rad or m.

    Raises:
        UnknownNameError: The sampler does not have the state.
    """

    states: Sequence[str] = ()

    def __init__(
        self,
        name: str,
        state_type: str,
        mujoco_objects: Any = None,
        joint_ranges: Sequence[float] = (0.0, 0.0),
        rng: np.random.Generator | None = None,
    ):
        if self.states and state_type not in self.states:
            raise UnknownNameError(f"state of {name}", state_type, self.states)
        super().__init__(name, mujoco_objects, rng)
        self.state_type, self.joint_ranges = state_type, tuple(joint_ranges)

    def sample(self) -> float:
        """Return a position in the range."""
        return float(self.rng.uniform(min(self.joint_ranges), max(self.joint_ranges)))


class OpenCloseSampler(ObjectPropertySampler):
    """Samples how far an object is open."""

    states = ("open", "close")


class TurnOnOffSampler(ObjectPropertySampler):
    """Samples how far a knob is turned."""

    states = ("turnon", "turnoff")


_OF_LIBERO_100 = ("kitchen_table", "living_room_table", "study_table")
REGION_SAMPLERS: dict[str, dict[str, type]] = {}  # problem -> workspace -> class
for _category in BUILTIN_WORKSPACES:
    _base = Libero100TableRegionSampler if _category in _OF_LIBERO_100 else TableRegionSampler
    _class = type(f"{_base.__name__}_{_category}", (_base,), {"category": _category})
    REGION_SAMPLERS[load_workspace(_category).problem.lower()] = {_category: _class}


def get_region_samplers(problem_name: str, region_sampler_name: str) -> type:
    """Return the sampler of a workspace in a problem; raise an UnknownNameError if there is none."""
    samplers = lookup(REGION_SAMPLERS, "problem", problem_name)
    return lookup(samplers, f"region sampler of {problem_name}", region_sampler_name)


def update_region_samplers(problem_name: str, region_sampler_name: str, region_sampler: type) -> None:
    """Add a sampler or replace one."""
    REGION_SAMPLERS.setdefault(problem_name, {})[region_sampler_name] = region_sampler


send_to_workers(__name__, "REGION_SAMPLERS")
alias_modules(__name__, "base_region_sampler workspace_region_sampler object_property_sampler")
