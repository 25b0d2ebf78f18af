"""The folder of an evaluation: what is evaluated, which units are done, who works on which, and what went wrong.

Any number of processes share it. A unit's result is a file with the unit's name, which appears in one step and is never
replaced: nothing is lost when a process is killed, and nothing can be counted twice.

    evaluation.json   what is evaluated; a process that evaluates anything else is refused
    units/            results, one file for each unit
    claims/           which process works on which unit
    errors/           errors of units, with tracebacks
    eval.json         the result, once all units are done
"""

import hashlib
import json
import os
import shutil
import socket
import traceback
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from libero_env.storage import atomic_write_text, create_text
from libero_eval.evaluation_file import FILE_NAME, TaskResult, task_result
from libero_eval.work.claims import LEASE, Claim, Claims, Held
from libero_eval.work.units import Unit
from lifelong.errors import ConfigError, LifelongError, ResultsError
from lifelong.results.provenance import utc_now
from lifelong.results.summary import json_safe

PLAN_NAME = "evaluation.json"
PLAN_FORMAT = "libero-evaluation-plan/1"
UNIT_FORMAT = "libero-evaluation-unit/1"
AGAIN = "name another folder with --out, or repeat the evaluation with --again"
OWN_PARTS = (PLAN_NAME, FILE_NAME, "units", "claims", "errors")


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
    environment: Mapping[str, Any]
    versions: Mapping[str, str]
    process: str
    started: float
    finished: float


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


class WorkFolder:
    """The folder of an evaluation.

    Args:
        path: The folder.
        plan: Plain data that define the evaluation: policy, protocol, initial states, units, simulation.
        lease: Time after which a unit whose holder is silent is given to another process, [s].
    """

    def __init__(self, path: Path, plan: Mapping[str, Any], lease: float = LEASE):
        self.path, self._plan = path, json_safe(plan)
        self.claims = Claims(path / "claims", lease)
        self._results: dict[str, UnitResult] = {}

    def join(self, units: Sequence[Unit]) -> None:
        """Start the evaluation, or join it.

        Raises:
            ConfigError: The folder holds another evaluation; the message names every difference.
            LifelongError: The folder cannot be written, or holds a broken file.
        """
        with _named_errors(self.path, "the folder of the evaluation cannot be written"):
            self.path.mkdir(parents=True, exist_ok=True)
            sizes = {unit.name: len(unit.starts) for unit in units}
            known = self._read_plan()
            if known is None:
                text = _to_text({**self._plan, "units": sizes, "started": utc_now()})
                create_text(self.path / PLAN_NAME, text)
                known = read_plan(self.path)
            self._check_plan(known)
            if not sizes.keys() <= known["units"].keys():  # more tasks than so far
                atomic_write_text(self.path / PLAN_NAME, _to_text(known | {"units": known["units"] | sizes}))

    def clear(self) -> None:
        """Remove the evaluation; videos and files of others stay.

        Raises:
            ConfigError: Another process works on it.
        """
        for held in self.claims.held().values():
            who = held.claim.holder if held.claim else "a process"
            raise ConfigError(
                f"{self.path}: {who} works on {held.unit}; end it before you repeat the evaluation"
            )
        for name in OWN_PARTS:
            path = self.path / name
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
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

    def publish(self, unit: Unit, found: UnitResult) -> None:
        """Write a unit's result. If another process was faster, its result stays.

        Raises:
            ResultsError: It cannot be written; the unit counts as not done.
        """
        head = {"format": UNIT_FORMAT, "unit": unit.name, "digest": self._digest(unit)}
        with _named_errors(
            self._unit_path(unit), "the result of the unit cannot be written, it is not counted"
        ):
            create_text(self._unit_path(unit), _to_text(head | asdict(found)))
        if not found.result.errors:
            (self.path / "errors" / f"{unit.name}.json").unlink(missing_ok=True)

    def add_error(self, unit: Unit, error: BaseException) -> UnitErrors:
        """Record an error of a unit with its traceback. Only the holder of the unit may do so."""
        path = self.path / "errors" / f"{unit.name}.json"
        entry = {
            "error": describe(error),
            "process": this_process(),
            "when": utc_now(),
            "traceback": "".join(traceback.format_exception(error)),
        }
        with _named_errors(path, "the error of a unit cannot be written"):
            atomic_write_text(path, _to_text({"unit": unit.name, "errors": [*_read_errors(path), entry]}))
        return self.errors()[unit.name]

    def errors(self) -> dict[str, UnitErrors]:
        """Return the errors of the units that are not done."""
        found = {}
        for name in sorted(_names(self.path / "errors") - _names(self.path / "units")):
            path = self.path / "errors" / f"{name}.json"
            if entries := _read_errors(path):
                found[name] = UnitErrors(len(entries), str(entries[-1]["error"]), path)
        return found

    def take(self, units: Iterable[Unit]) -> tuple[Unit, Claim] | None:
        """Claim the first of the units that nobody works on; None if there is none.

        Raises:
            LifelongError: The folder cannot be written.
        """
        with _named_errors(self.path, "a unit cannot be claimed"):
            for unit in units:
                claim = self.claims.take(unit.name)
                if claim and self._unit_path(unit).exists():  # it was finished a moment ago
                    self.claims.release(claim)
                elif claim:
                    return unit, claim
        return None

    @property
    def has_results(self) -> bool:
        """Whether any unit is done."""
        return bool(_names(self.path / "units"))

    def held(self) -> dict[str, Held]:
        """Return the units that processes work on."""
        return self.claims.held()

    def _unit_path(self, unit: Unit) -> Path:
        return self.path / "units" / f"{unit.name}.json"

    def _read_plan(self) -> dict[str, Any] | None:
        return read_plan(self.path) if (self.path / PLAN_NAME).exists() else None

    def _check_plan(self, known: Mapping[str, Any]) -> None:
        different = list(_differences({k: known.get(k) for k in self._plan}, self._plan))
        if different:
            raise ConfigError(f"{self.path} holds another evaluation: {'; '.join(different)}. Either {AGAIN}")

    def _digest(self, unit: Unit) -> str:
        parts = [self._plan, unit.task.bddl_text, unit.starts]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]

    def _read_unit(self, unit: Unit) -> UnitResult:
        path = self._unit_path(unit)
        found, digest = read_unit(path)
        if digest != self._digest(unit) or found.result.init_states != unit.starts:
            raise ConfigError(
                f"{path} was made by another evaluation or another version of the task: {AGAIN}"
            )
        return found


