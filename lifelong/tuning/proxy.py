"""Short streams of tasks, learned as a run learns them and measured on held-out demonstrations instead of rollouts.

What is measured is kept, so a sweep that was stopped goes on.
"""

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from libero_env.storage import read_record, write_record
from libero_env.tasks import Task
from lifelong import checkpoints
from lifelong.algorithms.base import Algorithm
from lifelong.data.demonstrations import DemoDatasets, check_pairing, find_demos
from lifelong.data.settings import DataSettings
from lifelong.data.windows import TaskWindows
from lifelong.errors import ConfigError
from lifelong.policies.base import Policy
from lifelong.results.provenance import installed_versions, source_digest
from lifelong.seeding import BEGIN_TASK, END_TASK, FIT, INIT, generator, seeded
from lifelong.sequence.learning import meet
from lifelong.settings import Configuration
from lifelong.training.fit import fit
from lifelong.training.precision import autocast
from lifelong.training.settings import FitSettings
from lifelong.tuning.frontier import Errors, Frontier, Outcome
from lifelong.types import Batch, PolicySpec

FORMAT = 1  # of a trial's record; another one is measured again
MEASURED = 512  # largest number of held-out windows of a task
CHUNK = 128  # windows of a forward pass
_GROUPS = ("algo", "policy", "data", "augmentation", "train", "language")  # that a trial depends on
# Keys that no trial obeys -> their values besides null that it agrees with. Not seed, benchmark.suite and eval, which
# presets choose for the runs
_UNUSED: dict[str, tuple[Any, ...]] = {
    **dict.fromkeys(("stream.base_tasks", "stream.demos_later", "stream.perturb", "pretrain.suite"), ()),
    **dict.fromkeys(("data.perturb", "init_from", "run_id"), ()),
    "stream.blur": (0,),
    "benchmark.group_size": (1,),
    "device": ("auto", "cpu"),
    "runs_dir": ("runs",),
    "resume": (True,),
    "progress": (False,),
    "tracker": ({"_target_": "lifelong.tracking.Tracker"},),
}
# Tasks of libero_90: packages into a basket, in a scene that of the reported suites only libero_10 has. Five, because
# strengths that are chosen on two hold back a longer stream (experiments/tuning)
STREAMS = (
    tuple(
        f"LIVING_ROOM_SCENE2_pick_up_the_{item}_and_put_it_in_the_basket"
        for item in ("alphabet_soup", "butter", "milk", "orange_juice", "tomato_sauce")
    ),
)


@dataclass(frozen=True)
class ProxySettings:
    """Settings of the measurement.

    Attributes:
        streams: Tasks of each stream, in learning order.
        seeds: Seeds with which each stream is learned.
        steps: Number of optimiser steps on a task.
        held_out: Share of each task's demonstrations that is not learned from but measured on.
    """

    streams: tuple[tuple[Task, ...], ...]
    seeds: tuple[int, ...] = (1,)
    steps: int = 160
    held_out: float = 0.25


@dataclass(frozen=True)
class Candidate:
    """A configuration to be measured.

    Attributes:
        label: Name in tables and pictures.
        settings: Values that it differs in, by dotted key.
        config: Configuration of a run, as plain data.
    """

    label: str
    settings: dict[str, Any]
    config: Mapping[str, Any]


@dataclass(frozen=True)
class StreamData:
    """Demonstrations of a stream's tasks.

    Attributes:
        spec: What the policy observes and does.
        training: Windows to learn from, of each task.
        held_out: Windows to measure on, of each task.
    """

    spec: PolicySpec
    training: tuple[TaskWindows, ...]
    held_out: tuple[Batch, ...]


@dataclass(frozen=True)
class Trial:
    """One configuration that learns one stream.

    Attributes:
        config: Configuration of a run, as plain data.
        stream: Tasks in learning order.
        seed: Seed of all random draws.
        steps: Number of optimiser steps on a task.
        held_out: Share of the demonstrations that is measured on.
    """

    config: Mapping[str, Any]
    stream: tuple[Task, ...]
    seed: int
    steps: int
    held_out: float

    def key(self) -> str:
        """Return a digest of all that the trial depends on: its settings, the source, packages and models."""
        return self._digest(self.config["algo"])

    def start_key(self, algorithm: Algorithm) -> str:
        """Return a digest of all that the first task's learning depends on; on later tasks by their statistics."""
        own = {name: value for name, value in self.config["algo"].items() if name not in algorithm.tuned}
        return self._digest({} if algorithm.plain_start else own)

    def _digest(self, algo: Mapping[str, Any]) -> str:
        groups = {group: self.config[group] for group in _GROUPS} | {"algo": algo}
        stream = [task.id for task in self.stream]
        rest = [FORMAT, stream, self.seed, self.steps, self.held_out, source_digest(), installed_versions()]
        rest += _stamps(self.config["data"])
        return hashlib.sha256(json.dumps([groups, rest], sort_keys=True).encode()).hexdigest()[:16]


