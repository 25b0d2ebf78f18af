"""The dataclass `PublishedTask`: a variant of a task of LIBERO, as others have published it."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from libero_env.errors import LiberoError
from libero_env.tasks.problem import Problem
from libero_env.tasks.published.plus_id import PlusVariant
from libero_env.tasks.task import Task

RobotState = Literal["overwritten", "skipped"]
_PICTURES = {
    "light": "lights",
    "table": "the table's texture",
    "table_and_wall": "the textures of table and wall",
}


@dataclass(frozen=True)
class PublishedTask(Task):
    """A variant of a task of LIBERO.

    Attributes:
        base: Task that is varied; its stored initial states are also those of a variant that leaves objects in place.
        kind: Kind of the change: one of LIBERO-Plus' seven dimensions, or `swap`, `object`, `language`, `task`.
        file: Task file of the variant.
        states_file: File with its published initial states.
        has_own_start: Whether its initial states are not those of `base`.
        variant: What the id says, of LIBERO-Plus; otherwise None.
        robot_state: What becomes of the arm's pose in LIBERO-Plus. `overwritten`: the stored initial state is set after
            the reset, as its README says, and only the controller keeps the pose; `skipped`: no state is set, as RLinf
            does, so that the arm starts in the pose.
        lacks: What the scene needs that no distribution has; empty for nothing.

    The instruction `language` is never that of a file's name with its ending: it is the base task's, or that of the
    task file where the variant is of its words or its goal.
    """

    base: Task
    kind: str
    file: Path
    states_file: Path
    has_own_start: bool = False
    variant: PlusVariant | None = None
    robot_state: RobotState = "overwritten"
    lacks: str = ""

    @property
    def origin(self) -> Task:
        """Task of LIBERO that it is a variant of."""
        return self.base

    @property
    def start_task(self) -> Task:
        """Task whose stored initial states it starts in."""
        return self if self.has_own_start else self.base

    @property
    def num_starts(self) -> int:
        """Number of stored initial states; LIBERO-Plus publishes one of a variant with other objects or places."""
        return 1 if self.has_own_start and self.variant is not None else super().num_starts


def lacking(variant: PlusVariant | None, problem: Problem, known: Iterable[str]) -> str:
    """Return what a variant needs that no distribution has; empty for nothing.

    Args:
        variant: Variant of LIBERO-Plus, or None.
        problem: Its problem.
        known: Categories of objects that have a model.
    """
    if variant is not None and variant.scenery in _PICTURES:
        return _PICTURES[variant.scenery]
    categories = {*problem.objects.values(), *problem.fixtures.values()}
    missing = sorted(categories.difference(known))
    return f"models of {', '.join(missing)}" if missing else ""


def require_available(tasks: Iterable[Task]) -> None:
    """Check that the scenes of tasks can be built.

    Raises:
        LiberoError: Some cannot; the message counts them by kind, and says how to leave them out.
    """
    given = list(tasks)
    absent = [task for task in given if isinstance(task, PublishedTask) and task.lacks]
    if not absent:
        return
    first, counts = absent[0], Counter(task.kind for task in absent)
    shown = ", ".join(f"{kind} {count}" for kind, count in counts.items())
    raise LiberoError(
        f"{len(absent)} of {len(given)} tasks need files that no distribution has ({shown}), such as {first.id}, which "
        f"needs {first.lacks}; the others are the suite {first.suite}:available"
    )
