"""Figures of robustness: success against severity for every kind, and what is kept as a radar picture."""

import math
from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from libero_eval.robustness.results import Axis
from lifelong.report.figures import INK, LINE_COLOURS, LINE_MARKERS, STYLE, hide_spines, legend_below, shorten

COLUMNS = 4


def curves_figure(policies: Mapping[str, Sequence[Axis]], units: Mapping[str, str]) -> Figure:
    """Draw success against severity with intervals, one panel for each kind, in the order of the first policy.

    Args:
        policies: Label of each policy and its axes.
        units: What severity 1 is, by kind; a second line of the panel's title.
    """
    first = next(iter(policies.values()))
    columns, rows = min(COLUMNS, len(first)), math.ceil(len(first) / COLUMNS)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(2.15 * columns + 0.4, 1.95 * rows + 0.3), layout="constrained")
        grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
        for axes in grid.flat[len(first) :]:
            axes.set_axis_off()
        named = set[str]()  # policies that are in the legend
        for place, kind in enumerate(axis.kind for axis in first):
            axes = grid.flat[place]
            for number, (label, found) in enumerate(policies.items()):
                axis = next((a for a in found if a.kind == kind), None)
                if axis is not None:
                    _draw_axis(axes, axis, number, "" if label in named else shorten(label, 60))
                    named.add(label)
            axes.set_title(f"{kind}\n{shorten(units.get(kind, ''), 34)}".strip(), loc="left", fontsize=8)
            axes.set_xlim(-0.03, 1.03)
            axes.set_ylim(0, 102)
            axes.set_xticks((0, 0.5, 1), ("0", "½", "1"))
            axes.grid(axis="y", lw=0.4, alpha=0.3, color=INK)
            hide_spines(axes)
            if place % columns == 0:
                axes.set_ylabel("success (%)")
            if place + columns >= len(first):
                axes.set_xlabel("severity")
        legend_below(figure)
    return figure


def radar_figure(policies: Mapping[str, Sequence[Axis]]) -> Figure:
    """Draw the success that is to be expected along each kind, its area, as a radar picture.

    Args:
        policies: Label of each policy and its axes; kinds are in the order of the first, by name.
    """
    kinds = sorted(axis.kind for axis in next(iter(policies.values())))
    angles = np.linspace(0, 2 * np.pi, len(kinds), endpoint=False)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(4.4, 4.2), layout="constrained")
        axes = figure.add_subplot(projection="polar")
        axes.set_theta_offset(np.pi / 2)  # type: ignore[attr-defined]  # of polar axes
        axes.set_theta_direction(-1)  # type: ignore[attr-defined]
        for number, (label, found) in enumerate(policies.items()):
            areas = {axis.kind: 100 * axis.area.value for axis in found}
            values = [areas.get(kind, np.nan) for kind in kinds]
            colour = LINE_COLOURS[number % len(LINE_COLOURS)]
            closed = [*values, values[0]], [*angles, angles[0]]
            style = "-" if number == 0 else "--"
            marker = LINE_MARKERS[number % len(LINE_MARKERS)]  # shows a kind without neighbours
            axes.plot(
                closed[1],
                closed[0],
                color=colour,
                lw=1.5,
                ls=style,
                marker=marker,
                ms=2.5,
                label=shorten(label, 60),
            )
            if number == 0:
                axes.fill(closed[1], closed[0], color=colour, alpha=0.15, lw=0)
        axes.set_ylim(0, 100)
        axes.set_yticks((25, 50, 75, 100), ("25", "50", "75", "100 %"), fontsize=6.5)
        axes.set_xticks(angles, kinds)
        axes.tick_params(axis="x", pad=2)
        for text, angle in zip(axes.get_xticklabels(), angles, strict=True):
            side = round(np.sin(angle), 3)  # labels grow away from the circle
            text.set_horizontalalignment("left" if side > 0 else "right" if side < 0 else "center")
        axes.set_rlabel_position(180 / len(kinds))  # type: ignore[attr-defined]  # between two kinds
        axes.grid(lw=0.4, alpha=0.4, color=INK)
        axes.spines["polar"].set_linewidth(0.5)
        legend_below(figure)
    return figure


def _draw_axis(axes: matplotlib.axes.Axes, axis: Axis, number: int, label: str) -> None:
    colour, marker = LINE_COLOURS[number % len(LINE_COLOURS)], LINE_MARKERS[number % len(LINE_MARKERS)]
    low, mean, high = (
        100 * np.array([getattr(e, name) for e in axis.success]) for name in ("low", "value", "high")
    )
    style = "-" if number == 0 else "--"
    axes.fill_between(axis.severities, low, high, color=colour, alpha=0.16 if number == 0 else 0.08, lw=0)
    axes.plot(
        axis.severities,
        mean,
        color=colour,
        lw=1.4,
        ls=style,
        marker=marker,
        ms=3,
        label=label or None,
        clip_on=False,
    )
