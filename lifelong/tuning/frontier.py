"""What values of a setting keep and let learn, and which of them is best."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Errors = list[list[float]]  # of one trial: after each stage, the error on each task so far


@dataclass(frozen=True)
class Ratio:
    """A factor on errors over several trials: their geometric mean, the least and the largest."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        if f"{self.low:.2f}" == f"{self.high:.2f}":
            return f"{self.value:.2f}"
        return f"{self.value:.2f} [{self.low:.2f}, {self.high:.2f}]"


@dataclass(frozen=True)
class Outcome:
    """What one value of the settings came to.

    All are factors on the errors that fine-tuning leaves on a task that it has just learned: 1 is as good as that, 2
    has twice the error.

    Attributes:
        label: The value, as the tables name it.
        settings: Values of the settings by dotted key; none of an algorithm that is shown to compare with.
        trials: Errors of each trial, one for each stream and seed.
        fine_tuning: Errors of fine-tuning in the same trials.
    """

    label: str
    settings: dict[str, Any]
    trials: tuple[Errors, ...]
    fine_tuning: tuple[Errors, ...]

    @cached_property
    def _logs(self) -> list[NDArray[np.float64]]:
        """Logarithms of the factors at the end, of each trial, (K,)."""
        return [
            np.log([error / base[task][task] for task, error in enumerate(errors[-1])])
            for errors, base in zip(self.trials, self.fine_tuning, strict=True)
        ]

    @property
    def kept(self) -> Ratio:
        """Error on the earlier tasks at the end."""
        return _ratio([logs[:-1].mean() for logs in self._logs])

    @property
    def learned(self) -> Ratio:
        """Error on the newest task at the end."""
        return _ratio([logs[-1] for logs in self._logs])

    @property
    def score(self) -> Ratio:
        """Error on all tasks at the end, which the choice makes least."""
        return _ratio([logs.mean() for logs in self._logs])

    @property
    def errors(self) -> tuple[float, float]:
        """Mean error on the earlier tasks and on the newest one at the end, in units of the actions."""
        last = [errors[-1] for errors in self.trials]
        return float(np.mean([np.mean(e[:-1]) for e in last])), float(np.mean([e[-1] for e in last]))


def _ratio(logs: Sequence[float]) -> Ratio:
    value, low, high = np.exp([np.mean(logs), np.min(logs), np.max(logs)])
    return Ratio(float(value), float(low), float(high))


@dataclass(frozen=True)
class Frontier:
    """Values of the settings, in the order given, and algorithms to compare with.

    Attributes:
        outcomes: The values.
        others: Algorithms that are shown beside them.
    """

    outcomes: tuple[Outcome, ...]
    others: tuple[Outcome, ...] = ()

    @property
    def chosen(self) -> Outcome:
        """The value with the least error on all tasks at the end; of equal ones the first."""
        return min(self.outcomes, key=lambda outcome: outcome.score.value)

    def is_efficient(self, outcome: Outcome) -> bool:
        """Return whether no other value keeps and lets learn at least as well, and one of both better."""
        mine = outcome.kept.value, outcome.learned.value
        return not any(
            (kept := other.kept.value) <= mine[0]
            and (learned := other.learned.value) <= mine[1]
            and (kept, learned) != mine
            for other in self.outcomes
        )

    def at_edge(self) -> bool:
        """Return whether the chosen value is the first or the last of several: a better one may lie beyond."""
        return len(self.outcomes) > 1 and self.chosen in (self.outcomes[0], self.outcomes[-1])


def render(frontier: Frontier, default: str | None) -> str:
    """Return the frontier as a table in Markdown.

    Args:
        frontier: What was measured.
        default: Label of the value that is used without tuning; None where it is not among them.
    """
    rows = [("value", "kept", "learned", "all", "error kept", "error learned", "")]
    for outcome in (*frontier.outcomes, *frontier.others):
        marks = []
        if outcome in frontier.outcomes and frontier.is_efficient(outcome):
            marks.append("frontier")
        if outcome is frontier.chosen:
            marks.append("**chosen**")
        if outcome in frontier.outcomes and outcome.label == default:
            marks.append("default")
        kept, learned = (f"{error:.3f}" for error in outcome.errors)
        factors = (str(outcome.kept), str(outcome.learned), str(outcome.score))
        rows.append((outcome.label, *factors, kept, learned, ", ".join(marks)))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["| " + " | ".join(map(str.ljust, row, widths)) + " |" for row in rows]
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join(lines)
