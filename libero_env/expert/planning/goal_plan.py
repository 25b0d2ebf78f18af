"""From a goal and a state to the steps that are left."""

from dataclasses import dataclass

import numpy as np

from libero_env.errors import LiberoError
from libero_env.objects.model import OPPOSITE_STATES
from libero_env.sim.history import History
from libero_env.sim.predicates import contains, evaluate, ground, region_boxes
from libero_env.sim.scene import Scene
from libero_env.sim.state import StateView
from libero_env.tasks.expression import And, Atom, Count, Expression, ForAll, Never, Not, Or, Then

PLACES = ("On", "In", "Stack")


class UnsupportedGoalError(LiberoError):
    """No skill reaches a goal; the message lists the goals that are supported."""


@dataclass(frozen=True)
class Step:
    """The work of one skill.

    Attributes:
        atom: Atom to make true.
        slot: (k, n): the object is number k of n that go to the same place.
    """

    atom: Atom
    slot: tuple[int, int] = (0, 1)


def look(history: History, view: StateView) -> None:
    """Take note of the present state, if a goal has conditions over time."""
    if history.memory.size:
        held = {atom: np.array([evaluate(atom, view)]) for atom in history.goal.atoms()}
        history.look(np.zeros(1, np.int64), held)


def plan_goal(goal: Expression, view: StateView, history: History | None = None) -> tuple[Step, ...]:
    """Return the steps that are left, in a safe order; none where the goal holds.

    The order: close what receives nothing, so that it is not in the way; turn knobs and open parts, including those
    that give access to a place or an object; place objects, each after the object that carries it; close what has
    received something.

    Args:
        goal: Goal of the episode.
        view: Its state.
        history: What the goal's conditions over time remember of it; None where it begins now.

    Raises:
        UnsupportedGoalError: No skill reaches an atom of the goal.
    """
    scene = view.scene
    if history is None:
        history = History(ground(goal, scene), 1)
        look(history, view)
    atoms = _required_atoms(history.goal if history.memory.size else goal, view, history)
    for atom in atoms:
        _check(atom, scene)
    placements = [atom for atom in atoms if atom.predicate in PLACES]
    slots = {atom: _slot(atom, placements) for atom in placements}
    left = [atom for atom in atoms if not evaluate(atom, view)]
    placing = _carriers_first([atom for atom in left if atom.predicate in PLACES])
    access = [need for atom in placing for need in _required_open(atom, view)]
    receiving = {_joint_address(atom.args[1], scene) for atom in placing} | {need.args[0] for need in access}
    closing = [atom for atom in left if atom.predicate == "Close"]
    closing_first = [atom for atom in closing if atom.args[0] not in receiving]
    closing_last = [atom for atom in closing if atom not in closing_first]
    moving = [a for a in left if a.predicate in ("Turnon", "Turnoff", "Open") and a not in access]
    opening = [need for need in dict.fromkeys(access) if not evaluate(need, view)]
    order = [*closing_first, *moving, *opening, *placing, *closing_last]
    return tuple(Step(atom, slots.get(atom, (0, 1))) for atom in dict.fromkeys(order))


def _required_atoms(goal: Expression, view: StateView, history: History) -> list[Atom]:
    """Return the atoms that have to hold; of alternatives, those with the fewest left to do."""
    match goal:
        case Atom("Up" | "True" | "Printjointstate" | "Incontact"):
            if evaluate(goal, view):
                return []
            raise UnsupportedGoalError(_unsupported(goal))
        case Atom():
            return [goal]
        case And(parts):
            return list(
                dict.fromkeys(atom for part in parts for atom in _required_atoms(part, view, history))
            )
        case Or(parts):
            choices = [_required_atoms(part, view, history) for part in parts]
            return min(choices, key=lambda atoms: sum(not evaluate(atom, view) for atom in atoms))
        case Not(Atom(predicate, args)) if predicate.lower() in OPPOSITE_STATES:
            opposite = OPPOSITE_STATES[predicate.lower()].capitalize()
            return [] if evaluate(goal, view) else [Atom(opposite, args)]
        case Then(parts):
            if history.is_late(0, goal):
                return _undone(goal, parts[1])
            return _required_atoms(parts[history.count(0, goal)], view, history)
        case Count(number, part):
            if history.count(0, goal) >= number:
                return []
            return _undone(goal, part) if evaluate(part, view) else _required_atoms(part, view, history)
        case Never():
            if history.count(0, goal):
                raise UnsupportedGoalError(f"{goal} is broken, and no skill takes that back")
            return []
        case Not() | ForAll():
            if evaluate(goal, view):
                return []
            raise UnsupportedGoalError(
                f"no skill reaches {goal}; state what has to hold instead of what must not"
            )
    raise TypeError(f"not a goal: {goal!r}")


