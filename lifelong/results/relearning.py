"""What relearning came to: steps until a forgotten task is back, beside learning it for the first time."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from libero_env.text import Table
from lifelong.results.log import ResultLog
from lifelong.results.records import RelearnRecord

FILE_NAME = "relearning.jsonl"  # in the run's directory


@dataclass(frozen=True)
class Savings:
    """One task, relearned and learned for the first time under the same conditions.

    Attributes:
        learned_error: What was measured when the run had just learned it: the error on held-out demonstrations, or the
            share of failed rollouts.
        final_error: The same at the end of the run.
        again: Number of steps from the end of the run until it was back; None if it was given up.
        first: Number of steps from the run's initial weights; None if it was given up, or not measured.
        again_tried: Largest number of steps from the end of the run.
        first_tried: Largest number of steps from the initial weights; None if it was not measured.
        every: Number of steps between measurements, 0 if there was only one.
    """

    task: int
    learned_error: float
    final_error: float
    again: int | None
    first: int | None
    again_tried: int
    first_tried: int | None
    every: int

    @property
    def share(self) -> float | None:
        """Savings (Ebbinghaus 1885): the share of the first steps that relearning does without, 1 if none is needed.

        Below 0, relearning takes longer. None unless both ended.
        """
        if self.again is None or not self.first:
            return None
        return 1 - self.again / self.first


def read_relearning(run: Path) -> list[RelearnRecord]:
    """Return what `libero relearn` has measured in a run's directory; nothing without its file.

    Raises:
        ResultsError: The file cannot be read.
    """
    file = run / FILE_NAME
    return ResultLog(file).read().of(RelearnRecord) if file.is_file() else []


def by_measure(records: Sequence[RelearnRecord]) -> list[list[RelearnRecord]]:
    """Part records by their settings and their initial weights, errors before rollouts; without what is not paired."""
    parts = []
    for setting in sorted({_setting(r) for r in records if r.start == "final"}):
        same = [r for r in records if _setting(r) == setting]
        for weights in sorted({r.weights for r in same if r.start == "initial"}) or [""]:
            parts.append([r for r in same if r.start == "final" or r.weights == weights])
    return parts


def _setting(record: RelearnRecord) -> tuple[float, ...]:
    return record.episodes, record.held_out, record.tolerance, record.rate


def savings(records: Sequence[RelearnRecord]) -> list[Savings]:
    """Pair the starts of each task, the latest of each.

    Args:
        records: One part of `by_measure`, in the order they were written.
    """
    found = []
    for task in sorted({r.task for r in records}):
        last = next((r for r in reversed(records) if (r.task, r.start) == (task, "final")), None)
        if last is None:
            continue
        rivals = [
            r
            for r in records
            if (r.task, r.start) == (task, "initial") and r.learned_error == last.learned_error
            if len({b - a for one in (r, last) for a, b in pairwise(one.steps)}) < 2  # measured as often
        ]
        first = rivals[-1] if rivals else None
        needed, tried = (first.needed, first.steps[-1]) if first else (None, None)
        errors = last.learned_error, last.errors[0]
        every = max(b - a for one in (last, first or last) for a, b in pairwise((*one.steps[:1], *one.steps)))
        found.append(Savings(task, *errors, last.needed, needed, last.steps[-1], tried, every))
    return found


def savings_table(records: Sequence[RelearnRecord]) -> Table:
    """Return the savings of one part of `by_measure`, a row for each task, counted from 1."""
    one = records[0]
    what, on = (
        ("success", f"{one.episodes} rollouts") if one.episodes else ("error", f"{one.held_out} held out")
    )
    shown = _percent if one.episodes else "{:.3f}".format
    weights = next((f" (weights {r.weights[:8]})" for r in records if r.weights), "")
    again, first = f"steps again (tolerance {one.tolerance:g}, {on})", f"steps at first{weights}"
    heads = ("task", f"{what} just learned", f"{what} at the end", again, first, "savings", "measured every")
    rows = [
        (
            *(row.task + 1, shown(row.learned_error), shown(row.final_error)),
            _steps(row.again, row.again_tried),
            "–" if row.first_tried is None else _steps(row.first, row.first_tried),
            "–" if row.share is None else f"{100 * row.share:.0f} %".replace("-", "−"),
            f"{row.every} steps" if row.every else "–",
        )
        for row in savings(records)
    ]
    return Table(heads, rows, left=0)


def _percent(failed: float) -> str:
    """Return the success rate of a share of failed rollouts."""
    return f"{100 * (1 - failed):.0f} %"


def _steps(needed: int | None, tried: int) -> str:
    return f"> {tried}" if needed is None else str(needed)
