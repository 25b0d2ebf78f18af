"""The dataclasses `Task` and `Suite`."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from libero_env.errors import InvalidInputError, require_known
from libero_env.storage import read_yaml
from libero_env.tasks import bddl
from libero_env.tasks.problem import Problem
from libero_env.workspaces import find_workspace

FILE = "file"  # suite of a task that was read from a file on its own
NUM_INIT_STATES = 50  # that are stored of a task
MAX_NAME_BYTES = 200  # of a task or suite; names of files made of them are a little longer


def check_name(name: str, what: str = "task") -> str:
    """Return the name of a task or suite, which becomes that of files and folders, if it can be.

    Args:
        what: What it names, for the message.

    Raises:
        InvalidInputError: The name is empty, too long, begins with a point, or has a slash or a character that cannot
            be printed.
    """
    plain = isinstance(name, str) and name.isprintable() and name == name.strip()
    if not plain or not name or name[0] == "." or {*name} & {*"/\\"} or len(name.encode()) > MAX_NAME_BYTES:
        raise InvalidInputError(
            f"{name!r:.60} is not a valid name of a {what}; expected one line without / and \\ that does not begin "
            f"with a point, at most {MAX_NAME_BYTES} bytes"
        )
    return name


@dataclass(frozen=True)
class Task:
    """One task of a suite.

    Attributes:
        suite: Name of its suite, such as `libero_object`; `file` for a task that was read from a file on its own.
        index: Position in the suite, from 0.
        name: Name that is unique in the benchmark, such as `pick_up_the_milk_and_place_it_in_the_basket`.
        language: Default instruction. In tasks of the benchmark it is derived from the name, as in the original.
        bddl_language: Instruction in `:language` of the task file.
        problem: Scene, initial conditions and goal.

    Raises:
        InvalidInputError: Suite or name cannot be that of a file.
    """

    suite: str
    index: int
    name: str
    language: str
    bddl_language: str
    problem: Problem

    def __post_init__(self) -> None:
        check_name(self.suite, "suite")
        check_name(self.name)

    @property
    def id(self) -> str:
        """Suite and index, such as `libero_object/3`; `get_task` accepts it."""
        return f"{self.suite}/{self.index}"

    @property
    def origin(self) -> "Task":
        """Task of the benchmark that it is a variant of, by others: itself, unless it is one."""
        return self

    @property
    def start_task(self) -> "Task":
        """Task whose stored initial states it starts in: itself, unless it is a variant of another."""
        return self

    @property
    def num_starts(self) -> int:
        """Number of stored initial states."""
        return NUM_INIT_STATES

    @property
    def start_file(self) -> Path | None:
        """File with the initial states that others publish of it; None unless it is a variant by others."""
        return None

    @property
    def rest(self) -> np.ndarray:
        """Joints that the controller takes for the arm's rest pose, (7,) [rad]."""
        from libero_env.assets.robot import REST_QPOS  # with MuJoCo

        return np.array(REST_QPOS)

    def changes(self) -> tuple[Any, ...]:
        """Return what its environment changes beside the problem, as `EnvConfig.perturb` may name it."""
        return ()

    def require_available(self) -> None:
        """Raise a `LiberoError` where its scene cannot be built, as some files cannot be had."""

    @property
    def bddl_text(self) -> str:
        """Text of the task file in BDDL, generated from `problem`."""
        return bddl.write(self.problem)

    @property
    def digest(self) -> str:
        """Digest, 16 hex digits, of its text and of the user's objects and workspaces in it."""
        from libero_env.objects import folder  # with MuJoCo

        categories = sorted({*self.problem.fixtures.values(), *self.problem.objects.values()})
        found = (folder.find(name) or find_workspace(name) for name in categories)
        parts = [self.bddl_text, *(folder.digest(directory) for directory in found if directory)]
        return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]


def task_order(suite: str, size: int, index: int) -> list[int]:
    """Return the indices of a suite's tasks in one of the sequences of the original benchmark; see `Suite.order`."""
    orders: list[list[int]] = read_yaml("tasks/data/task_orders.yaml") if size == 10 else [list(range(size))]
    require_known(f"task order of {suite}", index, range(len(orders)))
    return orders[index]


@dataclass(frozen=True)
class Suite:
    """Tasks in their published order.

    A suite can consist of others: LIBERO-100 is LIBERO-90 and LIBERO-10. Its tasks keep the suite and index that they
    have there, and so their demonstrations and initial states.

    Attributes:
        name: Name of the suite, such as `libero_object`.
    """

    name: str
    tasks: tuple[Task, ...]

    def __len__(self) -> int:
        return len(self.tasks)

    def order(self, order_index: int = 0) -> tuple[Task, ...]:
        """Return the tasks in one of the sequences of the original benchmark.

        Args:
            order_index: Number of the sequence; 0 is the order of the indices. The ten-task suites have 21, others 1.

        Returns:
            All tasks of the suite in that order.

        Raises:
            UnknownNameError: The suite has no such order.
        """
        return tuple(self.tasks[i] for i in task_order(self.name, len(self), order_index))
