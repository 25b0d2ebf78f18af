"""`eval.json`: the result of an evaluation, as written by `libero eval` and read by everything that judges it.

The file holds, for each task, one entry per episode, and everything that is needed to run the evaluation again: the
policy, the resolved protocol, the initial states, the versions and the environment. What depends on when it was run
stands apart, under `times`: two evaluations with the same outcomes have the same `outcomes`, a digest.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import compress
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from libero_env.errors import LiberoError
from libero_env.sim.backend import MUJOCO
from libero_env.storage import read_json, write_json
from libero_env.tasks import get_suite
from libero_env.text import json_safe, shorten, shown
from libero_env.validation import validate
from libero_eval.stats.sequential import anytime_interval
from lifelong.errors import EvaluationFileError, writing
from lifelong.results.records import Count, Episodes
from lifelong.results.subgoals import predicate_of
from lifelong.stats.intervals import LEAST_EPISODES, Estimate, mean_success

FORMAT = "libero-evaluation/1"
FILE_NAME = "eval.json"
# What the outcome of an episode depends on by design. Other entries of the environment (renderer, processor) and
# versions change little; a difference in them is told, and the comparison goes on.
WORLD = ("models", "robot", "drawing")

_Name = Annotated[str, Field(min_length=1, max_length=1000)]
# also part of the names of files
_Id = Annotated[str, Field(pattern=r"^[^/\x00]+/[^\x00]+$", max_length=1000)]


@dataclass(frozen=True)
class TaskResult(Episodes):
    """Results of a policy on a task, with one entry per episode.

    Attributes:
        task: Id of the task, such as `libero_goal/3`.
        name: Name of the task, that of its file.
        instruction: Instruction that the policy received.
        digest: Digest of the task, see `libero_env.tasks.Task.digest`; empty where it was not recorded.
        errors: Error of each episode that the protocol counts as a failure, or None; empty if there are none.
        actions: Digest of the actions of each episode, by which episodes can be compared to the bit; empty if they
            were not recorded.
        attempts: Number of samples that were not valid of each perturbation of the protocol, (episodes, perturbations);
            empty without perturbations.
        began: Number of control steps from the reset before each event began, -1 where it never did, (episodes,
            events); empty without events.
        solved: Whether the expert, from the state just after each event, solves what is left: 1 or 0, -1 where it never
            began.
        atoms_at_start: Whether each atom held before the policy acted, (episodes, atoms).
        timing: Requests to the policy, answers that were used, and steps waited for one, of each episode; empty without
            a clock.

    Raises:
        EvaluationFileError: The columns have different lengths.
    """

    task: _Id
    name: _Name
    instruction: str
    digest: str = ""
    errors: tuple[str | None, ...] = ()
    actions: tuple[str, ...] = ()
    attempts: tuple[tuple[Count, ...], ...] = ()
    began: tuple[tuple[Annotated[int, Field(ge=-1)], ...], ...] = ()
    atoms_at_start: tuple[tuple[bool, ...], ...] = ()
    solved: tuple[tuple[Annotated[int, Field(ge=-1, le=1)], ...], ...] = ()
    timing: tuple[tuple[Count, ...], ...] = ()

    # of the columns below, those that `outcomes` depends on
    OUTCOMES: ClassVar[tuple[str, ...]] = ("errors", "attempts")
    OPTIONAL: ClassVar[tuple[str, ...]] = (
        *(*Episodes.OPTIONAL, *OUTCOMES),
        *("actions", "began", "atoms_at_start", "solved", "timing"),
    )

    def __post_init__(self) -> None:
        errors = self.shape_errors()
        if len(set(self.starts)) != len(self.starts):
            errors.append(f"an initial state is counted twice: {list(self.starts)}")
        if errors:
            raise EvaluationFileError(f"{self.task}: {errors[0]}")

    @classmethod
    def joined(cls, parts: "Sequence[TaskResult]") -> "TaskResult":
        """Return the results of a task from those of parts of its episodes, in the order of the starts' numbers."""
        raised = any(part.errors for part in parts)
        rows: dict[str, tuple] = {
            f.name: sum((getattr(part, f.name) for part in parts), ())
            for f in fields(cls)
            if isinstance(getattr(parts[0], f.name), tuple)
            and f.name not in ("atoms", "errors", "limits_reached")
        }
        rows["errors"] = sum((p.errors or (None,) * len(p.init_states) for p in parts), ()) if raised else ()
        limits = sum((Counter(dict(part.limits_reached)) for part in parts), Counter[str]())
        rows["limits_reached"] = tuple(sorted(limits.items()))
        order = sorted(range(len(rows["init_states"])), key=rows["init_states"].__getitem__)
        for name in ("init_states", "successes", "lengths", *cls.OPTIONAL, *cls.OF_ATOMS):
            rows[name] = tuple(rows[name][i] for i in order) if rows[name] else ()
        rows["simulation_errors"] = tuple(sorted(rows["simulation_errors"]))
        first = parts[0]
        return cls(first.task, first.name, first.instruction, first.digest, atoms=first.atoms, **rows)

    def of_starts(self, starts: Collection[int]) -> "TaskResult":
        """Return the results of the episodes from some of the starts; which limits these reached is not known."""
        kept = [start in starts for start in self.init_states]
        rows = ("init_states", "successes", "lengths", *self.OPTIONAL, *self.OF_ATOMS)
        changes: dict[str, Any] = {name: tuple(compress(getattr(self, name), kept)) for name in rows}
        errors = tuple(one for one in self.simulation_errors if one[0] in starts)
        limits = self.limits_reached if all(kept) else ()
        return replace(self, **changes, simulation_errors=errors, limits_reached=limits)

    @property
    def starts(self) -> tuple[int, ...]:
        """Initial states of all episodes, also of those that do not count; these are the last."""
        return (*self.init_states, *(start for start, _ in self.simulation_errors))

    @property
    def event_note(self) -> str:
        """In how many episodes each event began, and the expert solves the rest, as text; empty without events."""
        events = list(zip(*self.began, strict=True))
        solved = list(zip(*self.solved, strict=True)) or [()] * len(events)
        counts = [
            f"{sum(at >= 0 for at in event)} of {len(event)}"
            + (f" (the expert solves {rest.count(1)} from there)" if {0, 1} & {*rest} else "")
            for event, rest in zip(events, solved, strict=True)
        ]
        return f"events began in {', '.join(counts)}" if counts else ""

    @property
    def clock_note(self) -> str:
        """How many answers were used, and for how long they were waited for, as text; empty without a clock."""
        if not self.timing:
            return ""
        requests, used, waited = (sum(column) for column in zip(*self.timing, strict=True))
        share = 100 * waited / max(1, sum(self.lengths))
        return f"{used} of {requests} answers used, waited in {share:.0f} % of the steps"

    @property
    def suite(self) -> str:
        """Name of the task's suite."""
        return self.task.partition("/")[0]

    @property
    def success(self) -> Estimate:
        """Success rate with Wilson's interval; NaN if no episode counts."""
        return overall([self])

    @property
    def steps(self) -> float:
        """Mean length of the successful episodes, [control steps]; NaN if there are none."""
        lengths = [n for n, won in zip(self.lengths, self.successes, strict=True) if won]
        return float(np.mean(lengths)) if lengths else float("nan")


