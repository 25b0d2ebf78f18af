"""From a goal and a state to the next thing to do."""

from dataclasses import dataclass

from libero_env.errors import LiberoError
from libero_env.expert.shapes import Shapes, pose_of
from libero_env.sim.predicates import evaluate
from libero_env.sim.regions import contains, region_boxes
from libero_env.sim.scene import Scene
from libero_env.sim.state import StateView
from libero_env.tasks.problem import And, Atom, Expression, ForAll, Not, Or

__all__ = ["Shapes", "Step", "UnsupportedGoalError", "plan_goal", "pose_of"]

JOINT_STATES = {"Open": "open", "Close": "close", "Turnon": "turnon", "Turnoff": "turnoff"}
PLACES = ("On", "In", "Stack")
OPPOSITES = {"Open": "Close", "Close": "Open", "Turnon": "Turnoff", "Turnoff": "Turnon"}


class UnsupportedGoalError(LiberoError):
    """A goal for which no skill exists; the message lists those that do."""


@dataclass(frozen=True)
class Step:
    """One skill's work: an atom to make true."""

    atom: Atom
    share: tuple[int, int] = (0, 1)  # which of how many things that go to the same place


def plan_goal(goal: Expression, view: StateView) -> tuple[Step, ...]:
    """The steps that are left, in the order in which they are safe; empty where the goal holds.

    First what is to be closed and receives nothing is closed, so that it is not in the way; then joints are turned and
    opened, those that a place or an object needs included; then things are put, what carries before what it carries;
    then what received something is closed.

    Raises:
        UnsupportedGoalError: an atom that no skill reaches.
    """
    scene = view.scene
    atoms = _wanted(goal, view)
    for atom in atoms:
        _check(atom, scene)
    places = [atom for atom in atoms if atom.predicate in PLACES]
    shares = {atom: _share(atom, places) for atom in places}
    left = [atom for atom in atoms if not evaluate(atom, view)]
    putting = _carriers_first([atom for atom in left if atom.predicate in PLACES])
    needed = [need for atom in putting for need in _needs(atom, view)]
    receiving = {_joint_owner(atom.args[1], scene) for atom in putting} | {need.args[0] for need in needed}
    closing = [atom for atom in left if atom.predicate == "Close"]
    early = [atom for atom in closing if atom.args[0] not in receiving]
    turning = [
        atom for atom in left if atom.predicate in ("Turnon", "Turnoff", "Open") and atom not in needed
    ]
    late = [atom for atom in closing if atom not in early]
    opening = [need for need in dict.fromkeys(needed) if not evaluate(need, view)]
    order = [*early, *turning, *opening, *putting, *late]
    return tuple(Step(atom, shares.get(atom, (0, 1))) for atom in dict.fromkeys(order))


def _wanted(goal: Expression, view: StateView) -> list[Atom]:
    """The atoms that shall hold, of each choice the one with the least to do."""
    match goal:
        case Atom("Up" | "True" | "Printjointstate" | "Incontact"):
            if evaluate(goal, view):
                return []
            raise UnsupportedGoalError(_refusal(goal))
        case Atom():
            return [goal]
        case And(parts):
            return list(dict.fromkeys(atom for part in parts for atom in _wanted(part, view)))
        case Or(parts):
            choices = [_wanted(part, view) for part in parts]
            return min(choices, key=lambda atoms: sum(not evaluate(atom, view) for atom in atoms))
        case Not(Atom(predicate, args)) if predicate in OPPOSITES:
            return [] if evaluate(goal, view) else [Atom(OPPOSITES[predicate], args)]
        case Not() | ForAll():
            if evaluate(goal, view):
                return []
            raise UnsupportedGoalError(
                f"no skill reaches {goal}; state what shall hold instead of what shall not"
            )
    raise TypeError(f"not a goal: {goal!r}")


def _check(atom: Atom, scene: Scene) -> None:
    joint = atom.predicate in JOINT_STATES and scene.owner(atom.args[0]) is not None
    place = atom.predicate in PLACES and len(atom.args) == 2 and atom.args[0] in scene.objects
    if not joint and not place:
        raise UnsupportedGoalError(_refusal(atom))


def _refusal(atom: Atom) -> str:
    return (
        f"no skill reaches ({atom.predicate} {' '.join(atom.args)}); there are some for (On OBJECT PLACE), "
        "(In OBJECT REGION), (Stack OBJECT PLACE), and (Open PART), (Close PART), (Turnon THING), (Turnoff THING)"
    )


def _share(atom: Atom, places: list[Atom]) -> tuple[int, int]:
    same = [other for other in places if other.args[1] == atom.args[1]]
    return same.index(atom), len(same)


def _carriers_first(atoms: list[Atom]) -> list[Atom]:
    """What other things are put on or into comes before them."""
    order: list[Atom] = []
    waiting = list(atoms)
    while waiting:
        moved = {atom.args[0] for atom in waiting}
        ready = [
            atom
            for atom in waiting
            if not any(_belongs(atom.args[1], name) for name in moved - {atom.args[0]})
        ]
        order += ready or waiting  # in a circle as they are written
        waiting = [atom for atom in waiting if atom not in order]
    return order


def _belongs(place: str, name: str) -> bool:
    return place == name or place.startswith(f"{name}_") and not place.removeprefix(f"{name}_")[:1].isdigit()


def _joint_owner(place: str, scene: Scene) -> str | None:
    """The address whose joints give access to a region: its own part's, else those of the whole thing."""
    owner = scene.owner(place)
    if owner is None or owner not in scene.fixtures or "open" not in scene.entities[owner].articulation:
        return None
    return place if scene.joints.get(place) else owner


def _needs(atom: Atom, view: StateView) -> list[Atom]:
    """Parts that must be open to put something there, and to take it from where it is."""
    scene, thing = view.scene, atom.args[0]
    found = []
    address = _joint_owner(atom.args[1], scene)
    if atom.predicate == "In" and address is not None:
        found.append(address)
    for region in scene.problem.regions:
        part = None if region.ranges else _joint_owner(region.address, scene)
        if part is None or region.address not in scene.joints or region.address.endswith("_side"):
            continue
        if any(contains(box, view.body_pos(thing)) for box in region_boxes(view, region.address)):
            found.append(part)
    return [Atom("Open", (part,)) for part in found if scene.joints.get(part)]
