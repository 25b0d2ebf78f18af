"""The recorded results of a run: what is done already, and the inputs of metrics and reports.

`lifelong.results.log.ResultLog` reads and appends the records. Tasks are positions in the sequence.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lifelong.errors import ResultsError
from lifelong.results.coverage import measured_tasks
from lifelong.results.curves import Curve, Transfer, mean_curve
from lifelong.results.metrics import Metrics, lifelong_metrics
from lifelong.results.records import (
    CostRecord,
    DemonstrationsRecord,
    EvalRecord,
    LossRecord,
    PhaseRecord,
    Record,
    RunEndRecord,
    RunRecord,
    TaskEndRecord,
)
from lifelong.results.repeats import repeated_rows
from lifelong.results.scores import Cell, Scores
from lifelong.results.subgoals import Subgoals, subgoals


@dataclass(frozen=True)
class Results:
    """A typed view of a run's records. Of records with the same key the last one counts.

    Attributes:
        records: Records in the order they were written.
        problems: Lines that could not be read, as file:line and the reason.
    """

    records: tuple[Record, ...]
    problems: tuple[str, ...] = ()

    def of(self, kind: type) -> list[Any]:
        """Return the records of one class, in the order they were written."""
        return [r for r in self.records if isinstance(r, kind)]

    @property
    def run(self) -> RunRecord:
        """Record that names the run.

        Raises:
            ResultsError: There is none.
        """
        runs = self.of(RunRecord)
        if not runs:
            found = self.problems[0] if self.problems else "the run was stopped before it began"
            raise ResultsError(f"the results have no 'run' record: {found}. Give the run's command again")
        return runs[0]

    @property
    def finished(self) -> bool:
        """Whether the whole sequence is learned."""
        return bool(self.of(RunEndRecord))

    @property
    def demonstrations(self) -> DemonstrationsRecord | None:
        """What the tasks are learned from, after the last resume; None where it is not recorded."""
        found = self.of(DemonstrationsRecord)
        return found[-1] if found else None

    def evaluation(
        self, phase: str, learned: int, task: int, epoch: int | None = None, *, shift: str = ""
    ) -> EvalRecord | None:
        """Return the evaluation with this key, of any epoch if none is given; None if it is not recorded."""
        key = (phase, learned, task, shift)
        found = [
            r
            for r in self.of(EvalRecord)
            if (r.phase, r.learned, r.task, r.shift) == key and epoch in (None, r.epoch)
        ]
        return found[-1] if found else None

    def original(self, decided_by: str) -> EvalRecord | None:
        """Return the rollouts that were run under the same digest of all they depend on; None without any."""
        runs = (r for r in reversed(self.of(EvalRecord)) if r.same_as is None)
        return next((r for r in runs if r.decided_by == decided_by != ""), None)

    def episodes(self) -> tuple[int, int]:
        """Return the numbers of episodes that were run, and that were copied from those they would have repeated."""
        count = {
            copied: sum(len(r.successes) for r in self.of(EvalRecord) if (r.same_as is not None) == copied)
            for copied in (False, True)
        }
        return count[False], count[True]

    def evaluations(self) -> list[EvalRecord]:
        """Return every evaluation of curves and matrix once, in the order of the run: the episodes behind metrics."""
        measured = [r for r in self.of(EvalRecord) if r.phase != "shift"]
        found = {(r.learned, r.phase, r.epoch, r.task): r for r in measured}
        return [found[key] for key in sorted(found, key=lambda k: (k[0], k[1], k[2], k[3]))]

    def has_loss(self, task: int, epoch: int) -> bool:
        """Return whether the loss of this epoch is recorded."""
        return any((r.task, r.epoch) == (task, epoch) for r in self.of(LossRecord))

    def task_end(self, task: int) -> TaskEndRecord | None:
        """Return the record that closes a task; None while it is being learned."""
        return next((r for r in reversed(self.of(TaskEndRecord)) if r.task == task), None)

    def last_of_group(self, task: int) -> int:
        """Return the last task of a task's group, whose row of the matrix is the first after learning it."""
        return self.run.group(task)[-1]

    def learned_tasks(self) -> int:
        """Count the tasks, from the first, with a complete row in the matrix; all count if the last row is complete."""
        rates, _ = self.success_matrix()
        groups = self.run.groups
        full = [self._is_complete(rates[group[-1]], group) for group in groups]
        return groups[full.index(False)].start if False in full and not full[-1] else len(rates)

    def _is_complete(self, rates: NDArray[np.float64], stage: range) -> bool:
        """Return whether a row of the matrix has all cells that the run measures; without any, whether it has ended."""
        columns = measured_tasks(self.run.cells, stage, len(self.run.tasks))
        return bool(np.isfinite(rates[columns]).all()) if columns else self.task_end(stage[-1]) is not None

    def curves(self) -> dict[int, Curve]:
        """Return the learning curve of each task that has one."""
        names = self.run.tasks
        return {
            task: _curve([by_epoch[e] for e in sorted(by_epoch)], names[task])
            for task, by_epoch in self._curve_points().items()
        }

    def _curve_points(self) -> dict[int, dict[int, EvalRecord]]:
        """Return the evaluations of each learning curve by task and epoch."""
        points: dict[int, dict[int, EvalRecord]] = {}
        for r in self.of(EvalRecord):
            if r.phase == "curve" and r.learned == self.last_of_group(r.task):
                points.setdefault(r.task, {})[r.epoch] = r
        return points

    def losses(self) -> dict[int, tuple[NDArray[np.int64], NDArray[np.float64]]]:
        """Return the epochs and mean training losses of each task."""
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
        """Return success rates c[i,j] (K, K), NaN where not evaluated, and their numbers of episodes (K, K).

        Args:
            diagonal: Source of c[i,i], see `matrix_evaluations`.
        """
        size = len(self.run.tasks)
        rates, episodes = np.full((size, size), np.nan), np.zeros((size, size), dtype=np.int64)
        for cell, record in self.matrix_evaluations(diagonal).items():
            rates[cell], episodes[cell] = record.rate, len(record.successes)
        return rates, episodes

    def matrix_evaluations(
        self, diagonal: Literal["matrix", "curve"] = "matrix"
    ) -> dict[tuple[int, int], EvalRecord]:
        """Return the evaluation behind every c[i,j], by (i, j).

        Args:
            diagonal: Source of c[i,i]. "matrix": the evaluation after learning task i, like the rest of its
                column, so that the choice of the best epoch does not bias the reported number; the best of
                the learning curve where there is none, in a run that measures all cells. "curve": always the latter,
                c[i,i] = max over e of c[i,i,e], as eq. 3 is written.
        """
        size = len(self.run.tasks)
        found = {
            (r.learned, r.task): r
            for r in self.of(EvalRecord)
            if r.phase == "matrix" and r.task <= r.learned < size
        }
        points = self._curve_points()
        curves = self._group_curves(self.curves())
        best = {last: int(curve.epochs[curve.best]) for last, curve in curves.items()}
        for task, by_epoch in points.items():
            row = self.last_of_group(task)
            measured = (row, task) in found
            ended = self.task_end(row) is not None and self.run.cells == "all"
            if row in best and ((diagonal == "curve" and measured) or (not measured and ended)):
                found[row, task] = by_epoch[best[row]]
        return found

    @property
    def transfer(self) -> Transfer:
        """Estimate of forward transfer: the run's own; for runs that do not say, by which weights they kept."""
        if self.run.transfer:
            return self.run.transfer
        kept = {r.task: r.best_epoch for r in self.of(TaskEndRecord)}
        curves = {last: c for last, c in self._group_curves(self.curves()).items() if last in kept}
        last = all(kept[task] == curve.epochs[-1] for task, curve in curves.items())
        chosen = all(kept[task] == curve.epochs[curve.best] for task, curve in curves.items())
        return "plain" if last and not chosen else "cross_fitted"

    def scores(
        self, diagonal: Literal["matrix", "curve"] = "matrix", transfer: Transfer | None = None
    ) -> Scores:
        """Return the input of the metrics, with the tasks learned so far as the whole sequence.

        A group of tasks that were learned together counts as one task; its success is the mean over its tasks.

        Args:
            diagonal: Source of c[i,i], see `matrix_evaluations`.
            transfer: Estimate of forward transfer; None for the run's own.
        """
        size = self.learned_tasks()
        groups = [g for g in self.run.groups if g.stop <= size]
        rates, episodes = self.success_matrix(diagonal)
        curves, empty = self._group_curves(self.curves()), _curve([], "")
        rows = [g[-1] for g in groups]
        return Scores(
            tuple(curves.get(row, empty) for row in rows),
            np.stack([rates[rows, g.start : g.stop].mean(1) for g in groups], axis=1),
            np.stack([episodes[rows, g.start : g.stop].sum(1) for g in groups], axis=1),
            tuple(map(len, groups)),
            self._cells(diagonal, groups),
            transfer or self.transfer,
        )

    def _cells(self, diagonal: Literal["matrix", "curve"], groups: Sequence[range]) -> tuple[Cell, ...]:
        """Return the episodes of the matrix; rollouts are repeated where outcomes and lengths are."""
        names, row_of = self.run.tasks, {g[-1]: number for number, g in enumerate(groups)}
        column_of = {task: number for number, g in enumerate(groups) for task in g}
        used = {
            (row, task): record
            for (row, task), record in sorted(self.matrix_evaluations(diagonal).items())
            if row in row_of and task in column_of
        }
        same = repeated_rows(used)
        return tuple(
            Cell(
                row=row_of[row],
                column=column_of[task],
                task=names[task],
                starts=np.array(record.init_states, dtype=np.int64),
                successes=np.array(record.successes, dtype=bool),
                same_as=row_of[same[row, task]],
            )
            for (row, task), record in used.items()
        )

    def _group_curves(self, curves: Mapping[int, Curve]) -> dict[int, Curve]:
        """Return each group's learning curve by its last task, at the epochs where all its tasks were evaluated."""
        groups: dict[int, list[Curve]] = {}
        for task, curve in sorted(curves.items()):
            groups.setdefault(self.last_of_group(task), []).append(curve)
        sizes = {group[-1]: len(group) for group in self.run.groups}
        return {last: mean_curve(found) for last, found in groups.items() if len(found) == sizes[last]}

    def costs(self, task: int) -> dict[str, float]:
        """Return the costs of learning a task, by the names of `lifelong.training.costs`; empty if not recorded."""
        return {k: v for r in self.of(CostRecord) if r.task == task for k, v in r.costs.items()}

    def task_seconds(self, task: int) -> dict[str, float]:
        """Return the wall time of a task, [s]: of training on it, and of evaluation while and after learning it."""
        return {
            "training": sum(r.seconds for r in self.of(LossRecord) if r.task == task),
            "evaluation": sum(r.seconds for r in self.of(EvalRecord) if r.learned == task),
        }

    def subgoals(self) -> Subgoals:
        """Return how often parts of the goals of the tasks learned so far were reached, and forgotten."""
        return subgoals(self.of(EvalRecord), self.learned_tasks())

    def seconds_by_phase(self) -> dict[str, float]:
        """Return the wall time of the recorded phases (such as demos), of training and of evaluation, [s]."""
        times: dict[str, float] = {}
        for r in self.of(PhaseRecord):
            times[r.phase] = times.get(r.phase, 0.0) + r.seconds
        times["training"] = sum(r.seconds for r in self.of(LossRecord))
        times["evaluation"] = sum(r.seconds for r in self.of(EvalRecord))
        between = sum(r.costs.get("end_task_seconds", 0.0) for r in self.of(CostRecord))
        if between:
            times["between tasks"] = between
        return times


def after_base_stage(results: Results) -> Metrics | None:
    """Compute the metrics over the tasks after the base stage, as if the sequence began with them.

    Args:
        results: Records of a run.

    Returns:
        The metrics; None if the run has no base stage, or no later task is learned.
    """
    return lifelong_metrics(results.scores().without_first()) if has_later_tasks(results) else None


def has_later_tasks(results: Results) -> bool:
    """Return whether a run has a base stage, and has learned a task after it."""
    run = results.run
    return run.has_base_stage and results.learned_tasks() > len(run.groups[0])


def _curve(records: list[EvalRecord], task: str) -> Curve:
    """Return a learning curve; if points have other starts than the first, episodes correspond by their number."""
    count = min((len(r.successes) for r in records), default=0)
    return Curve(
        np.array([r.epoch for r in records], dtype=np.int64),
        np.array([r.rate for r in records], dtype=float),
        np.array([len(r.successes) for r in records], dtype=np.int64),
        np.array([r.successes[:count] for r in records], dtype=float)[..., None] if records else None,
        np.array(records[0].init_states[:count], dtype=np.int64) if records else None,
        (task,) if records else (),
    )