@dataclass(frozen=True)
class Stopped:
    """Until when an evaluation was to go on; what was not run by then is not counted.

    Attributes:
        until: What was to be known, `--until`.
        verdict: `known` or `not known`, or `above` or `below` the other result, less the margin.
        planned: Number of episodes without it.
    """

    until: str
    verdict: str
    planned: Annotated[int, Field(ge=1)]


@dataclass(frozen=True)
class EvaluationResult:
    """The result of an evaluation.

    Attributes:
        evaluated: Plain data that identify the policy.
        protocol: How episodes were run: the resolved protocol as plain data.
        init_states: Indices of the initial states of each task.
        versions: Versions of Python, of the packages and of the models.
        environment: What the numbers may also depend on: models, robot, drawing, renderer, processor, threads. Where
            the processes of an evaluation differ, a value is the list of the different ones.
        unit_starts: Number of episodes that were run in one batch; the bits of a policy may depend on it. None: all
            episodes of a task.
        stopped: Until when it was to go on; None for all episodes.
        times: When and how long it was run; not part of `outcomes`.

    Raises:
        EvaluationFileError: There are no tasks, one is counted twice, or no episode of one counts.
    """

    evaluated: Mapping[str, Any]
    protocol: Mapping[str, Any]
    init_states: tuple[Count, ...]
    versions: Mapping[str, Any]
    tasks: tuple[TaskResult, ...]
    environment: Mapping[str, Any] = field(default_factory=dict)
    unit_starts: Annotated[int, Field(ge=1)] | None = None
    stopped: Stopped | None = None
    times: Mapping[str, Any] = field(default_factory=dict, compare=False)

    def __post_init__(self) -> None:
        for section in ("world", "episode", "action"):
            if not isinstance(found := self.protocol.get(section, {}), Mapping):
                raise EvaluationFileError(f"protocol.{section} is {shown(found)}; expected keys with values")
        names = [result.task for result in self.tasks]
        if not names:
            raise EvaluationFileError("there are no tasks")
        if lost := [result.task for result in self.tasks if not result.init_states]:
            raise EvaluationFileError(
                f"simulation errors ended all episodes of {', '.join(lost)}: nothing counts"
            )
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise EvaluationFileError(f"tasks are counted twice: {', '.join(twice)}")

    @property
    def policy(self) -> str | None:
        """Word that names the policy on a command line: a run, a module, a server; None where that is not stated."""
        stated = (self.evaluated.get(key) for key in ("run", "policy", "server"))
        return next((str(word) for word in stated if word), None)

    @property
    def success(self) -> Estimate:
        """Mean success over tasks; see `overall`. Where it could be stopped, the interval is an always-valid one."""
        return self.success_of(self.tasks)

    def success_of(self, tasks: Sequence[TaskResult]) -> Estimate:
        """Return the mean success over some of the tasks, with an interval as of `success`."""
        return overall(tasks, stopped=self.stopped is not None)

    @property
    def stop_note(self) -> str:
        """After how many episodes it was stopped, and what was known, as text; empty where it could not be."""
        if self.stopped is None:
            return ""
        count = sum(len(task.starts) for task in self.tasks)
        return (
            f"stopped after {count} of {self.stopped.planned}; {self.stopped.until}: {self.stopped.verdict}"
        )

    @property
    def suite_labels(self) -> dict[str, str]:
        """Label of each suite, see `suite_label`."""
        return {
            name: suite_label(name, [task.task for task in tasks]) for name, tasks in self.by_suite.items()
        }

    @property
    def suites(self) -> dict[str, Estimate]:
        """Mean success over the tasks of each suite, with intervals as of `success`."""
        return {name: self.success_of(tasks) for name, tasks in self.by_suite.items()}

    @property
    def by_suite(self) -> dict[str, list[TaskResult]]:
        """The tasks of each suite."""
        names = dict.fromkeys(task.suite for task in self.tasks)
        return {name: [task for task in self.tasks if task.suite == name] for name in names}

    @property
    def world(self) -> dict[str, Any]:
        """What the outcome of an episode depends on by design, of the environment."""
        return world_of(self.environment)

    @property
    def backend(self) -> str:
        """Backend that simulated it; results that name none are of `mujoco`."""
        world = self.protocol.get("world")
        return str(world.get("backend", MUJOCO)) if isinstance(world, Mapping) else MUJOCO

    @property
    def outcomes(self) -> str:
        """Digest of everything that was measured, without actions, times, versions and the environment."""
        unmeasured = {"digest", "limits_reached", *TaskResult.OPTIONAL} - {*TaskResult.OUTCOMES}
        rows = [{k: v for k, v in asdict(r).items() if k not in unmeasured} for r in self.tasks]
        return _digest(sorted(rows, key=lambda row: row["task"]))

    @property
    def actions(self) -> str | None:
        """Digest of all actions: evaluations where it is the same agree to the bit. None if they were not recorded."""
        rows = sorted((r.task, *r.actions) for r in self.tasks)
        return _digest(rows) if all(r.actions for r in self.tasks) else None

    @classmethod
    def read(cls, path: Path | str) -> "EvaluationResult":
        """Read a result.

        Args:
            path: File, or a folder with `eval.json`.

        Raises:
            EvaluationFileError: The file is missing, broken, of another format or version, or was edited.
        """
        path = Path(path)
        path = path / FILE_NAME if path.is_dir() else path
        if not path.exists():
            raise EvaluationFileError(f"{path} does not exist; `libero eval` writes {FILE_NAME}")
        values = read_json(path, EvaluationFileError)
        _check_format(values, path)
        rows = values.get("tasks")
        if isinstance(rows, list):
            values["tasks"] = [_of_fields(row, TaskResult) if isinstance(row, dict) else row for row in rows]
        result: EvaluationResult = validate(
            cls, _of_fields(values, cls), source=str(path), error=EvaluationFileError
        )
        if values.get("outcomes") != result.outcomes:
            raise EvaluationFileError(
                f"{path}: the digest `outcomes` is not that of the tasks: the file was edited"
            )
        return result

    def write(self, path: Path | str) -> Path:
        """Write the result in one step, and return the file; readers never see a part of it.

        Args:
            path: File to write, usually `eval.json`.

        Raises:
            ResultsError: The file cannot be written.
        """
        path = Path(path)
        with writing(path, "the result"):
            write_json(path, self.to_plain(), fsync=True)
        return path

    def to_plain(self) -> dict[str, Any]:
        """Return the content of the file: plain data, with null for numbers that are not finite."""
        values = {
            "format": FORMAT,
            "evaluated": dict(self.evaluated),
            "protocol": dict(self.protocol),
            "init_states": self.init_states,
            "unit_starts": self.unit_starts,
            "stopped": self.stopped and asdict(self.stopped),
            "versions": dict(self.versions),
            "environment": dict(self.environment),
            "outcomes": self.outcomes,
            "actions": self.actions,
            "success": asdict(self.success),
            "suites": {name: asdict(estimate) for name, estimate in self.suites.items()},
            "predicates": predicate_rates(self.tasks),
            "tasks": [
                asdict(r) | {"success": asdict(self.success_of([r])), "mean_steps": r.steps}
                for r in self.tasks
            ],
            "times": dict(self.times),
        }
        return json_safe(values)