def _undone(goal: Expression, part: Expression) -> list[Atom]:
    """Return the atom that ends a part which has to begin to hold once more."""
    if isinstance(part, Atom) and (state := part.predicate.lower()) in OPPOSITE_STATES:
        return [Atom(OPPOSITE_STATES[state].capitalize(), part.args)]
    raise UnsupportedGoalError(f"{goal}: {part} holds, and no skill ends it so that it can begin again")


def _check(atom: Atom, scene: Scene) -> None:
    joint = atom.predicate.lower() in OPPOSITE_STATES and scene.owner(atom.args[0]) is not None
    place = atom.predicate in PLACES and len(atom.args) == 2 and atom.args[0] in scene.objects
    if not joint and not place:
        raise UnsupportedGoalError(_unsupported(atom))


def _unsupported(atom: Atom) -> str:
    return (
        f"no skill reaches {atom}; supported are (On OBJECT PLACE), "
        "(In OBJECT REGION), (Stack OBJECT PLACE), (Open PART), (Close PART), (Turnon FIXTURE), (Turnoff FIXTURE)"
    )


def _slot(atom: Atom, placements: list[Atom]) -> tuple[int, int]:
    same_place = [other for other in placements if other.args[1] == atom.args[1]]
    return same_place.index(atom), len(same_place)


def _carriers_first(atoms: list[Atom]) -> list[Atom]:
    """Return placements in an order in which an object is moved before others are put on or into it."""
    order: list[Atom] = []
    waiting = list(atoms)
    while waiting:
        moved = {atom.args[0] for atom in waiting}
        ready = [
            atom
            for atom in waiting
            if not any(_belongs(atom.args[1], name) for name in moved - {atom.args[0]})
        ]
        order += ready or waiting  # a cycle stays as it is written
        waiting = [atom for atom in waiting if atom not in order]
    return order


def _belongs(place: str, name: str) -> bool:
    """Return whether a place is an object, or a region of the object: `bowl_1_top`, but not `bowl_1_2`."""
    return place == name or place.startswith(f"{name}_") and not place.removeprefix(f"{name}_")[:1].isdigit()


def _joint_address(place: str, scene: Scene) -> str | None:
    """Return the address whose joints give access to a region: its own, or its fixture; None without such joints."""
    owner = scene.owner(place)
    if owner is None or owner not in scene.fixtures or "open" not in scene.entities[owner].articulation:
        return None
    return place if scene.joints.get(place) else owner


def _required_open(atom: Atom, view: StateView) -> list[Atom]:
    """Return the parts that have to be open to reach the place of a placement, and its object."""
    scene = view.scene
    parts = []
    address = _joint_address(atom.args[1], scene)
    if atom.predicate == "In" and address is not None:
        parts.append(address)
    for region in scene.problem.regions:
        part = None if region.ranges else _joint_address(region.address, scene)
        if part is None or region.address not in scene.joints or region.address.endswith("_side"):
            continue
        if any(contains(box, view.body_pos(atom.args[0])) for box in region_boxes(view, region.address)):
            parts.append(part)
    return [Atom("Open", (part,)) for part in parts if scene.joints.get(part)]
