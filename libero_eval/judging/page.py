"""A comparison as plain text for a terminal, and as a self-contained page with its figures."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from libero_env.sim.causes import CAUSES
from libero_env.text import Cell, Table
from libero_eval.judging.comparison import Comparison, Contrast, Gate, Row
from libero_eval.judging.group_scores import GroupScores, Profile
from libero_eval.stats.sequential import SequentialTest
from lifelong.report.figures import INK, LINE_COLOURS, STYLE, as_svg, legend_below, shorten
from lifelong.report.tables import percent, save_page
from lifelong.results.failures import NOT_SEEN, QUADRANTS, anything_seen
from lifelong.stats.intervals import Estimate

WORST = 5  # tasks in the table of a terminal
MOST_ROWS = 60  # of a forest plot
OVER_RUNS = (
    "over runs, of the starts that all have (rliable; intervals draw runs anew, too narrow for less than 5)"
)
OF_ONE = ("tasks", "episodes", "finished")  # facts that are not of all results of a page


def render(comparison: Comparison, *, tasks: bool = False) -> str:
    """Return the tables of a comparison.

    Args:
        tasks: Whether to show every task instead of those that differ most.
    """
    blocks = [str(_rates(comparison)) if comparison.rates else "control arm only"]
    blocks += map(str, _tallies(comparison).values())
    blocks += [_contrast_text(c, comparison.alpha, tasks) for c in comparison.comparisons]
    for c in comparison.controls:
        head = f"control arm: {c.first} − {c.second}, one policy twice"
        blocks.append("\n".join([head, chance_text(c), "", str(_table(c, (c.total, *c.suites)))]))
    if comparison.groups:
        table, lines = _groups(comparison.groups)
        blocks.append("\n".join([OVER_RUNS, str(table), *lines]))
    blocks += ["\n".join(f"note: {note}" for note in comparison.notes)] if comparison.notes else []
    return "\n\n".join(blocks)


def verdict(c: Contrast, alpha: float) -> str:
    """Return one sentence on what a comparison shows."""
    d, p = c.total.difference, c.total.adjusted
    assert p is not None
    tested = f"{p_equation(p)}{' after Holm' if p != d.p_value else ''}, {d.test}"
    if p <= alpha:
        better, worse = (c.first, c.second) if d.value > 0 else (c.second, c.first)
        return f"{better} is better than {worse} in these starts: {points(d.interval)} points ({tested})."
    text = f"No difference is shown: {c.first} − {c.second} is {points(d.interval)} points ({tested})."
    if math.isfinite(c.shown):
        text += (
            f" {d.pairs} pairs that differ as often show a difference of {100 * c.shown:.1f} points "
            "in four of five cases."
        )
    return text


def gate_text(g: Gate, comparison: Comparison) -> str:
    """Return one sentence on what a gate decided, and why."""
    (first, second), level = (rate.label for rate in comparison.rates), 100 * (1 - comparison.alpha)
    low, high = (f"{100 * end:.1f}".replace("-", "−") for end in (g.loss.low, g.loss.high))
    found = f"{second} loses {points(g.loss)} points against {first} in {g.pairs} starts"
    margin = f"the margin of {100 * g.margin:g}"
    told = {
        "regression": f"all of the {level:g} % interval is above {margin}",
        "no regression": f"the {level:g} % interval ends at {high}, not above {margin}",
        "undecided": f"the {level:g} % interval from {low} to {high} contains {margin}",
    }
    more = f"; about {g.enough} starts that differ as often would decide" if g.enough else ""
    return f"{g.verdict}: {found}, {told[g.verdict]}{more if g.verdict == 'undecided' else ''}"


def sequential_text(c: Contrast) -> str:
    """Return one sentence on the test that may be stopped early."""
    assert c.sequential is not None
    test, count = c.sequential, c.total.difference.pairs
    if test.decided_after is None:
        return f"Stopped at any time: not decided after {count} pairs ({p_equation(test.p_value)}); more may be added."
    better = c.first if test.first_better else c.second
    return (
        f"Stopped at any time: decided for {better} after {test.decided_after} of {count} pairs "
        f"({p_equation(test.p_value)})."
    )


def chance_text(c: Contrast) -> str:
    """Return one sentence on what a control arm shows."""
    d = c.total.difference
    if d.counts is None or d.by_chance is None:
        return f"One policy twice differs by {points(d.interval)} points by chance alone."
    return (
        f"One policy twice differs in {d.counts.discordant} of {d.pairs} starts; by chance alone that makes up to "
        f"±{100 * d.by_chance:.1f} points in 19 of 20 comparisons."
    )


def points(e: Estimate) -> str:
    """Format a difference with its interval in percentage points: +1.8 [0.6, 3.0]."""
    return f"{100 * e.value:+.1f} {interval_text(e)}".replace("-", "−")


def interval_text(e: Estimate) -> str:
    """Format an interval in percentage points; nothing where it is unknown."""
    return (
        f"[{100 * e.low:.1f}, {100 * e.high:.1f}]".replace("-", "−") if math.isfinite(e.low + e.value) else ""
    )


def p_text(p: float) -> str:
    """Format a p-value: three digits after the point, or that it is smaller."""
    return f"{p:.3f}" if p >= 0.001 else "< 0.001"


def p_equation(p: float) -> str:
    """Format a p-value in a sentence: p = 0.012, p < 0.001."""
    return f"p = {p_text(p)}" if p >= 0.001 else f"p {p_text(p)}"


def _rates(comparison: Comparison) -> Table:
    """Return the table of the policies."""
    return Table(
        ("policy", "runs", "episodes", "errors", "success %", "95 %"),
        [
            [
                Cell(r.label, ", ".join(r.paths)),
                *(r.runs, r.episodes, r.errors),
                Cell(percent(r.success.value), strong=True),
                interval_text(r.success),
            ]
            for r in comparison.rates
        ],
    )


def _tallies(comparison: Comparison) -> dict[str, Table]:
    """Return tables of episodes by outcome, with a row for each policy."""
    kinds = (
        ("failed because", CAUSES, [r.causes for r in comparison.rates]),
        ("safety", QUADRANTS, [r.safety for r in comparison.rates]),
    )
    tables = {}
    for head, names, found in kinds:
        outcomes = [name for name in (*names, NOT_SEEN) if any(name in counts for counts in found)]
        if anything_seen(*found):
            rows = zip(comparison.rates, found, strict=True)
            cells = [[r.label, *(counts.get(name, 0) for name in outcomes)] for r, counts in rows]
            tables[head] = Table((head, *outcomes), cells)
    return tables


def _contrast_text(c: Contrast, alpha: float, all_tasks: bool) -> str:
    lines = [verdict(c, alpha)]
    lines += [sequential_text(c)] if c.sequential else []
    lines += ["", str(_table(c, (c.total, *c.suites), alpha))]
    moved = [p for p in c.tasks if p.difference.value != 0]
    shown = c.tasks if all_tasks else sorted(moved, key=lambda p: -abs(p.difference.value))[:WORST]
    if shown and len(c.tasks) > 1:
        head = "every task" if all_tasks else f"tasks that differ most (of {len(c.tasks)})"
        lines += ["", f"{head}; Holm over the tasks", str(_table(c, shown, alpha))]
    return "\n".join(lines)


def _table(c: Contrast, rows: Sequence[Row], alpha: float = 0.0) -> Table:
    """Return the table of differences; bold where they remain after Holm's adjustment."""
    first, second = (name if len(name) <= 16 else f"…{name[-15:]}" for name in (c.first, c.second))
    heads = [Cell(f"{first} %"), Cell(f"{second} %"), "difference", "95 %", f"only {first}", f"only {second}"]
    return Table(["", "pairs", *heads, Cell("p"), "Holm"], [_cells(row, alpha) for row in rows])


