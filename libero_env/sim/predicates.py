"""Predicates: pure functions of a read-only view of the state of one simulation.

Those of `OF_ALL` also take a view of all simulations, and return a bool of each.

By default their semantics are the original's: objects are points (the origin of their root body), the half size of a
box is |R size|, and being on a region of the table needs no contact. `semantics="strict"` requires more; see `STRICT`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from libero_env.doors import doors, enter
from libero_env.errors import LiberoError, UnknownNameError, require_known
from libero_env.mujoco_compat import mujoco
from libero_env.objects.model import GLOW_GROUP, OPPOSITE_STATES, ObjectModel
from libero_env.parallel import send_to_workers
from libero_env.sim.history import History
from libero_env.sim.scene import ROBOT, ground
from libero_env.sim.scene_spec import zone_boxes
from libero_env.sim.state import StateView
from libero_env.tasks.expression import OPERATORS, Atom, Expression
from libero_env.tasks.problem import Region
from libero_env.tasks.rules import declare_predicate

BOX_BELOW = 0.01  # [m] depth below its box in which a region still contains a point
ON_BELOW, ON_ABOVE = 0.005, 0.10  # [m] range of heights around the top of a box that are on the region
ON_XY_DISTANCE = 0.03  # [m] between the origins of an object and the object under it
UP_HEIGHT = 1.0  # [m] in the world frame
_STRICT_MARGIN = 0.005  # [m] length by which an object may stick out of the box that contains it

Predicate = Callable[..., bool]


class Box(NamedTuple):
    """A box in the world.

    Attributes:
        centre: Position of its centre, (3,), m.
        mat: Orientation, box to world, (3, 3).
        half_size: Half of its edges, (3,), m.
    """

    centre: np.ndarray
    mat: np.ndarray
    half_size: np.ndarray


def region_of(view: StateView, address: str) -> Region:
    """Return a region by its address.

    Raises:
        UnknownNameError: The task has no such region.
    """
    region = view.scene.problem.region(address)
    if region is None:
        valid = [r.address for r in view.scene.problem.regions] + list(view.scene.objects)
        raise UnknownNameError("region or object", address, valid)
    return region


def region_boxes(view: StateView, address: str) -> list[Box]:
    """Return the boxes of a region: the site of that name, or a flat box over each rectangle on its surface.

    Raises:
        UnknownNameError: The task has no such region.
        LiberoError: The region has neither ranges nor a site.
    """
    region = region_of(view, address)
    if not region.ranges:
        site = mujoco.mj_name2id(view.scene.model, mujoco.mjtObj.mjOBJ_SITE, address)
        if site < 0:
            raise LiberoError(
                f"region {address}: {region.target} has no site {region.name!r}, and no ranges are given"
            )
        return [Box(view.site_pos(address), view.site_mat(address), view.scene.model.site_size[site])]
    boxes = zone_boxes(region, view.scene.workspace)
    return [Box(centre, np.eye(3), half) for centre, half in boxes]


def contains(box: Box, point: np.ndarray) -> Any:
    """Return whether a point (..., 3) is in a box; as in the original, along the world axes, half size |R size|."""
    centre, mat, size = box
    half = np.abs(mat @ size)
    low, high = centre - half, centre + half
    low[..., 2] -= BOX_BELOW
    return ((point > low) & (point < high)).all(axis=-1)


def is_over(box: Box, point: np.ndarray, above: float = ON_ABOVE) -> Any:
    """Return whether a point (..., 3) is on top of a box; as in the original, rotated by R instead of its inverse.

    Args:
        point: Point in the world.
        above: Largest height of the point above the box, m.
    """
    centre, mat, size = box
    x, y, z = np.moveaxis((mat @ (point - centre)[..., None])[..., 0], -1, 0)
    level = (size[2] - ON_BELOW < z) & (z < size[2] + above)
    return level & (np.abs(x) < size[0]) & (np.abs(y) < size[1])


def on(view: StateView, entity: str, target: str) -> Any:
    """Return whether `entity` is on an object (touching, above it, origins within 3 cm) or over the box of a region."""
    point = view.body_pos(entity)
    if view.is_entity(target):
        offset = point - view.body_pos(target)
        near = np.sqrt(offset[..., 0] ** 2 + offset[..., 1] ** 2) < ON_XY_DISTANCE
        above = near & (offset[..., 2] >= 0.0)
        return above & view.in_contact(entity, target) if above.any() else above
    over = np.any([is_over(box, point) for box in region_boxes(view, target)], axis=0)
    region = region_of(view, target)
    return over if region.ranges or not over.any() else over & view.in_contact(entity, region.target)


def in_(view: StateView, entity: str, region: str) -> Any:
    """Return whether the origin of `entity` is in the box of a region, with or without contact."""
    if view.is_entity(region):  # as in the original, where only the places in an object can contain
        if not np.any(view.in_contact(entity, region)):
            return False
        raise LiberoError(f"(In {entity} {region}): {region} is an object or fixture, not a region of one")
    point = view.body_pos(entity)
    return np.any([contains(box, point) for box in region_boxes(view, region)], axis=0)


def up(view: StateView, entity: str) -> Any:
    """Return whether the origin of `entity` is at least a metre above the floor."""
    return view.body_pos(entity)[..., 2] >= UP_HEIGHT


def touching(view: StateView, first: str, second: str) -> Any:
    """Return whether two entities touch."""
    return view.in_contact(first, second)


def stack(view: StateView, entity: str, target: str) -> Any:
    """Return whether `entity` touches the target, is on it and, for a region, in it."""
    owner = view.scene.owner(target)
    if owner is None:
        return False
    stacked = view.in_contact(entity, owner) & on(view, entity, target)
    return stacked if view.is_entity(target) else stacked & in_(view, entity, target)


def open_(view: StateView, address: str) -> Any:
    """Return whether any joint of an entity, or of the part that a region is on, is in the range of `open`."""
    return np.any(_joints_in_state(view, address, "open"), axis=0)


def close(view: StateView, address: str) -> Any:
    """Return whether all joints of an entity, or of the part that a region is on, are in the range of `close`."""
    return np.all(_joints_in_state(view, address, "close"), axis=0)


def turn_on(view: StateView, entity: str) -> Any:
    """Return whether any joint of an entity is in the range of `turnon`."""
    return np.any(_joints_in_state(view, entity, "turnon"), axis=0)


def turn_off(view: StateView, entity: str) -> Any:
    """Return whether all joints of an entity are in the range of `turnoff`."""
    return np.all(_joints_in_state(view, entity, "turnoff"), axis=0)


def print_joint_state(view: StateView, entity: str) -> bool:
    """Return True. The original prints the joints here; use `view.joint_positions(entity)` to read them."""
    view.joint_positions(entity)
    return True


PREDICATES: dict[str, Predicate] = {
    "On": on,
    "In": in_,
    "Up": up,
    "Open": open_,
    "Close": close,
    "Turnon": turn_on,
    "Turnoff": turn_off,
    "Incontact": touching,
    "Stack": stack,
    "Printjointstate": print_joint_state,
    "True": lambda view, *args: True,
    "False": lambda view, *args: False,
}
"""Predicates of the original by the names of task files."""

OF_ALL = frozenset((on, in_, up, touching, stack, open_, close, turn_on, turn_off))


def strict_on(view: StateView, entity: str, target: str) -> bool:
    """Return whether `entity` rests on an object or a region: touching it, released, its origin over it."""
    if view.in_contact(entity, ROBOT):
        return False
    point = view.body_pos(entity)
    if view.is_entity(target):
        low, high = view.bounds(target)
        over = ((point > low) & (point < high))[:2].all()
        return bool(over and point[2] > view.body_pos(target)[2] and view.in_contact(entity, target))
    region = region_of(view, target)
    if not view.in_contact(entity, region.target):
        return False
    boxes = region_boxes(view, target)
    if region.ranges:
        return any((np.abs(point - centre)[:2] < size[:2]).all() for centre, _, size in boxes)
    return any(is_over(Box(centre, mat.T, size), point) for centre, mat, size in boxes)


def strict_in(view: StateView, entity: str, region: str) -> bool:
    """Return whether `entity` is released, with footprint and lowest point in a region's box, in the box's frame."""
    if view.in_contact(entity, ROBOT):
        return False
    low, high = view.bounds(entity)
    middle, half = (low + high) / 2, (high - low) / 2
    for centre, mat, size in region_boxes(view, region):
        vertical_share = np.abs(mat[2])  # of each axis of the box
        is_upright = vertical_share.max() > 0.999
        box_half = np.abs(mat) @ size if is_upright else size
        world_to_box = np.eye(3) if is_upright else mat.T
        delta = world_to_box @ (middle - centre)
        inside = (np.abs(delta[:2]) + half[:2] < box_half[:2] + _STRICT_MARGIN).all()
        if inside and -box_half[2] - BOX_BELOW < delta[2] - half[2] < box_half[2]:
            return True
    return False


STRICT: dict[str, Predicate] = {**PREDICATES, "On": strict_on, "In": strict_in}
"""On and In with extent: the object is at rest, released, and in the frame of the region."""

SEMANTICS: dict[str, dict[str, Predicate]] = {"original": PREDICATES, "strict": STRICT}
send_to_workers(__name__, "PREDICATES", "STRICT")


def register_predicate(name: str, predicate: Predicate) -> None:
    """Add or replace a predicate, in both semantics, for this process and the workers that it starts later.

    Args:
        name: Name in task files; upper and lower case are the same.
        predicate: Function that takes a `StateView` and the arguments of the atom, and returns a bool. Task files must
            give it as many as it takes: names and words, which are texts, and for parameters that are annotated as
            `float` numbers.

    Raises:
        LiberoError: The name is not valid in a task file.
    """
    if not name.isidentifier() or name.capitalize() in OPERATORS:
        raise LiberoError(
            f"register_predicate: {name!r} is not a valid name; use letters, digits and underscores, and none of "
            f"{', '.join(sorted(OPERATORS))}"
        )
    if numbers := declare_predicate(name.capitalize(), predicate):
        predicate = partial(_with_numbers, predicate, numbers)
    for table in SEMANTICS.values():
        table[name.capitalize()] = predicate


def find_predicate(name: str, semantics: str) -> Predicate:
    """Return a predicate, also of an installed package, see `libero_env.doors`.

    Raises:
        UnknownNameError: It does not exist.
    """
    table = SEMANTICS[semantics]
    if name not in table and name in doors("predicates"):
        register_predicate(name, enter("predicates", name))
    require_known("predicate", name, table)
    return table[name]


def _with_numbers(predicate: Predicate, numbers: tuple[int, ...], view: StateView, *args: str) -> bool:
    """Return what a predicate says of arguments, some of which are numbers."""
    return predicate(view, *(float(arg) if i in numbers else arg for i, arg in enumerate(args)))


def evaluate(expression: Expression, view: StateView, semantics: str = "original") -> bool:
    """Return whether a goal holds in a state; conditions over time are those of an episode that begins there.

    Args:
        expression: Goal or atom.
        semantics: `original` or `strict`.

    Raises:
        UnknownNameError: A predicate, object or region does not exist.
        LiberoError: A predicate does not apply to the entity, such as opening a plate.
    """
    if isinstance(expression, Atom):
        return bool(find_predicate(expression.predicate, semantics)(view, *expression.args))
    goal = ground(expression, view.scene)
    held = {atom: np.array([evaluate(atom, view, semantics)]) for atom in goal.atoms()}
    return bool(History(goal, 1).look(np.zeros(1, np.int64), held)[0])


def glowing_sites(view: StateView) -> set[int]:
    """Return the indices of the sites that glow because their entity is turned on, such as a stove's burner."""
    model, sites = view.scene.model, set[int]()
    for name, item in view.scene.entities.items():
        if "turnon" in item.articulation and turn_on(view, name):
            of_entity = np.isin(model.site_bodyid, view.scene.bodies[name])
            sites |= set(np.flatnonzero(of_entity & (model.site_group == GLOW_GROUP)).tolist())
    return sites


