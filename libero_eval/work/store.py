"""The folder of an evaluation: what is evaluated, which units are done, who works on which, and what went wrong.

Any number of processes share it. A unit's result is a file with the unit's name, which appears in one step and is never
replaced: nothing is lost when a process is killed, and nothing can be counted twice.

    evaluation.json   what is evaluated; a process that evaluates anything else is refused, unless it only adds to it
    units/            results, one file for each unit
    claims/           which process works on which unit
    errors/           errors of units, with tracebacks
    eval.json         the result, once all units are done; eval.html, its page
"""

import hashlib
import json
import os
import shutil
import traceback
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from typing_extensions import TypedDict

from libero_env.errors import InvalidInputError
from libero_env.parallel import this_process
from libero_env.storage import create_text, own_folder, read_json, write_json
from libero_env.tasks import Task
from libero_env.text import flatten, json_safe, shorten, to_json
from libero_env.validation import validate
from libero_eval.evaluation_file import FILE_NAME, TaskResult
from libero_eval.policies import PROBE_TOLERANCE
from libero_eval.work.claims import Claims
from lifelong.errors import ConfigError, LifelongError, writing
from lifelong.results.provenance import utc_now

PLAN_NAME = "evaluation.json"
PAGE_NAME = "eval.html"
PLAN_FORMAT = "libero-evaluation-plan/1"
UNIT_FORMAT = "libero-evaluation-unit/1"
AGAIN = "name another folder with --out, or repeat the evaluation with --again"
PARTS = (PLAN_NAME, FILE_NAME, PAGE_NAME, "units", "claims", "errors")
FOLDERS = ("units", "claims", "errors", "videos")
MAX_BYTES = 64 << 20  # of a file in the folder
MAX_ERROR = 20_000  # characters of a traceback that is kept
Seconds = Annotated[float, Field(ge=0, le=1e11)]  # since the epoch


@dataclass(frozen=True)
class Unit:
    """A part of an evaluation, a task and a range of its initial states: all its episodes are run in one batch.

    Attributes:
        init_states: Indices of the initial states.
    """

    task: Task
    init_states: tuple[int, ...]

    @property
    def name(self) -> str:
        """Name of the unit's files, such as `libero_goal_03_starts_10_19`; of starts in another order with a digest."""
        starts, digest = self.init_states, ""
        if list(starts) != sorted(starts):
            digest = f"_{hashlib.sha256(repr(starts).encode()).hexdigest()[:8]}"
        return f"{self.task.suite}_{self.task.index:02d}_starts_{starts[0]:02d}_{starts[-1]:02d}{digest}"


def partition(tasks: Iterable[Task], init_states: Sequence[int], size: int) -> tuple[Unit, ...]:
    """Return the units of an evaluation, task by task.

    The units of a task do not depend on the other tasks, so that bits of a policy that depend on the composition of
    its batch do not either.

    Args:
        init_states: Indices of the initial states of each task.
        size: Number of initial states of a unit, at least 1; the last one of a task may have fewer.

    Raises:
        ConfigError: There are no initial states, or one is named twice.
    """
    if not init_states or len(set(init_states)) != len(init_states):
        raise ConfigError(f"initial states {list(init_states)}: name at least one, and each once")
    parts = [tuple(init_states[i : i + size]) for i in range(0, len(init_states), size)]
    return tuple(Unit(task, part) for task in tasks for part in parts)


class Plan(TypedDict):
    """Content of `evaluation.json`. Starts and tasks may be added to; everything else must be the same."""

    format: str
    evaluated: dict[str, Any]
    protocol: dict[str, Any]
    unit_starts: int
    errors_are_failures: bool
    policy_threads: int | None
    simulation: dict[str, str]
    init_states: tuple[Annotated[int, Field(ge=0)], ...]
    tasks: tuple[str, ...]
    units: dict[str, Annotated[int, Field(ge=1)]]  # name -> number of episodes
    probe: tuple[float, ...] | None  # what the policy answers to a fixed observation, where that repeats
    shuffled: bool  # whether it was begun with units of starts in the order in which `--until` looks at them
    started: str


@dataclass(frozen=True)
class UnitResult:
    """The result of a unit.

    Attributes:
        result: Episodes of the unit.
        environment: What the numbers may depend on besides the plan: renderer, processor, threads.
        versions: Versions of the packages.
        process: Process that ran it, such as `node3:4711`.
        started: When it started, seconds since the epoch.
        finished: When it ended, seconds since the epoch.
    """

    result: TaskResult
    environment: dict[str, Any]
    versions: dict[str, str]
    process: str
    started: Seconds
    finished: Seconds


@dataclass(frozen=True)
class UnitErrors:
    """Errors of a unit.

    Attributes:
        attempts: How often it ended with an error.
        last: The last error in one line.
        path: File with the tracebacks.
    """

    attempts: int
    last: str
    path: Path


