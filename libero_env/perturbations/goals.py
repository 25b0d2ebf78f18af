"""Another goal in the same scene, with its instruction."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache

from libero_env.errors import InvalidInputError
from libero_env.storage import read_yaml
from libero_env.tasks.builder import entities_in_goal
from libero_env.tasks.problem import And, Atom, Problem
from libero_env.tasks.suites import get_suite, suite_names
from libero_env.tasks.task import Task

_ON_PLATE = "on the plate"
_PLACES = {  # category of a fixture and name of a region -> what an instruction calls the place
    ("flat_stove", "cook_region"): "on the stove",
    ("wooden_cabinet", "top_side"): "on top of the wooden cabinet",
}


def other_goals(task: Task) -> list[Task]:
    """Return the task with each other goal that its scene is known to have.

    They are the goals of the benchmark's tasks that begin in the same way; without any, those of carrying other objects
    to where the task's object belongs; without any, those of carrying that object elsewhere.

    Raises:
        InvalidInputError: There is none.
    """
    goals = list(_of_same_scene(task)) or list(_of_other_objects(task)) or list(_of_other_places(task))
    if not goals:
        raise InvalidInputError(f"{task.id} has no other goal: no task of the benchmark begins as it does")
    return goals


def _of_same_scene(task: Task) -> Iterator[Task]:
    said = {task.language}
    for other in _by_scene().get(_scene_of(task.problem), ()):
        if other.problem.goal != task.problem.goal and other.language not in said:
            said.add(other.language)
            yield _with_goal(task, other)


def _with_goal(task: Task, other: Task) -> Task:
    known = {region.address for region in task.problem.regions}
    more = tuple(region for region in other.problem.regions if region.address not in known)
    problem = replace(
        task.problem,
        language=other.problem.language,
        goal=other.problem.goal,
        obj_of_interest=other.problem.obj_of_interest,
        regions=(*task.problem.regions, *more),
    )
    return replace(task, language=other.language, bddl_language=other.bddl_language, problem=problem)


def _of_other_objects(task: Task) -> Iterator[Task]:
    """Yield the task of carrying each other object of a name of its own that stands where the task's object could."""
    problem, names = task.problem, read_yaml("perturbations/data/names.yaml")
    goal = problem.goal.parts if isinstance(problem.goal, And) else (problem.goal,)
    if len(goal) != 1 or not isinstance(goal[0], Atom) or goal[0].args[0] not in problem.objects:
        return
    atom = goal[0]
    own = names.get(problem.objects[atom.args[0]])
    categories = list(problem.objects.values())
    for name, category in problem.objects.items():
        alone = categories.count(category) == 1 and category in names
        if own is None or not alone or name in atom.args or not any(own in t for t in _instructions(task)):
            continue
        if any(arg.startswith(name) for arg in atom.args):  # it is where the object belongs
            continue
        changed = And((Atom(atom.predicate, (name, *atom.args[1:])),))
        language, bddl_language = (text.replace(own, names[category]) for text in _instructions(task))
        interest = entities_in_goal(changed, problem.regions, problem.objects, problem.fixtures)
        own_problem = replace(problem, goal=changed, language=bddl_language, obj_of_interest=tuple(interest))
        yield replace(task, language=language, bddl_language=bddl_language, problem=own_problem)


def _of_other_places(task: Task) -> Iterator[Task]:
    """Yield the task of carrying what belongs on the plate to each other place of the scene that has a name."""
    problem, goal = task.problem, task.problem.goal
    atoms = goal.parts if isinstance(goal, And) else (goal,)
    if len(atoms) != 1 or not isinstance(atoms[0], Atom) or atoms[0].predicate != "On":
        return
    carried = atoms[0].args[0]
    start = next((a.args[1] for a in problem.init if a.args[0] == carried and len(a.args) == 2), "")
    for region in problem.regions:
        words = _PLACES.get((problem.fixtures.get(region.target, ""), region.name))
        if words is None or start.startswith(region.target):
            continue
        if not all(text.endswith(_ON_PLATE) for text in _instructions(task)):
            continue
        changed = And((Atom("On", (carried, region.address)),))
        language, bddl_language = (text.removesuffix(_ON_PLATE) + words for text in _instructions(task))
        own = replace(problem, goal=changed, language=bddl_language, obj_of_interest=(carried, region.target))
        yield replace(task, language=language, bddl_language=bddl_language, problem=own)


def is_named(category: str, text: str) -> bool:
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
