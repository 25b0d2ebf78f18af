"""Kinds that change the problem: what the task says, and which objects are there. A perturbed task is a task."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from libero_env.errors import InvalidInputError, PlacementError
from libero_env.init_states.store import load_init_states
from libero_env.perturbations.instructions import reword
from libero_env.perturbations.kinds import direction
from libero_env.perturbations.starts import carried, contacts, shifted
from libero_env.sim.scene import Scene
from libero_env.storage import read_yaml
from libero_env.tasks.builder import entities_in_goal
from libero_env.tasks.expression import And, Atom
from libero_env.tasks.problem import Problem, Region
from libero_env.tasks.suites import get_suite, suite_names
from libero_env.tasks.task import Task
from libero_env.workspaces import WORKSPACES

_REACH = (-0.2, -0.25, 0.1, 0.25)  # [m] rectangle that the arm reaches easily on every workspace
_MARGIN = 0.05  # [m] by which the distractors' region is larger than that of the task's own objects
_LAYOUT_TRIES = 200  # directions for each object
DISTRACTOR_REGION = "distractor_region"
_ON_PLATE = "on the plate"
_PLACES = {  # category of a fixture and name of a region -> what an instruction calls the place
    ("flat_stove", "cook_region"): "on the stove",
    ("wooden_cabinet", "top_side"): "on top of the wooden cabinet",
}


def _goal(count: float, rng: np.random.Generator, task: Task, scene: Scene) -> Task:
    """Return the task with another goal that its scene is known to have.

    It is that of one of the benchmark's tasks that begin in the same way; without any, carrying another object to where
    the task's object belongs; without any, carrying that object elsewhere.

    Raises:
        InvalidInputError: There is none.
    """
    goals = list(_of_same_scene(task)) or list(_of_other_objects(task)) or list(_of_other_places(task))
    if not goals:
        raise InvalidInputError(f"{task.id} has no other goal: no task of the benchmark begins as it does")
    return goals[rng.integers(len(goals))]


def _of_same_scene(task: Task) -> Iterator[Task]:
    said, known = {task.language}, {region.address for region in task.problem.regions}
    for other in _by_scene().get(_scene_of(task.problem), ()):
        if other.problem.goal != task.problem.goal and other.language not in said:
            said.add(other.language)
            more = tuple(region for region in other.problem.regions if region.address not in known)
            changes = {name: getattr(other.problem, name) for name in ("language", "goal", "obj_of_interest")}
            regions = (*task.problem.regions, *more)
            yield _with_words(task, _instructions(other), **changes, regions=regions)


def _with_words(task: Task, said: Sequence[str], **changes: Any) -> Task:
    """Return a task with other instructions, `language` and `bddl_language`, and another problem."""
    language, bddl_language = said
    problem = replace(task.problem, **{"language": bddl_language, **changes})
    return replace(task, language=language, bddl_language=bddl_language, problem=problem)


def _only_atom(task: Task) -> Atom | None:
    """Return the atom of a goal that has only one."""
    goal = task.problem.goal
    parts = goal.parts if isinstance(goal, And) else (goal,)
    return parts[0] if len(parts) == 1 and isinstance(parts[0], Atom) else None


def _of_other_objects(task: Task) -> Iterator[Task]:
    """Yield the task of carrying each other object of a name of its own that stands where the task's object could."""
    problem, names, atom = task.problem, read_yaml("perturbations/data/names.yaml"), _only_atom(task)
    if atom is None or atom.args[0] not in problem.objects:
        return
    own = names.get(problem.objects[atom.args[0]])
    categories = list(problem.objects.values())
    for name, category in problem.objects.items():
        alone = categories.count(category) == 1 and category in names
        if own is None or not alone or name in atom.args or not any(own in t for t in _instructions(task)):
            continue
        if any(arg.startswith(name) for arg in atom.args):  # it is where the object belongs
            continue
        changed = And((Atom(atom.predicate, (name, *atom.args[1:])),))
        said = [text.replace(own, names[category]) for text in _instructions(task)]
        interest = entities_in_goal(changed, problem.regions, problem.objects, problem.fixtures)
        yield _with_words(task, said, goal=changed, obj_of_interest=tuple(interest))


