"""Suites as the original's `Benchmark` classes."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from libero._adapters.lookup import lookup
from libero.libero import get_libero_path
from libero_env.errors import LiberoError, UnknownNameError, require_known
from libero_env.init_states.pickles import read_states
from libero_env.init_states.store import load_init_states
from libero_env.sim.scene import build_scene
from libero_env.storage import read_yaml
from libero_env.tasks import get_suite, suite_names
from libero_env.tasks import get_task as get_native_task
from libero_env.tasks.builder import language_from_name
from libero_env.tasks.task import task_order

BENCHMARK_MAPPING: dict[str, type["Benchmark"]] = {}

libero_suites = ["libero_spatial", "libero_object", "libero_goal", "libero_90", "libero_10"]


class Task(NamedTuple):
    """A task of a benchmark."""

    name: str
    language: str
    problem: str
    problem_folder: str
    bddl_file: str
    init_states_file: str


def __getattr__(name: str) -> Any:
    """Return `task_maps` (suite -> task name -> Task), `task_orders` or `libero_task_map`, read at the first use."""
    if name == "task_maps":
        return _task_maps()
    if name == "task_orders":
        return read_yaml("tasks/data/task_orders.yaml")
    if name == "libero_task_map":
        from libero.libero.benchmark.libero_suite_task_map import libero_task_map

        return libero_task_map
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def register_benchmark(target_class: type["Benchmark"]) -> type["Benchmark"]:
    """Register a class by its name; case does not matter."""
    BENCHMARK_MAPPING[target_class.__name__.lower()] = target_class
    return target_class


def get_benchmark_dict(help: bool = False) -> dict[str, type["Benchmark"]]:
    """Return lower-case name -> class; with `help`, print the names."""
    if help:
        print_benchmark()
    return BENCHMARK_MAPPING


def get_benchmark(benchmark_name: str) -> type["Benchmark"]:
    """Return the class of this name, ignoring case; raise an UnknownNameError if there is none."""
    return lookup(BENCHMARK_MAPPING, "benchmark", benchmark_name)


def print_benchmark() -> None:
    """Print the names of all benchmarks."""
    print("Benchmarks:", *BENCHMARK_MAPPING, sep="\n  ")


def grab_language_from_filename(x: str) -> str:
    """Return the instruction that the name of a task file spells."""
    return language_from_name(x.removesuffix(".bddl"))


@cache
def _task_maps() -> dict[str, dict[str, Task]]:
    return {
        suite: {task.name: _entry(task.suite, task.name, task.language) for task in get_suite(suite).tasks}
        for suite in suite_names()
    }


def _entry(suite: str, name: str, language: str) -> Task:
    return Task(name, language, "Libero", suite, f"{name}.bddl", f"{name}.pruned_init")


class Benchmark:
    """A sequence of tasks. Subclasses set `name` and call `_make_benchmark`.

    Attributes:
        tasks: Tasks in the order of `task_order_index`.
        task_embs: One embedding for each task, once set.
    """

    name: str

    def __init__(self, task_order_index: int = 0):
        self.task_embs: Sequence[Any] | None = None
        self.task_order_index = task_order_index

    def _make_benchmark(self) -> None:
        tasks = self._entries()
        self.tasks = [tasks[i] for i in task_order(self.name, len(tasks), self.task_order_index)]
        self.n_tasks = len(self.tasks)

    def _entries(self) -> list[Task]:
        """Return the tasks of the suite: of `task_maps`, or named in `libero_task_map` as in the original."""
        from libero.libero.benchmark.libero_suite_task_map import libero_task_map

        if self.name in _task_maps():
            return list(_task_maps()[self.name].values())
        if self.name not in libero_task_map:
            raise UnknownNameError("suite", self.name, [*_task_maps(), *libero_task_map])
        names = libero_task_map[self.name]
        return [_entry(self.name, name, grab_language_from_filename(name)) for name in names]

    def get_num_tasks(self) -> int:
        """Return the number of tasks."""
        return self.n_tasks

    def get_task_names(self) -> list[str]:
        """Return the names of the tasks."""
        return [task.name for task in self.tasks]

    def get_task_problems(self) -> list[str]:
        """Return the kind of problem of each task."""
        return [task.problem for task in self.tasks]

    def get_task_bddl_files(self) -> list[str]:
        """Return the file name of each task."""
        return [task.bddl_file for task in self.tasks]

    def get_task_bddl_file_path(self, i: int) -> str:
        """Return the path of the file of a task."""
        return str(Path(get_libero_path("bddl_files"), self.tasks[i].problem_folder, self.tasks[i].bddl_file))

    def get_task_demonstration(self, i: int) -> str:
        """Return the path of the demonstrations of a task; raise an UnknownNameError if there is no such task."""
        require_known(f"task index of {self.name}", i, range(self.n_tasks))
        return f"{self.tasks[i].problem_folder}/{self.tasks[i].name}_demo.hdf5"

    def get_task(self, i: int) -> Task:
        """Return a task."""
        return self.tasks[i]

    def get_task_emb(self, i: int) -> Any:
        """Return the embedding of a task, which `set_task_embs` has set."""
        assert self.task_embs is not None, "call set_task_embs first"
        return self.task_embs[i]

    def get_task_init_states(self, i: int) -> np.ndarray:
        """Return the fixed initial states of a task for `set_init_state`, (n, size).

        States of the configured folder are [time, qpos, qvel]; in those of this package the poses of the fixtures
        follow.
        """
        task = self.tasks[i]
        path = Path(get_libero_path("init_states"), task.problem_folder, task.init_states_file)
        if path.exists():
            return read_states(path)
        if task.problem_folder not in suite_names():
            raise LiberoError(f"{path}: no such file; it has the initial states of {task.name}")
        names = [other.name for other in get_suite(task.problem_folder).tasks]
        native = get_native_task(f"{task.problem_folder}/{names.index(task.name)}")
        return load_init_states(native, build_scene(native.problem))

    def set_task_embs(self, task_embs: Sequence[Any]) -> None:
        """Set one embedding for each task."""
        self.task_embs = task_embs


def _suite(suite: str, doc: str) -> type[Benchmark]:
    """Register the class of a suite of this package."""

    class Suite(Benchmark):
        def __init__(self, task_order_index: int = 0, *, task_order: int | None = None):
            super().__init__(task_order_index if task_order is None else task_order)
            self.name = suite
            self._make_benchmark()

    Suite.__name__ = Suite.__qualname__ = suite.upper()
    Suite.__doc__ = doc
    return register_benchmark(Suite)


LIBERO_SPATIAL = _suite("libero_spatial", "Ten tasks with the same objects at other places.")
LIBERO_OBJECT = _suite("libero_object", "Ten tasks with other objects and the same action.")
LIBERO_GOAL = _suite("libero_goal", "Ten tasks with other goals and the same objects and places.")
LIBERO_90 = _suite("libero_90", "Ninety short tasks.")
LIBERO_10 = _suite("libero_10", "Ten long tasks.")
LIBERO_100 = _suite("libero_100", "The ninety short tasks and the ten long ones.")
