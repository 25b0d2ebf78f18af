"""Suites and tasks by name, with the original's task orders."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

from libero_env import bddl
from libero_env.errors import LiberoError, UnknownNameError
from libero_env.problem import Problem
from libero_env.tasks.builder import build_problem, language_from_name, load_data, load_scene

ENDINGS = (".bddl", ".yaml", ".yml")  # of task files


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


def suite_names() -> tuple[str, ...]:
    """The names that `get_suite` knows; a suite that consists of others comes after them."""
    return tuple(_parts())


def _parts() -> dict[str, list[str]]:
    """Suite -> the suites it consists of; none for a suite with tasks of its own."""
    found: dict[str, list[str]] = {}
    for entry in load_data("suites.yaml"):
        found |= entry if isinstance(entry, dict) else {entry: []}
    return found


@cache
def get_suite(name: str) -> Suite:
    """The suite of this name.

    Raises:
        UnknownNameError: no suite has this name; the message lists them.
    """
    parts = _parts()
    if name not in parts:
        raise UnknownNameError("suite", name, parts)
    if parts[name]:
        return Suite(name, tuple(task for part in parts[name] for task in get_suite(part).tasks))
    facts = load_data(f"{name}.yaml")
    return Suite(name, tuple(_task(name, i, {**facts, **task}) for i, task in enumerate(facts["tasks"])))


def _task(suite: str, index: int, facts: dict) -> Task:
    name = facts["name"]
    if "scene" not in facts:
        raise LiberoError(f"task {name}: neither it nor {suite}.yaml says 'scene'; add it to the YAML")
    own = {key: value for key, value in facts.items() if key != "tasks"}
    problem = build_problem(load_scene(facts["scene"]), own)
    return Task(suite, index, name, language_from_name(name), problem.language, problem)


def get_task(key: str) -> Task:
    """The task called `suite/index`, `suite-index` or by its name alone; or of a file, see `read_task`.

    Raises:
        UnknownNameError: no such suite, index or task.
        LiberoError: the file is not a task.
    """
    if key.endswith(ENDINGS):
        return read_task(key)
    for mark in "/-":
        suite_name, found, index = key.rpartition(mark)
        if found:
            suite = get_suite(suite_name)
            if not index.isdecimal() or int(index) >= len(suite):
                raise UnknownNameError(f"index of {suite_name}", index, range(len(suite)))
            return suite.tasks[int(index)]
    named = {task.name: task for name in suite_names() for task in get_suite(name).tasks}
    if key not in named:
        raise UnknownNameError("task", key, named)
    return named[key]


def read_task(path: str | Path) -> Task:
    """A task of your own from a BDDL or YAML file; its suite is `file`, its name the file's.

    A BDDL file's instruction is that of its name, as in the original; a YAML file's what it says, see
    `libero_env.tasks.authoring`.

    Raises:
        BDDLError: the file is not a task; the message starts with file:line.
        LiberoError: a YAML file that is not one task.
    """
    if str(path).endswith(ENDINGS[1:]):
        from libero_env.tasks.files import read_yaml_tasks

        tasks = read_yaml_tasks(path)
        if len(tasks) != 1:
            raise LiberoError(
                f"{path} holds {len(tasks)} tasks, and one is wanted; put it in a file of its own"
            )
        return tasks[0]
    problem, name = bddl.read(path), Path(path).stem
    return Task("file", 0, name, language_from_name(name), problem.language, problem)
