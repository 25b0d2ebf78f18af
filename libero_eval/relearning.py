"""Relearning: how many optimiser steps a forgotten task takes until it is back.

What is forgotten in behaviour may be kept in the weights: relearning is then shorter than learning was. Ebbinghaus
(1885) called the share of the first effort that is spared savings, and measured memory by it; Hinton and Plaut (1987)
did so for networks. Here a copy of the policy at the end of a run is fine-tuned on a task's demonstrations, until its
error on held-out demonstrations is what it was when the task had just been learned, and so is a policy with the run's
initial weights: same batches, same rate, all weights trained, whatever the run's algorithm was. The rate is constant
after its warm-up, so that the number of steps does not depend on where a schedule would end. Success of rollouts can
be what has to come back instead of the error, which costs next to nothing.
"""

import copy
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import torch

from libero_env.demos.read import demo_origin
from libero_env.errors import DemoError, SimulationError
from libero_env.paths import demos_dir
from libero_eval.requests import RelearnRequest
from lifelong.algorithms.base import Algorithm
from lifelong.data.demonstrations import DemoDatasets, demo_copies, find_demos, perturb_demos
from lifelong.data.windows import TaskWindows, WindowDataset
from lifelong.errors import DataError, LifelongError
from lifelong.evaluation.environments import VectorEnv
from lifelong.evaluation.restore import LoadedRun, read_config, restore
from lifelong.evaluation.rollout import rollout
from lifelong.policies.base import Policy, device_of, in_mode
from lifelong.results.log import ResultLog
from lifelong.results.records import DemonstrationsRecord, RelearnRecord, back_limit
from lifelong.results.relearning import FILE_NAME
from lifelong.seeding import RELEARN
from lifelong.sequence.learning import meet
from lifelong.sequence.measuring import digest
from lifelong.settings import Configuration
from lifelong.streams import StageData, StreamSettings
from lifelong.training.fit import EpochEnd, fit
from lifelong.training.settings import FitSettings
from lifelong.training.step import BatchAugmentation
from lifelong.types import Batch

Start = Literal["final", "initial"]
Measure = Callable[[Policy], float]  # 0 is perfect
STARTS: tuple[Start, ...] = ("final", "initial")
MEASURED = 512  # largest number of held-out windows of a task
CHUNK = 128  # windows of a forward pass


@dataclass(frozen=True)
class Trial:
    """One task to be relearned.

    Attributes:
        training: Windows of the demonstrations that the run learned from.
        measure: Function that returns the error of a policy on the task, or its share of failed rollouts.
        limit: Largest value of it with which the task counts as back.
    """

    task: int
    training: WindowDataset
    measure: Measure
    limit: float


def failure_share(policy: Policy, run: LoadedRun, task: int, env: VectorEnv, episodes: int) -> float:
    """Return the share of a policy's rollouts on a task of a run that fail, under the run's own protocol.

    Args:
        policy: Policy; its mode is left as it is.
        env: Environment of the task, with a simulation for each rollout.
        episodes: Number of rollouts, which start in the first initial states.

    Raises:
        SimulationError: A simulation has failed.
    """
    done = rollout(
        policy,
        env,
        range(episodes),
        language=run.embed(task),
        horizon=run.eval.horizon,
        settle_steps=run.eval.settle_steps,
        seed=(run.seed, RELEARN, task),
        device=run.device,
        precision=run.eval.precision,
    )
    if done.failed:
        raise SimulationError(done.failed)
    return 1 - done.rate


def relearn(request: RelearnRequest, initial: Policy) -> list[RelearnRecord]:
    """Measure the steps until tasks of a finished run are back, and record them in its directory.

    What is recorded already under the same settings is not measured again, so a killed call goes on where it was. The
    run itself is not changed.

    Args:
        request: Run, tasks, and how it is measured.
        initial: Policy with the weights that the run began with; it is not changed.

    Returns:
        The records under these settings, also those of tasks that were measured before.

    Raises:
        LifelongError: The run is not finished, a position is not one of its tasks, or demonstrations are missing.
    """
    device, allow = request.device, request.allow
    run = with_demos(restore(request.run, device=device, allow=allow), request.demos)
    if run.learned != len(run.tasks) - 1:
        raise LifelongError(
            f"{request.run} is not finished: {run.learned + 1} of {len(run.tasks)} tasks are learned"
        )
    config = read_config(run.path / "config.yaml", allow)
    rate, weights = config.build("train").lr, digest({}, initial)
    log = ResultLog(run.path / FILE_NAME)

    def recorded() -> list[RelearnRecord]:
        return [r for r in log.read().of(RelearnRecord) if _repeats(r, request, rate, weights)]

    for task in _chosen(run, request.tasks):
        known = {(r.task, r.start) for r in recorded()}
        starts = [start for start in STARTS if (task, start) not in known]
        if not starts:
            continue
        own = request.demos is not None
        before = restore(run.path, after=_stage_end(run, task), device=device, allow=allow)
        training, held_out = task_windows(run, task, request.demos_held_out, config, request.demos)
        with measured_on(run, task, held_out, request.episodes) as measure:
            with before.acting(task) as then:
                learned = measure(then)
            trial = Trial(task, training, measure, back_limit(learned, request.tolerance, request.episodes))
            for start in starts:
                acting = run.acting(task) if start == "final" else None
                with acting or nullcontext(_met(run, initial, task, config, own)) as policy:
                    record = _relearned(run, policy, start, trial, learned, request, config)
                    log.append(replace(record, weights=weights if start == "initial" else ""))
    return recorded()


