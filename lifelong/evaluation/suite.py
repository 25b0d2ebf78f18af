"""Success of a policy on tasks of the benchmark: fixed starts, all episodes of a task at once, Wilson's intervals.

What is done of a task is on disk when it is done, so a stopped evaluation goes on where it was.
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from libero_env.init_states.store import NUM_INIT_STATES
from libero_env.storage import atomic_write_text
from libero_env.tasks import Task
from libero_env.timing import CONTROL_PERIOD
from lifelong.errors import ConfigError, LifelongError
from lifelong.evaluation.actors import Actor
from lifelong.evaluation.environments import VectorEnv
from lifelong.evaluation.rollout import Rollouts, play, save_animation
from lifelong.results.metrics import Estimate, combine_intervals, wilson_interval
from lifelong.results.records import installed_versions, utc_now
from lifelong.results.subgoals import predicate_of
from lifelong.results.summary import plain

SELECTION = range(NUM_INIT_STATES - 20, NUM_INIT_STATES)  # starts that choose a checkpoint by default


@dataclass(frozen=True)
class Protocol:
    """How episodes are run.

    Attributes:
        horizon: Most control steps, or by suite.
        settle_steps: Steps before the policy acts.
        settle_action: What is done in them; None: nothing.
        camera_size: Pixels of the pictures, (height, width), for policies that do not say themselves.
        original: Observations under the names of LIBERO's own environments, pictures bottom up.
    """

    horizon: int | Mapping[str, int] = 600
    settle_steps: int = 5
    settle_action: tuple[float, ...] | None = None
    camera_size: tuple[int, int] = (128, 128)
    original: bool = False

    def steps(self, task: Task) -> int:
        """The horizon of a task."""
        if isinstance(self.horizon, int):
            return self.horizon
        return self.horizon.get(task.suite, max(self.horizon.values()))


# `libero`: Liu et al. 2023, appendix B. `openpi`: as the scripts of openpi and OpenVLA-OFT evaluate.
PROTOCOLS = {
    "libero": Protocol(),
    "openpi": Protocol(
        horizon={
            "libero_spatial": 220,
            "libero_object": 280,
            "libero_goal": 300,
            "libero_10": 520,
            "libero_90": 400,
        },
        settle_steps=10,
        settle_action=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0),
        camera_size=(256, 256),
        original=True,
    ),
}


def starts(which: str, count: int | None, selection: Sequence[int] = SELECTION) -> tuple[int, ...]:
    """Indices of the initial states that are evaluated.

    Args:
        which: `all`; `selection`: those by which a checkpoint may have been chosen; `reporting`: the others.
        count: The first so many of them; None: all of them.
        selection: Those for selection.

    Raises:
        ConfigError: Another word, or more starts than there are.
    """
    parts: dict[str, Sequence[int]] = {
        "all": range(NUM_INIT_STATES),
        "selection": selection,
        "reporting": [i for i in range(NUM_INIT_STATES) if i not in selection],
    }
    if which not in parts:
        raise ConfigError(f"starts are {which!r}; valid: {', '.join(parts)}")
    chosen = tuple(parts[which])
    count = len(chosen) if count is None else count
    if not 1 <= count <= len(chosen):
        raise ConfigError(f"{count} episodes of a task; {which} has 1 to {len(chosen)} initial states")
    return chosen[:count]


@dataclass(frozen=True)
class TaskResult:
    """What a policy did on a task; an entry for each episode."""

    task: str
    name: str
    instruction: str
    init_states: tuple[int, ...]
    successes: tuple[bool, ...]
    lengths: tuple[int, ...]
    seconds: float
    atoms: tuple[str, ...] = ()
    atoms_ever: tuple[tuple[bool, ...], ...] = ()
    atoms_at_end: tuple[tuple[bool, ...], ...] = ()

    @property
    def success(self) -> Estimate:
        """Share of successes with Wilson's interval."""
        wins, count = sum(self.successes), len(self.successes)
        low, high = wilson_interval(wins, count)
        return Estimate(wins / count, float(low), float(high))

    @property
    def steps(self) -> float:
        """Mean length of the successful episodes, control steps; NaN without any."""
        lengths = [n for n, won in zip(self.lengths, self.successes, strict=True) if won]
        return float(np.mean(lengths)) if lengths else float("nan")