def _of_other_places(task: Task) -> Iterator[Task]:
    """Yield the task of carrying what belongs on the plate to each other place of the scene that has a name."""
    problem, atom = task.problem, _only_atom(task)
    if atom is None or atom.predicate != "On" or not all(t.endswith(_ON_PLATE) for t in _instructions(task)):
        return
    moved = atom.args[0]
    start = problem.places.get(moved, "")
    for region in problem.regions:
        words = _PLACES.get((problem.fixtures.get(region.target, ""), region.name))
        if words is not None and not start.startswith(region.target):
            changed = And((Atom("On", (moved, region.address)),))
            said = [text.removesuffix(_ON_PLATE) + words for text in _instructions(task)]
            yield _with_words(task, said, goal=changed, obj_of_interest=(moved, region.target))


def _is_named(category: str, text: str) -> bool:
    """Return whether an instruction names objects of a category."""
    name = read_yaml("perturbations/data/names.yaml").get(category)
    return name in text if name else bool({*category.split("_")} & {*text.split()})


def _instructions(task: Task) -> tuple[str, str]:
    return task.language, task.bddl_language


def _scene_of(problem: Problem) -> tuple[object, ...]:
    """Return what two tasks share whose episodes begin in the same way."""
    regions = {atom.args[1]: problem.region(atom.args[1]) for atom in problem.init if len(atom.args) == 2}
    places = frozenset(
        (name, region.ranges, region.yaw) for name, region in regions.items() if region is not None
    )
    return (
        tuple(problem.fixtures.items()),
        tuple(problem.objects.items()),
        frozenset(problem.init),
        places,
        tuple(sorted(problem.scene_properties.items())),
    )


@cache
def _by_scene() -> dict[tuple[object, ...], list[Task]]:
    tasks: dict[tuple[object, ...], list[Task]] = {}
    for task in dict.fromkeys(task for name in suite_names() for task in get_suite(name).tasks):
        tasks.setdefault(_scene_of(task.problem), []).append(task)
    return tasks


def _objects(share: float, rng: np.random.Generator, task: Task, scene: Scene) -> Task:
    """Return the task with others in the place of objects that neither goal nor instruction are about."""
    problem = task.problem
    used = {n for atom in scene.goal_atoms for arg in atom.args for n in problem.objects if arg.startswith(n)}
    free = _unnamed(task, scene)
    roots = carried(problem)
    instructions = " ".join(_instructions(task)).lower()
    alone = [
        n for n in roots if not roots[n] and n not in used and not _is_named(problem.objects[n], instructions)
    ]
    chosen = [alone[i] for i in rng.permutation(len(alone))][: max(1, round(share * len(alone)))]
    others = {name: free[i] for name, i in zip(chosen, rng.permutation(len(free)), strict=False)}
    if not others:
        raise InvalidInputError(f"{task.id} has no object that could be another: all are part of the task")
    _require(free, len(chosen), task)
    return replace(task, problem=replace(problem, objects={**problem.objects, **others}))


def _instruction(distance: float, rng: np.random.Generator, task: Task, scene: Scene) -> Task:
    """Return the task with other words for the same; both of its instructions are reworded in the same way."""
    instruction = reword(task.language, distance, rng)
    return _with_words(task, (instruction, instruction))


def _distractors(count: float, rng: np.random.Generator, task: Task, scene: Scene) -> Task:
    """Return the task with more objects, of categories that it neither has nor names."""
    problem, free = task.problem, _unnamed(task, scene)
    _require(free, int(count), task)
    entities = {*problem.objects, *problem.fixtures}
    chosen = [free[i] for i in rng.permutation(len(free))][: int(count)]
    names = {_free_name(category, entities): category for category in chosen}
    workspace = next(name for name, category in problem.fixtures.items() if category in WORKSPACES)
    region = Region(DISTRACTOR_REGION, workspace, (_around(problem, workspace),))
    changed = replace(
        problem,
        objects={**problem.objects, **names},
        regions=(*problem.regions, region),
        init=(*problem.init, *(Atom("On", (name, region.address)) for name in names)),
    )
    return replace(task, problem=changed)


def _unnamed(task: Task, scene: Scene) -> list[str]:
    """Return categories of objects that the task neither has nor could mean."""
    known = {**task.problem.objects, **task.problem.fixtures}.values()
    there, used = scene.pack.categories(), {*" ".join(_instructions(task)).lower().split()}
    return [
        category
        for category, words in read_yaml("perturbations/data/distractors.yaml")["categories"].items()
        if category not in known and category in there and not used & set(words or category.split("_"))
    ]


