"""An object that is to be placed, and the spots of its target."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from libero_env.expert.clearance import Voxels
from libero_env.expert.shapes import DENSE, Shapes, pose_of
from libero_env.geometry import Pose
from libero_env.sim.predicates import Box, contains, is_over, region_boxes
from libero_env.sim.state import StateView
from libero_env.tasks.problem import Atom

_GRID = 7  # spots along each side of a region
_OFFSETS = np.array([(0, 0), (0.01, 0), (-0.01, 0), (0, 0.01), (0, -0.01)])  # [m] of spots on an object
_MAX_STACK_OFFSET = 0.024  # [m] between the origins of stacked objects
_EDGE_COST, _EDGE_MARGIN = 40.0, 0.02  # cost for each [m] closer to the edge of a region than the margin


@dataclass(frozen=True)
class Placement:
    """An object that is to be placed, and the scene around it.

    Attributes:
        view: State of the simulation.
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


def target_spots(placement: Placement) -> Iterator[Spots]:
    """Yield the spots of each part of the target."""
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
        u, v = (np.linspace(-0.9, 0.9, _GRID) * h for h in half[:2])
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
