"""The phases of training on a stage, and what their learning curves have recorded so far."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

from lifelong.algorithms.base import Phase
from lifelong.context import RunContext
from lifelong.evaluation.settings import Selection
from lifelong.results.records import EvalRecord
from lifelong.results.results import Results
from lifelong.streams import learning_stages


@dataclass(frozen=True)
class TrainingPhase:
    """One phase of an algorithm on one stage: a task, or tasks that are learned together.

    Attributes:
        stage: Positions of the tasks.
        number: Number of the phase within the stage, from 0.
        kind: Phase as the algorithm defines it.
        steps_per_epoch: Number of steps per epoch; None: every window once.
        offset: Number of epochs of the stage's earlier phases.
        curve: Epochs of the phase at which its learning curve has points; empty where success is not its measure.
        select: Weights that are kept, see `EvalSettings`.
        enough: Success at a point of the curve at which training ends; None for all epochs.
    """

    stage: Sequence[int]
    number: int
    kind: Phase
    epochs: int
    steps_per_epoch: int | None
    offset: int
    curve: tuple[int, ...]
    select: Selection
    enough: float | None = None

    @property
    def selects_best(self) -> bool:
        """Whether the weights of the best point are kept, rather than the last ones."""
        return self.select != "last"

    @property
    def task(self) -> int:
        """Position of the last task, which identifies the stage."""
        return self.stage[-1]

    def points(self, results: Results) -> dict[int, float]:
        """Return the mean success over the stage's tasks at each point of the curve that is recorded for all."""
        found = {}
        for epoch in self.curve:
            keys = [("curve", self.task, task, self.offset + epoch) for task in self.stage]
            records = [record for key in keys if (record := results.evaluation(*key)) is not None]
            if len(records) == len(keys):
                found[epoch] = mean_rate(records)
        return found

    def last_epoch(self, results: Results) -> int:
        """Return the epoch at which training ends, as far as points of the curve are recorded."""
        reached = (
            e for e, rate in self.points(results).items() if self.enough is not None and rate >= self.enough
        )
        return next(reached, self.epochs)

    def best_epoch(self, results: Results, until: int) -> int:
        """Return the epoch with the highest recorded success; where the last weights are kept, the last epoch.

        Args:
            results: Records of the run, with at least one point of the curve.
            until: Last epoch to consider.
        """
        if not self.selects_best:
            return self.last_epoch(results)
        rates = {epoch: rate for epoch, rate in self.points(results).items() if epoch <= until}
        return max(rates, key=lambda epoch: (rates[epoch], -epoch if self.select == "first_best" else epoch))

    def missing_points(self, results: Results, before: int | None = None) -> list[int]:
        """Return the epochs whose points of the curve are not recorded, of those before an epoch or of all."""
        found, end = self.points(results), self.last_epoch(results)
        return [e for e in self.curve if e not in found and e < (end + 1 if before is None else before)]


def training_phases(context: RunContext, stage: Sequence[int]) -> list[TrainingPhase]:
    """Return the phases of training on a stage, in order."""
    fit, phases = context.fit, context.algorithm.phases()
    epochs = [max(1, round(fit.epochs * phase.share)) for phase in phases]
    steps = fit.steps_per_epoch and fit.steps_per_epoch * len(stage)  # as many for each task, together or not
    return [
        TrainingPhase(
            stage=stage,
            number=number,
            kind=phase,
            epochs=count,
            steps_per_epoch=steps,
            offset=offset,
            curve=context.eval.curve_epochs(count) if phase.measures_transfer else (),
            select=context.eval.select if phase.measures_transfer else "last",
            enough=context.eval.enough(stage) if phase.measures_transfer else None,
        )
        for number, (phase, count, offset) in enumerate(
            zip(phases, epochs, accumulate(epochs, initial=0), strict=False)
        )
    ]


def missing_points(context: RunContext, stage: Sequence[int], results: Results) -> list[int]:
    """Return the epochs whose points of the learning curve on a stage are not recorded.

    What is measured before the first stage counts as its epoch 0, once its row is measured: pretraining has none.
    """
    found = [epoch for phase in training_phases(context, stage) for epoch in phase.missing_points(results)]
    measured = 0 in stage and results.task_end(stage[-1]) is not None
    lost = measured and any(results.evaluation("initial", 0, task) is None for task in context.untrained)
    return [0, *found] if lost and 0 not in found else found


def unseen_tasks(context: RunContext, stage: Sequence[int]) -> list[int]:
    """Return the tasks that are evaluated after a stage although they are not learned yet, or never."""
    later = [s for s in learning_stages(context.algorithm, context.group_sizes) if s[0] > stage[-1]]
    return context.eval.unseen_tasks(later) if later else [*context.never_learned]


def lacks_row(context: RunContext, stage: Sequence[int], results: Results) -> bool:
    """Return whether a stage's row of the success matrix is incomplete, of the cells that are measured; see `eval`."""
    columns = context.eval.row(stage, len(context.tasks))
    row = [results.evaluation("matrix", stage[-1], seen) for seen in columns]
    row += [results.evaluation("unseen", stage[-1], task) for task in unseen_tasks(context, stage)]
    if context.shift is not None:
        for seen in context.eval.shifted_row(stage, len(context.tasks)):
            row.append(results.evaluation("shift", stage[-1], seen, shift=context.shift.text))
    return None in row or results.task_end(stage[-1]) is None


def is_measured(context: RunContext, results: Results) -> bool:
    """Return whether all learning curves and the success matrix of a run are recorded."""
    stages = learning_stages(context.algorithm, context.group_sizes)
    return not any(
        missing_points(context, stage, results) or lacks_row(context, stage, results) for stage in stages
    )


def mean_rate(records: Sequence[EvalRecord]) -> float:
    """Return the mean success of evaluations; NaN without any."""
    return round(sum(record.rate for record in records) / len(records), 9) if records else math.nan
