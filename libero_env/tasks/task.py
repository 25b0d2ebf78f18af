"""The values `Task` and `Suite`."""

from dataclasses import dataclass

from libero_env.errors import UnknownNameError
from libero_env.tasks import bddl
from libero_env.tasks.builder import load_data
from libero_env.tasks.problem import Problem


@dataclass(frozen=True)
class Task:
    """One task of a suite. `language` is the default instruction, read from the name as the original does;
    `bddl_language` is what its task file says."""

    suite: str
    index: int
    name: str
    language: str
    bddl_language: str
    problem: Problem

    @property
    def id(self) -> str:
        """`libero_object/3`."""
        return f"{self.suite}/{self.index}"

    @property
    def bddl_text(self) -> str:
        """The task file, generated."""
        return bddl.write(self.problem)


@dataclass(frozen=True)
class Suite:
    """Tasks in their published order. Those of a suite that consists of others (LIBERO-100 is LIBERO-90 and
    LIBERO-10) keep the suite and index that they have there, and with them their demonstrations and states."""

    name: str
    tasks: tuple[Task, ...]

    def __len__(self) -> int:
        return len(self.tasks)

    def order(self, order_index: int = 0) -> tuple[Task, ...]:
        """The tasks in one of the sequences of the original benchmark.

        Args:
            order_index: 0 is the order of the indices; the ten-task suites have 21 orders.

        Raises:
            UnknownNameError: the suite has no such order.
        """
        orders = load_data("task_orders.yaml") if len(self) == 10 else [list(range(len(self)))]
        if order_index not in range(len(orders)):
            raise UnknownNameError(f"task order of {self.name}", order_index, range(len(orders)))
        return tuple(self.tasks[i] for i in orders[order_index])
