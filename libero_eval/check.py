"""Examination of a run directory: whether everything in it is as it was written, belongs together, and is complete."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from libero_env.errors import LiberoError
from libero_env.text import json_safe
from libero_eval.evaluation_file import FILE_NAME, EvaluationResult
from lifelong.errors import CheckpointError, LifelongError
from lifelong.results.log import ResultLog
from lifelong.results.records import EvalRecord, LossRecord, TaskEndRecord, measured_tasks
from lifelong.results.results import Results
from lifelong.results.run_directory import BROKEN_SUFFIX, CheckpointFolder, RunDirectory, read_saved_config
from lifelong.results.summary import summarize

_COMPARED = (
    *("finished", "tasks_learned", "success_matrix", "curves", "losses", "best_epochs"),
    "metrics",
)


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
    """What was found in a run directory.

    Attributes:
        path: The directory.
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
    found = sorted({file.parent for name in names for file in path.glob(f"**/{name}")})
    if not found:
        raise LifelongError(f"{path}: no run directory, which has config.yaml and results.jsonl")
    return found


def examine(path: Path) -> Examination:
    """Read everything in a run directory, and change nothing.

    Args:
        path: Directory of a run, finished or not.
    """
    return _Examiner(path).examine()


class _Examiner:
    def __init__(self, path: Path):
        self.path, self.folder = path, RunDirectory(path).checkpoints
        self.counts = {"records": 0, "checkpoints": 0, "evaluations": 0}
        self.found: list[Finding] = []

    def examine(self) -> Examination:
        if self._try(lambda: read_saved_config(self.path / "config.yaml")) is None:
            self.folder = CheckpointFolder(self.folder.path)  # whose checkpoints may be of any run
        results = self._try(lambda: ResultLog(self.path / "results.jsonl").read())
        if results is not None:
            self._check_records(results)
        self._check_checkpoints(results)
        for file in sorted(self.path.glob(f"**/{FILE_NAME}")):
            if self._try(partial(EvaluationResult.read, file)) is not None:
                self.counts["evaluations"] += 1
        for file in sorted(self.path.rglob(".*.part")):
            self._note(f"{file} was left by a process that was killed; a resume removes it")
        return Examination(self.path, self.counts, tuple(self.found))

    def _check_records(self, results: Results) -> None:
        self.counts["records"] = len(results.records)
        for problem in results.problems:
            self._fault(problem)
        if not results.records:
            return self._fault(
                f"{self.path / 'results.jsonl'} has no records: it is missing, or the run never began"
            )
        try:
            size, learned = len(results.run.tasks), results.learned_tasks()
        except LifelongError as error:
            return self._fault(f"{self.path / 'results.jsonl'}: {error}")
        if not results.finished:
            self._note(f"the run is not finished: {learned} of {size} tasks are learned and evaluated")
        for text in _missing_records(results):
            self._fault(f"{self.path / 'results.jsonl'} lacks {text}; the run's command measures it again")
        for text in _false_copies(results):
            self._fault(f"{self.path / 'results.jsonl'}: {text}")
        self._check_summary(results)

    def _check_summary(self, results: Results) -> None:
        """Compare results.json with the records that it was made from."""
        file = self.path / "results.json"
        if not file.exists():
            if results.finished:
                self._fault(f"{file} is missing; the run's command writes it again")
            return
        try:
            written = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError) as error:
            return self._fault(f"{file} is broken ({error}); the run's command writes it again")
        if not isinstance(written, dict):
            return self._fault(f"{file} is broken: expected an object; the run's command writes it again")
        now = json.loads(json.dumps(json_safe(summarize(results))))
        earlier = written.get("statistics") != now["statistics"]  # other intervals from the same records
        compared = [key for key in _COMPARED if not (earlier and key == "metrics")]
        differing = [key for key in compared if not _alike(written.get(key), now[key])]
        if differing:
            self._fault(
                f"{file} is not what results.jsonl gives ({', '.join(differing)}); the run's command writes it again"
            )

    def _check_checkpoints(self, results: Results | None) -> None:
        folder = self.folder
        tasks, ended = folder.tasks(), {r.task for r in results.of(TaskEndRecord)} if results else set()
        for task in tasks:
            self._check_checkpoint(folder.task_path(task), folder.load_task)
        for path in (folder.progress_path, folder.previous_path):
            self._check_checkpoint(path, folder.load_progress)
        self._check_checkpoint(folder.best_path, lambda _: folder.load_best())
        for file in sorted(folder.path.glob(f"*{BROKEN_SUFFIX}")):
            self._note(f"{file} is a damaged checkpoint that was set aside; it may be removed")
        if lost := sorted(ended - set(tasks)):
            level = self._fault if lost[-1] == max(ended) else self._note
            level(
                f"{folder.path} has no checkpoints after tasks {', '.join(map(str, lost))}, which are learned"
            )

    def _check_checkpoint(self, path: Path, load: Callable[[Path], Any]) -> None:
        if not path.exists():
            return
        try:
            load(path)
            self.counts["checkpoints"] += 1
        except CheckpointError as error:
            self._fault(str(error))

    def _try(self, read: Callable[[], Any]) -> Any:
        try:
            return read()
        except (LiberoError, OSError) as error:
            self._fault(str(error))
            return None

    def _fault(self, text: str) -> None:
        self.found.append(Finding("fault", text))

    def _note(self, text: str) -> None:
        self.found.append(Finding("note", text))


def _missing_records(results: Results) -> Iterator[str]:
    """Yield what the records of learned tasks lack, compared with each other."""
    ended = sorted({record.task for record in results.of(TaskEndRecord)})
    for task in ended:
        row = measured_tasks(results.run.cells, results.run.group(task), len(results.run.tasks))
        if absent := [seen for seen in row if results.evaluation("matrix", task, seen) is None]:
            yield f"evaluations after task {task} of tasks {_listed(absent)}"
    curves = {task: set(curve.epochs.tolist()) for task, curve in results.curves().items()}
    whole = {task: curves.get(task, set()) for task in range(max(ended, default=-1) + 1)}
    for task, absent in _gaps(whole):
        yield f"points of the learning curve of task {task}, epochs {_listed(absent)}"
    losses = {task: {r.epoch for r in results.of(LossRecord) if r.task == task} for task in ended}
    for task, absent in _gaps(losses):
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


def _gaps(epochs: dict[int, set[int]]) -> Iterator[tuple[int, list[int]]]:
    every = set().union(*epochs.values())
    for task, found in epochs.items():
        if every - found:
            yield task, sorted(every - found)


def _listed(numbers: list[int]) -> str:
    return ", ".join(map(str, numbers[:6])) + (", ..." if len(numbers) > 6 else "")


def _alike(a: Any, b: Any) -> bool:
    """Return whether plain data are equal, numbers up to rounding."""
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(_alike(a[key], b[key]) for key in a)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(_alike, a, b))
    if isinstance(a, float) and isinstance(b, float):
        return abs(a - b) < 1e-9
    return bool(a == b)