def _joints_in_state(view: StateView, address: str, state: str) -> list[Any]:
    """Return for each joint whether it is in a state, see `reaches_state`.

    An entity without joints has none that is open, and all it has are closed, as in the original.
    """
    owner = view.scene.owner(address)
    if owner is None:
        raise UnknownNameError("object, fixture or region of one", address, view.scene.joints)
    values = view.joint_positions(address).values()
    return [reaches_state(view.scene.entities[owner], value, state) for value in values]


def reaches_state(model: ObjectModel, qpos: Any, state: str) -> Any:
    """Return whether a joint is as far as the range of a state begins, seen from the range of the opposite.

    Args:
        model: Object or fixture with the joint.
        qpos: Position of the joint, rad or m; or positions, an array.
        state: `open`, `close`, `turnon` or `turnoff`.

    Raises:
        LiberoError: The model has no range for the state.
    """
    bound, upwards = state_bound(model, state)
    if state == "turnon":
        return qpos >= bound if upwards else qpos <= bound
    return qpos > bound if upwards else qpos < bound


def state_bound(model: ObjectModel, state: str) -> tuple[float, bool]:
    """Return the position at which the range of a state begins, and whether it lies upwards of it.

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
    opposite = OPPOSITE_STATES[state]
    upwards = opposite not in ranges or low + high > sum(ranges[opposite])
    return (low if upwards else high), upwards
