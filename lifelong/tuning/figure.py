"""The picture of a frontier of retention and plasticity."""

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

from lifelong.report.figures import INK, LINE_COLOURS, STYLE, hide_spines, save
from lifelong.tuning.frontier import Frontier, Outcome

_TICKS = (1.0, 1.05, 1.1, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 8.0, 9.0)  # of factors
_FEW_TICKS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)  # where an axis is longer than a factor of two


def draw_frontier(frontier: Frontier, title: str, stem: Path) -> None:
    """Draw what is kept against what is learned and write `stem`.png and `stem`.pdf; below and left is better.

    Values are joined in their order, with bars from the least to the largest trial. On the dashed line, all tasks
    together have the error of the chosen value.

    Args:
        frontier: What was measured.
        title: Title of the picture.
        stem: Path without suffix.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(4.6, 3.6), layout="constrained")
        axes = figure.subplots()
        axes.set_xscale("log")
        axes.set_yscale("log")
        learned = [o.learned.value for o in frontier.outcomes]
        axes.plot(
            learned, [o.kept.value for o in frontier.outcomes], color=LINE_COLOURS[0], lw=0.8, alpha=0.6
        )
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
        axes.set_xlabel("error on the newest task\n(1: just learned by fine-tuning)")
        axes.set_ylabel("error on earlier tasks")
        axes.set_title(title, loc="left")
        hide_spines(axes)
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
