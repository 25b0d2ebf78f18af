"""`eval.json`: the result of an evaluation, as written by `libero eval` and read by everything that judges it.

The file holds, for each task, one entry per episode, and everything that is needed to run the evaluation again: the
policy, the resolved protocol, the initial states, the versions and the environment. What depends on when it was run
stands apart, under `times`: two evaluations with the same outcomes have the same `outcomes`, a digest.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, NotRequired

import numpy as np
from pydantic import Field
from typing_extensions import TypedDict

from libero_env.storage import atomic_write_text
from libero_env.validation import validate
from lifelong.errors import EvaluationFileError, ResultsError
from lifelong.results.subgoals import predicate_of
from lifelong.results.summary import json_safe
from lifelong.stats.intervals import Estimate, combine_intervals, wilson_interval

FORMAT = "libero-evaluation/1"
FILE_NAME = "eval.json"

_Count = Annotated[int, Field(ge=0, le=2**31)]
_Name = Annotated[str, Field(min_length=1, max_length=1000)]
_Id = Annotated[
    str, Field(pattern=r"^[^/\x00]+/[^\x00]+$", max_length=1000)
]  # also part of the names of files


class _TaskRow(TypedDict):
    """A task in the file, without what follows from it."""

    task: _Id
    name: _Name
    instruction: str
    init_states: list[_Count]
    successes: list[bool]
    lengths: list[_Count]
    atoms: NotRequired[list[str]]
    atoms_ever: NotRequired[list[list[bool]]]
    atoms_at_end: NotRequired[list[list[bool]]]
    errors: NotRequired[list[str | None]]
    actions: NotRequired[list[str]]
    attempts: NotRequired[list[list[_Count]]]


class _Content(TypedDict):
    """The file, without what follows from it."""

    evaluated: dict[str, Any]
    protocol: dict[str, Any]
    init_states: list[_Count]
    versions: dict[str, Any]
    tasks: list[Any]
    environment: NotRequired[dict[str, Any]]
    unit_starts: NotRequired[Annotated[int, Field(ge=1)] | None]
    times: NotRequired[dict[str, Any]]


@dataclass(frozen=True)
class TaskResult:
    """Results of a policy on a task, with one entry per episode.

    Attributes:
        task: Id of the task, such as `libero_goal/3`.
        name: Name of the task.
        instruction: Instruction that the policy received.
        init_states: Index of the initial state of each episode.
        successes: Whether each episode reached the goal.
        lengths: Number of control steps of the policy in each episode.
        atoms: Atoms of the goal, such as `(On plate_1 stove_1)`; empty if they were not measured.
        atoms_ever: Whether each atom held at any time, (episodes, atoms).
        atoms_at_end: Whether each atom held at the end, (episodes, atoms).
        errors: Error of each episode that the protocol counts as a failure, or None; empty if there are none.
        actions: Digest of the actions of each episode, by which episodes can be compared to the bit; empty if they
            were not recorded.
        attempts: Number of draws that were not valid of each perturbation of the protocol, (episodes, perturbations);
            empty without perturbations.

    Raises:
        EvaluationFileError: The arrays have different lengths, or values of the wrong kind.
    """

    task: str
    name: str
    instruction: str
    init_states: tuple[int, ...]
    successes: tuple[bool, ...]
    lengths: tuple[int, ...]
    atoms: tuple[str, ...] = ()
    atoms_ever: tuple[tuple[bool, ...], ...] = ()
    atoms_at_end: tuple[tuple[bool, ...], ...] = ()
    errors: tuple[str | None, ...] = ()
    actions: tuple[str, ...] = ()
    attempts: tuple[tuple[int, ...], ...] = ()

    def __post_init__(self) -> None:
        for problem in self._problems():
            raise EvaluationFileError(f"{self.task}: {problem}")

    @property
    def success(self) -> Estimate:
        """Success rate with Wilson's interval."""
        wins, count = sum(self.successes), len(self.successes)
        low, high = wilson_interval(wins, count)
        return Estimate(wins / count, float(low), float(high))

    @property
    def steps(self) -> float:
        """Mean length of the successful episodes, [control steps]; NaN if there are none."""
        lengths = [n for n, won in zip(self.lengths, self.successes, strict=True) if won]
        return float(np.mean(lengths)) if lengths else float("nan")

    def _problems(self) -> list[str]:
        count = len(self.init_states)
        rows: dict[str, Sequence[Any]] = {"successes": self.successes, "lengths": self.lengths}
        rows |= {"errors": self.errors} if self.errors else {}
        rows |= {"actions": self.actions} if self.actions else {}
        rows |= {"attempts": self.attempts} if self.attempts else {}
        rows |= {"atoms_ever": self.atoms_ever, "atoms_at_end": self.atoms_at_end} if self.atoms else {}
        found = [
            f"{name} has {len(values)} entries, init_states has {count}"
            for name, values in rows.items()
            if len(values) != count
        ]
        if not count:
            found.append("there are no episodes")
        if len(set(self.init_states)) != count:
            found.append(f"an initial state is counted twice: {list(self.init_states)}")
        for name in ("atoms_ever", "atoms_at_end"):
            widths = {len(row) for row in getattr(self, name)}
            if widths - {len(self.atoms)}:
                found.append(f"{name} needs a column for each of the {len(self.atoms)} atoms")
        return found


