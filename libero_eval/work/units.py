"""Units of work of an evaluation: a task and a range of its initial states, run as one batch."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from libero_env.tasks import Task
from lifelong.errors import ConfigError

# Episodes of a unit by default, measured by experiments/benchmarks/evaluation_units.py
UNIT_STARTS = 10


@dataclass(frozen=True)
class Unit:
    """A part of an evaluation: all its episodes are run at once, in one batch.

    Attributes:
        task: Task of the benchmark.
        starts: Indices of the initial states.
    """

    task: Task
    starts: tuple[int, ...]

    @property
    def name(self) -> str:
        """Name of the unit's files, such as `libero_goal_03_starts_10_19`."""
        return f"{self.task.suite}_{self.task.index:02d}_starts_{self.starts[0]:02d}_{self.starts[-1]:02d}"


def partition(tasks: Iterable[Task], starts: Sequence[int], size: int) -> tuple[Unit, ...]:
    """Return the units of an evaluation, task by task.

    The units of a task do not depend on the other tasks, so that bits of a policy that depend on the composition of
    its batch do not either.

    Args:
        tasks: Tasks of the benchmark.
        starts: Indices of the initial states of each task.
        size: Number of initial states of a unit; the last one of a task may have fewer.

    Raises:
        ConfigError: The size is not positive, there are no initial states, or one is named twice.
    """
    if size < 1:
        raise ConfigError(f"{size} initial states in a unit; a unit needs at least 1")
    if not starts or len(set(starts)) != len(starts):
        raise ConfigError(f"initial states {list(starts)}: name at least one, and each once")
    parts = [tuple(starts[i : i + size]) for i in range(0, len(starts), size)]
    return tuple(Unit(task, part) for task in tasks for part in parts)
