"""Kinds that change the problem: what the task says, and which objects are there. A perturbed task is a task."""

from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from libero_env.assets.arena import WORKSPACES
from libero_env.assets.pack import Pack
from libero_env.perturbations.drawing import draw_key
from libero_env.perturbations.instructions import reword
from libero_env.perturbations.kind import Kind
from libero_env.storage import read_yaml
from libero_env.tasks.problem import Atom, Problem, Region
from libero_env.tasks.task import Task

if TYPE_CHECKING:
    from libero_env.perturbations.value import Perturbation

_MARGIN = 0.05  # [m] by which the distractors' region is larger than that of the task's own objects
DISTRACTOR_REGION = "distractor_region"


def perturb_task(task: Task, perturbations: "Iterable[Perturbation]", pack: Pack) -> Task:
    """Return a task as perturbations change it; those of other layers are ignored.

    Suite, index and name stay, so that its results can be paired with those of the task without perturbations.

    Args:
        task: Task.
        perturbations: Perturbations in the order in which they are applied.
        pack: Asset pack of the models.
    """
    return _perturbed(
        task, tuple(p for p in perturbations if p.definition.layer == "problem" and p.severity), pack
    )


@lru_cache(maxsize=256)
def _perturbed(task: Task, perturbations: "tuple[Perturbation, ...]", pack: Pack) -> Task:
    changed = task
    for one in perturbations:
        rng = draw_key(one.kind, one.seed, task.id).generator()
        changed = one.definition.draw(one.amount, rng, changed, pack)
    return changed


def _instruction(distance: float, rng: np.random.Generator, task: Task, pack: Pack) -> Task:
    """Return the task with other words for the same; both of its instructions are reworded in the same way."""
    name_words = reword(task.language, distance, rng)
    return with_instruction(task, name_words)


def with_instruction(task: Task, instruction: str) -> Task:
    """Return a task with another instruction."""
    problem = replace(task.problem, language=instruction)
    return replace(task, language=instruction, bddl_language=instruction, problem=problem)


def _distractors(count: float, rng: np.random.Generator, task: Task, pack: Pack) -> Task:
    """Return the task with more objects, of categories that it neither has nor names."""
    problem, words = task.problem, set(f"{task.language} {task.bddl_language}".lower().split())
    entities = {*problem.objects, *problem.fixtures}
    known = {**problem.objects, **problem.fixtures}.values()
    free = [
        category
        for category in read_yaml("perturbations/data/distractors.yaml")["categories"]
        if category not in known and category in pack.categories() and not words & _nouns(category)
    ]
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


def _nouns(category: str) -> set[str]:
    return set(
        read_yaml("perturbations/data/distractors.yaml")["categories"][category] or category.split("_")
    )


def _free_name(category: str, taken: Iterable[str]) -> str:
    return next(name for i in range(1, 1000) if (name := f"{category}_{i}") not in taken)


def _around(problem: Problem, workspace: str) -> tuple[float, float, float, float]:
    """Return the rectangle around all regions on the workspace, and a margin."""
    ranges = np.array([r for region in problem.regions if region.target == workspace for r in region.ranges])
    if not ranges.size:
        ranges = np.array([[-0.1, -0.1, 0.1, 0.1]])
    low, high = ranges[:, :2].min(axis=0) - _MARGIN, ranges[:, 2:].max(axis=0) + _MARGIN
    return (*low.round(6).tolist(), *high.round(6).tolist())


KINDS = (
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
