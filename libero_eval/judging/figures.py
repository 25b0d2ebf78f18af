"""Figures of a comparison: differences by task, evidence as episodes come in, performance profiles."""

from collections.abc import Mapping

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from libero_eval.judging.comparison import Comparison, Part
from libero_eval.judging.group_scores import Profile
from lifelong.report.figures import INK, LINE_COLOURS, STYLE, hide_spines, legend_below, shorten
from lifelong.stats.episodes import SequentialTest

MOST_ROWS = 60  # of a forest plot


def forest_figure(c: Comparison, control: Comparison | None = None) -> Figure:
    """Draw the difference of every task with its interval; above them all tasks, suites and the control arm.

    Tasks whose difference is significant after Holm are filled. Of more than sixty tasks, those that differ most are
    drawn.

    Args:
        c: The comparison.
        control: One policy twice, drawn above in grey, with a band of what chance alone makes.
    """
    tasks = sorted(c.tasks, key=lambda p: -abs(p.difference.value))[:MOST_ROWS]
    tasks = [p for p in c.tasks if p in tasks]
    parts: list[tuple[Part, str, str]] = [(c.total, "all tasks", INK)]
    parts += [(p, p.name, LINE_COLOURS[0]) for p in c.suites]
    if control:
        parts.append((control.total, "control: one policy twice", LINE_COLOURS[-1]))
    if len(c.tasks) > 1:
        parts += [(p, f"{p.name}  {shorten(p.title, 44)}", LINE_COLOURS[0]) for p in tasks]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.6, 0.7 + 0.2 * len(parts)), layout="constrained")
        axes = figure.subplots()
        for row, (part, _, colour) in enumerate(parts):
            e = part.difference.interval
            strong = part.adjusted is not None and part.adjusted <= 0.05
            axes.plot([100 * e.low, 100 * e.high], [row, row], color=colour, lw=1.6 if row == 0 else 1.1)
            face = colour if strong else "white"
            axes.plot(100 * e.value, row, "s" if row == 0 else "o", ms=4.2, mec=colour, mfc=face, mew=1.0)
        if control and control.total.difference.by_chance is not None:
            band = 100 * control.total.difference.by_chance
            axes.axvspan(-band, band, color=LINE_COLOURS[-1], alpha=0.15, lw=0)
        axes.axvline(0, color=INK, lw=0.6)
        axes.set_yticks(range(len(parts)), [shorten(name) for _, name, _ in parts])
        axes.tick_params(axis="y", length=0)
        axes.set_ylim(len(parts) - 0.4, -0.6)
        axes.set_xlabel(f"{shorten(c.first, 30)} − {shorten(c.second, 30)}, percentage points")
        axes.grid(axis="x", lw=0.4, alpha=0.3, color=INK)
        hide_spines(axes)
    return figure


def sequential_figure(tests: Mapping[str, SequentialTest]) -> Figure:
    """Draw the evidence of each comparison against the number of pairs, with the line at which it is decided.

    Args:
        tests: Sequential tests by label, all with the same alpha.
    """
    alpha = next(iter(tests.values())).alpha
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(5.6, 2.7), layout="constrained")
        axes = figure.subplots()
        lowest = 0.0
        for number, (label, test) in enumerate(tests.items()):
            colour = LINE_COLOURS[number % len(LINE_COLOURS)]
            path = np.concatenate([[0.0], test.log_e]) / np.log(10)
            lowest = min(lowest, float(path.min()))
            axes.step(
                np.arange(len(path)), path, where="post", color=colour, lw=1.3, label=shorten(label, 60)
            )
            if test.decided_after is not None:
                axes.plot(test.decided_after, path[test.decided_after], "o", ms=5, mfc="white", mec=colour)
        axes.axhline(-np.log10(alpha), color=INK, lw=0.7, ls="--")
        axes.set_ylim(bottom=max(lowest - 0.3, -4))
        axes.set_xlabel("pairs, one start of every task after the other")
        axes.set_ylabel("evidence, log₁₀ e")
        hide_spines(axes)
        legend_below(figure)
    return figure


def profile_figure(profiles: Mapping[str, Profile]) -> Figure:
    """Draw the share of runs and tasks whose success is above each threshold, with bands."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(5.6, 2.7), layout="constrained")
        axes = figure.subplots()
        for number, (label, p) in enumerate(profiles.items()):
            colour = LINE_COLOURS[number % len(LINE_COLOURS)]
            axes.plot(100 * p.thresholds, 100 * p.shares, color=colour, lw=1.4, label=shorten(label, 60))
            axes.fill_between(100 * p.thresholds, 100 * p.low, 100 * p.high, color=colour, alpha=0.16, lw=0)
        axes.set_xlim(0, 100)
        axes.set_ylim(0, 101)
        axes.set_xlabel("success above (%)")
        axes.set_ylabel("of runs and tasks (%)")
        hide_spines(axes)
        legend_below(figure)
    return figure
