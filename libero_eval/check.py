"""Examination of a run directory: whether everything in it is as it was written, belongs together, and is complete."""

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from libero_env.errors import LiberoError
from libero_env.storage import read_json
from libero_env.text import to_json
from libero_eval.evaluation_file import FILE_NAME, EvaluationResult
from lifelong.errors import LifelongError, ResultsError
from lifelong.results.log import ResultLog
from lifelong.results.records import EvalRecord, LossRecord, TaskEndRecord
from lifelong.results.results import Results
from lifelong.results.run_directory import BROKEN_SUFFIX, CheckpointFolder, RunDirectory, read_saved_config
from lifelong.results.summary import summarize

_COMPARED = (*("finished", "tasks_learned", "success_matrix", "curves", "losses", "best_epochs"), "metrics")


@dataclass(frozen=True)
class Finding:
    """Something about a run directory that its owner should know.

    Attributes:
        level: `fault` where something is damaged, lost or does not belong there; `note` for everything else.
        text: What it is, with the file, and what to do.
    """

    level: Literal["fault", "note"]
    text: str


@dataclass(frozen=True)
class Examination:
    """The state of a run directory.

    Attributes:
        counts: Number of records, checkpoints and evaluations that are intact.
        findings: Faults and notes.
    """

    path: Path
    counts: dict[str, int]
    findings: tuple[Finding, ...]

    @property
    def sound(self) -> bool:
        """Whether there is no fault."""
        return all(finding.level != "fault" for finding in self.findings)


def find_runs(path: Path) -> list[Path]:
    """Return the run directories at and below a path.

    Raises:
        LifelongError: There are none.
    """
    names = ("config.yaml", "results.jsonl")
    if any((path / name).is_file() for name in names):
        return [path]
    runs = sorted({file.parent for name in names for file in path.glob(f"**/{name}")})
    if not runs:
        raise LifelongError(f"{path}: no run directory, which has config.yaml and results.jsonl")
    return runs


def examine(path: Path) -> Examination:
    """Read everything in a run directory, and change nothing.

    Args:
        path: Directory of a run, finished or not.
    """
    counts = {"records": 0, "checkpoints": 0, "evaluations": 0}
    findings: list[Finding] = []

    def attempt(read: Callable[[], Any], counted: str = "") -> Any:
        try:
            value = read()
        except (LiberoError, OSError) as error:
            findings.append(Finding("fault", str(error)))
            return None
        if counted:
            counts[counted] += 1
        return value

    folder = RunDirectory(path).checkpoints
    if attempt(lambda: read_saved_config(path / "config.yaml")) is None:
        folder = CheckpointFolder(folder.path)  # whose checkpoints may be of any run
    results: Results | None = attempt(lambda: ResultLog(path / "results.jsonl").read())
    if results is not None:
        counts["records"] = len(results.records)
        findings += _record_findings(results, path)
    tasks = folder.tasks()
    for task in tasks:
        attempt(partial(folder.load_task, folder.task_path(task)), "checkpoints")
    for file in filter(Path.exists, (folder.progress_path, folder.previous_path)):
        attempt(partial(folder.load_progress, file), "checkpoints")
    if folder.best_path.exists():
        attempt(folder.load_best, "checkpoints")
    ended = {record.task for record in results.of(TaskEndRecord)} if results else set()
    if lost := sorted(ended - set(tasks)):
        text = f"{folder.path} has no checkpoints after tasks {', '.join(map(str, lost))}, which are learned"
        findings.append(Finding("fault" if lost[-1] == max(ended) else "note", text))
    for file in sorted(path.glob(f"**/{FILE_NAME}")):
        attempt(partial(EvaluationResult.read, file), "evaluations")
    for file in sorted(folder.path.glob(f"*{BROKEN_SUFFIX}")):
        findings.append(
            Finding("note", f"{file} is a damaged checkpoint that was set aside; it may be removed")
        )
    for file in sorted(path.rglob(".*.part")):
        findings.append(Finding("note", f"{file} was left by a process that was killed; a resume removes it"))
    return Examination(path, counts, tuple(findings))


