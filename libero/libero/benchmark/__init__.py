"""Suites as the original's `Benchmark` classes."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from libero.libero import get_libero_path
from libero_env.errors import UnknownNameError
from libero_env.init_states.pickles import read_states
from libero_env.init_states.store import load_init_states
from libero_env.sim.scene import build_scene
from libero_env.tasks import get_suite, suite_names
from libero_env.tasks import get_task as get_native_task
from libero_env.tasks.builder import language_from_name, load_data

BENCHMARK_MAPPING: dict[str, type["Benchmark"]] = {}

libero_suites = ["libero_spatial", "libero_object", "libero_goal", "libero_90", "libero_10"]


class Task(NamedTuple):
    """What a benchmark says about a task."""

    name: str
    language: str
    problem: str
    problem_folder: str
    bddl_file: str
    init_states_file: str


def __getattr__(name: str) -> Any:
    """`task_maps` (suite -> task name -> Task) and `task_orders`, read when asked for."""
    if name == "task_maps":
        return _task_maps()
    if name == "task_orders":
        return load_data("task_orders.yaml")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def register_benchmark(target_class: type["Benchmark"]) -> type["Benchmark"]:
    """Make a class known by its name; case does not count."""
    BENCHMARK_MAPPING[target_class.__name__.lower()] = target_class
    return target_class


def get_benchmark_dict(help: bool = False) -> dict[str, type["Benchmark"]]:
    """Lower-case name -> class; with `help` the names are printed."""
    if help:
        print_benchmark()
    return BENCHMARK_MAPPING


def get_benchmark(benchmark_name: str) -> type["Benchmark"]:
    """The class of this name; case does not count.

    Raises:
        UnknownNameError: no such benchmark.
    """
    if benchmark_name.lower() not in BENCHMARK_MAPPING:
        raise UnknownNameError("benchmark", benchmark_name, BENCHMARK_MAPPING)
    return BENCHMARK_MAPPING[benchmark_name.lower()]


def print_benchmark() -> None:
    """Print the names of all benchmarks."""
    print("Benchmarks:", *BENCHMARK_MAPPING, sep="\n  ")


def grab_language_from_filename(x: str) -> str:
    """The instruction that a task file's name spells."""
    return language_from_name(x.removesuffix(".bddl"))


@cache
def _task_maps() -> dict[str, dict[str, Task]]:
    return {suite: {task.name: _entry(task) for task in get_suite(suite).tasks} for suite in suite_names()}


def _entry(task: Any) -> Task:
    return Task(
        name=task.name,
        language=task.language,
        problem="Libero",
        problem_folder=task.suite,
        bddl_file=f"{task.name}.bddl",
        init_states_file=f"{task.name}.pruned_init",
    )


class Benchmark:
    """A sequence of tasks. Subclasses set `name` and call `_make_benchmark`.

    Attributes:
        tasks: in the order of `task_order_index`.
        task_embs: one embedding for each task, once set.
    """

    name: str

    def __init__(self, task_order_index: int = 0):
        self.task_embs: Sequence[Any] | None = None
        self.task_order_index = task_order_index

    def _make_benchmark(self) -> None:
        tasks = list(_task_maps()[self.name].values())
        if self.name in suite_names():
            self.tasks = [_entry(task) for task in get_suite(self.name).order(self.task_order_index)]
        else:
            order = (
                load_data("task_orders.yaml")[self.task_order_index]
                if len(tasks) == 10
                else range(len(tasks))
            )
            self.tasks = [tasks[i] for i in order]
        self.n_tasks = len(self.tasks)

    def get_num_tasks(self) -> int:
        """How many tasks."""
        return self.n_tasks

    def get_task_names(self) -> list[str]:
        """Names in order."""
        return [task.name for task in self.tasks]

    def get_task_problems(self) -> list[str]:
        """Kind of problem of each task."""
        return [task.problem for task in self.tasks]

    def get_task_bddl_files(self) -> list[str]:
        """File name of each task."""
        return [task.bddl_file for task in self.tasks]

    def get_task_bddl_file_path(self, i: int) -> str:
        """Path of a task's file."""
        return str(Path(get_libero_path("bddl_files"), self.tasks[i].problem_folder, self.tasks[i].bddl_file))

    def get_task_demonstration(self, i: int) -> str:
        """Path of a task's demonstrations below the datasets folder.

        Raises:
            UnknownNameError: no such task.
        """
        if i not in range(self.n_tasks):
            raise UnknownNameError(f"task index of {self.name}", i, range(self.n_tasks))
        return f"{self.tasks[i].problem_folder}/{self.tasks[i].name}_demo.hdf5"

    def get_task(self, i: int) -> Task:
        """A task."""
        return self.tasks[i]

    def get_task_emb(self, i: int) -> Any:
        """A task's embedding, set before with `set_task_embs`."""
        assert self.task_embs is not None, "call set_task_embs first"
        return self.task_embs[i]

    def get_task_init_states(self, i: int) -> np.ndarray:
        """A task's fixed initial states for `set_init_state`, (n, size).

        Those of the configured folder: [time, qpos, qvel]; else this package's, followed by the fixtures' poses.
        """
        task = self.tasks[i]
        path = Path(get_libero_path("init_states"), task.problem_folder, task.init_states_file)
        if path.exists():
            return read_states(path)
        names = [other.name for other in get_suite(task.problem_folder).tasks]
        native = get_native_task(f"{task.problem_folder}/{names.index(task.name)}")
        return load_init_states(native, build_scene(native.problem))

    def set_task_embs(self, task_embs: Sequence[Any]) -> None:
        """Remember one embedding for each task."""
        self.task_embs = task_embs


class _Suite(Benchmark):
    suite: ClassVar[str]

    def __init__(self, task_order_index: int = 0, *, task_order: int | None = None):
        super().__init__(task_order_index if task_order is None else task_order)
        self.name = self.suite
        self._make_benchmark()


@register_benchmark
class LIBERO_SPATIAL(_Suite):
    """The same objects at other places."""

    suite = "libero_spatial"


@register_benchmark
class LIBERO_OBJECT(_Suite):
    """Other objects, the same act."""

    suite = "libero_object"


@register_benchmark
class LIBERO_GOAL(_Suite):
    """Other goals, the same objects and places."""

    suite = "libero_goal"


@register_benchmark
class LIBERO_90(_Suite):
    """Ninety short tasks."""

    suite = "libero_90"


@register_benchmark
class LIBERO_10(_Suite):
    """Ten long tasks."""

    suite = "libero_10"


@register_benchmark
class LIBERO_100(_Suite):
    """The ninety short tasks and the ten long ones."""

    suite = "libero_100"
