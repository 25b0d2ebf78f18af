"""What a run did, one JSON line at a time: nothing recorded is ever lost or rewritten.

`ResultLog` appends records to `results.jsonl`; `Results` is the typed view that the trainer asks what is
already done, and that metrics and reports are made from. Tasks are positions in the sequence.
"""

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import NDArray

from lifelong.errors import LifelongError
from lifelong.metrics import METRIC_NAMES, Curve, Scores, lifelong_metrics, wilson_interval
from lifelong.records import (
    CostRecord,
    EvalRecord,
    LossRecord,
    PhaseRecord,
    Record,
    RunEndRecord,
    RunRecord,
    TaskEndRecord,
    from_line,
    to_line,
)
from lifelong.subgoals import Subgoals, subgoals


class ResultsError(LifelongError):
    """Results that cannot be read or written; the message names the file and what is missing."""


class ResultLog:
    """Append-only `results.jsonl`. Each record is on disk when `append` returns."""

    def __init__(self, path: Path | str):
        self.path = Path(path)

    def append(self, record: Record) -> None:
        """Adds one line, flushed and synced.

        A fragment that a killed process left at the end is removed first. If the line cannot be written
        whole (disk full), what was written of it is taken back, so the file stays readable.

        Raises:
            ResultsError: The file cannot be written.
        """
        line = to_line(record)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with open(self.path, "a+b", buffering=0) as file:
                size, separator = _end_of_records(file)
                try:
                    file.truncate(size)
                    if file.write(separator + line) != len(separator + line):
                        raise OSError("the line was written in part only")
                    os.fsync(file.fileno())
                except OSError:
                    file.truncate(size)
                    raise
        except OSError as error:
            raise ResultsError(
                f"{self.path}: cannot append a {record.kind!r} record ({error}). What was recorded before "
                "is intact; free some space or mend the permissions, then start the same command again"
            ) from error

    def read(self) -> "Results":
        """Everything recorded so far; empty if the file does not exist yet. Never changes the file."""
        if not self.path.exists():
            return Results(())
        try:
            raw = self.path.read_bytes()
        except OSError as error:
            raise ResultsError(f"{self.path}: cannot be read ({error})") from error
        records: list[Record] = []
        problems: list[str] = []
        lines = raw.split(b"\n")
        for number, line in enumerate(lines, start=1):
            if not line.strip():
                continue
            try:
                records.append(from_line(line))
            except ValueError as error:
                if number < len(lines):  # the last line has no newline: it was cut off, not broken
                    problems.append(f"{self.path}:{number}: {error}; the line is left out")
        return Results(tuple(records), tuple(problems))