def read_unit(path: Path) -> tuple[UnitResult, str]:
    """Return the result of a unit from its file, and the digest of the evaluation that it belongs to.

    Raises:
        LifelongError: The file is broken.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if values["format"] != UNIT_FORMAT:
            raise ValueError(f"the format is {values['format']!r}, not {UNIT_FORMAT}")
        found = UnitResult(
            result=task_result(values["result"]),
            environment=dict(values["environment"]),
            versions=dict(values["versions"]),
            process=str(values["process"]),
            started=float(values["started"]),
            finished=float(values["finished"]),
        )
        return found, str(values["digest"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise LifelongError(
            f"{path} is not a valid result of a unit ({describe(error)}); nothing of it is counted: remove it, and "
            "the unit is run again"
        ) from error


def read_plan(path: Path) -> dict[str, Any]:
    """Return what is evaluated in a folder, as `evaluation.json` has it.

    Raises:
        LifelongError: There is no evaluation, or the file is broken.
    """
    file = path / PLAN_NAME
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise LifelongError(f"{path} holds no evaluation: {file.name} is missing") from error
    except (OSError, ValueError) as error:
        raise LifelongError(f"{file} cannot be read ({error}): {AGAIN}") from error
    if not isinstance(values, dict) or values.get("format") != PLAN_FORMAT:
        stated = values.get("format") if isinstance(values, dict) else None
        raise ConfigError(f"{file} has the format {stated!r}; this version reads {PLAN_FORMAT}: {AGAIN}")
    if not all(isinstance(values.get(key), dict) for key in ("units", "evaluated")):
        raise LifelongError(f"{file} lacks `units` or `evaluated`: it is broken; {AGAIN}")
    return values


def this_process() -> str:
    """Return the machine and number of this process, such as `node3:4711`."""
    return f"{socket.gethostname()}:{os.getpid()}"


def describe(error: BaseException) -> str:
    """Return an error in one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


@contextmanager
def _named_errors(path: Path, what: str) -> Iterator[None]:
    """Turn an `OSError` of the block into a `ResultsError` that names the file."""
    try:
        yield
    except OSError as error:
        raise ResultsError(f"{error.filename or path}: {what}: {error.strerror or error}") from error


def _to_text(values: Mapping[str, Any]) -> str:
    return json.dumps(json_safe(values), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _names(folder: Path) -> set[str]:
    """Return the names of the complete files in a folder, without the suffix."""
    try:
        return {n.removesuffix(".json") for n in os.listdir(folder) if n.endswith(".json") and n[0] != "."}
    except FileNotFoundError:
        return set()


def _read_errors(path: Path) -> list[Mapping[str, Any]]:
    try:
        return list(json.loads(path.read_text(encoding="utf-8"))["errors"])
    except (OSError, ValueError, KeyError, TypeError):
        return []


def _differences(there: Any, here: Any, name: str = "") -> Iterable[str]:
    """Yield where plain data differ, such as `protocol.horizon is 600 there and 300 here`."""
    if isinstance(there, dict) and isinstance(here, dict):
        for key in sorted({*there, *here}):
            yield from _differences(there.get(key), here.get(key), f"{name}.{key}" if name else key)
    elif there != here:
        yield f"{name} is {_short(there)} there and {_short(here)} here"


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."
