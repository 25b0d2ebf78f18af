"""Success of a policy on tasks of the benchmark, from fixed initial states.

An evaluation is a list of units, each a task and a range of its initial states. Any number of processes take units from
a folder they share, see `libero_eval.work.worker`; each may be killed, and the result is that of one process.
"""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from itertools import takewhile
from pathlib import Path
from typing import Any

from libero_env.errors import LiberoError
from libero_env.expert.expert import solved_from_events
from libero_env.parallel import this_process
from libero_env.perturbations import parse_perturbations
from libero_env.perturbations.events import NEVER
from libero_env.tasks import Task
from libero_env.text import json_safe
from libero_eval.evaluation_file import EvaluationResult, Stopped, TaskResult, known_by, world_of
from libero_eval.protocols.naming import compared
from libero_eval.protocols.protocol import EvalProtocol
from libero_eval.stats.sequential import shuffled
from libero_eval.work.progress import busy_seconds
from libero_eval.work.stopping import StoppingRule
from libero_eval.work.store import PLAN_FORMAT, Unit, UnitResult, WorkStore, describe, partition
from lifelong.errors import ConfigError, EvaluationIncompleteError
from lifelong.evaluation.actors import Actor, WatchesWorld
from lifelong.evaluation.environments import EnvPool, VectorEnv, common_environment, describe_environment
from lifelong.evaluation.rollout import Episode, Rollouts, run_episodes, save_animation
from lifelong.results.provenance import installed_versions

# Memory, as measured with libero_10/0
PROCESS_BYTES, SIMULATION_BYTES, IMAGE_COPIES = 600e6, 2e6, 7
DECISIVE = ("mujoco", "models", "models_digest")  # versions that the results of one evaluation must share


