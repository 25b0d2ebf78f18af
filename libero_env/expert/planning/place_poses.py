"""Where to put an object: poses that make a goal's atom true, found by lowering the object's shape onto the scene."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product

import numpy as np

from libero_env.errors import LiberoError
from libero_env.expert.clearance import Voxels, lower_surface, upper_surface
from libero_env.expert.shapes import DENSE, Shapes, pose_of
from libero_env.geometry import Pose, rotation_about, rotation_about_z
from libero_env.sim.predicates import Box, contains, is_over, region_boxes
from libero_env.sim.state import StateView
from libero_env.tasks.expression import Atom

DOWN = np.array([0.0, 0.0, -1.0])
UP = np.array([0.0, 0.0, 1.0])
_NUM_YAWS = 12
_LIFT = 0.008  # [m] off its support, when an object is tested for collisions
_ENTRY_STEPS = tuple(np.arange(0.02, 0.29, 0.025))  # [m] of the path from a side that has to be free
_LEANS = (0.45, 0.8, 1.3)  # [rad] of an object that fits nowhere upright
_MAX_OVERLAP = 0.04  # share of an object's points that may be in occupied cells, as voxels are coarse
_MAX_OVERHANG = 0.15  # share of an object's columns that may reach into an overhang
_MIN_ENTRY_OVERLAP = 0.03  # share of points that is tolerated on the way in
_UNSUPPORTED_COST = 2.0  # of a leaning object with nothing under its middle
_NUM_TESTED = 80  # points of an object that are tested
_GRID, _FINE_GRID = 7, 21  # spots along each side of a region
_FLOOR = 0.015  # [m] above the lowest point of a region, up to which an object stands on its floor
_OFFSETS = np.array([(0, 0), (0.01, 0), (-0.01, 0), (0, 0.01), (0, -0.01)])  # [m] of spots on an object
_MAX_STACK_OFFSET = 0.024  # [m] between the origins of stacked objects
_EDGE_COST, _EDGE_MARGIN = 40.0, 0.02  # cost for each [m] closer to the edge of a region than the margin


class PlaceError(LiberoError):
    """There is no room for an object where the goal requires it."""


@dataclass(frozen=True)
class PlacePose:
    """Pose of an object at its place.

    Attributes:
        pos: Position of the object's origin, (3,), [m].
        mat: Orientation of the object, (3, 3).
        entry: Direction in which the object comes in, unit vector (3,).
        cost: Cost of the place; lower is better.
        room: Distance in the ground plan that the object may be off the place and the atom still holds, [m].
    """

    pos: np.ndarray
    mat: np.ndarray
    entry: np.ndarray
    cost: float
    room: float

    @property
    def pose(self) -> Pose:
        """Pose of the object."""
        return Pose(self.pos, self.mat)

    @property
    def from_above(self) -> bool:
        """Whether the object comes in from above and not from a side."""
        return bool(self.entry[2] <= -0.5)


@dataclass(frozen=True)
class Placement:
    """An object that is to be placed, and the scene around it.

    Attributes:
        atom: Atom to make true: (On object place), (In object region) or (Stack object place).
        slot: (k, n): the object is number k of n that go to this place; each leaves room for the others.
        cloud: Points on the object, world frame, (N, 3).
        object_pose: Pose of the object now.
        voxels: Voxels of everything else.
    """

    view: StateView
    atom: Atom
    slot: tuple[int, int]
    cloud: np.ndarray
    object_pose: Pose
    voxels: Voxels

    @classmethod
    def from_view(cls, view: StateView, shapes: Shapes, atom: Atom, slot: tuple[int, int]) -> "Placement":
        """Build the voxels of a scene for placing one of its objects."""
        name = atom.args[0]
        cloud, pose = shapes.cloud(view, name), pose_of(view, name)
        obstacles = shapes.obstacles(view, name, spacing=DENSE)
        voxels = Voxels(obstacles, view.scene.workspace.surface_height, pose.pos)
        return cls(view, atom, slot, cloud, pose, voxels)

    @property
    def target(self) -> str:
        """Object, fixture or region on which or in which the object is placed."""
        return self.atom.args[1]

    @property
    def target_is_flat(self) -> bool:
        """Whether the target is a rectangle on a surface, such as the table."""
        region = self.view.scene.problem.region(self.target)
        return region is not None and bool(region.ranges)

    @cached_property
    def sides(self) -> list[np.ndarray]:
        """The four horizontal directions along the sides of what the target belongs to, (3,) each."""
        owner = self.view.scene.owner(self.target)
        x = pose_of(self.view, owner).mat[:, 0] if owner is not None else np.array([1.0, 0.0, 0.0])
        x = np.array([x[0], x[1], 0.0]) / max(float(np.hypot(x[0], x[1])), 1e-9)
        y = np.array([-x[1], x[0], 0.0])
        return [x, -x, y, -y]


@dataclass(frozen=True)
class Spots:
    """Spots of one part of a target.

    Attributes:
        xy: Positions of the object's origin, (S, 2), [m].
        costs: Costs of the spots, (S,).
        room: Distance that the object may be off each spot and the atom still holds, (S,), [m].
        below: Height above which nothing supports the object, [m].
        holds: Returns whether the atom holds for a position of the object's origin, (3,).
    """

    xy: np.ndarray
    costs: np.ndarray
    room: np.ndarray
    below: float
    holds: Callable[[np.ndarray], bool]


def target_spots(placement: Placement, grid: int = _GRID) -> Iterator[Spots]:
    """Yield the spots of each part of the target, `grid` along each side of a region."""
    view, target = placement.view, placement.target
    if view.is_entity(target):
        xy = view.body_pos(target)[:2]
        distances = np.linalg.norm(_OFFSETS, axis=1)

        def stacked(pos: np.ndarray) -> bool:
            return bool(np.linalg.norm(pos[:2] - xy) < _MAX_STACK_OFFSET)

        yield Spots(xy + _OFFSETS, 8.0 * distances, _MAX_STACK_OFFSET - distances, np.inf, stacked)
        return
    inside = placement.atom.predicate == "In"
    test = contains if inside else is_over
    for box in region_boxes(view, target):
        centre, mat, size = box
        half = np.abs(mat @ size)
        u, v = (np.linspace(-0.9, 0.9, grid) * h for h in half[:2])
        offsets = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        costs = 4.0 * np.linalg.norm(offsets - _slot_offset(half, placement.slot), axis=1)
        room = (half[:2] - np.abs(offsets)).min(axis=1)
        costs += _EDGE_COST * np.maximum(_EDGE_MARGIN - room, 0.0)
        below = centre[2] + (0.5 * half[2] if inside else 0.06)
        if placement.target_is_flat:
            below = view.scene.workspace.surface_height + 0.02
        yield Spots(centre[:2] + offsets, costs, room, below, partial(test, _shrunk(box)))


def _slot_offset(half: np.ndarray, slot: tuple[int, int]) -> np.ndarray:
    """Return where in a region one of several objects stands, along its longer side, (2,) from the middle, [m]."""
    k, number = slot
    offset = np.zeros(2)
    if number > 1:
        axis = int(half[1] > half[0])
        offset[axis] = 0.62 * half[axis] * (2 * k / (number - 1) - 1)
    return offset


def _shrunk(box: Box) -> Box:
    """Return a box that is smaller by a margin, where it is not flat."""
    centre, mat, size = box
    half = np.abs(mat @ size)
    smaller = np.maximum(size - 0.1 * half.min(), 0.7 * size)
    return Box(centre, mat, np.where(np.abs(size) > 0.012, smaller, size))


def find_place_poses(placement: Placement) -> list[PlacePose]:
    """Return poses at which the atom would hold, best first.

    The object stays upright and is rotated about the vertical. Only where it fits nowhere, it is rotated parallel to
    the sides of the place, then leaned; at last more overlap with the coarse voxels is accepted.

    Raises:
        PlaceError: There is no room.
    """
    on_entity = placement.view.is_entity(placement.target)
    overlap = 3 * _MAX_OVERLAP if on_entity else _MAX_OVERLAP
    even = [_Rotation(rotation_about_z(yaw), 0.1 * abs(yaw)) for yaw in _even_yaws(_NUM_YAWS)]
    parallel_yaws = _parallel_yaws(placement.cloud, placement.sides[0])
    parallel = [_Rotation(rotation_about_z(yaw), 0.1 * abs(yaw)) for yaw in parallel_yaws]
    places = _search(placement, even, overlap)
    if places and not _on_floor(placement, places):  # a drawer does not close over what stands on its rim
        places = _on_floor(placement, _search(placement, even, overlap, _FINE_GRID)) or places
    places = places or _search(placement, parallel, overlap)
    if not places and not placement.target_is_flat:
        yaws = [*parallel_yaws, *_even_yaws(_NUM_YAWS // 2)]
        for lean in _LEANS:  # about the vertical, after which the top leans back against the entry direction
            leaning = [
                _Rotation(
                    rotation_about(np.cross(side, UP), lean) @ rotation_about_z(yaw), 0.1 * abs(yaw), side
                )
                for side, yaw in product(placement.sides, yaws)
            ]
            places += _search(placement, leaning, overlap)
    if not places:
        places = _search(placement, [*even, *parallel], 8 * overlap)
    if not places:
        raise PlaceError(f"{placement.atom}: there is no room for {placement.atom.args[0]}")
    lowest = min(place.pos[2] for place in places)
    places = [replace(place, cost=place.cost + 3.0 * (place.pos[2] - lowest)) for place in places]
    return sorted(places, key=lambda place: place.cost)


@dataclass(frozen=True)
class _Rotation:
    """Rotation of an object from its orientation now."""

    mat: np.ndarray  # (3, 3)
    cost: float
    only_entry: np.ndarray | None = None  # the direction in which a leaning object has to come in, (3,)


def _on_floor(placement: Placement, places: list[PlacePose]) -> list[PlacePose]:
    """Return the places, of an upright object, on the floor of what it goes into; all where it goes onto something."""
    if placement.atom.predicate != "In" or placement.target_is_flat:
        return places
    boxes = region_boxes(placement.view, placement.target)
    floor = min(centre[2] - np.abs(mat @ size)[2] for centre, mat, size in boxes)
    bottom = placement.cloud[:, 2].min() - placement.object_pose.pos[2]
    return [place for place in places if place.pos[2] + bottom < floor + _FLOOR]


def _search(
    placement: Placement, rotations: list[_Rotation], max_overlap: float, grid: int = _GRID
) -> list[PlacePose]:
    """Return places of an object with some rotations, of whose points at most a share is in occupied cells."""
    places: list[PlacePose] = []
    for rotation in rotations:
        body = (placement.cloud - placement.object_pose.pos) @ rotation.mat.T
        for spots in target_spots(placement, grid):
            places += _search_spots(placement, body, rotation, spots, max_overlap)
    return places


def _search_spots(
    placement: Placement, body: np.ndarray, rotation: _Rotation, spots: Spots, max_overlap: float
) -> list[PlacePose]:
    """Return places of an object, whose points relative to its origin are `body` (N, 3), at some spots."""
    voxels, tested = placement.voxels, body[:: max(1, len(body) // _NUM_TESTED)]
    heights = voxels.resting_heights(lower_surface(body), spots.xy, spots.below)
    origins = np.column_stack([spots.xy, heights])
    keep = np.array([spots.holds(origin) for origin in origins + [0.0, 0.0, 0.003]])
    if not keep.any():
        return []
    origins = origins[keep]
    overhang = voxels.overhang_overlap(upper_surface(body) + [0, 0, _LIFT], origins, spots.below)
    free = overhang < _MAX_OVERHANG
    costs, origins = (spots.costs[keep] + 2.0 * overhang)[free], origins[free]
    rooms = spots.room[keep][free]
    entries = placement.sides
    if rotation.only_entry is not None:
        entries = [rotation.only_entry]
        middle = body.mean(axis=0)[None] * [1, 1, 0] + [0, 0, body[:, 2].min()]
        gap = origins[:, 2] - voxels.resting_heights(middle, origins[:, :2], spots.below)
        costs = costs + _UNSUPPORTED_COST * (gap > 0.01)
    ways, overlaps = _find_entries(voxels, tested, origins, entries, max_overlap)
    places = []
    for pos, cost, room, entry, overlap in zip(origins, costs, rooms, ways, overlaps, strict=True):
        if entry is not None:
            total = cost + rotation.cost + 8.0 * overlap + 0.5 * (entry[2] > -0.5)
            mat = rotation.mat @ placement.object_pose.mat
            places.append(PlacePose(pos, mat, entry, total, float(room)))
    return places


def _even_yaws(number: int) -> list[float]:
    """Return equally spaced angles about the vertical, from -pi to pi, [rad]."""
    angles = [2 * np.pi * k / number for k in range(number)]
    return [a - 2 * np.pi if a > np.pi else a for a in angles]


def _parallel_yaws(cloud: np.ndarray, side: np.ndarray) -> list[float]:
    """Return angles about the vertical that put the narrowest width of an object along or across a direction, [rad]."""
    plan = np.unique(np.round(cloud[:, :2], 3), axis=0)
    yaws = np.pi * np.arange(90) / 90
    widths = np.ptp(plan @ [np.cos(yaws), np.sin(yaws)], axis=0)
    first = np.arctan2(side[1], side[0]) - yaws[widths.argmin()]
    return [(first + k * np.pi / 2 + np.pi) % (2 * np.pi) - np.pi for k in range(4)]


def _find_entries(
    voxels: Voxels, body: np.ndarray, origins: np.ndarray, directions: list[np.ndarray], max_overlap: float
) -> tuple[list[np.ndarray | None], np.ndarray]:
    """Find the direction along which an object comes in.

    Args:
        voxels: Voxels of everything but the object.
        body: Points on the object relative to its origin, (N, 3).
        origins: Positions of the object, (S, 3).
        directions: Directions from a side; used only where no position can be reached from above.
        max_overlap: Largest share of points in occupied cells.

    Returns:
        For each position the direction (3,), or None without one; and the share of points in occupied cells, (S,).
    """
    standing = origins[:, None] + body[None] + [0, 0, _LIFT]
    overlap = voxels.count_occupied(standing) / len(body)
    entries: list[np.ndarray | None] = [None] * len(origins)
    covered = voxels.is_covered(standing).mean(axis=1)
    tolerated = np.maximum(overlap, _MIN_ENTRY_OVERLAP)
    from_above = (overlap < max_overlap) & (covered <= tolerated)
    for i in np.flatnonzero(from_above):
        entries[i] = DOWN
    if from_above.any():
        return entries, overlap
    for direction in directions:
        left = [i for i in range(len(origins)) if entries[i] is None and overlap[i] < max_overlap]
        if not left:
            break
        free = np.ones(len(left), bool)
        for length in _ENTRY_STEPS:
            occupied = voxels.count_occupied(standing[left] - length * direction)
            free &= occupied <= tolerated[left] * len(body)
        for index, is_free in zip(left, free, strict=True):
            if is_free:
                entries[index] = direction
    return entries, overlap