def _met(run: LoadedRun, initial: Policy, task: int, config: Configuration, own: bool) -> Policy:
    """Return a copy of the initial policy that has met a task as the run had before it learned it."""
    policy = copy.deepcopy(initial)
    last = _stage_end(run, task)
    instruction = run.learned_task(last).language
    windows = stage_windows(run, config, own)
    meet(policy, windows, list(windows), last, instruction, run.data.statistics, {})
    return policy


def _stage_end(run: LoadedRun, task: int) -> int:
    return next(stage for stage in run.stages if task in stage)[-1]


def _relearned(
    run: LoadedRun,
    policy: Policy,
    start: Start,
    trial: Trial,
    learned: float,
    request: RelearnRequest,
    config: Configuration,
) -> RelearnRecord:
    """Fine-tune a copy of a policy until a task is back; return the record."""
    fit_settings: FitSettings = config.build("train")
    began = time.perf_counter()
    steps, errors = steps_until(
        copy.deepcopy(policy).to(run.device),
        trial,
        request=request,
        fit_settings=fit_settings,
        seed=(run.seed, RELEARN, trial.task),
        augment=config.build("augmentation") if "augmentation" in config.values else None,
    )
    return RelearnRecord(
        task=trial.task,
        start=start,
        learned_error=learned,
        tolerance=request.tolerance,
        held_out=request.demos_held_out,
        episodes=request.episodes,
        rate=fit_settings.lr,
        steps=tuple(steps),
        errors=tuple(errors),
        seconds=time.perf_counter() - began,
    )


