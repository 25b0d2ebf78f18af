"""What values of a setting keep and let learn, and which of them is best: as a table, a picture and files."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import yaml
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from libero_env.storage import atomic_write_text, write_json
from lifelong.report.figures import LINE_COLOURS, STYLE, save


@dataclass(frozen=True)
class Measured:
    """What one trial came to.

    Attributes:
        success: Share of successful rollouts on each task at the end, (K,).
        weights: Digest of the policy at the end.
        seconds: Wall time of learning and of the rollouts, [s].
    """

    success: list[float]
    weights: str = ""
    seconds: list[float] = field(default_factory=lambda: [0.0, 0.0])


@dataclass(frozen=True)
class Rate:
    """A success rate over several trials: their mean, the least and the largest."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        shown = f"{self.value:.0%}"
        return shown if self.low == self.high else f"{shown} [{self.low:.0%}, {self.high:.0%}]"


@dataclass(frozen=True)
class Outcome:
    """What one value of the settings came to.

    Attributes:
        label: The value, as the tables name it.
        settings: Values of the settings by dotted key; none of an algorithm that is shown to compare with.
        trials: What each trial came to, one for each stream and seed.
    """

    label: str
    settings: dict[str, Any]
    trials: tuple[Measured, ...]

    @property
    def kept(self) -> Rate:
        """Success on the earlier tasks at the end."""
        return _rate([np.mean(one.success[:-1]) for one in self.trials])

    @property
    def learned(self) -> Rate:
        """Success on the newest task at the end."""
        return _rate([one.success[-1] for one in self.trials])

    @property
    def score(self) -> Rate:
        """Success on all tasks at the end, which the choice makes largest."""
        return _rate([np.mean(one.success) for one in self.trials])

    @property
    def seconds(self) -> tuple[float, float]:
        """Mean wall time of a trial's learning and of its rollouts, [s]."""
        learning, rollouts = np.mean([one.seconds for one in self.trials], axis=0)
        return float(learning), float(rollouts)


def _rate(values: Sequence[Any]) -> Rate:
    return Rate(float(np.mean(values)), float(np.min(values)), float(np.max(values)))


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
        """The value with the largest success on all tasks at the end; of equal ones the first."""
        return max(self.outcomes, key=lambda outcome: outcome.score.value)

    def equals(self) -> tuple[Outcome, ...]:
        """Return the values whose success on all tasks is that of the chosen one, which is among them."""
        return tuple(one for one in self.outcomes if one.score.value == self.chosen.score.value)

    def is_efficient(self, outcome: Outcome) -> bool:
        """Return whether no other value keeps and lets learn at least as well, and one of both better."""
        mine = outcome.kept.value, outcome.learned.value
        return not any(
            (kept := other.kept.value) >= mine[0]
            and (learned := other.learned.value) >= mine[1]
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
    rows: list[tuple[str, ...]] = [("value", "kept", "learned", "all", "s: learning", "rollouts", "")]
    for outcome in (*frontier.outcomes, *frontier.others):
        marks = []
        if outcome in frontier.outcomes and frontier.is_efficient(outcome):
            marks.append("frontier")
        if outcome is frontier.chosen:
            marks.append("**chosen**")
        if outcome in frontier.outcomes and outcome.label == default:
            marks.append("default")
        rates = (str(outcome.kept), str(outcome.learned), str(outcome.score))
        rows.append((outcome.label, *rates, *(f"{s:.0f}" for s in outcome.seconds), ", ".join(marks)))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["| " + " | ".join(map(str.ljust, row, widths)) + " |" for row in rows]
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join(lines)


@matplotlib.rc_context(STYLE)
def draw_frontier(frontier: Frontier, title: str, stem: Path) -> None:
    """Draw what is kept against what is learned and write `stem`.png and `stem`.pdf; above and right is better.

    Values are joined in their order, with bars from the least to the largest trial.

    Args:
        frontier: What was measured.
        title: Title of the picture.
        stem: Path without suffix.
    """
    figure = Figure(figsize=(4.6, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.set(xlim=(-0.05, 1.05), ylim=(-0.05, 1.05))
    learned = [o.learned.value for o in frontier.outcomes]
    axes.plot(learned, [o.kept.value for o in frontier.outcomes], color=LINE_COLOURS[0], lw=0.8, alpha=0.6)
    for outcome in frontier.outcomes:
        chosen = outcome is frontier.chosen
        _point(axes, outcome, "o", LINE_COLOURS[0], filled=frontier.is_efficient(outcome), large=chosen)
    for outcome in frontier.others:
        _point(axes, outcome, "s", LINE_COLOURS[-1], filled=True, large=False)
    _name_points(axes, frontier)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(PercentFormatter(1, 0))
    axes.set(xlabel="success on the newest task", ylabel="success on earlier tasks")
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


def write_frontier(frontier: Frontier, path: Path, about: Mapping[str, Any]) -> None:
    """Write a frontier with what all trials came to to a JSON file.

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
        "trials": [asdict(one) for one in outcome.trials],
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
