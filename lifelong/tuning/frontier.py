"""What values of a setting keep and let learn, and which of them is best: as a table, a picture and files."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import yaml
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator
from numpy.typing import NDArray

from libero_env.storage import atomic_write_text, write_json
from lifelong.report.figures import INK, LINE_COLOURS, STYLE, save

Errors = list[list[float]]  # of one trial: after each stage, the error on each task so far
_TICKS = (1.0, 1.05, 1.1, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 8.0, 9.0)  # of factors
_FEW_TICKS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)  # where an axis is longer than a factor of two


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


@matplotlib.rc_context(STYLE)
def draw_frontier(frontier: Frontier, title: str, stem: Path) -> None:
    """Draw what is kept against what is learned and write `stem`.png and `stem`.pdf; below and left is better.

    Values are joined in their order, with bars from the least to the largest trial. On the dashed line, all tasks
    together have the error of the chosen value.

    Args:
        frontier: What was measured.
        title: Title of the picture.
        stem: Path without suffix.
    """
    figure = Figure(figsize=(4.6, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.set(xscale="log", yscale="log")
    learned = [o.learned.value for o in frontier.outcomes]
    axes.plot(learned, [o.kept.value for o in frontier.outcomes], color=LINE_COLOURS[0], lw=0.8, alpha=0.6)
    for outcome in frontier.outcomes:
        chosen = outcome is frontier.chosen
        _point(axes, outcome, "o", LINE_COLOURS[0], filled=frontier.is_efficient(outcome), large=chosen)
    for outcome in frontier.others:
        _point(axes, outcome, "s", LINE_COLOURS[-1], filled=True, large=False)
    _equal_scores(axes, frontier.chosen)
    _name_points(axes, frontier)
    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        axis.set_major_locator(LogLocator(base=10, subs=_FEW_TICKS if high > 2 * low else _TICKS))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
        axis.set_minor_formatter(NullFormatter())
    axes.set(
        xlabel="error on the newest task\n(1: just learned by fine-tuning)", ylabel="error on earlier tasks"
    )
    axes.set_title(title, loc="left")
    save(figure, stem)


def _point(axes: Axes, outcome: Outcome, marker: str, colour: str, *, filled: bool, large: bool) -> None:
    x, y = outcome.learned, outcome.kept
    xerr, yerr = ([[r.value - r.low], [r.high - r.value]] for r in (x, y))
    axes.errorbar(
        x.value, y.value, xerr=xerr, yerr=yerr, fmt="none", ecolor=colour, elinewidth=0.6, alpha=0.5
    )
    face = colour if filled else "white"
    axes.plot(x.value, y.value, marker, ms=8 if large else 5, mec=colour, mfc=face, mew=1.2)


def _name_points(axes: Axes, frontier: Frontier) -> None:
    """Write each value beside its point, at the corner that is farthest from other points and names."""
    outcomes = [*frontier.outcomes, *frontier.others]
    places = axes.transData.transform([(o.learned.value, o.kept.value) for o in outcomes])
    taken = list(places)
    for outcome, place in zip(outcomes, places, strict=True):
        width = 4.5 * len(outcome.label)  # of its text, [points]
        middles = {(x, y): place + (x + np.sign(x) * width / 2, y + 4) for x in (6, -6) for y in (5, -12)}
        rest = [other for other in taken if other is not place]
        corner = max(
            middles,
            key=lambda c: min((np.hypot(*((middles[c] - other) / (width, 10))) for other in rest), default=0),
        )
        taken.append(middles[corner])
        axes.annotate(
            outcome.label,
            (outcome.learned.value, outcome.kept.value),
            corner,
            textcoords="offset points",
            fontsize=8,
            weight="bold" if outcome is frontier.chosen else "normal",
            ha="left" if corner[0] > 0 else "right",
        )


def _equal_scores(axes: Axes, chosen: Outcome) -> None:
    """Draw where kept^(K-1) learned is that of the chosen value."""
    earlier = len(chosen.trials[0][-1]) - 1
    limits = axes.get_xlim(), axes.get_ylim()
    x = np.geomspace(*limits[0], 50)
    y = chosen.kept.value * (chosen.learned.value / x) ** (1 / earlier)
    axes.plot(x, y, color=INK, lw=0.7, ls="--", alpha=0.6, scalex=False, scaley=False)
    axes.set_xlim(limits[0])
    axes.set_ylim(limits[1])


def write_frontier(frontier: Frontier, path: Path, about: Mapping[str, Any]) -> None:
    """Write a frontier with all errors to a JSON file.

    Args:
        frontier: What was measured.
        about: What else is to be known: command, tasks, versions.
    """
    record = {
        **about,
        "chosen": frontier.chosen.settings,
        "values": [_row(outcome) for outcome in frontier.outcomes],
        "others": [_row(outcome) for outcome in frontier.others],
    }
    write_json(path, record)


def _row(outcome: Outcome) -> dict[str, Any]:
    return {
        "label": outcome.label,
        "settings": outcome.settings,
        **{name: asdict(getattr(outcome, name)) for name in ("kept", "learned", "score")},
        "errors": outcome.trials,
    }


def write_tuned(outcome: Outcome, path: Path, about: str) -> None:
    """Write a value of an algorithm's settings as a file of the configuration group `tuned`.

    Args:
        outcome: The chosen value.
        about: Where it comes from; a comment at the top.
    """
    node: dict[str, Any] = {}
    for key, value in outcome.settings.items():
        _, *names = key.split(".")  # of algo
        place = node
        for name in names[:-1]:
            place = place.setdefault(name, {})
        place[names[-1]] = value
    comment = "".join(f"# {line}\n" for line in about.splitlines())
    atomic_write_text(path, comment + yaml.safe_dump(node, sort_keys=False))
