"""Settings of the run, the task sequence and pretraining."""

import difflib
import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from hydra.utils import get_object, instantiate
from omegaconf import DictConfig, OmegaConf

from libero_env.errors import UnknownNameError
from libero_env.tasks import Suite, Task, get_suite, suite_names
from libero_env.tasks.files import OWN, read_suite
from lifelong.data.settings import CAMERAS, DataSettings
from lifelong.errors import ConfigError

__all__ = ["CAMERAS", "BenchmarkSettings", "DataSettings", "PretrainSettings", "RunSettings", "build"]


def build(node: DictConfig, **arguments: Any) -> Any:
    """Build the object that a node of the configuration describes, with plain lists and dictionaries inside.

    Args:
        node: Node with `_target_`, the dotted path of a class or function.
        arguments: Further keyword arguments of the target.

    Raises:
        ConfigError: The target has no parameter of a key's name, or takes no value of this kind.
    """
    check_values(node, get_object(node._target_))
    return instantiate(node, _convert_="all", _partial_=True)(**arguments)


def check_values(node: DictConfig, target: Callable[..., Any]) -> None:
    """Check the keys of a node, and values that should be numbers or truths, against the signature of its target.

    Args:
        node: Node of the configuration.
        target: Class or function that takes its keys as arguments.

    Raises:
        ConfigError: A key is unknown, or a value is of the wrong kind.
    """
    try:
        parameters = inspect.signature(target).parameters
    except ValueError:  # of some builtins, such as dict, which take anything
        return
    any_key = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    try:
        hints = get_type_hints(target.__init__ if inspect.isclass(target) else target)
    except (NameError, TypeError):  # of a user's class: names that exist for type checkers only
        hints = {}
    for key in map(str, node):
        if key.startswith("_") or OmegaConf.is_missing(node, key):
            continue
        name = node._get_full_key(key)
        if key not in parameters and not any_key:
            close = difflib.get_close_matches(key, parameters, n=1)
            hint = f" Did you mean {close[0]}?" if close else ""
            raise ConfigError(f"unknown key {name}.{hint} Valid: {', '.join(parameters)}")
        if key in hints and not _is_of(node[key], hints[key]):
            kinds = " or ".join(KINDS.get(kind, str(kind)) for kind in get_args(hints[key]) or (hints[key],))
            raise ConfigError(f"{name} is {node[key]!r}; expected {kinds}")


KINDS = {int: "a whole number", float: "a number", bool: "true or false", str: "a text", NoneType: "null"}


def _is_of(value: Any, hint: Any) -> bool:
    """Return whether a value is of a kind; kinds other than numbers, truths and null are not checked."""
    if isinstance(hint, UnionType) or get_origin(hint) is Union:
        return any(_is_of(value, one) for one in get_args(hint))
    if hint is NoneType:
        return value is None
    if hint is bool:
        return isinstance(value, bool) or value in (0, 1)
    if hint in (int, float):
        return isinstance(value, int if hint is int else (int, float)) and not isinstance(value, bool)
    return True


@dataclass(frozen=True)
class RunSettings:
    """Keys at the top of the configuration; see configs/config.yaml."""

    seed: int
    device: str
    threads: int
    runs_dir: str
    run_id: str | None
    resume: bool
    progress: bool | None
    deterministic: bool
    init_from: str | None


@dataclass(frozen=True)
class BenchmarkSettings:
    """The task sequence.

    Attributes:
        suite: Name of a suite.
        order: Index of one of the suite's published sequences.
        tasks: Number of tasks from the start of the sequence, or a list of names or indices in learning order.
            None: all.
        horizon: Number of control steps in which a fast policy solves any of the tasks; `eval.horizon` may refer
            to it.
        group_size: Number of neighbouring tasks of the sequence that are learned together as one step of it. They
            are evaluated one by one; metrics treat a group as one task, whose success is the mean over its tasks.
        files: User-defined task files, .yaml or .bddl, which form the suite; `suite` is then its name.
    """

    suite: str
    order: int = 0
    tasks: int | Sequence[int | str] | None = None
    horizon: int = 600
    group_size: int = 1
    files: Sequence[str] | None = None

    def sequence(self) -> tuple[Task, ...]:
        """Return the tasks in learning order.

        Raises:
            UnknownNameError: The suite, the order or a task does not exist.
            ConfigError: The number of tasks is not a multiple of the group size, or the files do not make a suite.
        """
        tasks = self._chosen()
        valid = [n for n in range(1, len(tasks) + 1) if len(tasks) % n == 0]
        if self.group_size not in valid:
            raise ConfigError(
                f"benchmark.group_size is {self.group_size}; {len(tasks)} tasks can be learned in groups of "
                f"{', '.join(map(str, valid))}"
            )
        return tasks

    def _suite(self) -> Suite:
        if self.files is None and self.suite != OWN:
            return get_suite(self.suite)
        if not self.files or isinstance(self.files, str):
            raise ConfigError(
                f"benchmark.files is {self.files!r}; give a list of task files: '[a.yaml,b.bddl]'"
            )
        if self.suite in suite_names():
            raise ConfigError(
                f"benchmark.files are given, and {self.suite} has its own tasks; use benchmark=own"
            )
        return read_suite(self.files, self.suite)

    def _chosen(self) -> tuple[Task, ...]:
        suite = self._suite()
        tasks = suite.order(self.order)
        if self.tasks is None:
            return tasks
        if isinstance(self.tasks, int):
            if not 1 <= self.tasks <= len(tasks):
                raise ConfigError(f"benchmark.tasks is {self.tasks}; {self.suite} has {len(tasks)} tasks")
            return tasks[: self.tasks]
        known = {t.name: t for t in suite.tasks} | {str(i): t for i, t in enumerate(suite.tasks)}
        for name in self.tasks:
            if str(name) not in known:
                raise UnknownNameError(f"task of {self.suite}", name, [t.name for t in suite.tasks])
        return tuple(known[str(name)] for name in self.tasks)


@dataclass(frozen=True)
class PretrainSettings:
    """Tasks that a policy learns jointly before the sequence.

    Attributes:
        suite: Name of a suite. None: no pretraining.
        tasks: Number of tasks from the start of the suite, or a list of names or indices. None: all.
        demos: Number of demonstrations of each task. None: `data.demos`.
        epochs: Number of epochs. None: `train.epochs`.
    """

    suite: str | None = None
    tasks: int | Sequence[int | str] | None = None
    demos: int | None = None
    epochs: int | None = None

    def __post_init__(self) -> None:
        for name in ("demos", "epochs"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ConfigError(f"pretrain.{name} is {value}; it must be at least 1, or null")

    def sequence(self) -> tuple[Task, ...]:
        """Return the tasks; none without pretraining.

        Raises:
            UnknownNameError: The suite or a task does not exist.
        """
        return () if self.suite is None else BenchmarkSettings(self.suite, tasks=self.tasks).sequence()
