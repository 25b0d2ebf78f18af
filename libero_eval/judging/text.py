"""A comparison as plain text for a terminal."""

import math
from collections.abc import Sequence

from libero_eval.judging.comparison import Comparison, Judgement, Part
from lifelong.stats.episodes import Difference
from lifelong.stats.intervals import Estimate

WORST = 5  # tasks in the table of a terminal


def render(found: Judgement, *, tasks: bool = False) -> str:
    """Return the tables of a comparison.

    Args:
        found: The comparison.
        tasks: Whether to show every task instead of those that differ most.
    """
    blocks = [_rates(found)]
    blocks += [_comparison(c, found.alpha, tasks) for c in found.comparisons]
    blocks += [_control(c) for c in found.controls]
    blocks += [_groups(found)] if found.groups else []
    blocks += ["\n".join(f"note: {note}" for note in found.notes)] if found.notes else []
    return "\n\n".join(blocks)


def verdict(c: Comparison, alpha: float) -> str:
    """Return one sentence on what a comparison shows."""
    d, p = c.total.difference, c.total.adjusted
    assert p is not None
    tested = f"{p_equation(p)}, {d.test}"
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


def sequential_text(c: Comparison) -> str:
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


def chance_text(c: Comparison) -> str:
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
    return f"[{100 * e.low:.1f}, {100 * e.high:.1f}]".replace("-", "−") if math.isfinite(e.low) else ""


def p_text(p: float) -> str:
    """Format a p-value: three digits after the point, or that it is smaller."""
    return f"{p:.3f}" if p >= 0.001 else "< 0.001"


def p_equation(p: float) -> str:
    """Format a p-value in a sentence: p = 0.012, p < 0.001."""
    return f"p = {p_text(p)}" if p >= 0.001 else f"p {p_text(p)}"


def _rates(found: Judgement) -> str:
    width = max(len("policy"), *(len(r.label) for r in found.rates)) if found.rates else 0
    lines = [f"{'policy':<{width}}  {'runs':>4}  {'episodes':>8}  {'errors':>6}  {'success %':>9}  95 %"]
    for r in found.rates:
        rate = f"{100 * r.success.value:>9.1f}  {interval_text(r.success)}"
        lines.append(f"{r.label:<{width}}  {r.runs:>4}  {r.episodes:>8}  {r.errors:>6}  {rate}")
    return "\n".join(lines) if found.rates else "control arm only"


def _comparison(c: Comparison, alpha: float, all_tasks: bool) -> str:
    lines = [verdict(c, alpha)]
    lines += [sequential_text(c)] if c.sequential else []
    lines += ["", *_table(c, (c.total, *c.suites))]
    moved = [p for p in c.tasks if p.difference.value != 0]
    shown = c.tasks if all_tasks else sorted(moved, key=lambda p: -abs(p.difference.value))[:WORST]
    if shown and len(c.tasks) > 1:
        head = "every task" if all_tasks else f"tasks that differ most (of {len(c.tasks)})"
        lines += ["", f"{head}; Holm over the tasks", *_table(c, shown)]
    return "\n".join(lines)


def _control(c: Comparison) -> str:
    head = f"control arm: {c.first} − {c.second}, one policy twice"
    return "\n".join([head, chance_text(c), "", *_table(c, (c.total, *c.suites))])


def _table(c: Comparison, parts: Sequence[Part]) -> list[str]:
    names = [_short(c.first), _short(c.second)]
    width = max(4, *(len(p.name) for p in parts))
    heads = [f"{names[0]} %", f"{names[1]} %", "difference", "95 %", f"only {names[0]}", f"only {names[1]}"]
    rows = [["pairs", *heads, "p", "Holm"], *(_cells(p.difference, p.adjusted) for p in parts)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    labels = ["", *(p.name for p in parts)]
    return [
        f"{label:<{width}}  " + "  ".join(f"{cell:>{w}}" for cell, w in zip(row, widths, strict=True))
        for label, row in zip(labels, rows, strict=True)
    ]


def _cells(d: Difference, adjusted: float | None) -> list[str]:
    only = [str(d.counts.only_first), str(d.counts.only_second)] if d.counts else ["–", "–"]
    return [
        str(d.pairs),
        f"{100 * d.first:.1f}",
        f"{100 * d.second:.1f}",
        f"{100 * d.value:+.1f}".replace("-", "−"),
        interval_text(d.interval),
        *only,
        p_text(d.p_value),
        "–" if adjusted is None else p_text(adjusted),
    ]


def _groups(found: Judgement) -> str:
    assert found.groups is not None
    g = found.groups
    width = max(len(name) for name in g.runs)
    lines = ["over runs (rliable; intervals draw runs anew, and are too narrow for fewer than five)"]
    lines += [f"{'':<{width}}  {'runs':>4}  {'mean %':>6}  {'95 %':>14}  {'IQM %':>6}  {'95 %':>14}"]
    for name, runs in g.runs.items():
        mean, iqm = g.mean[name], g.iqm[name]
        lines.append(
            f"{name:<{width}}  {runs:>4}  {100 * mean.value:>6.1f}  {interval_text(mean):>14}  "
            f"{100 * iqm.value:>6.1f}  {interval_text(iqm):>14}"
        )
    for (a, b), e in g.improvement.items():
        lines.append(
            f"a run of {a} beats one of {b} on a task with probability {e.value:.2f} [{e.low:.2f}, {e.high:.2f}]"
        )
    return "\n".join(lines)


def _short(label: str, length: int = 16) -> str:
    return label if len(label) <= length else "…" + label[1 - length :]