def by_start(tasks: Sequence[TaskResult]) -> dict[tuple[str, int], bool]:
    """Return whether each episode succeeded, by task and initial state; those that do not count are left out."""
    return {
        (task.task, start): won
        for task in tasks
        for start, won in zip(task.init_states, task.successes, strict=True)
    }


def world_of(environment: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of an environment that outcomes depend on by design, see `WORLD`."""
    return {k: v for k, v in environment.items() if k.partition("_")[0] in WORLD and v is not None}


def known_by(identity: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a policy is known by: of a server that was given a name this, its address may change."""
    return {key: value for key, value in identity.items() if key != "server" or not identity.get("name")}


def suite_label(suite: str, tasks: Collection[str]) -> str:
    """Return the name of a suite; where not all of its tasks were run, with how many: `libero_goal (1 of 10 tasks)`."""
    try:
        count = len(get_suite(suite).tasks)
    except LiberoError:  # of a user, or of others and not here
        return suite
    return suite if len(tasks) >= count else f"{suite} ({len(tasks)} of {count} tasks)"


def overall(results: Sequence[TaskResult], *, stopped: bool = False) -> Estimate:
    """Return the mean success over tasks with its interval, see `mean_success`; tasks of several runs count each.

    The tasks are fixed, so the interval covers the chance in the episodes, not the choice of tasks. That of episodes
    whose number depends on their outcomes is always valid, see `anytime_interval`.
    """
    found = mean_success([sum(r.successes) for r in results], [len(r.successes) for r in results])
    wins, count = (sum(sum(r.successes) for r in results), sum(len(r.successes) for r in results))
    if not stopped or count < LEAST_EPISODES:
        return found
    return replace(anytime_interval(wins, count), value=found.value)


def predicate_rates(results: Sequence[TaskResult]) -> dict[str, float]:
    """Return how often atoms of the goals held at any time, by predicate: means over atoms."""
    rates: dict[str, list[float]] = {}
    for result in results:
        for atom, held in zip(result.atoms, zip(*result.atoms_ever, strict=True), strict=True):
            rates.setdefault(predicate_of(atom), []).append(float(np.mean(held)))
    return {name: float(np.mean(values)) for name, values in rates.items()}


def _digest(rows: Any) -> str:
    return "sha256:" + hashlib.sha256(json.dumps(rows, sort_keys=True).encode()).hexdigest()


def _check_format(values: Any, path: Path) -> None:
    stated = values.get("format") if isinstance(values, dict) else None
    if stated == FORMAT:
        return
    if str(stated).partition("/")[0] == FORMAT.partition("/")[0]:
        versions = values.get("versions")
        wrote = versions.get("libero-lifelong") if isinstance(versions, dict) else None
        reader = (
            f"libero-lifelong {shorten(str(wrote), 40)}, which"
            if wrote
            else "the version of libero-lifelong that"
        )
        raise EvaluationFileError(
            f"{path}: the format is {stated}, and this program reads {FORMAT}: read it with {reader} wrote it, "
            "or evaluate the policy again"
        )
    what = "has no format" if stated is None else f"has the format {stated!r}"
    raise EvaluationFileError(
        f"{path}: this is not the result of an evaluation: it {what}; expected {FORMAT}"
    )


def _of_fields(values: Mapping[str, Any], kind: Any) -> dict[str, Any]:
    """Return the values that are fields of a class; the others in the file follow from them."""
    return {f.name: values[f.name] for f in fields(kind) if f.name in values}