def steps_until(
    policy: Policy,
    trial: Trial,
    *,
    request: RelearnRequest,
    fit_settings: FitSettings,
    seed: Sequence[int],
    augment: BatchAugmentation | None = None,
) -> tuple[list[int], list[float]]:
    """Fine-tune a policy in place until a task is back, or the steps are spent.

    Args:
        policy: Policy to be trained, all weights of it.
        trial: The task.
        request: How it is measured.
        fit_settings: Batch size and optimiser; the rate stays what it is after the warm-up.
        seed: Integers that all draws derive from.
        augment: Augmentation of training batches.

    Returns:
        Numbers of steps after which it was measured, from 0, and what was measured.
    """
    steps: list[int] = []
    errors: list[float] = []

    def measure(end: EpochEnd) -> None:
        steps.append(end.epoch * request.every)
        errors.append(trial.measure(policy))
        if errors[-1] <= trial.limit:
            raise _Back

    epochs = -(-request.steps // request.every)
    constant = replace(
        fit_settings, epochs=epochs, steps_per_epoch=request.every, lr_min=fit_settings.lr, compile="off"
    )
    with suppress(_Back):
        fit(
            policy,
            trial.training,
            Algorithm(),
            settings=constant,
            seed=seed,
            augment=augment,
            on_epoch=measure,
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
        for rows in torch.arange(len(batch)).split(CHUNK):
            part = batch.rows(rows).to(device)
            errors.append((policy.predict(part).float() - part.actions).abs().mean((1, 2)).cpu())
    return float(torch.cat(errors).mean())


class _Back(Exception):  # noqa: N818 - ends training that has done what it is for
    """The task is back."""


def _chosen(run: LoadedRun, tasks: Sequence[int]) -> list[int]:
    """Return the positions of the tasks to measure, ascending."""
    last = run.stages[-1][0]
    if not tasks:
        return list(range(last))
    if odd := [task for task in tasks if task not in range(len(run.tasks))]:
        raise LifelongError(f"{run.path} has tasks 0 to {len(run.tasks) - 1}; there is no task {odd[0]}")
    return sorted(set(tasks))


def _repeats(r: RelearnRecord, request: RelearnRequest, rate: float, weights: str) -> bool:
    """Return whether a request would repeat a measurement."""
    wanted = request.tolerance, request.demos_held_out, request.episodes, rate
    return (
        (r.tolerance, r.held_out, r.episodes, r.rate) == wanted
        and (r.start == "final" or r.weights == weights)
        and r.steps == tuple(range(0, r.steps[-1] + 1, request.every))
        and (r.needed is not None or r.steps[-1] >= request.steps)
    )


def stage_windows(run: LoadedRun, config: Configuration, own: bool) -> StageData:
    """Return the windows that the run learned from in each stage, as recorded: without perturbations of what is seen.

    Args:
        config: Configuration of the run.
        own: Whether the folder of its demonstrations is the user's word, see `with_demos`.
    """
    stream, learned = _learned_from(run, config)
    paths, read = _demos(run, learned, learned, own), replace(run.data, memory="host")
    languages = torch.stack([run.embed(task) for task in range(len(run.tasks))])
    windows = DemoDatasets(paths, learned, run.policy.spec, languages, read, run.device)
    return StageData(windows, run.stages, stream, run.seed)


def _learned_from(run: LoadedRun, config: Configuration) -> tuple[StreamSettings, tuple[int, ...]]:
    """Return the run's stream, and the number of demonstrations of each task."""
    stream: StreamSettings = config.build("stream") if "stream" in config.values else StreamSettings()
    return stream, stream.demos(run.data.demos, len(run.tasks), (run.group_sizes or (1,))[0])


def with_demos(run: LoadedRun, folder: Path | None) -> LoadedRun:
    """Return a run whose demonstrations are looked for in a folder, where one is given."""
    return run if folder is None else replace(run, data=replace(run.data, folder=str(folder), files=()))


def _demos(run: LoadedRun, needed: Sequence[int], learned: Sequence[int], own: bool = False) -> list[Path]:
    """Return the demonstration file of each task of a run, which may be somebody else's; see `find_demos`."""
    with _demos_named():
        return find_demos(run.tasks, needed, run.data, None, learned=learned, own=own)


@contextmanager
def _demos_named() -> Iterator[None]:
    """Say in what an error about demonstrations that are missing says how others are named."""
    try:
        yield
    except (DataError, DemoError) as error:
        raise DataError(f"{error}; name the folder of the run's demonstrations with --demos DIR") from None


def task_windows(
    run: LoadedRun, task: int, held_out: int, config: Configuration, demos: Path | None = None
) -> tuple[TaskWindows, Batch | None]:
    """Read the windows that the run learned from, and those to measure the error on.

    Args:
        held_out: Number of demonstrations to measure on, which follow those that were learned from; 0: None for them.
        config: Configuration of the run.
        demos: The folder of `with_demos`, into which more may be written.
    """
    data, own = run.data, [] if demos is None else [demos]
    _, learned = _learned_from(run, config)
    learned_from, needed = learned[task], list(learned)
    needed[task] += held_out
    try:
        recorded = _demos(run, needed, learned, bool(own))[task]  # data.files may name files of every task
    except DataError as error:
        if not held_out:
            raise
        more = f"--held-out reads {held_out} demonstrations more than the run learned from"
        raise DataError(f"{error}; {more}") from None
    with _demos_named():
        _require_learned(run, task, recorded, learned_from)
    tasks, perturb = [run.tasks[task]], [run.perturbations(task)]
    with _demos_named():
        (path,) = perturb_demos([recorded], tasks, [needed[task]], perturb, data, None, [*own, demos_dir()])
        copies = demo_copies([recorded], tasks, [learned_from], perturb, data, None, own)
    languages, read = run.embed(task)[None], replace(data, memory="host")

    def windows(count: int, copies: Sequence[Sequence[Path]] = ()) -> TaskWindows:
        return DemoDatasets([path], [count], run.policy.spec, languages, read, run.device, copies)[0]

    training = windows(learned_from, copies)
    if not held_out:
        return training, None
    everything, count = windows(needed[task]), len(training) // (1 + len(copies[0]))
    rest = torch.arange(count, len(everything))  # windows are in the order of the demonstrations
    return training, everything.batch(rest[torch.linspace(0, len(rest) - 1, min(MEASURED, len(rest))).long()])


def _require_learned(run: LoadedRun, task: int, file: Path, count: int) -> None:
    """Raise a DataError where a file no longer has the demonstrations that a run learned a task from."""
    found = ResultLog(run.path / "results.jsonl").read().of(DemonstrationsRecord)
    if found and demo_origin(file, count).digest != found[-1].digests[task]:
        raise DataError(
            f"{file} has other demonstrations than {run.path} learned {run.tasks[task].name!r} from"
        )


@contextmanager
def measured_on(run: LoadedRun, task: int, held_out: Batch | None, episodes: int) -> Iterator[Measure]:
    """Yield what measures a policy on a task: its error on held-out windows, or without any, its failed rollouts."""
    if held_out is not None:
        yield partial(error_on, batch=held_out)
        return
    with closing(run.environment(task, episodes, run.eval.horizon)) as env:
        yield partial(failure_share, run=run, task=task, env=env, episodes=episodes)