@dataclass(frozen=True)
class Evaluation:
    """An evaluation of a policy on tasks.

    Attributes:
        identity: Plain data that identify the policy; a folder holds results of one policy only.
        init_states: Initial states of each task.
        protocol: How episodes are run.
        out: Folder of the results.
        env: Function that builds the environment of a task with the given number of simulations.
        actor: Function that returns the context manager of the actor of a task and its initial states.
        unit_starts: Number of initial states of a unit, which are run in one batch.
        retries: How often a unit that ends with an error is tried again.
        errors_are_failures: Whether an episode that ends with an error is a failed one, as some protocols have it.
            Otherwise its unit is not counted, and there is no result until it has been run without an error.
        videos: Number of recorded episodes of each task.
        record_every: Number of control steps between two frames.
        progress: Whether to show progress bars.
        versions: Versions of the packages and models.
        probe: What the policy answers to a fixed observation, where that repeats; another answer is another policy.
        policy_threads: Number of threads of the policy on the CPU, on which its bits depend; None where the policy is
            not one of this package, or runs elsewhere. Whoever runs the evaluation sets it.
        until: When it may stop before all episodes are run.
        stopped: How the result was stopped that is run again; None where this is not one, or it was not.
        shuffled: Whether units are of starts in the order in which `until` looks at them, see `shuffled`.
    """

    identity: Mapping[str, Any]
    tasks: Sequence[Task]
    init_states: tuple[int, ...]
    protocol: EvalProtocol
    out: Path
    env: Callable[[Task, int], VectorEnv]
    actor: Callable[[Task, Sequence[int]], AbstractContextManager[Actor]]
    unit_starts: int = 10
    retries: int = 1
    errors_are_failures: bool = False
    videos: int = 0
    record_every: int = 4
    progress: bool = False
    versions: Mapping[str, str] = field(default_factory=installed_versions)
    probe: Sequence[float] | None = None
    policy_threads: int | None = None
    until: StoppingRule | None = None
    stopped: Stopped | None = None
    shuffled: bool = False

    @cached_property
    def units(self) -> tuple[Unit, ...]:
        """Units in order."""
        return partition(self.tasks, self._starts, self.unit_starts)

    @cached_property
    def _starts(self) -> tuple[int, ...]:
        """Starts in the order in which they are run."""
        return shuffled(self.init_states) if self.shuffled else self.init_states

    def turn(self, unit: Unit) -> int:
        """Return the round in which a unit is looked at first; 0 where the evaluation cannot be stopped."""
        order = shuffled(self.init_states) if self.until else ()
        return min((order.index(start) for start in unit.init_states), default=0) if order else 0

    @cached_property
    def store(self) -> WorkStore:
        """The folder of the results, which other processes may share."""
        plan = {
            "format": PLAN_FORMAT,
            "evaluated": known_by(self.identity),
            "protocol": compared(self._resolved_protocol),
            "unit_starts": self.unit_starts,
            "errors_are_failures": self.errors_are_failures,
            "policy_threads": self.policy_threads,
            "simulation": {k: v for k, v in self.versions.items() if k in DECISIVE},
        }
        return WorkStore(self.out, plan, self.probe, shuffled=self.shuffled)

    @property
    def _resolved_protocol(self) -> dict[str, Any]:
        return json_safe(self.protocol.resolved())

    def memory(self, workers: int) -> float:
        """Return an estimate of the memory that so many processes need, [bytes]; policies need theirs besides."""
        height, width = self.protocol.pixels.render_size or (128, 128)
        image = 3 * height * width * len(self.protocol.pixels.cameras)
        batch = min(self.unit_starts, len(self.init_states))
        steps = max((self.protocol.steps(task) for task in self.tasks), default=0) if self.videos else 0
        frames = min(self.videos, batch) * -(-steps // self.record_every)
        return workers * (PROCESS_BYTES + batch * (SIMULATION_BYTES + IMAGE_COPIES * image) + frames * image)

    def pool(self) -> EnvPool:
        """Return a pool that keeps the environment of the last unit open, for the next one of the same task."""
        by_id = {task.id: task for task in self.tasks}
        return EnvPool(lambda key: self.env(by_id[key[0]], key[1]), capacity=1)

    def evaluate(
        self,
        unit: Unit,
        pool: EnvPool,
        label: str = "",
        on_step: Callable[[int, int], None] = lambda steps, most: None,
    ) -> UnitResult:
        """Run the episodes of a unit.

        Args:
            unit: Unit of this evaluation.
            pool: Open environments, see `pool`.
            label: Text before the progress bar.
            on_step: See `run_episodes`.
        """
        started = time.time()
        env = pool.get((unit.task.id, len(unit.init_states)))
        done = self._run(unit, env, label, on_step)
        self._save_videos(unit, done)
        return self._unit_result(unit, done, env, started)

    def evaluate_apart(self, unit: Unit, pool: EnvPool, *, has_worked: bool) -> UnitResult:
        """Run the episodes of a unit one by one; those that end with an error are failures.

        Args:
            unit: Unit of this evaluation.
            pool: Open environments, see `pool`.
            has_worked: Whether the policy is known to run; otherwise one episode must.

        Raises:
            LiberoError: The policy's answers are not valid, or it cannot be reached: nothing is counted.
            Exception: No episode has ever run: the error is that of the policy and not of an episode.
        """
        started, parts = time.time(), []
        errors: list[str | None] = []
        for start in unit.init_states:
            alone = Unit(unit.task, (start,))
            env = pool.get((unit.task.id, 1))
            try:
                parts.append(self._run(alone, env))
                errors.append(None)
            except LiberoError:
                raise
            except Exception as error:  # noqa: BLE001 - policies raise errors of any type
                if not has_worked and len(errors) == len(unit.init_states) - 1 and all(errors):
                    raise
                atoms = tuple(getattr(env, "atoms", ()))
                parts.append(Rollouts((self._failed(start, len(atoms)),), 0.0, atoms))
                errors.append(describe(error))
        done = Rollouts(tuple(p.episodes[0] for p in parts), sum(p.seconds for p in parts), parts[0].atoms)
        return self._unit_result(unit, done, env, started, tuple(errors))

    def _failed(self, start: int, atoms: int) -> Episode:
        """Return an episode that ended with an error, with columns as wide as those of the others."""
        perturbations = parse_perturbations(self.protocol.world.perturb, events=True)
        never = (NEVER,) * sum(bool(one.trigger) for one in perturbations)
        none = (False,) * atoms
        return Episode(
            *(start, False, 0, none, none, none),
            attempts=(0,) * len(perturbations),
            began=never,
            solved=never,
            timing=(0, 0, 0) if self.protocol.action.clock else (),
        )

    def task_result(self, task: Task, done: Mapping[str, UnitResult]) -> TaskResult | None:
        """Return the results of a task from those of its units, or None while some are missing."""
        names = [unit.name for unit in self.units if unit.task is task]
        if not all(name in done for name in names):
            return None
        return TaskResult.joined([done[name].result for name in names])

    def starts_needed(self, done: Mapping[str, UnitResult]) -> tuple[int, ...] | None:
        """Return the starts that the result is of; None where more units have to be run.

        The rule that may stop it sees the starts that all tasks have been run from, in the order of `shuffled`,
        whatever else is done.
        """
        units = [unit for unit in self.units if unit.name in done]
        ran = Counter(start for unit in units for start in unit.init_states)
        known = tuple(takewhile(lambda start: ran[start] == len(self.tasks), shuffled(self.init_states)))
        if self.until is not None and known:
            for unit in units:
                self.until.check_world(world_of(done[unit.name].environment))
            if count := self.until.starts_needed(self._by_task(units, done), known):
                return known[:count]
        return known if len(known) == len(self.init_states) else None

    def result(self, done: Mapping[str, UnitResult]) -> EvaluationResult:
        """Return the results of all tasks with all that they depend on; it depends on the units' files only.

        Args:
            done: Results of the units that are done by name.

        Raises:
            ConfigError: A unit is missing.
            EvaluationIncompleteError: Simulation errors ended all episodes of a task.
        """
        starts = self.starts_needed(done)
        if starts is None:
            raise ConfigError(f"{len(done)} of {len(self.units)} units are done: there is no result yet")
        chosen = [unit for unit in self.units if {*unit.init_states} & {*starts}]
        units = {unit.name: done[unit.name] for unit in chosen}
        tasks = [task.of_starts(starts) for task in self._by_task(chosen, done)]
        if lost := next((task for task in tasks if not task.init_states), None):
            raise EvaluationIncompleteError(
                f"simulation errors ended all episodes of {lost.task}, which has no success: "
                f"{lost.simulation_errors[0][1]}"
            )
        stopped = self.stopped
        if self.until is not None:
            planned = len(self.tasks) * len(self.init_states)
            stopped = Stopped(self.until.text, self.until.verdict(tasks, starts), planned)
        return EvaluationResult(
            evaluated=self.identity,
            protocol=self._resolved_protocol,
            init_states=tuple(sorted(starts)),
            versions=common_environment([one.versions for one in units.values()]),
            environment=common_environment([one.environment for one in units.values()]),
            unit_starts=self.unit_starts,
            stopped=stopped,
            tasks=tuple(tasks),
            times=self._times(units),
        )

    def _by_task(self, units: Sequence[Unit], done: Mapping[str, UnitResult]) -> list[TaskResult]:
        """Return the results of each task from those of units, in the order of the starts' numbers."""
        parts: dict[str, list[TaskResult]] = {}
        for unit in units:
            parts.setdefault(unit.task.id, []).append(done[unit.name].result)
        return [TaskResult.joined(part) for part in parts.values()]

    def _run(
        self,
        unit: Unit,
        env: VectorEnv,
        label: str = "",
        on_step: Callable[[int, int], None] = lambda steps, most: None,
    ) -> Rollouts:
        filmed = [i for i, start in enumerate(unit.init_states) if start in self._starts[: self.videos]]
        with self.actor(_acted_task(env, unit), unit.init_states) as actor:
            if isinstance(actor, WatchesWorld):
                actor.watch(env)  # type: ignore[arg-type]  # of every environment of this package
            done = run_episodes(
                actor,
                env,
                unit.init_states,
                horizon=self.protocol.steps(unit.task),
                settle_steps=self.protocol.settle_steps,
                settle_action=self.protocol.episode.settle_action,
                record_every=self.record_every if filmed else 0,
                recorded=filmed,
                label=label or unit.task.id,
                progress=self.progress,
                on_step=on_step,
            )
        if not any(one.began for one in done.episodes):
            return done
        solved = solved_from_events(env)  # type: ignore[arg-type]  # those with events are of this package
        rows = zip(done.episodes, solved.tolist(), strict=True)
        return replace(done, episodes=tuple(replace(one, solved=tuple(row)) for one, row in rows))

    def _unit_result(
        self, unit: Unit, done: Rollouts, env: VectorEnv, started: float, errors: tuple[str | None, ...] = ()
    ) -> UnitResult:
        names = ("attempts", "began", "solved", "timing")  # of what not every protocol has
        rows = {name: tuple(getattr(e, name) for e in done.counted) for name in names}
        kept = tuple(e for e, ran in zip(errors, done.episodes, strict=False) if not ran.simulation_error)
        result = TaskResult(
            task=unit.task.id,
            name=unit.task.name,
            instruction=self._instruction(env, unit),
            digest=unit.task.digest,
            errors=kept if any(kept) else (),
            actions=tuple(e.actions for e in done.counted),
            atoms_at_start=tuple(e.at_start for e in done.counted),
            **{name: column if any(column) else () for name, column in rows.items()},
            **done.columns(),
        )
        environment, versions = describe_environment(env), dict(self.versions)
        return UnitResult(result, environment, versions, this_process(), started, time.time())

    def _instruction(self, env: VectorEnv, unit: Unit) -> str:
        """Return what a policy is told, with what an event tells it later."""
        told = [_acted_task(env, unit), *filter(None, [getattr(env, "later", None)])]
        return ", then: ".join(map(self.protocol.words, told))

    def _times(self, done: Mapping[str, UnitResult]) -> dict[str, Any]:
        spans = {unit: done[unit.name] for unit in self.units if unit.name in done}
        results = spans.values()
        return {
            "started": iso_time(min(r.started for r in results)),
            "finished": iso_time(max(r.finished for r in results)),
            "busy_seconds": round(busy_seconds((r.started, r.finished) for r in results), 2),
            "seconds": {
                task.id: round(sum(r.finished - r.started for u, r in spans.items() if u.task is task), 2)
                for task in self.tasks
            },
            "processes": len({r.process for r in results}),
        }

    def is_filmed(self, unit: Unit) -> bool:
        """Return whether the episodes of a unit that are to be filmed have been."""
        starts = {*unit.init_states} & {*self._starts[: self.videos]}
        return all(any((self.out / "videos").glob(_video(unit, start, "*"))) for start in starts)

    def _save_videos(self, unit: Unit, done: Rollouts) -> None:
        seconds = self.record_every / self.protocol.world.control_freq
        filmed = [e for e in done.episodes if e.init_state in self._starts[: self.videos]]
        for frames, episode in zip(done.recordings, filmed, strict=False):
            if frames:
                outcome = "success" if episode.success else "failure"
                outcome = "simulation_error" if episode.simulation_error else outcome
                name = _video(unit, episode.init_state, f"{outcome}.webp")
                save_animation(frames, self.out / "videos" / name, seconds_per_frame=seconds)


def _video(unit: Unit, start: int, ending: str) -> str:
    return f"{unit.task.suite}_{unit.task.index:02d}_start_{start:02d}_{ending}"


def _acted_task(env: VectorEnv, unit: Unit) -> Task:
    """Return the task that a policy is told: that of the environment, which perturbations may have changed."""
    task = getattr(env, "task", None)
    return task if isinstance(task, Task) else unit.task


def iso_time(seconds: float) -> str:
    """Return a time, seconds since the epoch, as text."""
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")
