"""Settings of the run, the task sequence and pretraining."""

import re
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field

from libero_env.errors import UnknownNameError
from libero_env.tasks import Suite, Task, get_suite, suite_names
from libero_env.tasks.suites import OWN, read_suite
from libero_env.validation import checked
from lifelong.data.settings import CAMERAS, DataSettings, require_switched_on  # noqa: F401 - offered by the package
from lifelong.errors import ConfigError
from lifelong.types import Count, Natural, PathText


def _check_name(name: int | float | str) -> int | float | str:
    if not re.fullmatch(r"[^\W.][^/\\\0\n]*", str(name)) or len(str(name)) > 100:
        raise ValueError(
            f"{name!r} is not a name; expected up to 100 characters, a letter or digit first, no / and no \\"
        )
    return name


Name = Annotated[int | float | str, AfterValidator(_check_name)]  # of a directory


@checked
class RunSettings:
    """Keys at the top of the configuration; see configs/config.yaml."""

    seed: Annotated[int, Field(ge=0, lt=2**63)]
    device: str
    threads: Annotated[int, Field(ge=0, le=4096)]
    runs_dir: PathText
    run_id: Name | None
    resume: bool
    progress: bool | None
    deterministic: bool
    init_from: PathText | None


@checked
class BenchmarkSettings:
    """The task sequence.

    Attributes:
        suite: Name of a suite.
        order: Index of one of the suite's published sequences.
        tasks: Number of tasks from the start of the sequence, or a list of names or indices in learning order.
            None: all.
        order_seed: Seed of a random order of these tasks, in place of the published one; None: no random order.
        horizon: Number of control steps in which a fast policy solves any of the tasks; `eval.horizon` may refer
            to it.
        group_size: Number of neighbouring tasks of the sequence that are learned together as one step of it. They
            are evaluated one by one; metrics treat a group as one task, whose success is the mean over its tasks.
        files: User-defined task files, .yaml or .bddl, which form the suite; `suite` is then its name.
    """

    suite: str
    order: Natural = 0
    tasks: Count | Annotated[Sequence[Natural | str], Field(min_length=1)] | None = None
    order_seed: Natural | None = None
    horizon: Count = 600
    group_size: Count = 1
    files: Annotated[Sequence[PathText], Field(min_length=1)] | None = None

    def sequence(self) -> tuple[Task, ...]:
        """Return the tasks in learning order.

        Raises:
            UnknownNameError: The suite, the order or a task does not exist.
            ConfigError: The files do not make a suite, it has fewer tasks than are asked for, or two orders are given.
        """
        tasks = self._chosen()
        if self.order_seed is None:
            return tasks
        if self.order:
            raise ConfigError(
                f"benchmark.order is {self.order} and benchmark.order_seed {self.order_seed}; give one of them"
            )
        order = np.random.default_rng(self.order_seed).permutation(len(tasks))
        return tuple(tasks[i] for i in order)

    def _chosen(self) -> tuple[Task, ...]:
        suite = self._suite()
        tasks = suite.order(self.order)
        if self.tasks is None:
            return tasks
        if isinstance(self.tasks, int):
            if not 1 <= self.tasks <= len(tasks):
                raise ConfigError(f"benchmark.tasks is {self.tasks}; {self.suite} has {len(tasks)} tasks")
            return tasks[: self.tasks]
        if self.order:
            raise ConfigError(
                f"benchmark.order is {self.order} and benchmark.tasks a list, which has its own order; give one of them"
            )
        known = {t.name: t for t in suite.tasks} | {str(i): t for i, t in enumerate(suite.tasks)}
        for name in self.tasks:
            if str(name) not in known:
                raise UnknownNameError(f"task of {self.suite}", name, [t.name for t in suite.tasks])
        return tuple(known[str(name)] for name in self.tasks)

    def _suite(self) -> Suite:
        if self.files is None and self.suite != OWN:
            return get_suite(self.suite)
        if not self.files:
            raise ConfigError(
                f"benchmark.files is {self.files!r}; give a list of task files: '[a.yaml,b.bddl]'"
            )
        if self.suite in suite_names():
            raise ConfigError(
                f"benchmark.files are given, and {self.suite} has its own tasks; use benchmark=own"
            )
        return read_suite(self.files, self.suite)


@checked
class PretrainSettings:
    """Tasks that a policy learns jointly before the sequence.

    Attributes:
        suite: Name of a suite. None: no pretraining.
        tasks: Number of tasks from the start of the suite, or a list of names or indices. None: all.
        demos: Number of demonstrations of each task. None: `data.demos`.
        epochs: Number of epochs. None: `train.epochs`.
    """

    suite: str | None = None
    tasks: Count | Annotated[Sequence[Natural | str], Field(min_length=1)] | None = None
    demos: Annotated[int, Field(ge=1, le=100_000)] | None = None
    epochs: Count | None = None

    def __post_init__(self) -> None:
        require_switched_on(self, "pretrain", suite=("tasks", "demos", "epochs"))

    def sequence(self) -> tuple[Task, ...]:
        """Return the tasks; none without pretraining.

        Raises:
            UnknownNameError: The suite or a task does not exist.
            ConfigError: The suite has fewer tasks than are asked for.
        """
        if self.suite is None:
            return ()
        get_suite(self.suite)  # not `own`, whose files are those of the benchmark
        try:
            return BenchmarkSettings(self.suite, tasks=self.tasks).sequence()
        except ConfigError as error:
            raise ConfigError(str(error).replace("benchmark.tasks", "pretrain.tasks")) from None