def _require(free: Sequence[str], count: int, task: Task) -> None:
    """Raise unless there are as many categories as objects are to be new."""
    if len(free) < count:
        raise InvalidInputError(
            f"{task.id}: {count} objects are to be new, and {len(free)} categories are neither in the task nor named "
            "by it; choose a lower severity of distractors or objects"
        )


def _free_name(category: str, taken: Iterable[str]) -> str:
    return next(name for i in range(1, 1000) if (name := f"{category}_{i}") not in taken)


def _around(problem: Problem, workspace: str) -> tuple[float, float, float, float]:
    """Return the rectangle around all regions on the workspace and the middle of its reach, and a margin."""
    own = [r for region in problem.regions if region.target == workspace for r in region.ranges]
    ranges = np.array([*own, _REACH])
    low, high = ranges[:, :2].min(axis=0) - _MARGIN, ranges[:, 2:].max(axis=0) + _MARGIN
    return (*low.round(6).tolist(), *high.round(6).tolist())


def _layout(metres: float, rng: np.random.Generator, task: Task, scene: Scene) -> Task:
    """Return the task with the regions of its objects moved by the same distance, each in another direction.

    What the goal is about besides the objects that are carried stays in its place, as do fixtures. Where the
    instruction tells objects of one category apart by their places, all objects move together.

    Raises:
        PlacementError: An object cannot be moved so far without touching another in one of the stored initial states.
    """
    rows, loads = list(load_init_states(task, scene)), carried(task.problem)
    free = [contacts(scene, row) for row in rows]
    shifts: dict[str, np.ndarray] = {}
    for group in _groups(task.problem, scene):
        together = [name for one in group for name in (one, *loads[one])]
        for _ in range(_LAYOUT_TRIES):
            step = metres * direction(rng, 2)
            moved = [shifted(scene, row, together, step) for row in rows]
            if all(contacts(scene, row) <= before for row, before in zip(moved, free, strict=True)):
                rows = moved
                shifts |= dict.fromkeys(group, step)
                break
        else:
            raise PlacementError(f"{task.id}: {', '.join(group)} cannot be moved by {metres:.3f} m")
    return replace(task, problem=_with_shifts(task.problem, shifts))


def _groups(problem: Problem, scene: Scene) -> list[list[str]]:
    """Return the objects that stand on the workspace and are moved; those of a group by the same."""
    roots, atoms = carried(problem), scene.goal_atoms
    taken = [atom.args[0] for atom in atoms if atom.args[0] in problem.objects]
    counts = Counter(problem.objects.values())
    if any(
        counts[problem.objects[name]] > 1 for atom in atoms for name in atom.args if name in problem.objects
    ):
        return [list(roots)]
    on_table = any(
        (region := problem.region(name)) and region.ranges for atom in atoms for name in atom.args[1:]
    )
    fixed = {scene.owner(name) for atom in atoms for name in atom.args[1:]}
    if on_table:  # such as `to the right of the plate`: what is named beside it is a landmark
        words = set(problem.language.lower().split())
        fixed |= {n for n, c in problem.objects.items() if words & set(c.split("_")) and n not in taken}
    return [[name] for name in roots if name not in fixed]


def _with_shifts(problem: Problem, shifts: dict[str, np.ndarray]) -> Problem:
    """Return a problem in which each object has a region of its own, moved from where it was."""
    regions, init = list(problem.regions), []
    for atom in problem.init:
        region = problem.region(atom.args[-1])
        if atom.args[0] in shifts and region is not None and len(atom.args) == 2:
            x, y = shifts[atom.args[0]]
            ranges = tuple((a + x, b + y, c + x, d + y) for a, b, c, d in region.ranges)
            own = Region(f"{region.name}_of_{atom.args[0]}", region.target, ranges, region.yaw, region.rgba)
            regions.append(own)
            atom = Atom(atom.predicate, (atom.args[0], own.address))
        init.append(atom)
    return replace(problem, regions=tuple(regions), init=tuple(init))


SAMPLERS = {
    "goal": _goal,
    "layout": _layout,
    "objects": _objects,
    "distractors": _distractors,
    "instruction": _instruction,
}