@dataclass(frozen=True)
class EvaluationResult:
    """The result of an evaluation.

    Attributes:
        evaluated: Plain data that identify the policy.
        protocol: How episodes were run: the resolved protocol as plain data.
        init_states: Indices of the initial states of each task.
        versions: Versions of Python, of the packages and of the models.
        tasks: Results by task.
        environment: What the numbers may also depend on: models, robot, drawing, renderer, processor, threads. Where
            the processes of an evaluation differ, a value is the list of the different ones.
        unit_starts: Number of episodes that were run in one batch; the bits of a policy may depend on it. None: all
            episodes of a task.
        times: When and how long it was run; not part of `outcomes`.
    """

    evaluated: Mapping[str, Any]
    protocol: Mapping[str, Any]
    init_states: tuple[int, ...]
    versions: Mapping[str, str]
    tasks: tuple[TaskResult, ...]
    environment: Mapping[str, Any] = field(default_factory=dict)
    unit_starts: int | None = None
    times: Mapping[str, Any] = field(default_factory=dict, compare=False)

    def __post_init__(self) -> None:
        names = [result.task for result in self.tasks]
        if not names:
            raise EvaluationFileError("there are no tasks")
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise EvaluationFileError(f"tasks are counted twice: {', '.join(twice)}")

    @property
    def success(self) -> Estimate:
        """Mean success over tasks; see `overall`."""
        return overall(self.tasks)

    @property
    def suites(self) -> dict[str, Estimate]:
        """Mean success over the tasks of each suite."""
        names = dict.fromkeys(r.task.partition("/")[0] for r in self.tasks)
        return {s: overall([r for r in self.tasks if r.task.startswith(s + "/")]) for s in names}

    @property
    def outcomes(self) -> str:
        """Digest of everything that was measured, without actions, times, versions and the environment."""
        rows = [_measured(r) for r in self.tasks]
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
        if not path.is_file():
            raise EvaluationFileError(f"{path} does not exist; `libero eval` writes {FILE_NAME}")
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise EvaluationFileError(f"{path} cannot be read: {error}") from error
        except (ValueError, RecursionError) as error:
            raise EvaluationFileError(f"{path} is not JSON ({error}): it is broken or incomplete") from error
        try:
            return _from_plain(values)
        except EvaluationFileError as error:
            raise EvaluationFileError(f"{path}: {error}") from None

    def write(self, path: Path | str) -> Path:
        """Write the result in one step, and return the file; readers never see a part of it.

        Args:
            path: File to write, usually `eval.json`.

        Raises:
            ResultsError: The file cannot be written.
        """
        path = Path(path)
        try:
            text = json.dumps(self.to_plain(), indent=1, ensure_ascii=False, allow_nan=False)
            atomic_write_text(path, text + "\n", fsync=True)
        except OSError as error:
            raise ResultsError(f"{path}: the result cannot be written ({error})") from error
        return path

    def to_plain(self) -> dict[str, Any]:
        """Return the content of the file: plain data, with null for numbers that are not finite."""
        values = {
            "format": FORMAT,
            "evaluated": dict(self.evaluated),
            "protocol": dict(self.protocol),
            "init_states": self.init_states,
            "unit_starts": self.unit_starts,
            "versions": dict(self.versions),
            "environment": dict(self.environment),
            "outcomes": self.outcomes,
            "actions": self.actions,
            "success": asdict(self.success),
            "suites": {name: asdict(estimate) for name, estimate in self.suites.items()},
            "predicates": predicate_rates(self.tasks),
            "tasks": [asdict(r) | {"success": asdict(r.success), "mean_steps": r.steps} for r in self.tasks],
            "times": dict(self.times),
        }
        return json_safe(values)