class WorkStore:
    """The folder of an evaluation.

    Args:
        plan: Plain data that define the evaluation: policy, protocol, size of units, simulation.
        probe: What the policy answers to a fixed observation, where that repeats.
        shuffled: Whether units are of starts in the order in which a rule looks at them that may stop the evaluation.
    """

    def __init__(
        self,
        path: Path,
        plan: Mapping[str, Any],
        probe: Sequence[float] | None = None,
        *,
        shuffled: bool = False,
    ):
        self.path, self._plan, self._probe, self._shuffled = path, json_safe(plan), probe, shuffled
        self.claims = Claims(path / "claims")
        self._results: dict[str, UnitResult] = {}

    def join(self, units: Sequence[Unit]) -> None:
        """Start the evaluation, or join it; starts and tasks that are not in it yet are added.

        Raises:
            ConfigError: The folder holds another evaluation (the message names every difference), or a folder
                that is a link.
            LifelongError: The folder cannot be written, or holds a broken file.
        """
        growing = {
            "init_states": sorted({start for unit in units for start in unit.init_states}),
            "tasks": list(dict.fromkeys(unit.task.id for unit in units)),
            "units": {unit.name: len(unit.init_states) for unit in units},
        }
        for name in FOLDERS:
            own_folder(self.path, name, error=ConfigError)
        with writing(self.path, "the folder of the evaluation"):
            self.path.mkdir(parents=True, exist_ok=True)
            file = self.path / PLAN_NAME
            if not file.exists():
                begun = {"probe": self._probe, "shuffled": self._shuffled, "started": utc_now()}
                create_text(file, to_json({**self._plan, **growing, **begun}))
            stored = read_plan(self.path)
            self._check_plan(stored, growing)
            if stored["units"] != growing["units"]:
                write_json(file, {**stored, **growing})

    def is_whole(self, units: Iterable[Unit]) -> bool:
        """Return whether these are all units of the evaluation: another process may have added to it."""
        return {unit.name for unit in units} == read_plan(self.path)["units"].keys()

    def clear(self) -> None:
        """Remove the evaluation with its videos; files of others stay.

        Raises:
            ConfigError: Another process works on it, or a folder in it is a link.
        """
        for name in FOLDERS:
            own_folder(self.path, name, error=ConfigError)
        for unit, holder in self.claims.held().items():
            raise ConfigError(
                f"{self.path}: {holder} works on {unit}; end it before you repeat the evaluation"
            )
        for name in PARTS:
            path = self.path / name
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        for video in (self.path / "videos").glob("*[0-9]_start_[0-9][0-9]_*.webp"):
            video.unlink()
        self._results = {}

    def done(self, units: Iterable[Unit]) -> dict[str, UnitResult]:
        """Return the results that are known, by name of the unit; the files of the others are looked for.

        Raises:
            LifelongError: A file is broken.
            ConfigError: A file belongs to another evaluation.
        """
        units = list(units)
        there = _names(self.path / "units")
        for unit in units:
            if unit.name in there and unit.name not in self._results:
                self._results[unit.name] = self._read_unit(unit)
        return {unit.name: self._results[unit.name] for unit in units if unit.name in self._results}

    def publish(self, unit: Unit, result: UnitResult) -> None:
        """Write a unit's result. If another process was faster, its result stays.

        Raises:
            ResultsError: It cannot be written; the unit counts as not done.
        """
        head = {"format": UNIT_FORMAT, "unit": unit.name, "digest": self._digest(unit)}
        with writing(self._unit_path(unit), "the result of the unit, which is not counted,"):
            create_text(self._unit_path(unit), to_json(head | asdict(result)))
        if not result.result.errors:
            (self.path / "errors" / f"{unit.name}.json").unlink(missing_ok=True)

    def add_error(self, unit: Unit, error: BaseException) -> UnitErrors:
        """Record an error of a unit with its traceback. Only the holder of the unit may do so."""
        path = self.path / "errors" / f"{unit.name}.json"
        entry = {
            "error": describe(error),
            "process": this_process(),
            "when": utc_now(),
            "traceback": "".join(traceback.format_exception(error))[-MAX_ERROR:],
        }
        with writing(path, "the error of a unit"):
            write_json(path, {"unit": unit.name, "errors": [*_read_errors(path), entry]})
        return self.errors()[unit.name]

    def errors(self) -> dict[str, UnitErrors]:
        """Return the errors of the units that are not done."""
        errors = {}
        for name in sorted(_names(self.path / "errors") - _names(self.path / "units")):
            path = self.path / "errors" / f"{name}.json"
            if entries := _read_errors(path):
                errors[name] = UnitErrors(len(entries), entries[-1].get("error", "unknown"), path)
        return errors

    def take(self, units: Iterable[Unit]) -> Unit | None:
        """Claim the first of the units that nobody works on; None if there is none.

        Raises:
            LifelongError: The folder cannot be written.
        """
        with writing(self.path, "the claim of a unit"):
            for unit in units:
                if self.claims.take(unit.name):
                    if not self._unit_path(unit).exists():
                        return unit
                    self.claims.release(unit.name)  # it was finished a moment ago
        return None

    @property
    def has_results(self) -> bool:
        """Whether any unit is done."""
        return bool(_names(self.path / "units"))

    def _unit_path(self, unit: Unit) -> Path:
        return self.path / "units" / f"{unit.name}.json"

    def _check_plan(self, stored: Plan, growing: Mapping[str, Any]) -> None:
        """Check that the plan of the folder is the one here, or a part of it."""
        there, here = flatten({key: stored.get(key) for key in self._plan}), flatten(self._plan)
        different = [
            f"{name} is {_shown(there.get(name))} there and {_shown(here.get(name))} here"
            for name in sorted(there.keys() | here.keys())
            if there.get(name) != here.get(name)
        ]
        if (then := stored["probe"]) is not None and self._probe is not None:
            off = np.abs(np.subtract(then, self._probe)).max() if len(then) == len(self._probe) else np.inf
            if off > PROBE_TOLERANCE:
                different.append(
                    f"the policy answers a fixed observation otherwise than then, by up to {off:.3g}"
                )
        if different:
            raise ConfigError(f"{self.path} holds another evaluation: {'; '.join(different)}. Either {AGAIN}")
        for name in ("tasks", "init_states"):
            if lacking := [one for one in stored[name] if one not in growing[name]]:  # type: ignore[literal-required]
                raise ConfigError(
                    f"{self.path} holds also the {name} {_shown(lacking)}: an evaluation can grow, but not shrink. "
                    f"Ask for these too, or {AGAIN}"
                )

    def _digest(self, unit: Unit) -> str:
        parts = [self._plan, unit.task.digest, unit.init_states]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]

    def _read_unit(self, unit: Unit) -> UnitResult:
        path = self._unit_path(unit)
        result, digest = read_unit(path)
        if digest != self._digest(unit) or sorted(result.result.starts) != sorted(unit.init_states):
            raise ConfigError(
                f"{path} was made by another evaluation or another version of the task: {AGAIN}"
            )
        return result