def _cells(row: Row, alpha: float) -> list[object]:
    d, adjusted = row.difference, row.adjusted
    return [
        Cell(row.name, row.title),
        d.pairs,
        percent(d.first),
        percent(d.second),
        Cell(f"{100 * d.value:+.1f}".replace("-", "−"), strong=adjusted is not None and adjusted <= alpha),
        interval_text(d.interval),
        *([d.counts.only_first, d.counts.only_second] if d.counts else ["–", "–"]),
        p_text(d.p_value),
        "–" if adjusted is None else p_text(adjusted),
    ]


def _discordant(c: Contrast) -> Table | None:
    """Return the table of starts by outcome; None where a policy has several runs."""
    if (n := c.total.difference.counts) is None:
        return None
    return Table(
        ("", Cell(f"{c.second} succeeds"), Cell(f"{c.second} fails")),
        [
            [f"{c.first} succeeds", n.both, Cell(n.only_first, strong=True)],
            [f"{c.first} fails", Cell(n.only_second, strong=True), n.neither],
        ],
    )


def _groups(g: GroupScores) -> tuple[Table, list[str]]:
    """Return the table of aggregates over runs, and a line for each pair of methods."""
    rows = [
        [
            name,
            count,
            *(text for e in (g.mean[name], g.iqm[name]) for text in (percent(e.value), interval_text(e))),
        ]
        for name, count in g.runs.items()
    ]
    return Table(("", "runs", "mean %", "95 %", "IQM %", "95 %"), rows), [
        f"a run of {a} beats one of {b} on a task with probability {e.value:.2f} [{e.low:.2f}, {e.high:.2f}]"
        for (a, b), e in g.improvement.items()
    ]


