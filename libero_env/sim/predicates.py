"""Predicates: pure functions of a read-only view of one simulation's state.

By default their meaning is the original's: objects are points (the origin of their root body), a box is tested by
|R size|, and standing in a region of the table needs no contact. `semantics="strict"` asks more; see `STRICT`.
"""

from collections.abc import Callable, Mapping

import numpy as np

from libero_env.errors import LiberoError, UnknownNameError
from libero_env.objects.model import GLOW_GROUP, ObjectModel
from libero_env.sim.regions import BOX_BELOW, contains, is_over, region_boxes, region_of
from libero_env.sim.scene import ROBOT
from libero_env.sim.state import StateView
from libero_env.tasks.problem import And, Atom, Expression, ForAll, Not, Or

_ON_XY_DISTANCE = 0.03  # m, between the origins of an object and what it stands on
_UP_HEIGHT = 1.0  # m, world frame
_STRICT_MARGIN = 0.005  # m, by how much an object may stick out of a box that holds it


Predicate = Callable[..., bool]


def on(view: StateView, thing: str, place: str) -> bool:
    """`thing` stands on an object (touching, above it, origins within 3 cm) or lies over the box of a region."""
    if view.is_thing(place):
        above, below = view.body_pos(thing), view.body_pos(place)
        near = np.linalg.norm(above[:2] - below[:2]) < _ON_XY_DISTANCE
        return bool(below[2] <= above[2] and near and view.in_contact(thing, place))
    over = any(is_over(box, view.body_pos(thing)) for box in region_boxes(view, place))
    region = region_of(view, place)
    return over and (bool(region.ranges) or view.in_contact(thing, region.target))


def in_(view: StateView, thing: str, place: str) -> bool:
    """The origin of `thing` is in the box of a region; contact does not matter."""
    return any(contains(box, view.body_pos(thing)) for box in region_boxes(view, place))


def up(view: StateView, thing: str) -> bool:
    """The origin of `thing` is at least a metre above the floor."""
    return bool(view.body_pos(thing)[2] >= _UP_HEIGHT)


def in_contact(view: StateView, first: str, second: str) -> bool:
    """The two touch."""
    return view.in_contact(first, second)


def stack(view: StateView, thing: str, place: str) -> bool:
    """The two touch, `thing` is over the region or object and inside it."""
    owner = view.scene.owner(place)
    touching = owner is not None and view.in_contact(thing, owner)
    return touching and on(view, thing, place) and (view.is_thing(place) or in_(view, thing, place))


def open_(view: StateView, place: str) -> bool:
    """Any joint of the thing, or of the part that the region is on, is as far out as `open` begins."""
    return any(_in_state(view, place, "open", "close"))


def close(view: StateView, place: str) -> bool:
    """All joints of the thing, or of the part that the region is on, are as far in as `close` begins."""
    return all(_in_state(view, place, "close", "open"))


def turn_on(view: StateView, thing: str) -> bool:
    """Any joint is as far as `turnon` begins."""
    return any(_in_state(view, thing, "turnon", "turnoff"))


def turn_off(view: StateView, thing: str) -> bool:
    """All joints are as far back as `turnoff` begins."""
    return all(_in_state(view, thing, "turnoff", "turnon"))


def print_joint_state(view: StateView, thing: str) -> bool:
    """Always true. The original prints the joints here; `view.joint_positions(thing)` has them."""
    view.joint_positions(thing)
    return True


PREDICATES: Mapping[str, Predicate] = {
    "On": on,
    "In": in_,
    "Up": up,
    "Open": open_,
    "Close": close,
    "Turnon": turn_on,
    "Turnoff": turn_off,
    "Incontact": in_contact,
    "Stack": stack,
    "Printjointstate": print_joint_state,
    "True": lambda view, *args: True,
    "False": lambda view, *args: False,
}


def strict_on(view: StateView, thing: str, place: str) -> bool:
    """`thing` rests on the object or in the region: touching what is under it, let go, its origin over the place."""
    if view.in_contact(thing, ROBOT):
        return False
    if view.is_thing(place):
        low, high = view.bounds(place)
        over = ((view.body_pos(thing) > low) & (view.body_pos(thing) < high))[:2].all()
        return bool(
            over and view.body_pos(thing)[2] > view.body_pos(place)[2] and view.in_contact(thing, place)
        )
    region = region_of(view, place)
    point = view.body_pos(thing)
    if not view.in_contact(thing, region.target):
        return False
    boxes = region_boxes(view, place)
    if region.ranges:
        return any((np.abs(point - centre)[:2] < size[:2]).all() for centre, _, size in boxes)
    return any(is_over((centre, mat.T, size), point) for centre, mat, size in boxes)