def read_unit(path: Path) -> tuple[UnitResult, str]:
    """Return the result of a unit from its file, and the digest of the evaluation that it belongs to.

    Raises:
        LifelongError: The file is broken.
    """
    try:
        values = _of_format(path, UNIT_FORMAT)
        content = {f.name: values[f.name] for f in fields(UnitResult) if f.name in values}
        return validate(UnitResult, content), str(values.get("digest"))
    except (InvalidInputError, LifelongError) as error:
        raise LifelongError(
            f"{path} is not a valid result of a unit ({error}); nothing of it is counted: remove it, and "
            "the unit is run again"
        ) from error


def read_plan(path: Path) -> Plan:
    """Return what is evaluated in a folder, as `evaluation.json` has it.

    Raises:
        LifelongError: There is no evaluation, or the file is broken, or of another version.
    """
    file = path / PLAN_NAME
    if not file.exists():
        raise LifelongError(f"{path} holds no evaluation: none was begun there")
    try:
        return validate(Plan, _of_format(file, PLAN_FORMAT))
    except InvalidInputError as error:
        raise ConfigError(f"{file} is broken, or of another version ({error}): {AGAIN}") from error


def _of_format(path: Path, wanted: str) -> dict[str, Any]:
    """Return the content of a file with a format.

    Raises:
        InvalidInputError: It has another one, or cannot be read.
    """
    values = read_json(path, most=MAX_BYTES)
    stated = values.get("format") if isinstance(values, dict) else None
    if stated != wanted:
        raise InvalidInputError(f"the format is {stated!r}, not {wanted!r}")
    return values


def describe(error: BaseException) -> str:
    """Return an error in one line."""
    text = shorten(" ".join(str(error)[:MAX_ERROR].split()), 1000)
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def _names(folder: Path) -> set[str]:
    """Return the names of the complete files in a folder, without the suffix."""
    try:
        return {n.removesuffix(".json") for n in os.listdir(folder) if n.endswith(".json") and n[0] != "."}
    except FileNotFoundError:
        return set()


def _read_errors(path: Path) -> list[dict[str, str]]:
    """Return the errors in a file; a broken one says nothing that counts."""
    with suppress(InvalidInputError):
        found = validate(dict[str, Any], read_json(path, most=MAX_BYTES)).get("errors")
        return validate(list[dict[str, str]], found)
    return []


def _shown(value: Any) -> str:
    return shorten(json.dumps(value, ensure_ascii=False), 60)