def _stamps(data: Mapping[str, Any]) -> list[tuple[str, int, int]]:
    """Return name, size and time of the demonstration files that are the user's, which he may replace."""
    files = [Path(name).expanduser() for name in data["files"]]
    if data["folder"]:
        files += sorted(Path(data["folder"]).expanduser().rglob("*.hdf5"))
    return [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files if file.is_file()]


def open_stream(config: Mapping[str, Any], tasks: Sequence[Task], held_out: float) -> StreamData:
    """Read the demonstrations of a stream; missing ones are recorded.

    Args:
        config: Configuration of a run, as plain data.
        tasks: Tasks in learning order.
        held_out: Share of each task's demonstrations, the last ones, that is measured on.

    Raises:
        ConfigError: Too few demonstrations to learn from some and measure on others.
    """
    checked = Configuration(config)
    data: DataSettings = checked.build("data")
    learned = data.demos - round(held_out * data.demos)
    if not 0 < learned < data.demos:
        raise ConfigError(
            f"{learned} of {data.demos} demonstrations would be learned from; valid: at least one, and at least one "
            "held out (data.demos, --held-out)"
        )
    languages = checked.build("language").embed([task.language for task in tasks])
    spec = data.spec(languages.shape[1])
    paths = find_demos(tasks, [data.demos] * len(tasks), data, None)
    check_pairing(paths, data)
    device = torch.device("cpu")
    training, everything = (
        DemoDatasets(paths, [count] * len(tasks), spec, languages, data, device)
        for count in (learned, data.demos)
    )
    windows = tuple(training[k] for k in range(len(tasks)))
    measured = tuple(_sample(everything[k], len(windows[k])) for k in range(len(tasks)))
    return StreamData(spec, windows, measured)


def _sample(dataset: TaskWindows, first: int) -> Batch:
    """Return windows from `first` on at equal distances, `MEASURED` at most."""
    left = len(dataset) - first
    return dataset.batch(first + torch.linspace(0, left - 1, min(left, MEASURED)).round().long())


def measure(trial: Trial, data: Callable[[], StreamData], folder: Path) -> Errors:
    """Learn a trial's stream and return its errors; what was measured before is read back.

    Args:
        trial: What to learn.
        data: Function that returns the demonstrations of its stream, called where they are needed.
        folder: Folder of the records and of the weights after first tasks.

    Returns:
        For each stage, the mean absolute error of the actions on held-out windows of each task so far.
    """
    path = folder / "trials" / f"{trial.key()}.json"
    if (record := read_record(path)) is not None:
        return record["errors"]
    began = time.perf_counter()
    errors = _learn(trial, data(), folder)
    write_record(path, {"errors": errors, "seconds": round(time.perf_counter() - began, 1)})
    return errors


def _learn(trial: Trial, data: StreamData, folder: Path) -> Errors:
    config, seed = Configuration(trial.config), trial.seed
    algorithm: Algorithm = config.build("algo")
    if algorithm.stages(len(data.training)) != tuple((task,) for task in range(len(data.training))):
        raise ConfigError(
            f"{type(algorithm).__name__} learns several tasks together; nothing is forgotten and nothing tuned"
        )
    with seeded(seed, INIT):
        policy: Policy = config.build("policy", spec=data.spec)
    settings = scaled(config.build("train"), trial.steps)
    statistics = config.build("data").statistics
    frames: dict[int, tuple[Tensor, Tensor]] = {}  # readings and actions that normalise the policy
    algorithm.set_augmentation(config.build("augmentation"))
    first = folder / "first" / f"{trial.start_key(algorithm)}.safetensors"
    errors: Errors = []
    for task, windows in enumerate(data.training):
        if task == 0 and first.exists():
            state = checkpoints.load(first)
            checkpoints.load_weights(policy, state["policy"], first)
            if not algorithm.plain_start:
                algorithm.load_state_dict(state["algorithm"], {})
        else:
            ends, text = range(len(data.training)), trial.stream[task].language
            met = partial(meet, policy, data.training, ends, task, text, statistics, frames)
            met()
            with seeded(seed, BEGIN_TASK, task):
                algorithm.begin_task(task, windows, policy)
            met()  # again: it may have gone back to weights that do not know the task
            _train(algorithm, policy, task, windows, settings, seed)
            if task == 0:
                own = {} if algorithm.plain_start else algorithm.state_dict()
                state = {"policy": policy.state_dict(), "algorithm": own}
                checkpoints.save(first, state)
        with seeded(seed, END_TASK, task, 1):
            algorithm.end_task(task, windows, policy, generator(seed, END_TASK, task))
        errors.append([_error(algorithm, policy, k, data.held_out[k], settings) for k in range(task + 1)])
    return errors