@dataclass(frozen=True)
class SuiteEvaluation:
    """What is evaluated, and how.

    Attributes:
        what: What identifies the policy, as plain data; a folder holds results of one such only.
        tasks: Of the benchmark.
        init_states: The starts of each.
        protocol: How episodes are run.
        out: Folder of the results.
        env: Makes the environment of a task, with as many simulations as starts.
        actor: The actor on a task, within a context.
        videos: So many episodes of each task are recorded.
        record_every: Control steps between two pictures.
    """

    what: Mapping[str, Any]
    tasks: Sequence[Task]
    init_states: tuple[int, ...]
    protocol: Protocol
    out: Path
    env: Callable[[Task], VectorEnv]
    actor: Callable[[Task], AbstractContextManager[Actor]]
    videos: int = 0
    record_every: int = 4
    progress: bool = False
    versions: Mapping[str, str] = field(default_factory=installed_versions)

    def run(self, say: Callable[[TaskResult], None] = lambda _: None) -> list[TaskResult]:
        """Evaluate what is not on disk yet, and write `eval.json`.

        Args:
            say: Told each task's result, as soon as there is one.

        Raises:
            ConfigError: The folder holds results of something else.
        """
        results = []
        for task in self.tasks:
            results.append(self._stored(task) or self._evaluate(task))
            say(results[-1])
        _write(self.out / "eval.json", self.summary(results))
        return results

    def summary(self, results: Sequence[TaskResult]) -> dict[str, Any]:
        """Everything as plain data: what was evaluated, success in all, of each suite and of each task."""
        suites = dict.fromkeys(r.task.partition("/")[0] for r in results)
        return {
            "evaluated": dict(self.what),
            "protocol": asdict(self.protocol),
            "init_states": self.init_states,
            "finished": utc_now(),
            "versions": dict(self.versions),
            "success": asdict(overall(results)),
            "suites": {
                s: asdict(overall([r for r in results if r.task.startswith(s + "/")])) for s in suites
            },
            "predicates": predicate_rates(results),
            "tasks": [asdict(r) | {"success": asdict(r.success), "mean_steps": r.steps} for r in results],
        }

    def _evaluate(self, task: Task) -> TaskResult:
        env = self.env(task)
        try:
            with self.actor(task) as actor:
                done = play(
                    actor,
                    env,
                    self.init_states,
                    horizon=self.protocol.steps(task),
                    settle_steps=self.protocol.settle_steps,
                    settle_action=self.protocol.settle_action,
                    record_every=self.record_every if self.videos else 0,
                    recorded=range(min(self.videos, len(self.init_states))),
                    label=task.id,
                    progress=self.progress,
                )
        finally:
            env.close()
        result = _result(task, done)
        self._save_videos(task, done)
        _write(self._path(task), {"digest": self._digest(task), **asdict(result)})
        return result

    def _stored(self, task: Task) -> TaskResult | None:
        path = self._path(task)
        if not path.is_file():
            return None
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            digest = found.pop("digest")
            rows = {f.name: _tuples(found[f.name]) for f in fields(TaskResult)}
        except (ValueError, KeyError, AttributeError) as error:
            raise LifelongError(f"{path} is no result of a task ({error}); remove it") from error
        if digest != self._digest(task):
            raise ConfigError(
                f"{path} was made with another policy, protocol, set of starts or version of the simulation: "
                "name another folder with --out, or run it anew with --again"
            )
        return TaskResult(**rows)

    def _path(self, task: Task) -> Path:
        return self.out / "tasks" / f"{task.suite}_{task.index:02d}.json"

    def _digest(self, task: Task) -> str:
        simulation = {k: v for k, v in self.versions.items() if k in ("mujoco", "models")}
        parts = [dict(self.what), asdict(self.protocol), self.init_states, simulation, task.bddl_text]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]

    def _save_videos(self, task: Task, done: Rollouts) -> None:
        for film, episode in zip(done.films, done.episodes, strict=False):
            if film:
                outcome = "success" if episode.success else "failure"
                path = (
                    self.out
                    / "videos"
                    / f"{task.suite}_{task.index:02d}_start_{episode.init_state:02d}_{outcome}.webp"
                )
                save_animation(film, path, seconds_per_frame=CONTROL_PERIOD * self.record_every)


def overall(results: Sequence[TaskResult]) -> Estimate:
    """Success averaged over tasks, with the interval that Wilson's of the tasks imply (see `combine_intervals`).

    The tasks are fixed, so it covers chance in the episodes and not the choice of tasks.
    """
    found = [r.success for r in results]
    weights = np.full(len(found), 1 / max(1, len(found)))
    return combine_intervals(
        weights, [e.value for e in found], [e.low for e in found], [e.high for e in found]
    )


def predicate_rates(results: Sequence[TaskResult]) -> dict[str, float]:
    """How often atoms of the goals were reached at any time, by predicate; mean over atoms."""
    rates: dict[str, list[float]] = {}
    for result in results:
        for i, atom in enumerate(result.atoms):
            rates.setdefault(predicate_of(atom), []).append(
                float(np.mean([row[i] for row in result.atoms_ever]))
            )
    return {name: float(np.mean(values)) for name, values in rates.items()}


HEADER = f"{'task':<18} {'successes':>9} {'%':>6} {'95 %':>13} {'steps':>6}  instruction"


def line(result: TaskResult) -> str:
    """A task's line under `HEADER`: successes, share and interval in percent, mean steps of the successes."""
    wins = f"{sum(result.successes)}/{len(result.successes)}"
    steps = f"{result.steps:.0f}" if np.isfinite(result.steps) else "-"
    return f"{result.task:<18} {wins:>9} {_percent(result.success)} {steps:>6}  {result.instruction}"


def total_line(results: Sequence[TaskResult]) -> str:
    """The line of all tasks together."""
    wins, episodes = sum(sum(r.successes) for r in results), sum(len(r.successes) for r in results)
    return f"{'mean over tasks':<18} {f'{wins}/{episodes}':>9} {_percent(overall(results))}"


def _percent(e: Estimate) -> str:
    interval = f"[{100 * e.low:.1f}, {100 * e.high:.1f}]"
    return f"{100 * e.value:6.1f} {interval:>13}"


def _result(task: Task, done: Rollouts) -> TaskResult:
    return TaskResult(
        task=task.id,
        name=task.name,
        instruction=task.language,
        init_states=tuple(e.init_state for e in done.episodes),
        successes=tuple(e.success for e in done.episodes),
        lengths=tuple(e.length for e in done.episodes),
        seconds=done.seconds,
        atoms=done.atoms,
        atoms_ever=tuple(e.ever for e in done.episodes),
        atoms_at_end=tuple(e.at_end for e in done.episodes),
    )


def _write(path: Path, values: Mapping[str, Any]) -> None:
    atomic_write_text(path, json.dumps(plain(values), indent=1, ensure_ascii=False) + "\n")


def _tuples(value: Any) -> Any:
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value