def write_page(comparison: Comparison, path: Path) -> Path:
    """Write the page; it needs no other file and no network.

    Raises:
        ResultsError: The file cannot be written.
    """
    tests = {f"{c.first} − {c.second}": c.sequential for c in comparison.comparisons if c.sequential}
    return save_page(
        path,
        "libero_eval.judging",
        title=_title(comparison),
        rates=_rates(comparison),
        tallies=_tallies(comparison),
        comparisons=[_contrast_content(c, comparison) for c in comparison.comparisons],
        controls=[(chance_text(c), _table(c, (c.total, *c.suites))) for c in comparison.controls],
        notes=comparison.notes,
        facts=[fact for fact in comparison.facts if fact[0] not in OF_ONE],
        groups=_groups(comparison.groups) if comparison.groups else None,
        alpha=comparison.alpha,
        sequential=as_svg(sequential_figure(tests)) if tests else None,
        profiles=as_svg(profile_figure(comparison.groups.profiles)) if comparison.groups else None,
        interval_text=interval_text,
    )


def _title(comparison: Comparison) -> str:
    names = [r.label for r in comparison.rates] or [
        comparison.controls[0].first,
        comparison.controls[0].second,
    ]
    return " against ".join(names) if len(names) < 4 else f"{len(names)} policies compared"


def _contrast_content(c: Contrast, comparison: Comparison) -> dict[str, Any]:
    return {
        "comparison": c,
        "table": _table(c, (c.total, *c.suites), comparison.alpha),
        "tasks": _table(c, c.tasks, comparison.alpha),
        "discordant": _discordant(c),
        "verdict": verdict(c, comparison.alpha),
        "sequential": sequential_text(c) if c.sequential else None,
        "forest": as_svg(forest_figure(c, comparison.alpha, *comparison.controls[:1])),
    }


