"""Relearning: how many optimiser steps a forgotten task takes until it is back.

What is forgotten in behaviour may be kept in the weights: relearning is then shorter than learning was. Ebbinghaus
(1885) called the share of the first effort that is spared savings, and measured memory by it; Hinton and Plaut (1987)
did so for networks. Here a copy of the policy at the end of a run is fine-tuned on a task's demonstrations, until its
error on held-out demonstrations is what it was when the task had just been learned, and so is a policy with the run's
initial weights: same batches, same rate, all weights trained, whatever the run's algorithm was. The rate is constant
after its warm-up, so that the number of steps does not depend on where a schedule would end.
"""

import copy
import time
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import torch
from pydantic import Field

from libero_env.validation import validate_arguments
from lifelong.algorithms.base import Algorithm
from lifelong.data.demonstrations import DemoDatasets, find_demos, perturb_demos
from lifelong.data.settings import DataSettings
from lifelong.data.windows import TaskWindows, WindowDataset
from lifelong.errors import ConfigError, LifelongError
from lifelong.evaluation.restore import LoadedRun, read_config, restore
from lifelong.policies.base import Policy, device_of, in_mode
from lifelong.results.log import ResultLog
from lifelong.results.records import RelearnRecord
from lifelong.results.relearning import FILE_NAME
from lifelong.seeding import RELEARN
from lifelong.settings import Configuration
from lifelong.streams import StreamSettings
from lifelong.training.fit import EpochEnd, fit
from lifelong.training.settings import FitSettings
from lifelong.training.step import BatchAugmentation
from lifelong.types import Batch, Count, NonNegative

Start = Literal["final", "initial"]
STARTS: tuple[Start, ...] = ("final", "initial")
MEASURED = 512  # largest number of held-out windows of a task
_CHUNK = 128  # windows of a forward pass


@dataclass(frozen=True)
class RelearnSettings:
    """Settings of the measurement.

    Attributes:
        steps: Number of optimiser steps after which a task is given up.
        every: Number of optimiser steps between two measurements of the error.
        tolerance: Share by which the error may be larger than when the task had just been learned.
        held_out: Number of demonstrations to measure on, those after the ones that the run learned from.
    """

    steps: Count = 400
    every: Count = 20
    tolerance: NonNegative = 0.05
    held_out: Annotated[int, Field(ge=1, le=1000)] = 5

    def __post_init__(self) -> None:
        validate_arguments(type(self), vars(self), prefix=("relearn",), error=ConfigError)


@dataclass(frozen=True)
class Lesson:
    """One task to be relearned.

    Attributes:
        task: Position of the task.
        training: Windows of the demonstrations that the run learned from.
        held_out: Windows of other demonstrations.
        learned_error: Error on these when the run had just learned the task.
    """

    task: int
    training: WindowDataset
    held_out: Batch
    learned_error: float


def relearn(
    source: Path,
    initial: Policy,
    *,
    tasks: Sequence[int] | None = None,
    settings: RelearnSettings = RelearnSettings(),  # noqa: B008 - frozen
    device: str = "auto",
    allow: Sequence[str] = (),
) -> Path:
    """Measure the steps until tasks of a finished run are back, and record them in its directory.

    What is recorded already under the same settings is not measured again, so a killed call goes on where it was. The
    run itself is not changed.

    Args:
        source: Directory of the run.
        initial: Policy with the weights that the run began with; it is not changed.
        tasks: Positions of the tasks. None: all but those that the run learned last.
        settings: Settings of the measurement.
        device: Device of the policies: `auto`, `cpu`, `cuda`, `cuda:<number>`.
        allow: Packages whose classes the configuration may name, too.

    Returns:
        The file with the records.

    Raises:
        LifelongError: The run is not finished, a position is not one of its tasks, or demonstrations are missing.
    """
    run = restore(source, device=device, allow=allow)
    if run.learned != len(run.tasks) - 1:
        raise LifelongError(
            f"{source} is not finished: {run.learned + 1} of {len(run.tasks)} tasks are learned"
        )
    config = read_config(run.path / "config.yaml", allow)
    rate, log = config.build("train").lr, ResultLog(run.path / FILE_NAME)
    for task in _chosen(run, tasks):
        starts = [start for start in STARTS if not _recorded(log, task, start, settings, rate)]
        if not starts:
            continue
        before = restore(run.path, after=_stage(run, task)[-1], device=device, allow=allow)
        with before.acting(run.tasks[task]) as then:
            lesson = _lesson(run, then, task, settings, config)
        for start in starts:
            acting = run.acting(run.tasks[task]) if start == "final" else nullcontext(initial)
            with acting as policy:
                log.append(_measure(run, policy, start, lesson, settings, config))
    return log.path