def _train(
    algorithm: Algorithm, policy: Policy, task: int, windows: TaskWindows, settings: FitSettings, seed: int
) -> None:
    """Train on a task through all phases of the algorithm."""
    for number, phase in enumerate(algorithm.phases()):
        algorithm.begin_phase(phase, policy)
        epochs = max(1, round(settings.epochs * phase.share))
        adapts = settings.statistics_first and not number
        fit(
            policy,
            windows,
            algorithm,
            settings=replace(settings, epochs=epochs, statistics_first=adapts),
            seed=(seed, FIT, task, number),
            augment=algorithm.augment,
        )
        algorithm.end_phase(phase, policy)


def scaled(settings: FitSettings, steps: int) -> FitSettings:
    """Return settings with about this number of steps a task, and a warm-up of the same share of them.

    Args:
        steps: Number of steps; what is over after all epochs have the same number is left out.
    """
    per_epoch = max(1, steps // settings.epochs)
    epochs = min(settings.epochs, steps)
    whole = settings.epochs * (settings.steps_per_epoch or per_epoch)
    warmup = round(settings.warmup_steps * epochs * per_epoch / whole)
    return replace(settings, epochs=epochs, steps_per_epoch=per_epoch, warmup_steps=warmup)


@torch.no_grad()
def _error(algorithm: Algorithm, policy: Policy, task: int, batch: Batch, settings: FitSettings) -> float:
    """Return the mean absolute error of the policy's actions on windows of a task."""
    with algorithm.policy_for(task, policy) as acting, autocast(torch.device("cpu"), settings.precision):
        acting.eval()
        parts = [batch.rows(rows) for rows in torch.arange(len(batch)).split(CHUNK)]
        errors = [(acting.predict(part).float() - part.actions).abs().flatten(1).mean(1) for part in parts]
    return float(torch.cat(errors).mean())


def measure_frontier(
    candidates: Sequence[Candidate],
    others: Sequence[Candidate],
    fine_tuning: Candidate,
    proxy: ProxySettings,
    folder: Path,
) -> Frontier:
    """Measure candidates on all streams and with all seeds.

    Args:
        candidates: Values to choose from, in the order of the picture's line.
        others: Algorithms to compare with.
        fine_tuning: Sequential fine-tuning, whose errors are the unit.
        proxy: Streams, seeds and length of training.
        folder: Folder of what is measured.

    Raises:
        ConfigError: A stream is too short to forget anything, or a setting has no effect on the trials.
    """
    everyone = (fine_tuning, *others, *candidates)
    for one in everyone:
        check_obeyed(one.config, one.settings)
    errors: list[list[Errors]] = [[] for _ in everyone]
    places = [(stream, seed) for stream in proxy.streams for seed in proxy.seeds]
    total, done = len(places) * len(everyone), 0
    for stream, seed in places:
        if len(stream) < 2:
            raise ConfigError(
                "a stream has one task; expected two or more, of which the first can be forgotten"
            )
        for one, own in zip(everyone, errors, strict=True):
            began = time.perf_counter()
            trial = Trial(one.config, stream, seed, proxy.steps, proxy.held_out)
            found = measure(trial, partial(_opened, trial), folder)
            own.append(found)
            done += 1
            shown = ", ".join(f"{error:.3f}" for error in found[-1])
            print(
                f"{done}/{total} {one.label}, {stream[0].name} and {len(stream) - 1} more, seed {seed}: "
                f"errors at the end {shown} ({time.perf_counter() - began:.0f} s)"
            )
    outcomes = [
        Outcome(one.label, one.settings, tuple(own), tuple(errors[0]))
        for one, own in zip(everyone, errors, strict=True)
    ]
    compared = 1 + len(others)
    return Frontier(tuple(outcomes[compared:]), tuple(outcomes[:compared]))


def check_obeyed(config: Mapping[str, Any], keys: Iterable[str]) -> None:
    """Check that trials obey a configuration, and the keys that are varied.

    Raises:
        ConfigError: A setting has no effect on the trials.
    """
    tops = {key: key.lstrip("+").partition(".")[0] for key in keys}
    unused = [key for key, top in tops.items() if top in config and top not in _GROUPS]
    unused += [key for key in tops if key == "train.steps_per_epoch"]  # a trial has --steps
    for key, agreed in _UNUSED.items():
        group, _, name = key.rpartition(".")
        value = (config[group] if group else config).get(name)
        if value is not None and value not in agreed:
            unused.append(key)
    if unused:
        raise ConfigError(
            f"{unused[0]} has no effect in libero tune; leave it out, or the preset that sets it"
        )


def _opened(trial: Trial) -> StreamData:
    """Return the demonstrations of a trial, of which those of the last one are held."""
    needed = {group: trial.config[group] for group in ("data", "language")}
    return _open(json.dumps(needed, sort_keys=True), trial.stream, trial.held_out)


@lru_cache(maxsize=1)
def _open(config: str, stream: tuple[Task, ...], held_out: float) -> StreamData:
    return open_stream(json.loads(config), stream, held_out)
