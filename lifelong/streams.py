"""The order in which data arrive: groups of tasks, fewer demonstrations later, blurred boundaries, growing shifts.

A stage is what is learned at a time: a task, or a group of tasks. It is identified by its last task, in the hooks of
algorithms, in records and in the names of files.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Annotated

import torch
from pydantic import Field

from libero_env.perturbations import Perturbation, reword_task
from libero_env.tasks import Task, get_suite
from libero_env.validation import checked
from lifelong.algorithms.base import Algorithm
from lifelong.algorithms.multitask import Multitask
from lifelong.data.settings import PerturbSetting, read_perturbations, require_switched_on
from lifelong.data.windows import StageWindows, TaskWindows, WindowSubset
from lifelong.errors import ConfigError
from lifelong.seeding import BLUR, generator
from lifelong.settings import Configuration
from lifelong.types import Count, Natural

Stages = tuple[tuple[int, ...], ...]
_SEVERITY_DIGITS = 4  # so that the text of a perturbation, by which files and records name it, is exact


@checked
class StreamSettings:
    """Settings of the order in which data arrive; by default all windows of one task at a time.

    Attributes:
        base_tasks: Number of tasks, from the start of the sequence, that are learned together before the others (the
            base stage). None: as many as in every group (`benchmark.group_size`), which is 1 by default.
        demos_later: Demonstrations of each task after the first one (or after the first group): a number, a share
            of `data.demos` (a float up to 1.0), or a list with one entry for each of these tasks. None: as many as
            of the first.
        blur: Share of each stage's windows that are learned in neighbouring stages instead of their own.
        blur_reach: Number of stages before and after that count as neighbours.
        perturb: Perturbations that grow as tasks go by, kinds with severities such as `{light: 1}`, or a text such as
            `light=1`, of kinds that change what is seen or said. The first group of tasks is without them, the last one
            has the severities that are named, and those between are at equal distances. None: no perturbations.
        perturb_seed: Seed of what perturbations draw.

    With `blur`, a stage's windows are divided at random, once for the whole run: a share of `1 - blur` is learned in
    the stage itself, the rest is distributed evenly over the neighbours. Every window is learned in exactly one
    stage. That is the Blurry-M stream of Bang et al. 2021 ("Rainbow memory", section 3: each task consists of
    100 - M % of its own classes' samples and M % of the others'), here between neighbouring stages; Koh et al. 2022
    (i-Blurry) add classes that occur in all tasks. Algorithms see the same stages as without blur, with mixed
    contents, and so does the replay memory. Success on a task before its stage (epoch 0 of its learning curve) is
    then no longer that on an unseen task.
    """

    base_tasks: Count | None = None
    demos_later: Count | Annotated[float, Field(gt=0, le=1)] | Sequence[Count] | None = None
    blur: Annotated[float, Field(ge=0, lt=1)] = 0.0
    blur_reach: Count = 1
    perturb: PerturbSetting | None = None
    perturb_seed: Natural = 0

    def __post_init__(self) -> None:
        require_switched_on(self, "stream", perturb=["perturb_seed"], blur=["blur_reach"])
        self._largest_perturbations()

    def perturbations(self, sizes: Sequence[int]) -> tuple[tuple[Perturbation, ...], ...]:
        """Return the perturbations of each task; those that are learned together have the same.

        Args:
            sizes: Number of tasks in each group, from `group_sizes`.

        Raises:
            ConfigError: All tasks are in one group, which is without perturbations.
        """
        largest, last = self._largest_perturbations(), max(1, len(sizes) - 1)
        if largest and len(sizes) == 1:
            raise ConfigError(
                "stream.perturb has no effect on one group of tasks, which is without perturbations; "
                "use eval.shift or data.perturb"
            )
        return tuple(
            tuple(
                replace(one, severity=round(one.severity * number / last, _SEVERITY_DIGITS))
                for one in largest
                if number
            )
            for number, size in enumerate(sizes)
            for _ in range(size)
        )

    def _largest_perturbations(self) -> tuple[Perturbation, ...]:
        return read_perturbations(self.perturb, "stream.perturb", seed=self.perturb_seed, rendered=True)

    def group_sizes(self, tasks: int, group_size: int = 1) -> tuple[int, ...]:
        """Return the number of tasks in each group: those of the base stage, then `group_size` at a time.

        Args:
            tasks: Number of tasks, K.
            group_size: Number of tasks of a group after the base stage.

        Raises:
            ConfigError: The base stage is larger than the sequence, or the rest cannot be divided into groups.
        """
        base = self.base_tasks or 0
        if base > tasks:
            raise ConfigError(
                f"stream.base_tasks is {base}; the sequence has {tasks} tasks, of which 1 to {tasks} can be learned "
                "together first"
            )
        rest = tasks - base
        if rest % group_size:
            valid = [n for n in range(1, rest + 1) if rest % n == 0]
            after = f" after stream.base_tasks={base}" if base else ""
            raise ConfigError(
                f"benchmark.group_size is {group_size}; {rest} tasks{after} can be learned in groups of "
                f"{', '.join(map(str, valid))}"
            )
        return (*([base] if base else []), *[group_size] * (rest // group_size))

    def demos(self, full: int, tasks: int, first: int = 1) -> tuple[int, ...]:
        """Return the number of demonstrations of each task.

        Args:
            full: Number of demonstrations of each task of the first stage.
            tasks: Number of tasks, K.
            first: Number of tasks of the first stage.

        Raises:
            ConfigError: `demos_later` is a list of the wrong length, or no task comes later.
        """
        later, rest = self.demos_later, tasks - first
        if later is not None and not rest:
            raise ConfigError(
                "stream.demos_later has no effect: all tasks are in the first stage; leave it out"
            )
        if later is None:
            counts = [full] * rest
        elif isinstance(later, int | float):
            counts = [later if isinstance(later, int) else max(1, round(later * full))] * rest
        else:
            counts = list(later)
            if len(counts) != rest:
                raise ConfigError(
                    f"stream.demos_later lists {len(counts)} tasks; {rest} come after the first stage"
                )
        return (*[full] * first, *counts)


@dataclass(frozen=True)
class TaskPlan:
    """The tasks of a run.

    Attributes:
        before: Tasks of the pretraining.
        tasks: The K tasks in learning order, without perturbations.
        stream: Settings of the order in which data arrive.
        group_sizes: Number of tasks in each group that is learned together.
        perturb: Perturbations under which each task is learned and evaluated.
        held_out: Tasks that are evaluated and never learned.
    """

    before: tuple[Task, ...]
    tasks: tuple[Task, ...]
    stream: StreamSettings
    group_sizes: tuple[int, ...]
    perturb: tuple[tuple[Perturbation, ...], ...]
    held_out: tuple[Task, ...] = ()

    @property
    def instructions(self) -> tuple[str, ...]:
        """Instructions that are embedded together: those of the pretraining, then those of the run, reworded."""
        learned = (reword_task(task, some) for task, some in zip(self.tasks, self.perturb, strict=True))
        return tuple(task.language for task in (*self.before, *learned))


def plan_tasks(config: Configuration) -> TaskPlan:
    """Return the tasks of a run's configuration.

    Raises:
        ConfigError: They cannot be divided into groups as the configuration says, all are in one group of an algorithm
            that is not joint training, the pretraining learns some of them, the stream perturbs or blurs what has only
            one group or stage, or it rewords instructions of tasks that are known by their position.
        UnknownNameError: A suite, an order or a task does not exist.
    """
    benchmark, stream = config.build("benchmark"), config.build("stream")
    tasks, before = benchmark.sequence(), config.build("pretrain").sequence()
    groups = stream.group_sizes(len(tasks), benchmark.group_size)
    own, suite = {task.digest for task in tasks}, config.build("eval").held_out
    held_out = tuple(task for task in get_suite(suite).tasks if task.digest not in own) if suite else ()
    plan = TaskPlan(before, tasks, stream, groups, stream.perturbations(groups), held_out)
    until = config.build("eval").until
    if until is not None and not any(phase.measures_transfer for phase in config.build("algo").phases()):
        raise ConfigError("eval.until has no effect on an algorithm without learning curves")
    if isinstance(until, Sequence) and len(until) != len(tasks):
        raise ConfigError(f"eval.until has {len(until)} entries; the run has {len(tasks)} tasks")
    if suite and not held_out:
        raise ConfigError(f"eval.held_out={suite} holds nothing out: the run learns all of its tasks")
    if known := {task.digest for task in before} & {task.digest for task in tasks} if before else ():
        names = [task.name for task in before if task.digest in known]
        raise ConfigError(
            f"pretrain learns {len(names)} of the run's tasks before their turn, such as {names[0]}, and transfer to "
            "them would be measured as if they were new; name others in pretrain.suite or pretrain.tasks"
        )
    reworded = plan.instructions[len(before) :] != tuple(task.language for task in tasks)
    if (reworded or held_out) and config.build("language").by_position:
        what = "eval.held_out has tasks" if held_out else "stream.perturb changes instructions"
        raise ConfigError(
            f"{what}, and this language encoder knows tasks by their position; choose another, such as language=minilm"
        )
    stages, base = len(config.build("algo").stages(len(groups))), config.values["algo"].get("base_tasks")
    if len(groups) == 1 < len(tasks) and not isinstance(config.build("algo"), Multitask):
        key = (
            f"stream.base_tasks={stream.base_tasks}"
            if stream.base_tasks
            else f"benchmark.group_size={len(tasks)}"
        )
        raise ConfigError(
            f"{key} joins all tasks, and joint training is algo=multitask; lower it, or choose that"
        )
    if stream.blur and stages == 1:
        raise ConfigError(
            "stream.blur has no effect on one stage, which has no neighbours; use stream.blur=0"
        )
    if isinstance(base, int) and base >= max(stages, 2):
        raise ConfigError(
            f"algo.base_tasks is {base}; of {stages} stages none would be left to learn in the algorithm's own way"
        )
    return plan


def learning_stages(algorithm: Algorithm, sizes: Sequence[int]) -> Stages:
    """Return the tasks of each stage: the groups, or the groups that an algorithm learns together.

    Args:
        algorithm: Algorithm, which may learn several groups in one stage.
        sizes: Number of tasks in each group, from `StreamSettings.group_sizes`.
    """
    groups = [tuple(range(end - size, end)) for size, end in zip(sizes, accumulate(sizes), strict=True)]
    stages = algorithm.stages(len(groups))
    return tuple(tuple(task for group in stage for task in groups[group]) for stage in stages)


@dataclass(frozen=True)
class StageData(Mapping[int, TaskWindows]):
    """The windows that are learned in each stage, by its last task.

    Attributes:
        datasets: Windows of each task, by position; each is read when first used.
        stages: Tasks of each stage, from `learning_stages`.
        settings: Settings of the stream.
        seed: Seed of the run, which decides the windows that are learned in neighbouring stages.
    """

    datasets: Mapping[int, TaskWindows]
    stages: Stages
    settings: StreamSettings
    seed: int

    def __getitem__(self, last: int) -> TaskWindows:
        ends = list(self)
        if last not in ends:
            raise KeyError(last)
        here = ends.index(last)
        if not self.settings.blur:
            return self._own(here)
        parts = [self._portion(here, here)] + [self._portion(k, here) for k in self._neighbours(here)]
        return StageWindows([part for part in parts if len(part)], last)

    def __iter__(self) -> Iterator[int]:
        return iter(stage[-1] for stage in self.stages)

    def __len__(self) -> int:
        return len(self.stages)

    def _own(self, place: int) -> TaskWindows:
        """Return all windows of a stage's tasks."""
        stage = self.stages[place]
        if len(stage) == 1:
            return self.datasets[stage[0]]
        return StageWindows([self.datasets[task] for task in stage], stage[-1])

    def _neighbours(self, place: int) -> list[int]:
        reach = self.settings.blur_reach
        near = range(max(0, place - reach), min(len(self.stages), place + reach + 1))
        return [k for k in near if k != place]

    def _portion(self, source: int, target: int) -> WindowSubset:
        """Return the windows of one stage that are learned in another, or in itself."""
        windows, neighbours = self._own(source), self._neighbours(source)
        draws = generator(self.seed, BLUR, self.stages[source][-1])
        order = torch.randperm(len(windows), generator=draws)
        moved = round(self.settings.blur * len(windows)) if neighbours else 0
        if source == target:
            return WindowSubset(windows, order[moved:].sort().values)
        portions = order[:moved].tensor_split(len(neighbours))
        return WindowSubset(windows, portions[neighbours.index(target)].sort().values)