def _measure(
    run: LoadedRun,
    policy: Policy,
    start: Start,
    lesson: Lesson,
    settings: RelearnSettings,
    config: Configuration,
) -> RelearnRecord:
    """Fine-tune a copy of a policy until a task is back; return the record."""
    fit_settings: FitSettings = config.build("train")
    began = time.perf_counter()
    steps, errors = steps_until(
        copy.deepcopy(policy).to(run.device),
        lesson,
        settings=settings,
        fit_settings=fit_settings,
        seed=(run.seed, RELEARN, lesson.task),
        augment=config.build("augmentation") if "augmentation" in config.values else None,
    )
    return RelearnRecord(
        task=lesson.task,
        start=start,
        learned_error=lesson.learned_error,
        tolerance=settings.tolerance,
        held_out=settings.held_out,
        rate=fit_settings.lr,
        steps=tuple(steps),
        errors=tuple(errors),
        seconds=time.perf_counter() - began,
    )


def steps_until(
    policy: Policy,
    lesson: Lesson,
    *,
    settings: RelearnSettings,
    fit_settings: FitSettings,
    seed: Sequence[int],
    augment: BatchAugmentation | None = None,
) -> tuple[list[int], list[float]]:
    """Fine-tune a policy in place until a task is back, or the steps are spent.

    Args:
        policy: Policy to be trained, all weights of it.
        lesson: The task.
        settings: Settings of the measurement.
        fit_settings: Batch size and optimiser; the rate stays what it is after the warm-up.
        seed: Integers that all draws derive from.
        augment: Augmentation of training batches.

    Returns:
        Numbers of steps after which the error was measured, from 0, and the errors.
    """
    limit = (1 + settings.tolerance) * lesson.learned_error
    steps: list[int] = []
    errors: list[float] = []

    def look(end: EpochEnd) -> None:
        steps.append(end.epoch * settings.every)
        errors.append(error_on(policy, lesson.held_out))
        if errors[-1] <= limit:
            raise _Back

    epochs = -(-settings.steps // settings.every)
    constant = replace(
        fit_settings, epochs=epochs, steps_per_epoch=settings.every, lr_min=fit_settings.lr, compile="off"
    )
    with suppress(_Back):
        fit(
            policy,
            lesson.training,
            Algorithm(),
            settings=constant,
            seed=seed,
            device=device_of(policy),
            augment=augment,
            on_epoch=look,
            label=f"task {lesson.task + 1}",
        )
    return steps, errors


def error_on(policy: Policy, batch: Batch) -> float:
    """Return the mean absolute error of a policy's mean actions, in the units of actions.

    Args:
        policy: Policy; its mode is left as it is.
        batch: Windows to measure on.
    """
    device, errors = device_of(policy), []
    with torch.no_grad(), in_mode(policy, training=False):
        for rows in torch.arange(len(batch)).split(_CHUNK):
            part = batch.rows(rows).to(device)
            errors.append((policy.predict(part).float() - part.actions).abs().mean((1, 2)).cpu())
    return float(torch.cat(errors).mean())


class _Back(Exception):  # noqa: N818 - ends training that has done what it is for
    """The task is back."""


def _chosen(run: LoadedRun, tasks: Sequence[int] | None) -> list[int]:
    """Return the positions of the tasks to measure, ascending."""
    last = run.stages[-1][0]
    if tasks is None:
        return list(range(last))
    if odd := [task for task in tasks if task not in range(len(run.tasks))]:
        raise LifelongError(f"{run.path} has tasks 0 to {len(run.tasks) - 1}; there is no task {odd[0]}")
    return sorted(set(tasks))


def _recorded(log: ResultLog, task: int, start: str, settings: RelearnSettings, rate: float) -> bool:
    """Return whether a measurement is recorded that these settings would repeat."""
    wanted = settings.tolerance, settings.held_out, rate
    for r in log.read().of(RelearnRecord):
        same = (r.task, r.start) == (task, start) and (r.tolerance, r.held_out, r.rate) == wanted
        grid = r.steps == tuple(range(0, r.steps[-1] + 1, settings.every))
        if same and grid and (r.needed is not None or r.steps[-1] >= settings.steps):
            return True
    return False


def _stage(run: LoadedRun, task: int) -> tuple[int, ...]:
    return next(stage for stage in run.stages if task in stage)


def _lesson(
    run: LoadedRun, then: Policy, task: int, settings: RelearnSettings, config: Configuration
) -> Lesson:
    """Read the demonstrations of a task, and measure the error of the policy that had just learned it."""
    data: DataSettings = config.build("data")
    stream: StreamSettings = config.build("stream") if "stream" in config.values else StreamSettings()
    learned_from = stream.demos(data.demos, len(run.tasks), (run.group_sizes or (1,))[0])[task]
    tasks, counts = [run.tasks[task]], [learned_from + settings.held_out]
    recorded = find_demos(tasks, counts, data, None)
    (path,) = perturb_demos(recorded, tasks, counts, [run.perturbations(task)], data, None)
    languages, read = run.embed(run.learned_task(task))[None], replace(data, memory="host", backend="native")

    def windows(count: int) -> TaskWindows:
        return DemoDatasets([path], [count], then.spec, languages, read, run.device)[0]

    everything, training = windows(learned_from + settings.held_out), windows(learned_from)
    rest = torch.arange(len(training), len(everything))  # windows are in the order of the demonstrations
    held_out = everything.batch(rest[torch.linspace(0, len(rest) - 1, min(MEASURED, len(rest))).long()])
    return Lesson(task, training, held_out, error_on(then, held_out))
