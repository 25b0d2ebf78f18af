"""The recorded results of a run: what is done already, and the inputs of metrics and reports.

`lifelong.results.log.ResultLog` reads and appends the records. Tasks are positions in the sequence.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lifelong.errors import ResultsError
from lifelong.results.records import (
    CollectionRecord,
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
from lifelong.results.subgoals import Subgoals, subgoals
from lifelong.stats.metrics import (
    Curve,
    Metrics,
    Scores,
    Transfer,
    average_success,
    estimate_cells,
    lifelong_metrics,
    mean_curve,
    other_conventions,
    unseen_transfer,
)

Diagonal = Literal["matrix", "curve"]


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

    @cached_property
    def run(self) -> RunRecord:
        """Record that names the run.

        Raises:
            ResultsError: There is none.
        """
        first = next((r for r in self.records if isinstance(r, RunRecord)), None)
        if first is None:
            reason = self.problems[0] if self.problems else "the run was stopped before it began"
            raise ResultsError(f"the results have no 'run' record: {reason}. Give the run's command again")
        return first

    @property
    def finished(self) -> bool:
        """Whether the whole sequence is learned."""
        return bool(self.of(RunEndRecord))

    @property
    def demonstrations(self) -> DemonstrationsRecord | None:
        """What the tasks are learned from, after the last resume; None where it is not recorded."""
        recorded = self.of(DemonstrationsRecord)
        return recorded[-1] if recorded else None

    def evaluation(
        self, phase: str, learned: int, task: int, epoch: int | None = None, *, shift: str = ""
    ) -> EvalRecord | None:
        """Return the evaluation with this key, of any epoch if none is given; None if it is not recorded."""
        key = (phase, learned, task, shift)
        same = (r for r in reversed(self.of(EvalRecord)) if (r.phase, r.learned, r.task, r.shift) == key)
        return next((r for r in same if epoch in (None, r.epoch)), None)

    def original(self, decided_by: str) -> EvalRecord | None:
        """Return the rollouts that were run under the same digest of all they depend on; None without any."""
        runs = (r for r in reversed(self.of(EvalRecord)) if r.same_as is None)
        return next((r for r in runs if r.decided_by == decided_by != ""), None)

    @property
    def error_notes(self) -> list[str]:
        """A sentence for each evaluation in which simulation errors ended episodes."""
        return [
            f"After learning task {r.learned + 1}, {r.phase} of task {r.task + 1}: {r.error_note} "
            f"({'; '.join(f'start {start}: {why}' for start, why in r.simulation_errors[:3])})."
            for r in self.of(EvalRecord)
            if r.simulation_errors and r.same_as is None
        ]

    def episodes(self) -> tuple[int, int]:
        """Return the numbers of episodes that were run, and that were copied from those they would have repeated."""
        counts = [(r.same_as is not None, len(r.successes)) for r in self.of(EvalRecord)]
        return sum(n for copied, n in counts if not copied), sum(n for copied, n in counts if copied)

    def evaluations(self) -> list[EvalRecord]:
        """Return every evaluation of curves and matrix once, in the order of the run: the episodes behind metrics."""
        last = {
            (r.learned, r.phase, r.epoch, r.task): r
            for r in self.of(EvalRecord)
            if r.phase in ("curve", "matrix")
        }
        return [last[key] for key in sorted(last)]

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

        def is_complete(group: range) -> bool:  # without cells to be measured: whether it has ended
            columns = self.run.row(group)
            row = rates[group[-1], columns]
            return bool(np.isfinite(row).all()) if columns else self.task_end(group[-1]) is not None

        complete = [is_complete(group) for group in self.run.groups]
        return len(rates) if complete[-1] else self.run.groups[complete.index(False)].start

    def curves(self) -> dict[int, Curve]:
        """Return the learning curve of each task that has one."""
        return {task: _curve(r for _, r in sorted(p.items())) for task, p in self._curve_points.items()}

    @cached_property
    def _curve_points(self) -> dict[int, dict[int, EvalRecord]]:
        """Evaluations of each learning curve by task and epoch."""
        points: dict[int, dict[int, EvalRecord]] = {}
        for r in self.of(EvalRecord):
            if r.phase == "curve" and r.learned == self.last_of_group(r.task):
                points.setdefault(r.task, {})[r.epoch] = r
        return points

    @cached_property
    def _group_curves(self) -> dict[int, Curve]:
        """Each group's learning curve by its last task, at the epochs where all its tasks were evaluated."""
        curves = self.curves()
        return {
            group[-1]: mean_curve([curves[task] for task in group])
            for group in self.run.groups
            if all(task in curves for task in group)
        }

    def collections(self) -> dict[int, list[CollectionRecord]]:
        """Return the iterations of each task that was learned from reward."""
        found: dict[int, list[CollectionRecord]] = {}
        for r in self.of(CollectionRecord):
            found.setdefault(r.task, []).append(r)
        return found

    def losses(self) -> dict[int, tuple[NDArray[np.int64], NDArray[np.float64]]]:
        """Return the epochs and mean training losses of each task."""
        points: dict[int, dict[int, float]] = {}
        for r in self.of(LossRecord):
            points.setdefault(r.task, {})[r.epoch] = r.loss
        return {
            task: (np.array(sorted(p), dtype=np.int64), np.array([p[e] for e in sorted(p)], dtype=float))
            for task, p in points.items()
        }

    def success_matrix(self, diagonal: Diagonal = "matrix") -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return success rates c[i,j] (K, K), NaN where not evaluated, and their numbers of episodes (K, K).

        Args:
            diagonal: Source of c[i,i]. "matrix": the evaluation after learning task i, like the rest of its
                column, so that the choice of the best epoch does not bias the reported number; the best of
                the learning curve where there is none, in a run that measures all cells. "curve": always the latter,
                c[i,i] = max over e of c[i,i,e], as eq. 3 is written.
        """
        return self._matrices[diagonal]

    @cached_property
    def _matrices(self) -> dict[Diagonal, tuple[NDArray[np.float64], NDArray[np.int64]]]:
        size = len(self.run.tasks)
        cells = {
            (r.learned, r.task): r
            for r in self.of(EvalRecord)
            if r.phase == "matrix" and r.task <= r.learned < size
        }
        best: dict[tuple[int, int], EvalRecord] = {}  # of the curves of tasks that are learned
        for group in self.run.groups:
            row, curve = group[-1], self._group_curves.get(group[-1])
            ended = self.task_end(row) is not None and self.run.cells == "all"
            for task in group:
                if curve is not None and ((row, task) in cells or ended):
                    best[row, task] = self._curve_points[task][int(curve.epochs[curve.best])]
        return {"matrix": _matrix(size, best | cells), "curve": _matrix(size, cells | best)}

    def _estimated(self, rates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return success rates with the cells that a sample left out estimated; see `estimate_cells`."""
        if self.run.cells != "sampled":
            return rates
        return estimate_cells(rates, [(group[-1], group.start) for group in self.run.groups])

    def average_success(self) -> NDArray[np.float64]:
        """Return the mean success over the tasks learned so far, after each task, (K,); NaN from the next task on.

        Where it is estimated from a sample of the cells, it is held within [0, 1].
        """
        size, average = self.learned_tasks(), np.full(len(self.run.tasks), np.nan)
        average[:size] = average_success(self._estimated(self.success_matrix()[0])[:size, :size]).clip(0, 1)
        return average

    @property
    def transfer(self) -> Transfer:
        """Estimate of forward transfer."""
        return self.run.transfer

    def scores(self, diagonal: Diagonal = "matrix", transfer: Transfer | None = None) -> Scores:
        """Return the input of the metrics, with the tasks learned so far as the whole sequence.

        A group of tasks that were learned together counts as one task; its success is the mean over its tasks.

        Args:
            diagonal: Source of c[i,i], see `success_matrix`.
            transfer: Estimate of forward transfer; None for the run's own.
        """
        size = self.learned_tasks()
        groups = [g for g in self.run.groups if g.stop <= size]
        rates, episodes = self.success_matrix(diagonal)
        rows = [g[-1] for g in groups]
        rates = self._estimated(rates)
        return Scores(
            tuple(self._group_curves.get(row, _curve(())) for row in rows),
            np.stack([rates[rows, g.start : g.stop].mean(1) for g in groups], axis=1),
            np.stack([episodes[rows, g.start : g.stop].sum(1) for g in groups], axis=1),
            tuple(map(len, groups)),
            transfer or self.transfer,
            sampled=self.run.cells == "sampled",
        )

    def unseen_transfer(self) -> dict[str, float]:
        """Return success on tasks before they are learned, see `lifelong.stats.metrics.unseen_transfer`."""
        size, groups = len(self.run.tasks), self.run.groups
        before, initial = np.full((size, size), np.nan), np.full(size, np.nan)
        for r in (r for r in self.of(EvalRecord) if r.task < size):
            if r.phase == "unseen":
                before[r.learned, r.task] = r.rate
            elif r.phase == "initial":
                initial[r.task] = r.rate
        rows = [g[-1] for g in groups]
        columns = [before[rows, g.start : g.stop].mean(1) for g in groups]
        return unseen_transfer(np.stack(columns, axis=1), [initial[g.start : g.stop].mean() for g in groups])

    def held_out_success(self) -> dict[str, float]:
        """Return the mean success on tasks that are never learned, before the first task and after the last."""
        held = [r for r in self.of(EvalRecord) if r.task >= len(self.run.tasks)]
        names = {"held_out_before": "initial", "held_out_after": "unseen"}
        rates = {name: {r.task: r.rate for r in held if r.phase == phase} for name, phase in names.items()}
        return {
            name: float(np.mean([*found.values()]))
            if found and len(found) == len(self.run.held_out)
            else np.nan
            for name, found in rates.items()
        }

    def other_conventions(self) -> dict[str, float]:
        """Return what other papers print of the success matrix, see `lifelong.stats.metrics`."""
        found = other_conventions(self.scores().matrix) | self.unseen_transfer() | self.held_out_success()
        if self.run.cells == "sampled":  # the best of the cells that happen to be measured means nothing
            found["forgetting"] = float("nan")
        return found

    def costs(self, task: int) -> dict[str, float]:
        """Return the costs of learning a task, by the names of `lifelong.training.costs`; empty if not recorded."""
        return {k: v for r in self.of(CostRecord) if r.task == task for k, v in r.costs.items()}

    def costs_by_task(self) -> dict[int, dict[str, float]]:
        """Return the costs of each task that has any recorded, with its `training_seconds` and `evaluation_seconds`.

        Evaluation is that while and after learning the task.
        """
        losses, evaluations = self.of(LossRecord), [r for r in self.of(EvalRecord) if r.phase != "initial"]
        return {
            task: self.costs(task)
            | {"training_seconds": sum((r.seconds for r in losses if r.task == task), 0.0)}
            | {"evaluation_seconds": sum((r.seconds for r in evaluations if r.learned == task), 0.0)}
            for task in sorted({r.task for r in self.of(CostRecord)})
        }

    def subgoals(self) -> Subgoals:
        """Return how often parts of the goals of the tasks learned so far were reached, and forgotten."""
        return subgoals(self.of(EvalRecord), [*map(self.last_of_group, range(self.learned_tasks()))])

    def seconds_by_phase(self) -> dict[str, float]:
        """Return the wall time of the recorded phases (such as demos), of training and of evaluation, [s]."""
        times: dict[str, float] = {}
        for r in self.of(PhaseRecord):
            times[r.phase] = times.get(r.phase, 0.0) + r.seconds
        times["training"] = sum(r.seconds for r in self.of(LossRecord))
        times["evaluation"] = sum(r.seconds for r in self.of(EvalRecord))
        between = sum(r.costs.get("end_task_seconds", 0.0) for r in self.of(CostRecord))
        return times | ({"between tasks": between} if between else {})

    def has_later_tasks(self) -> bool:
        """Return whether the run has a base stage, and has learned a task after it."""
        return self.run.has_base_stage and self.learned_tasks() > len(self.run.groups[0])

    def after_base_stage(self) -> Metrics | None:
        """Compute the metrics over the tasks after the base stage, as if the sequence began with them.

        None if the run has no base stage, or no later task is learned.
        """
        return lifelong_metrics(self.scores().without_first()) if self.has_later_tasks() else None


def _matrix(
    size: int, cells: dict[tuple[int, int], EvalRecord]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    rates, episodes = np.full((size, size), np.nan), np.zeros((size, size), dtype=np.int64)
    for cell, record in cells.items():
        rates[cell], episodes[cell] = record.rate, len(record.successes)
    return rates, episodes


def _curve(evaluations: Iterable[EvalRecord]) -> Curve:
    """Return a learning curve; if points have other starts than the first, episodes correspond by their number.

    The outcomes of a start are left out of all points where a simulation error ended an episode from it in one.
    """
    records = list(evaluations)
    lost = {start for r in records for start, _ in r.simulation_errors}
    outcomes = [
        [won for start, won in zip(r.init_states, r.successes, strict=True) if start not in lost]
        for r in records
    ]
    count = min(map(len, outcomes), default=0)
    return Curve(
        np.array([r.epoch for r in records], dtype=np.int64),
        np.array([r.rate for r in records], dtype=float),
        np.array([len(r.successes) for r in records], dtype=np.int64),
        np.array([row[:count] for row in outcomes], dtype=float)[..., None] if records else None,
    )
