"""Short streams of tasks, learned as a run learns them, with rollouts on each task at the end.

What is measured is kept, so a sweep that was stopped goes on.
"""

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from libero_env.doors import doors
from libero_env.storage import files_below, read_record, write_record
from libero_env.tasks import Task
from lifelong import checkpoints
from lifelong.algorithms.base import Algorithm
from lifelong.data.demonstrations import DemoDatasets, check_pairing, find_demos
from lifelong.data.settings import DataSettings
from lifelong.data.windows import TaskWindows
from lifelong.errors import ConfigError
from lifelong.evaluation.environments import run_environment
from lifelong.evaluation.rollout import rollout
from lifelong.evaluation.settings import EvalSettings
from lifelong.policies.base import Policy
from lifelong.results.provenance import installed_versions, source_digest
from lifelong.seeding import BEGIN_TASK, END_TASK, FIT, INIT, ROLLOUT, generator, seeded
from lifelong.sequence.learning import meet
from lifelong.sequence.measuring import digest
from lifelong.settings import Configuration
from lifelong.training.fit import fit
from lifelong.training.settings import FitSettings
from lifelong.tuning.frontier import Frontier, Measured, Outcome
from lifelong.types import PolicySpec

FORMAT = 2  # of a trial's record; another one is measured again
_GROUPS = ("algo", "policy", "data", "augmentation", "train", "language")  # that learning depends on
_ACTING = ("horizon", "settle_steps", "precision", "backend")  # of eval, that rollouts depend on
# Keys that no trial obeys -> their values besides null that it agrees with. Not seed, benchmark.suite and the rest of
# eval, which presets choose for the runs
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
class TrialSettings:
    """Settings of the measurement.

    Attributes:
        streams: Tasks of each stream, in learning order.
        seeds: Seeds with which each stream is learned.
        steps: Number of optimiser steps on a task.
        starts: Number of initial states, the first ones of each task, from which it is rolled out at the end.
    """

    streams: tuple[tuple[Task, ...], ...]
    seeds: tuple[int, ...] = (1,)
    steps: int = 600
    starts: int = 10


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
    """

    spec: PolicySpec
    training: tuple[TaskWindows, ...]


@dataclass(frozen=True)
class Trial:
    """One configuration that learns one stream.

    Attributes:
        config: Configuration of a run, as plain data.
        stream: Tasks in learning order.
        seed: Seed of all random draws.
        steps: Number of optimiser steps on a task.
        starts: Number of initial states from which each task is rolled out.
    """

    config: Mapping[str, Any]
    stream: tuple[Task, ...]
    seed: int
    steps: int
    starts: int = 10

    def key(self) -> str:
        """Return a digest of all that the trial depends on: its settings, the source, packages and models."""
        acting = {name: self.config["eval"][name] for name in _ACTING}
        return self._digest(self.config["algo"], self.starts, acting)

    def start_key(self, algorithm: Algorithm) -> str:
        """Return a digest of all that the first task's learning depends on; on later tasks by their statistics."""
        own = {name: value for name, value in self.config["algo"].items() if name not in algorithm.tuned}
        return self._digest({} if algorithm.plain_start else own)

    def _digest(self, algo: Mapping[str, Any], *more: Any) -> str:
        groups = {group: self.config[group] for group in _GROUPS} | {"algo": algo}
        stream = [task.id for task in self.stream]
        rest = [FORMAT, stream, self.seed, self.steps, *more, source_digest(), installed_versions()]
        rest += _stamps(self.config["data"])
        return hashlib.sha256(json.dumps([groups, rest], sort_keys=True).encode()).hexdigest()[:16]


def _stamps(data: Mapping[str, Any]) -> list[tuple[str, int, int]]:
    """Return name, size and time of the demonstration files that are the user's, which he may replace."""
    files = [Path(name).expanduser() for name in data["files"]]
    if data["folder"]:
        files += sorted(files_below(Path(data["folder"]).expanduser(), "*.hdf5"))
    for form, _, folder in (name.partition(":") for name in data["files"]):
        if form in doors("sets"):
            files += sorted(files_below(Path(folder).expanduser(), "*"))
    return [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files if file.is_file()]