@dataclass(frozen=True)
class Results:
    """A typed view of a run's records. Of records with the same key the last one counts."""

    records: tuple[Record, ...]
    problems: tuple[str, ...] = ()  # lines that could not be read, as file:line

    def of(self, kind: type) -> list[Any]:
        """The records of one class, in the order they were written."""
        return [r for r in self.records if isinstance(r, kind)]

    @property
    def run(self) -> RunRecord:
        """The record that names the run. Raises: ResultsError if there is none."""
        runs = self.of(RunRecord)
        if not runs:
            raise ResultsError("the results have no 'run' record: the run was stopped before it began")
        return runs[0]

    @property
    def finished(self) -> bool:
        """Whether the whole sequence is learned."""
        return bool(self.of(RunEndRecord))

    def evaluation(self, phase: str, learned: int, task: int, epoch: int | None = None) -> EvalRecord | None:
        """The evaluation with this key, whatever its epoch if none is given; None if not recorded."""
        found = [
            r
            for r in self.of(EvalRecord)
            if (r.phase, r.learned, r.task) == (phase, learned, task) and epoch in (None, r.epoch)
        ]
        return found[-1] if found else None

    def has(self, phase: str, learned: int, task: int, epoch: int | None = None) -> bool:
        """Whether this evaluation is recorded: a resumed run need not repeat it."""
        return self.evaluation(phase, learned, task, epoch) is not None

    def has_loss(self, task: int, epoch: int) -> bool:
        """Whether the loss of this epoch is recorded."""
        return any((r.task, r.epoch) == (task, epoch) for r in self.of(LossRecord))

    def task_end(self, task: int) -> TaskEndRecord | None:
        """The record that closes a task; None while it is being learned."""
        return next((r for r in reversed(self.of(TaskEndRecord)) if r.task == task), None)

    def learned_with(self, task: int) -> int:
        """The task whose row of the matrix is the first after learning this one: the last of its group."""
        size = self.run.group_size
        return (task // size + 1) * size - 1

    def learned_tasks(self) -> int:
        """How many tasks, from the first on, have a complete row in the matrix; all of them where the last has one."""
        rates, _ = self.success_matrix()
        size = self.run.group_size
        full = [bool(np.isfinite(rates[i, : i + 1]).all()) for i in range(size - 1, len(rates), size)]
        return size * (full.index(False) if False in full and not full[-1] else len(full))

    def curves(self) -> dict[int, Curve]:
        """Learning curve of each task that has one."""
        points: dict[int, dict[int, EvalRecord]] = {}
        for r in self.of(EvalRecord):
            if r.phase == "curve" and r.learned == self.learned_with(r.task):
                points.setdefault(r.task, {})[r.epoch] = r
        return {task: _curve([by_epoch[e] for e in sorted(by_epoch)]) for task, by_epoch in points.items()}

    def losses(self) -> dict[int, tuple[NDArray[np.int64], NDArray[np.float64]]]:
        """Task -> (epochs, mean training losses)."""
        points: dict[int, dict[int, float]] = {}
        for r in self.of(LossRecord):
            points.setdefault(r.task, {})[r.epoch] = r.loss
        return {
            task: (np.array(sorted(p), dtype=np.int64), np.array([p[e] for e in sorted(p)], dtype=float))
            for task, p in points.items()
        }

    def success_matrix(
        self, diagonal: Literal["matrix", "curve"] = "matrix"
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Success rates c[i,j] (K, K), NaN where not (yet) evaluated, and the episodes behind them (K, K).

        Args:
            diagonal: Where c[i,i] comes from. "matrix": from the evaluation after learning task i, like
                the rest of its column, which keeps the choice of the best epoch out of the reported
                number; the best of the learning curve stands in where there is none. "curve": always
                the latter, c[i,i] = max over e of c[i,i,e], eq. 3 to the letter.
        """
        size = len(self.run.tasks)
        rates, episodes = np.full((size, size), np.nan), np.zeros((size, size), dtype=np.int64)
        for r in self.of(EvalRecord):
            if r.phase == "matrix" and r.task <= r.learned < size:
                rates[r.learned, r.task], episodes[r.learned, r.task] = r.rate, len(r.successes)
        curves = self.curves()
        best = {last: curve.epochs[curve.best] for last, curve in self._group_curves(curves).items()}
        for task, curve in curves.items():
            row = self.learned_with(task)
            measured = not math.isnan(rates[row, task])
            ended = self.task_end(row) is not None
            if row in best and ((diagonal == "curve" and measured) or (not measured and ended)):
                point = curve.epochs.tolist().index(best[row])
                rates[row, task], episodes[row, task] = curve.rates[point], curve.episodes[point]
        return rates, episodes

    def scores(self, diagonal: Literal["matrix", "curve"] = "matrix") -> Scores:
        """The metrics' input: the tasks learned so far as if they were the whole sequence.

        A group of tasks that were learned together is one task there: its success is the mean over its tasks.
        """
        size, group = self.learned_tasks(), self.run.group_size
        rates, episodes = self.success_matrix(diagonal)
        curves, nothing = self._group_curves(self.curves()), _curve([])
        used = tuple(curves.get(task, nothing) for task in range(group - 1, size, group))
        cells = (slice(group - 1, size, group), slice(0, size))
        shape = (size // group, size // group, group)
        return Scores(
            used, rates[cells].reshape(shape).mean(-1), episodes[cells].reshape(shape).sum(-1), group
        )

    def _group_curves(self, curves: Mapping[int, Curve]) -> dict[int, Curve]:
        """The learning curve of each group by its last task, at the epochs where all its tasks were evaluated."""
        groups: dict[int, list[Curve]] = {}
        for task, curve in sorted(curves.items()):
            groups.setdefault(self.learned_with(task), []).append(curve)
        size = self.run.group_size
        return {last: _mean_curve(found) for last, found in groups.items() if len(found) == size}

    def costs(self, task: int) -> dict[str, float]:
        """What learning a task cost, by the names of `lifelong.costs`; empty where nothing is recorded."""
        return {k: v for r in self.of(CostRecord) if r.task == task for k, v in r.costs.items()}

    def task_seconds(self, task: int) -> dict[str, float]:
        """Wall time in seconds of a task: of training on it, of evaluating while and after learning it."""
        return {
            "training": sum(r.seconds for r in self.of(LossRecord) if r.task == task),
            "evaluation": sum(r.seconds for r in self.of(EvalRecord) if r.learned == task),
        }

    def subgoals(self) -> Subgoals:
        """Which parts of the goals of the tasks learned so far were reached, and forgotten."""
        return subgoals(self.of(EvalRecord), self.learned_tasks())

    def seconds_by_phase(self) -> dict[str, float]:
        """Wall time in seconds: the recorded phases (such as demos), then training and evaluation."""
        times: dict[str, float] = {}
        for r in self.of(PhaseRecord):
            times[r.phase] = times.get(r.phase, 0.0) + r.seconds
        times["training"] = sum(r.seconds for r in self.of(LossRecord))
        times["evaluation"] = sum(r.seconds for r in self.of(EvalRecord))
        between = sum(r.costs.get("end_task_seconds", 0.0) for r in self.of(CostRecord))
        if between:
            times["between tasks"] = between
        return times


def write_summary(path: Path | str, results: Results, config: Mapping[str, Any]) -> dict[str, Any]:
    """Writes `results.json`: matrix, curves, metrics with intervals, config, versions and wall times.

    The file is replaced in one step, so a reader never sees half of it.

    Args:
        path: Usually `run_dir/results.json`.
        results: What is recorded so far; an unfinished run is summed up as far as it is.
        config: The resolved configuration as plain data.

    Returns:
        What was written. Rates are in [0, 1]; NaN is null.
    """
    summary = plain(summarize(results) | {"config": dict(config)})
    path = Path(path)
    part = path.with_name(path.name + ".part")
    try:
        with open(part, "w", encoding="utf-8") as file:
            json.dump(summary, file, indent=1, ensure_ascii=False, allow_nan=False)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise ResultsError(
            f"{path}: the summary cannot be written ({error}); results.jsonl is intact"
        ) from error
    return summary


def summarize(results: Results) -> dict[str, Any]:
    """The summary as plain data: who ran, what succeeded, the metrics, the times."""
    run, size = results.run, results.learned_tasks()
    rates, episodes = results.success_matrix()
    low, high = wilson_interval(np.nan_to_num(rates) * episodes, episodes)
    unseen = np.isnan(rates)
    ends = {r.task: r.best_epoch for r in results.of(TaskEndRecord)}
    return {
        "run": {k: v for k, v in asdict(run).items() if k != "kind"},
        "finished": results.finished,
        "tasks_learned": size,
        "metrics": _metrics(results, "matrix") if size else None,
        "metrics_diagonal_from_curve": _metrics(results, "curve") if size else None,
        "success_matrix": {
            "rates": rates.tolist(),
            "episodes": episodes.tolist(),
            "wilson_low": np.where(unseen, np.nan, low).tolist(),
            "wilson_high": np.where(unseen, np.nan, high).tolist(),
        },
        "curves": {
            str(task): {name: getattr(curve, name).tolist() for name in ("epochs", "rates", "episodes")}
            for task, curve in sorted(results.curves().items())
        },
        "losses": {
            str(task): {"epochs": epochs.tolist(), "losses": losses.tolist()}
            for task, (epochs, losses) in sorted(results.losses().items())
        },
        "best_epochs": {str(task): ends[task] for task in sorted(ends)},
        "subgoals": asdict(results.subgoals()),
        "costs": {
            str(task): results.costs(task)
            | {f"{k}_seconds": v for k, v in results.task_seconds(task).items()}
            for task in range(len(run.tasks))
            if results.costs(task)
        },
        "seconds_by_phase": results.seconds_by_phase(),
        "problems": list(results.problems),
    }


def _metrics(results: Results, diagonal: Literal["matrix", "curve"]) -> dict[str, Any]:
    found = lifelong_metrics(results.scores(diagonal))
    by_task = {name: getattr(found, f"{name}_by_task").tolist() for name in ("fwt", "nbt", "auc")}
    return {name: asdict(getattr(found, name)) for name in METRIC_NAMES} | {"by_task": by_task}


def plain(value: Any) -> Any:
    """The same data with None for numbers that are not finite: JSON has no NaN."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _curve(records: list[EvalRecord]) -> Curve:
    return Curve(
        np.array([r.epoch for r in records], dtype=np.int64),
        np.array([r.rate for r in records], dtype=float),
        np.array([len(r.successes) for r in records], dtype=np.int64),
    )


def _mean_curve(curves: Sequence[Curve]) -> Curve:
    """The mean of several tasks' curves, over the episodes of all."""
    if len(curves) == 1:
        return curves[0]
    epochs = sorted(set.intersection(*(set(c.epochs.tolist()) for c in curves)))
    chosen = [np.isin(c.epochs, epochs) for c in curves]
    return Curve(
        np.array(epochs, dtype=np.int64),
        np.mean([c.rates[points] for c, points in zip(curves, chosen, strict=True)], axis=0),
        np.sum([c.episodes[points] for c, points in zip(curves, chosen, strict=True)], axis=0),
    )


def _end_of_records(file: IO[bytes]) -> tuple[int, bytes]:
    """Where the next record goes, and what must be written before it: a newline if only that is missing."""
    size = file.seek(0, os.SEEK_END)
    if size == 0:
        return 0, b""
    file.seek(size - 1)
    if file.read(1) == b"\n":
        return size, b""
    file.seek(0)
    fragment = file.read().rpartition(b"\n")[2]
    try:
        from_line(fragment)
    except ValueError:
        return size - len(fragment), b""
    return size, b"\n"
