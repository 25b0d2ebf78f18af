"""Success under held-out perturbations: of each task just after learning it, and of all tasks at the end of a run.

Rollouts under a shift begin in the starts of the success matrix. They are no part of it, nor of its metrics.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from lifelong.results.records import EvalRecord
from lifelong.results.results import Results
from lifelong.stats.intervals import UNKNOWN, Estimate, difference_of, mean_success

Cell = EvalRecord | None


@dataclass(frozen=True)
class ShiftedTask:
    """Evaluations of one task with and without the shift, None where there are none.

    Attributes:
        is_last: Whether nothing was learned after it, so that it cannot be forgotten.
        learned: Just after learning it, without the shift.
        learned_shifted: The same under the shift.
        final: At the end of the run, without the shift.
        final_shifted: The same under the shift.
    """

    task: int
    is_last: bool
    learned: Cell
    learned_shifted: Cell
    final: Cell
    final_shifted: Cell

    def rate(self, name: str) -> float:
        """Return the success rate of one of the four evaluations, NaN where it is missing."""
        found = getattr(self, name)
        return float("nan") if found is None else found.rate

    def forgotten(self, *, shifted: bool) -> float:
        """Return the success just after learning minus that at the end; NaN for what was learned last."""
        names = ("learned_shifted", "final_shifted") if shifted else ("learned", "final")
        return float("nan") if self.is_last else self.rate(names[0]) - self.rate(names[1])


@dataclass(frozen=True)
class ShiftScore:
    """Success and forgetting under one shift, with the same without it.

    The intervals are of starts, at 95 %: see `mean_success`, and `difference_of` for the difference of two means, which
    share their starts: its interval is rather too wide.

    Attributes:
        shift: The perturbations, as text.
        tasks: Evaluations of each task.
    """

    shift: str
    tasks: tuple[ShiftedTask, ...]

    def success(self, name: str) -> Estimate:
        """Return the mean over the tasks of one of the four evaluations; unknown unless all are there."""
        return _mean(getattr(task, name) for task in self.tasks)

    def forgetting(self, *, shifted: bool) -> Estimate:
        """Return the mean forgetting over the tasks after which others were learned; see `ShiftedTask.forgotten`."""
        names = ("learned_shifted", "final_shifted") if shifted else ("learned", "final")
        earlier = [task for task in self.tasks if not task.is_last]
        first, last = (_mean(getattr(task, name) for task in earlier) for name in names)
        return difference_of(first, last)


def shift_scores(results: Results) -> list[ShiftScore]:
    """Return the success under each shift that a run was evaluated under, in the order of the first evaluations."""
    shifts = dict.fromkeys(r.shift for r in results.of(EvalRecord) if r.phase == "shift")
    if not shifts:
        return []
    groups, last = results.run.groups, len(results.run.tasks) - 1
    return [
        ShiftScore(
            shift,
            tuple(
                ShiftedTask(
                    task,
                    last in group,
                    learned=results.evaluation("matrix", group[-1], task),
                    learned_shifted=results.evaluation("shift", group[-1], task, shift=shift),
                    final=results.evaluation("matrix", last, task),
                    final_shifted=results.evaluation("shift", last, task, shift=shift),
                )
                for group in groups
                for task in group
            ),
        )
        for shift in shifts
    ]


def shift_summary(results: Results) -> list[dict[str, object]]:
    """Return the success under each shift as plain data, rates in [0, 1]."""
    names = ("learned", "learned_shifted", "final", "final_shifted")
    return [
        {
            "shift": score.shift,
            **{name: vars(score.success(name)) for name in names},
            "forgetting": vars(score.forgetting(shifted=False)),
            "forgetting_shifted": vars(score.forgetting(shifted=True)),
            "tasks": [
                {"task": task.task, **{name: task.rate(name) for name in names}} for task in score.tasks
            ],
        }
        for score in shift_scores(results)
    ]


def _mean(cells: Iterable[Cell]) -> Estimate:
    """Return the mean success of cells; unknown unless all are there."""
    counts = [cell and (sum(cell.successes), len(cell.successes)) for cell in cells]
    return mean_success(*zip(*counts, strict=True)) if counts and all(counts) else UNKNOWN
