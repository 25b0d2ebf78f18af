"""Kinds that change the problem: what the task says, and which objects are there. A perturbed task is a task."""

from collections import OrderedDict
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from libero_env.assets.arena import WORKSPACES
from libero_env.errors import InvalidInputError
from libero_env.perturbations.drawing import draw_key
from libero_env.perturbations.draws import first_attempt
from libero_env.perturbations.goals import is_named, other_goals
from libero_env.perturbations.instructions import reword
from libero_env.perturbations.kind import Kind
from libero_env.perturbations.layouts import move_layout
from libero_env.perturbations.starts import carried
from libero_env.sim.scene import Scene
from libero_env.storage import read_yaml
from libero_env.tasks.problem import Atom, Problem, Region
from libero_env.tasks.task import Task

if TYPE_CHECKING:
    from libero_env.perturbations.value import Perturbation

_REACH = (-0.2, -0.25, 0.1, 0.25)  # [m] rectangle that the arm reaches easily on every workspace
_MARGIN = 0.05  # [m] by which the distractors' region is larger than that of the task's own objects
_MAX_KNOWN = 256
_known: OrderedDict[Any, Task] = OrderedDict()  # perturbed tasks
DISTRACTOR_REGION = "distractor_region"


def perturb_task(task: Task, perturbations: "Iterable[Perturbation]", scene: Scene) -> Task:
    """Return a task as perturbations change it; those of other layers are ignored.

    Suite, index and name stay, so that its results can be paired with those of the task without perturbations.

    Args:
        task: Task.
        perturbations: Perturbations in the order in which they are applied.
        scene: Compiled scene of the task.

    Raises:
        InvalidInputError: The task has no other goal.
        PlacementError: Objects cannot be moved so far.
    """
    found = [one for one in perturbations if one.definition.layer == "problem" and one.severity]
    attempts = [first_attempt(one, task.id) for one in found]
    key = (task, tuple(found), tuple(attempts), scene.pack, scene.robot)
    if key not in _known:
        _known[key] = _perturbed(task, zip(found, attempts, strict=True), scene)
        while len(_known) > _MAX_KNOWN:
            _known.popitem(last=False)
    return _known[key]


def reword_task(task: Task, perturbations: "Iterable[Perturbation]") -> Task:
    """Return a task in the words that perturbations give it, without its scene; those of other kinds are ignored."""
    for one in perturbations:
        if one.kind == "instruction" and one.severity:
            attempt = first_attempt(one, task.id)
            rng = draw_key(one.kind, one.seed, task.id, attempt=attempt).generator()
            return with_instruction(task, reword(task.language, one.amount, rng))
    return task


def _perturbed(task: Task, drawn: "Iterable[tuple[Perturbation, int]]", scene: Scene) -> Task:
    changed = task
    for one, attempt in drawn:
        rng = draw_key(one.kind, one.seed, task.id, attempt=attempt).generator()
        changed = one.definition.draw(one.amount, rng, changed, scene)
    return changed


def _goal(count: float, rng: np.random.Generator, task: Task, scene: Scene) -> Task:
    goals = other_goals(task)
    return goals[rng.integers(len(goals))]


def _objects(share: float, rng: np.random.Generator, task: Task, scene: Scene) -> Task:
    """Return the task with others in the place of objects that neither goal nor instruction are about."""
    problem = task.problem
    used = {
        n for atom in problem.goal.atoms() for arg in atom.args for n in problem.objects if arg.startswith(n)
    }
    free = _unnamed(task, scene)
    roots = carried(problem)
    told = f"{task.language} {task.bddl_language}".lower()
    alone = [n for n in roots if not roots[n] and n not in used and not is_named(problem.objects[n], told)]
    chosen = [alone[i] for i in rng.permutation(len(alone))][: max(1, round(share * len(alone)))]
    others = {name: free[i] for name, i in zip(chosen, rng.permutation(len(free)), strict=False)}
    if not others:
        raise InvalidInputError(f"{task.id} has no object that could be another: all are part of the task")
    return replace(task, problem=replace(problem, objects={**problem.objects, **others}))


def _instruction(distance: float, rng: np.random.Generator, task: Task, scene: Scene) -> Task:
    """Return the task with other words for the same; both of its instructions are reworded in the same way."""
    name_words = reword(task.language, distance, rng)
    return with_instruction(task, name_words)


def with_instruction(task: Task, instruction: str) -> Task:
    """Return a task with another instruction."""
    problem = replace(task.problem, language=instruction)
    return replace(task, language=instruction, bddl_language=instruction, problem=problem)


def _distractors(count: float, rng: np.random.Generator, task: Task, scene: Scene) -> Task:
    """Return the task with more objects, of categories that it neither has nor names."""
    problem, free = task.problem, _unnamed(task, scene)
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
    there = scene.pack.categories()
    return [c for c in _distractor_words() if c not in known and c in there and not _words(task) & _nouns(c)]


def _words(task: Task) -> set[str]:
    return set(f"{task.language} {task.bddl_language}".lower().split())


def _distractor_words() -> Mapping[str, list[str]]:
    return read_yaml("perturbations/data/distractors.yaml")["categories"]


def _nouns(category: str) -> set[str]:
    return set(_distractor_words().get(category) or category.split("_"))


def _free_name(category: str, taken: Iterable[str]) -> str:
    return next(name for i in range(1, 1000) if (name := f"{category}_{i}") not in taken)


def _around(problem: Problem, workspace: str) -> tuple[float, float, float, float]:
    """Return the rectangle around all regions on the workspace and the middle of its reach, and a margin."""
    own = [r for region in problem.regions if region.target == workspace for r in region.ranges]
    ranges = np.array([*own, _REACH])
    low, high = ranges[:, :2].min(axis=0) - _MARGIN, ranges[:, 2:].max(axis=0) + _MARGIN
    return (*low.round(6).tolist(), *high.round(6).tolist())


KINDS = (
    Kind(
        "goal",
        "problem",
        "goals",
        1,
        "the scene has another goal, with its instruction; the severity does not matter",
        _goal,
        scale="count",
        physical=True,
        exclusive=True,
    ),
    Kind(
        "layout",
        "problem",
        "m",
        0.1,
        "the places of objects are moved so far; what the goal puts them on or in, and fixtures, stay",
        move_layout,
        physical=True,
    ),
    Kind(
        "objects",
        "problem",
        "share",
        1.0,
        "this share of the objects that the task is not about are others, in the same places",
        _objects,
        physical=True,
    ),
    Kind(
        "distractors",
        "problem",
        "objects",
        6,
        "so many objects stand around that the task does not have",
        _distractors,
        scale="count",
        physical=True,
    ),
    Kind(
        "instruction",
        "problem",
        "token edit distance",
        0.8,
        "the instruction says the same in other words, at this normalised edit distance",
        _instruction,
    ),
)