def open_stream(config: Mapping[str, Any], tasks: Sequence[Task]) -> StreamData:
    """Read the demonstrations of a stream; missing ones are recorded.

    Args:
        config: Configuration of a run, as plain data.
        tasks: Tasks in learning order.
    """
    checked = Configuration(config)
    data: DataSettings = checked.build("data")
    languages = checked.build("language").embed([task.language for task in tasks])
    spec, counts = data.spec(languages.shape[1]), [data.demos] * len(tasks)
    paths = find_demos(tasks, counts, data, None)
    check_pairing(paths, data)
    training = DemoDatasets(paths, counts, spec, languages, data, torch.device("cpu"))
    return StreamData(spec, tuple(training[k] for k in range(len(tasks))))


def measure(trial: Trial, data: Callable[[], StreamData], folder: Path) -> Measured:
    """Learn a trial's stream and roll each task out; what was measured before is read back.

    Args:
        trial: What to learn.
        data: Function that returns the demonstrations of its stream, called where they are needed.
        folder: Folder of the records and of the weights after first tasks.
    """
    path = folder / "trials" / f"{trial.key()}.json"
    if (record := read_record(path)) is not None:
        return Measured(**record)
    began, opened = time.perf_counter(), data()
    *_, (algorithm, policy) = learn(trial, opened, folder)
    learned = time.perf_counter()
    found = Measured(
        [_success(trial, opened, algorithm, policy, task) for task in range(len(trial.stream))],
        digest({"algorithm": algorithm.state_dict()}, policy),
        [round(learned - began, 1), round(time.perf_counter() - learned, 1)],
    )
    write_record(path, asdict(found))
    return found


def _success(trial: Trial, data: StreamData, algorithm: Algorithm, policy: Policy, task: int) -> float:
    """Return the share of successful rollouts on a task."""
    config, followed = Configuration(trial.config), trial.stream[task]
    settings: EvalSettings = config.build("eval")
    env = run_environment(followed, trial.starts, data.spec, settings, config.build("data"))
    with env, algorithm.policy_for(task, policy) as acting:
        return rollout(
            acting,
            env,
            range(trial.starts),
            language=config.build("language").embed([followed.language])[0],
            horizon=settings.horizon,
            settle_steps=settings.settle_steps,
            seed=(trial.seed, ROLLOUT, len(trial.stream) - 1, 0, task),
            precision=settings.precision,
        ).rate


def learn(trial: Trial, data: StreamData, folder: Path) -> Iterator[tuple[Algorithm, Policy]]:
    """Learn a trial's stream and yield the algorithm and the policy after each task.

    Args:
        trial: What to learn.
        data: Demonstrations of its stream.
        folder: Folder of the weights after first tasks, which trials share.

    Raises:
        ConfigError: The algorithm learns several tasks together.
    """
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
        yield algorithm, policy


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


def measure_frontier(
    candidates: Sequence[Candidate], others: Sequence[Candidate], settings: TrialSettings, folder: Path
) -> Frontier:
    """Measure candidates on all streams and with all seeds.

    Args:
        candidates: Values to choose from, in the order of the picture's line.
        others: Algorithms to compare with.
        settings: Streams, seeds, length of training and number of rollouts.
        folder: Folder of what is measured.

    Raises:
        ConfigError: A stream is too short to forget anything, or a setting has no effect on the trials.
    """
    everyone = (*others, *candidates)
    for one in everyone:
        check_obeyed(one.config, one.settings)
    trials: list[list[Measured]] = [[] for _ in everyone]
    places = [(stream, seed) for stream in settings.streams for seed in settings.seeds]
    total, done = len(places) * len(everyone), 0
    for stream, seed in places:
        if len(stream) < 2:
            raise ConfigError(
                "a stream has one task; expected two or more, of which the first can be forgotten"
            )
        for one, own in zip(everyone, trials, strict=True):
            trial = Trial(one.config, stream, seed, settings.steps, settings.starts)
            own.append(found := measure(trial, partial(_opened, trial), folder))
            done += 1
            shown = ", ".join(f"{rate:.0%}" for rate in found.success)
            print(
                f"{done}/{total} {one.label}, {stream[0].name} and {len(stream) - 1} more, seed {seed}: success at the "
                f"end {shown} ({found.seconds[0]:.0f} s of learning, {found.seconds[1]:.0f} s of rollouts)"
            )
    outcomes = [
        Outcome(one.label, one.settings, tuple(own)) for one, own in zip(everyone, trials, strict=True)
    ]
    return Frontier(tuple(outcomes[len(others) :]), tuple(outcomes[: len(others)]))


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
    return _open(json.dumps(needed, sort_keys=True), trial.stream)


@lru_cache(maxsize=1)
def _open(config: str, stream: tuple[Task, ...]) -> StreamData:
    return open_stream(json.loads(config), stream)