def _record_findings(results: Results, path: Path) -> Iterator[Finding]:
    """Yield what is wrong with the records, and with the summary that was made from them."""
    log = path / "results.jsonl"
    for problem in results.problems:
        yield Finding("fault", problem)
    if not results.records:
        yield Finding("fault", f"{log} has no records: it is missing, or the run never began")
        return
    try:
        size, learned = len(results.run.tasks), results.learned_tasks()
    except LifelongError as error:
        yield Finding("fault", f"{log}: {error}")
        return
    if not results.finished:
        yield Finding("note", f"the run is not finished: {learned} of {size} tasks are learned and evaluated")
    for text in _missing_records(results, _ends_early(path)):
        yield Finding("fault", f"{log} lacks {text}; the run's command measures it again")
    for text in _false_copies(results):
        yield Finding("fault", f"{log}: {text}")
    summary = path / "results.json"
    if summary.exists() or results.finished:
        try:
            _check_summary(summary, results)
        except ResultsError as error:
            yield Finding("fault", f"{error}; the run's command writes it again")


def _check_summary(file: Path, results: Results) -> None:
    """Compare results.json with the records that it was made from.

    Raises:
        ResultsError: It is missing, broken, or says something else.
    """
    if not file.exists():
        raise ResultsError(f"{file} is missing")
    try:
        written = read_json(file, ResultsError)
    except ResultsError as error:
        raise ResultsError(f"{file} is broken ({error})") from error
    if not isinstance(written, dict):
        raise ResultsError(f"{file} is broken: expected an object")
    now = json.loads(to_json(summarize(results)))
    if differing := [key for key in _COMPARED if not _alike(written.get(key), now[key])]:
        raise ResultsError(f"{file} is not what results.jsonl gives ({', '.join(differing)})")


def _ends_early(path: Path) -> bool:
    """Return whether training on a task of the run ends at a success, see `eval.until`."""
    try:
        settings = read_saved_config(path / "config.yaml").get("eval")
    except LifelongError:  # told elsewhere
        return False
    return isinstance(settings, dict) and settings.get("until") is not None


def _missing_records(results: Results, ends_early: bool = False) -> Iterator[str]:
    """Yield what the records of learned tasks lack, compared with each other as far as each was to be trained."""
    last = {end.task: end.best_epoch for end in results.of(TaskEndRecord)} if ends_early else {}
    ended = sorted({record.task for record in results.of(TaskEndRecord)})
    for task in ended:
        run = results.run
        row = run.row(run.group(task))
        if absent := [seen for seen in row if results.evaluation("matrix", task, seen) is None]:
            yield f"evaluations after task {task} of tasks {_listed(absent)}"
    curves = {task: set(curve.epochs.tolist()) for task, curve in results.curves().items()}
    whole = {task: curves.get(task, set()) for task in range(max(ended, default=-1) + 1)}
    for task, absent in _gaps(whole, last):
        yield f"points of the learning curve of task {task}, epochs {_listed(absent)}"
    losses = {task: {r.epoch for r in results.of(LossRecord) if r.task == task} for task in ended}
    for task, absent in _gaps(losses, last):
        yield f"losses of task {task}, epochs {_listed(absent)}"


def _false_copies(results: Results) -> Iterator[str]:
    """Yield the evaluations that are not what the rollouts came to that they say they would have repeated."""
    for copy in results.of(EvalRecord):
        if copy.same_as is None:
            continue
        phase, learned, epoch = copy.same_as
        original = results.evaluation(phase, learned, copy.task, epoch, shift=copy.shift)
        name = f"the evaluation of task {copy.task} after task {copy.learned}"
        if original is None:
            yield f"{name} is a copy of one that is missing; the run's command measures that again"
        elif original.decided_by == copy.decided_by and original.outcome != copy.outcome:
            yield f"{name} is not what it is a copy of, that after task {learned}, epoch {epoch}"


def _gaps(epochs: dict[int, set[int]], last: dict[int, int]) -> Iterator[tuple[int, list[int]]]:
    every = set().union(*epochs.values())
    for task, there in epochs.items():
        if absent := sorted(e for e in every - there if e <= last.get(task, e)):
            yield task, absent


def _listed(numbers: list[int]) -> str:
    return ", ".join(map(str, numbers[:6])) + (", ..." if len(numbers) > 6 else "")


def _alike(a: Any, b: Any) -> bool:
    """Return whether plain data are equal, numbers up to rounding."""
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(_alike(a[key], b[key]) for key in a)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(_alike, a, b))
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, abs_tol=1e-9)
    return bool(a == b)
