"""Success of a policy on tasks of the benchmark: fixed initial states, all episodes of a task at once.

Each task's result is written when the task is done, so a stopped evaluation resumes after it.
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from libero_env.storage import atomic_write_text
from libero_env.tasks import Task
from libero_env.timing import CONTROL_PERIOD
from lifelong.errors import ConfigError, LifelongError
from lifelong.evaluation.actors import Actor
from lifelong.evaluation.environments import VectorEnv
from lifelong.evaluation.protocols import EvalProtocol
from lifelong.evaluation.rollout import Rollouts, run_episodes, save_animation
from lifelong.results.evaluation_file import FILE_NAME, EvaluationResult, TaskResult, overall, task_result
from lifelong.results.metrics import Estimate
from lifelong.results.records import installed_versions, utc_now
from lifelong.results.summary import json_safe


@dataclass(frozen=True)
class SuiteEvaluation:
    """An evaluation of a policy on tasks.

    Attributes:
        identity: Plain data that identify the policy; a folder holds results of one policy only.
        tasks: Tasks of the benchmark.
        init_states: Initial states of each task.
        protocol: How episodes are run.
        out: Folder of the results.
        env: Function that builds the environment of a task, with one simulation for each initial state.
        actor: Function that returns the context manager of a task's actor.
        videos: Number of recorded episodes of each task.
        record_every: Number of control steps between two frames.
        progress: Whether to show progress bars.
        versions: Versions of the packages and models.
    """

    identity: Mapping[str, Any]
    tasks: Sequence[Task]
    init_states: tuple[int, ...]
    protocol: EvalProtocol
    out: Path
    env: Callable[[Task], VectorEnv]
    actor: Callable[[Task], AbstractContextManager[Actor]]
    videos: int = 0
    record_every: int = 4
    progress: bool = False
    versions: Mapping[str, str] = field(default_factory=installed_versions)

    def run(self, on_result: Callable[[TaskResult], None] = lambda _: None) -> list[TaskResult]:
        """Evaluate the tasks whose results are not on disk yet, and write `eval.json`.

        Args:
            on_result: Function called with each task's result, as soon as it is known.

        Raises:
            ConfigError: The folder holds results of another evaluation.
        """
        results = []
        for task in self.tasks:
            results.append(self._stored_result(task) or self._evaluate(task))
            on_result(results[-1])
        self.result(results).write(self.out / FILE_NAME)
        return results

    def result(self, results: Sequence[TaskResult]) -> EvaluationResult:
        """Return the results of the tasks with all that they depend on."""
        return EvaluationResult(
            evaluated=self.identity,
            protocol=asdict(self.protocol),
            init_states=self.init_states,
            versions=self.versions,
            tasks=tuple(results),
            times={"finished": utc_now()},
        )

    def _evaluate(self, task: Task) -> TaskResult:
        env = self.env(task)
        try:
            with self.actor(task) as actor:
                done = run_episodes(
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

    def _stored_result(self, task: Task) -> TaskResult | None:
        path = self._path(task)
        if not path.is_file():
            return None
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            digest = found.pop("digest")
            result = task_result(found)
        except (ValueError, KeyError, AttributeError) as error:
            raise LifelongError(f"{path} is not a valid result of a task ({error}); remove it") from error
        if digest != self._digest(task):
            raise ConfigError(
                f"{path} was made with another policy, protocol, set of initial states or version of the simulation: "
                "name another folder with --out, or repeat the evaluation with --again"
            )
        return result

    def _path(self, task: Task) -> Path:
        return self.out / "tasks" / f"{task.suite}_{task.index:02d}.json"

    def _digest(self, task: Task) -> str:
        simulation = {k: v for k, v in self.versions.items() if k in ("mujoco", "models")}
        parts = [dict(self.identity), asdict(self.protocol), self.init_states, simulation, task.bddl_text]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]

    def _save_videos(self, task: Task, done: Rollouts) -> None:
        folder, seconds = self.out / "videos", CONTROL_PERIOD * self.record_every
        for frames, episode in zip(done.recordings, done.episodes, strict=False):
            if frames:
                outcome = "success" if episode.success else "failure"
                name = f"{task.suite}_{task.index:02d}_start_{episode.init_state:02d}_{outcome}.webp"
                save_animation(frames, folder / name, seconds_per_frame=seconds)


HEADER = f"{'task':<18} {'successes':>9} {'%':>6} {'95 %':>13} {'steps':>6}  instruction"


def table_row(result: TaskResult) -> str:
    """Format a task's row under `HEADER`: successes, rate and interval in percent, mean steps of the successes."""
    wins = f"{sum(result.successes)}/{len(result.successes)}"
    steps = f"{result.steps:.0f}" if np.isfinite(result.steps) else "-"
    return f"{result.task:<18} {wins:>9} {_percent(result.success)} {steps:>6}  {result.instruction}"


def total_row(results: Sequence[TaskResult]) -> str:
    """Format the row of all tasks together."""
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
        atoms=done.atoms,
        atoms_ever=tuple(e.ever for e in done.episodes),
        atoms_at_end=tuple(e.at_end for e in done.episodes),
    )


def _write(path: Path, values: Mapping[str, Any]) -> None:
    atomic_write_text(path, json.dumps(json_safe(values), indent=1, ensure_ascii=False) + "\n")