@matplotlib.rc_context(STYLE)
def forest_figure(c: Contrast, alpha: float, control: Contrast | None = None) -> Figure:
    """Draw the difference of every task with its interval; above them all tasks, suites and the control arm.

    Tasks whose difference is significant after Holm are filled. Of more than sixty tasks, those that differ most are
    drawn.

    Args:
        c: The comparison.
        alpha: Level of significance.
        control: One policy twice, drawn above in grey, with a band of what chance alone makes.
    """
    tasks = sorted(c.tasks, key=lambda p: -abs(p.difference.value))[:MOST_ROWS]
    tasks = [p for p in c.tasks if p in tasks]
    rows: list[tuple[Row, str, str]] = [(c.total, "all tasks", INK)]
    rows += [(p, p.name, LINE_COLOURS[0]) for p in c.suites]
    if control:
        rows.append((control.total, "control: one policy twice", LINE_COLOURS[-1]))
    if len(c.tasks) > 1:
        rows += [(p, f"{p.name}  {shorten(p.title, 44)}", LINE_COLOURS[0]) for p in tasks]
    figure = Figure(figsize=(7.6, 0.7 + 0.2 * len(rows)), layout="constrained")
    axes = figure.subplots()
    for place, (row, _, colour) in enumerate(rows):
        e = row.difference.interval
        strong = row.adjusted is not None and row.adjusted <= alpha
        axes.plot([100 * e.low, 100 * e.high], [place, place], color=colour, lw=1.6 if place == 0 else 1.1)
        face = colour if strong else "white"
        axes.plot(100 * e.value, place, "s" if place == 0 else "o", ms=4.2, mec=colour, mfc=face, mew=1.0)
    if control and control.total.difference.by_chance is not None:
        band = 100 * control.total.difference.by_chance
        axes.axvspan(-band, band, color=LINE_COLOURS[-1], alpha=0.15, lw=0)
    axes.axvline(0, color=INK, lw=0.6)
    axes.set_yticks(range(len(rows)), [shorten(name) for _, name, _ in rows])
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xlabel(f"{shorten(c.first, 30)} − {shorten(c.second, 30)}, percentage points")
    axes.grid(axis="x")
    return figure


@matplotlib.rc_context(STYLE)
def sequential_figure(tests: Mapping[str, SequentialTest]) -> Figure:
    """Draw the evidence of each comparison against the number of pairs, with the line at which it is decided.

    Args:
        tests: Sequential tests by label, all with the same alpha.
    """
    alpha = next(iter(tests.values())).alpha
    figure = Figure(figsize=(5.6, 2.7), layout="constrained")
    axes = figure.subplots()
    lowest = 0.0
    for number, (label, test) in enumerate(tests.items()):
        colour = LINE_COLOURS[number % len(LINE_COLOURS)]
        path = np.concatenate([[0.0], test.log_e]) / np.log(10)
        lowest = min(lowest, float(path.min()))
        axes.step(np.arange(len(path)), path, where="post", color=colour, lw=1.3, label=shorten(label, 60))
        if test.decided_after is not None:
            axes.plot(test.decided_after, path[test.decided_after], "o", ms=5, mfc="white", mec=colour)
    axes.axhline(-np.log10(alpha), color=INK, lw=0.7, ls="--")
    axes.set_ylim(bottom=max(lowest - 0.3, -4))
    axes.set(xlabel="pairs, one start of every task after the other", ylabel="evidence, log₁₀ e")
    legend_below(figure)
    return figure


@matplotlib.rc_context(STYLE)
def profile_figure(profiles: Mapping[str, Profile]) -> Figure:
    """Draw the share of runs and tasks whose success is above each threshold, with bands."""
    figure = Figure(figsize=(5.6, 2.7), layout="constrained")
    axes = figure.subplots()
    for number, (label, p) in enumerate(profiles.items()):
        colour = LINE_COLOURS[number % len(LINE_COLOURS)]
        axes.plot(100 * p.thresholds, 100 * p.shares, color=colour, lw=1.4, label=shorten(label, 60))
        axes.fill_between(100 * p.thresholds, 100 * p.low, 100 * p.high, color=colour, alpha=0.16, lw=0)
    axes.set(xlim=(0, 100), ylim=(0, 101), xlabel="success above (%)", ylabel="of runs and tasks (%)")
    legend_below(figure)
    return figure