def overall(results: Sequence[TaskResult]) -> Estimate:
    """Return the mean success over tasks, with the interval from Wilson's of the tasks (see `combine_intervals`).

    The tasks are fixed, so the interval covers the chance in the episodes, not the choice of tasks.
    """
    found = [r.success for r in results]
    weights = np.full(len(found), 1 / max(1, len(found)))
    return combine_intervals(
        weights, [e.value for e in found], [e.low for e in found], [e.high for e in found]
    )


def predicate_rates(results: Sequence[TaskResult]) -> dict[str, float]:
    """Return how often atoms of the goals held at any time, by predicate: means over atoms."""
    rates: dict[str, list[float]] = {}
    for result in results:
        for i, atom in enumerate(result.atoms):
            rates.setdefault(predicate_of(atom), []).append(
                float(np.mean([row[i] for row in result.atoms_ever]))
            )
    return {name: float(np.mean(values)) for name, values in rates.items()}


def task_result(values: Any, where: str = "a task") -> TaskResult:
    """Return a task's result from plain data; keys of `to_plain` that follow from the others are ignored.

    Args:
        values: Mapping with the fields of `TaskResult`; lists instead of tuples.
        where: What the values are, for the message of an error.

    Raises:
        EvaluationFileError: A field is missing or of the wrong kind.
    """
    if not isinstance(values, Mapping):
        raise EvaluationFileError(f"{where} is {type(values).__name__}; expected an object")
    names = [f.name for f in fields(TaskResult)]
    known = {name: values[name] for name in names if name in values}
    row = validate(_TaskRow, known, prefix=(where,), error=EvaluationFileError)
    return TaskResult(**{name: _tuples(value) for name, value in row.items()})


def _from_plain(values: Any) -> EvaluationResult:
    if not isinstance(values, dict):
        raise EvaluationFileError("this is not the result of an evaluation: expected a JSON object")
    _check_format(values.get("format"))
    known = {key: value for key, value in values.items() if key in _Content.__annotations__}
    content = validate(_Content, known, error=EvaluationFileError)
    result = EvaluationResult(
        evaluated=content["evaluated"],
        protocol=content["protocol"],
        init_states=tuple(content["init_states"]),
        versions=content["versions"],
        tasks=tuple(task_result(row, f"task {i}") for i, row in enumerate(content["tasks"])),
        environment=content.get("environment", {}),
        unit_starts=content.get("unit_starts"),
        times=content.get("times", {}),
    )
    if values.get("outcomes") != result.outcomes:
        raise EvaluationFileError("the digest `outcomes` is not that of the tasks: the file was edited")
    return result


def _measured(result: TaskResult) -> dict[str, Any]:
    """Return what was measured, as plain data; without perturbations as before there were any."""
    left_out = {"actions"} if result.attempts else {"actions", "attempts"}
    return {k: v for k, v in asdict(result).items() if k not in left_out}


def _digest(rows: Any) -> str:
    return "sha256:" + hashlib.sha256(json.dumps(rows, sort_keys=True).encode()).hexdigest()


def _check_format(name: Any) -> None:
    if name == FORMAT:
        return
    if str(name).partition("/")[0] == FORMAT.partition("/")[0]:
        raise EvaluationFileError(
            f"the format is {name}; this version reads {FORMAT}: "
            "update libero-lifelong, or read it with the version that wrote it"
        )
    stated = "has no format" if name is None else f"has the format {name!r}"
    raise EvaluationFileError(f"this is not the result of an evaluation: it {stated}; expected {FORMAT}")


def _tuples(value: Any) -> Any:
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value