def strict_in(view: StateView, thing: str, place: str) -> bool:
    """Footprint and lowest point of `thing` are in the box of the region, in the box's own frame, and it is let go."""
    if view.in_contact(thing, ROBOT):
        return False
    low, high = view.bounds(thing)
    middle, half = (low + high) / 2, (high - low) / 2
    for centre, mat, size in region_boxes(view, place):
        own_up = np.abs(mat[2])  # share of each axis of the box in the vertical
        box_half = np.abs(mat) @ size if own_up.max() > 0.999 else size
        turn = np.eye(3) if own_up.max() > 0.999 else mat.T
        delta = turn @ (middle - centre)
        inside = (np.abs(delta[:2]) + half[:2] < box_half[:2] + _STRICT_MARGIN).all()
        if inside and -box_half[2] - BOX_BELOW < delta[2] - half[2] < box_half[2]:
            return True
    return False


STRICT: Mapping[str, Predicate] = {**PREDICATES, "On": strict_on, "In": strict_in}
"""On and In as a person would judge them: at rest, let go, with extent, in the frame of the place."""

SEMANTICS: Mapping[str, Mapping[str, Predicate]] = {"original": PREDICATES, "strict": STRICT}


def register_predicate(name: str, predicate: Predicate) -> None:
    """Adds a predicate, or replaces one, in both semantics, for this process.

    Args:
        name: as task files write it; case does not count.
        predicate: called with a `StateView` and the atom's names.

    Raises:
        LiberoError: the name cannot stand in a task file.
    """
    if not name.isidentifier():
        raise LiberoError(f"register_predicate: {name!r} is no name; use letters, digits and underscores")
    for table in SEMANTICS.values():
        table[name.capitalize()] = predicate  # type: ignore[index]


def evaluate(expression: Expression, view: StateView, semantics: str = "original") -> bool:
    """Truth of a goal in a state.

    Args:
        expression: goal or atom.
        view: the state.
        semantics: `original` or `strict`.

    Raises:
        UnknownNameError: a predicate, object or region that does not exist.
        LiberoError: a predicate that makes no sense for the thing, such as opening a plate.
    """
    match expression:
        case Atom(predicate, args):
            table = SEMANTICS[semantics]
            if predicate not in table:
                raise UnknownNameError("predicate", predicate, table)
            return table[predicate](view, *args)
        case And(parts):
            return all(evaluate(part, view, semantics) for part in parts)
        case Or(parts):
            return any(evaluate(part, view, semantics) for part in parts)
        case Not(part):
            return not evaluate(part, view, semantics)
        case ForAll(variables, body):
            return all(
                evaluate(_bind(body, binding), view, semantics) for binding in _bindings(variables, view)
            )
    raise TypeError(f"not a goal: {expression!r}")


def glowing_sites(view: StateView) -> set[int]:
    """Ids of the sites that glow because their object is turned on, such as a stove's burner."""
    model, found = view.scene.model, set()
    for name, item in view.scene.entities.items():
        if "turnon" in item.articulation and turn_on(view, name):
            own = np.isin(model.site_bodyid, view.scene.bodies[name])
            found |= set(np.flatnonzero(own & (model.site_group == GLOW_GROUP)).tolist())
    return found


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


def _in_state(view: StateView, place: str, state: str, opposite: str) -> list[bool]:
    """Return for each joint whether it is in a state, see `reaches_state`.

    A thing without joints has none that is open, and all it has are closed, as in the original.
    """
    owner = view.scene.owner(place)
    if owner is None:
        raise UnknownNameError("object, fixture or region of one", place, view.scene.joints)
    values = view.joint_positions(place).values()
    return [reaches_state(view.scene.entities[owner], value, state, opposite) for value in values]


def reaches_state(model: ObjectModel, qpos: float, state: str, opposite: str) -> bool:
    """Return whether a joint is as far as the range of a state begins, seen from the range of the opposite.

    Args:
        model: Object or fixture with the joint.
        qpos: Position of the joint, rad or m.
        state: `open`, `close`, `turnon` or `turnoff`.
        opposite: The state at the other end.

    Raises:
        LiberoError: The model has no range for the state.
    """
    ranges = model.articulation
    if state not in ranges:
        raise LiberoError(
            f"a {model.category} has no joint range for the state {state!r}; it has ranges for: "
            f"{', '.join(ranges) or 'no state'}"
        )
    low, high = sorted(ranges[state])
    upwards = opposite not in ranges or low + high > sum(ranges[opposite])
    if state == "turnon":
        return qpos >= low if upwards else qpos <= high
    return qpos > low if upwards else qpos < high


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
