"""Predicates: pure functions of a read-only view of one simulation's state.

Semantics are the original's: objects are points (the origin of their root body), a box is tested by |R size|.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from libero_env.control import ArmIndex
from libero_env.errors import UnknownNameError
from libero_env.problem import And, Atom, Expression, ForAll, Not, Or, Region
from libero_env.robot import FINGER_JOINTS
from libero_env.scene import Scene
from libero_env.simulation import Simulations

_ON_XY_DISTANCE = 0.03  # m, between the origins of an object and what it stands on
_BOX_BELOW = 0.01  # m, how far below its box a region still holds a point
_ON_BELOW, _ON_ABOVE = 0.005, 0.10  # m, how far around the top of a region's box a point lies on it
_ZONE_HEIGHT, _ZONE_HALF_HEIGHT = 0.02, 0.007  # m, the box of a flat region over its surface


@dataclass(frozen=True)
class StateView:
    """What predicates and experts may know of simulation `index`. Positions are in the world frame, metres."""

    scene: Scene
    simulations: Simulations
    index: int = 0

    def is_object(self, name: str) -> bool:
        """Whether the scene has a movable object of this name."""
        return name in self.scene.objects

    def body_pos(self, name: str) -> np.ndarray:
        """Origin of the root body of an object, (3,)."""
        return self._field("xpos")[self._body(name)].copy()

    def body_quat(self, name: str) -> np.ndarray:
        """Orientation of the root body of an object, wxyz (4,)."""
        return self._field("xquat")[self._body(name)].copy()

    def site_pos(self, name: str) -> np.ndarray:
        """Position of a site, (3,)."""
        return self._field("site_xpos")[self.scene.model.site(name).id].copy()

    def site_mat(self, name: str) -> np.ndarray:
        """Orientation of a site, site to world (3, 3)."""
        return self._field("site_xmat")[self.scene.model.site(name).id].reshape(3, 3).copy()

    @property
    def eef_pos(self) -> np.ndarray:
        """Position of the point between the fingertips, (3,)."""
        return self._field("site_xpos")[self._arm.site].copy()

    @property
    def eef_mat(self) -> np.ndarray:
        """Orientation of the gripper, grip site to world (3, 3); the fingers open along its x axis."""
        return self._field("site_xmat")[self._arm.site].reshape(3, 3).copy()

    @property
    def finger_pos(self) -> np.ndarray:
        """Positions of the two fingers, (2,); 0 when closed, +0.04 and -0.04 when open."""
        addresses = [self.scene.model.joint(name).qposadr[0] for name in FINGER_JOINTS]
        return self._field("qpos")[addresses]

    def in_contact(self, first: str, second: str) -> bool:
        """Whether geoms of two objects (or of an object and the `robot`) touch."""
        data, model = self.simulations.data(self.index), self.scene.model
        pairs = model.geom_bodyid[data.contact.geom[: data.ncon]]
        bodies = [self._bodies(first), self._bodies(second)]
        for a, b in ((0, 1), (1, 0)):
            if (np.isin(pairs[:, 0], bodies[a]) & np.isin(pairs[:, 1], bodies[b])).any():
                return True
        return False

    def _bodies(self, name: str) -> np.ndarray:
        model = self.scene.model
        prefixes = ("robot0_", "gripper0_") if name == "robot" else (f"{name}_",)
        return np.array([b for b in range(model.nbody) if model.body(b).name.startswith(prefixes)])

    @property
    def _arm(self) -> ArmIndex:
        return self.simulations.arm

    def _field(self, name: str) -> np.ndarray:
        return self.simulations.fields[name][self.index]

    def _body(self, name: str) -> int:
        if not self.is_object(name):
            raise UnknownNameError("object", name, self.scene.objects)
        return self.scene.model.body(f"{name}_main").id


Predicate = Callable[..., bool]


def on(view: StateView, thing: str, place: str) -> bool:
    """`thing` stands on an object (touching, above it, origins within 3 cm) or lies over the box of a region."""
    if view.is_object(place):
        above, below = view.body_pos(thing), view.body_pos(place)
        near = np.linalg.norm(above[:2] - below[:2]) < _ON_XY_DISTANCE
        return bool(below[2] <= above[2] and near and view.in_contact(thing, place))
    over = any(_over(box, view.body_pos(thing)) for box in _boxes(view, place))
    region = _region(view, place)
    return over and (bool(region.ranges) or view.in_contact(thing, region.target))


def in_(view: StateView, thing: str, place: str) -> bool:
    """The origin of `thing` is in the box of a region; contact does not matter."""
    return any(_inside(box, view.body_pos(thing)) for box in _boxes(view, place))


PREDICATES: Mapping[str, Predicate] = {"On": on, "In": in_}


def evaluate(expression: Expression, view: StateView) -> bool:
    """Truth of a goal in a state.

    Raises:
        UnknownNameError: a predicate, object or region that does not exist.
    """
    match expression:
        case Atom(predicate, args):
            if predicate not in PREDICATES:
                raise UnknownNameError("predicate", predicate, PREDICATES)
            return PREDICATES[predicate](view, *args)
        case And(parts):
            return all(evaluate(part, view) for part in parts)
        case Or(parts):
            return any(evaluate(part, view) for part in parts)
        case Not(part):
            return not evaluate(part, view)
        case ForAll(variables, body):
            return all(evaluate(_bind(body, binding), view) for binding in _bindings(variables, view))
    raise TypeError(f"not a goal: {expression!r}")


def atoms_of(expression: Expression) -> tuple[Atom, ...]:
    """All atoms of a goal, in reading order."""
    match expression:
        case Atom():
            return (expression,)
        case And(parts) | Or(parts):
            return tuple(atom for part in parts for atom in atoms_of(part))
        case Not(part) | ForAll(_, part):
            return atoms_of(part)
    raise TypeError(f"not a goal: {expression!r}")


Box = tuple[np.ndarray, np.ndarray, np.ndarray]  # centre (3,), orientation to world (3, 3), half size (3,)


def _region(view: StateView, address: str) -> Region:
    region = view.scene.problem.region(address)
    if region is None:
        valid = [r.address for r in view.scene.problem.regions] + list(view.scene.objects)
        raise UnknownNameError("region or object", address, valid)
    return region


def _boxes(view: StateView, address: str) -> list[Box]:
    """The boxes of a region: the site of that name, or a flat box over each rectangle on its surface."""
    region = _region(view, address)
    if not region.ranges:
        return [(view.site_pos(address), view.site_mat(address), view.scene.model.site(address).size)]
    workspace = view.scene.workspace
    surface = np.array([0.0, 0.0, workspace.region_height + _ZONE_HEIGHT]) + workspace.offset
    return [
        (
            surface + ((x0 + x1) / 2, (y0 + y1) / 2, 0.0),
            np.eye(3),
            np.array([x1 - x0, y1 - y0, 2 * _ZONE_HALF_HEIGHT]) / 2,
        )
        for x0, y0, x1, y1 in region.ranges
    ]


def _inside(box: Box, point: np.ndarray) -> bool:
    centre, mat, size = box
    half = np.abs(mat @ size)
    low, high = centre - half, centre + half
    low[2] -= _BOX_BELOW
    return bool((point > low).all() and (point < high).all())


def _over(box: Box, point: np.ndarray) -> bool:
    centre, mat, size = box
    delta = mat @ (point - centre)
    return bool(size[2] - _ON_BELOW < delta[2] < size[2] + _ON_ABOVE and (np.abs(delta[:2]) < size[:2]).all())


def _bindings(variables: tuple[tuple[str, str], ...], view: StateView) -> list[dict[str, str]]:
    bindings: list[dict[str, str]] = [{}]
    for variable, category in variables:
        names = [name for name, item in view.scene.objects.items() if item.category == category]
        bindings = [{**binding, variable: name} for binding in bindings for name in names]
    return bindings


def _bind(expression: Expression, binding: Mapping[str, str]) -> Expression:
    match expression:
        case Atom(predicate, args):
            return Atom(predicate, tuple(binding.get(arg, arg) for arg in args))
        case And(parts):
            return And(tuple(_bind(part, binding) for part in parts))
        case Or(parts):
            return Or(tuple(_bind(part, binding) for part in parts))
        case Not(part):
            return Not(_bind(part, binding))
        case ForAll(variables, body):
            return ForAll(variables, _bind(body, binding))
    raise TypeError(f"not a goal: {expression!r}")
