"""What a diagnosis says: a line for each finding, a self-contained page, and all numbers as JSON."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from libero_env.storage import write_json
from libero_env.text import Cell, Table
from libero_eval.diagnosis.measure import PARTS, Diagnosis, Swap
from lifelong.errors import writing
from lifelong.report.figures import LINE_COLOURS, STYLE, as_svg, legend_below
from lifelong.report.tables import percent, save_page

MEASURES = {"error": "error", "failures": "share of failed rollouts"}


def findings(found: Diagnosis) -> list[str]:
    """Return what was found in sentences, one for each old task and measure, and one for each of the other kinds."""
    lines = [*found.notes, *map(_swap_text, found.swaps)]
    places = []
    for place in ("features", "latents"):
        drifts = [drift for drift in found.drifts if drift.place == place]
        cka, change = number(_mean(drifts, "cka")), number(_mean(drifts, "relative"))
        places.append(f"CKA of {place} {cka} (relative change {change})")
    lines.append(f"On frames of old tasks since they were learned, mean over tasks: {', '.join(places)}.")
    for part in PARTS:
        if own := [update for update in found.updates if update.part == part]:
            lines.append(
                f"Later tasks change the {part} by {percent(_mean(own, 'relative'), 0)} % of its norm, effective rank "
                f"{percent(_mean(own, 'effective'), 0)} % of the largest, stable rank {number(_mean(own, 'stable'))}."
            )
    if found.moved:
        worst = max(found.moved, key=lambda one: one.kl)
        mean, largest = number(_mean(found.moved, "kl")), number(worst.kl)
        lines.append(
            f"A task moves the policy by {mean} nats on its frames, task {worst.task + 1} most ({largest})."
        )
    if overlaps := [pair for pair in found.overlaps if not math.isnan(pair.all)]:
        most = max(overlaps, key=lambda pair: pair.all)
        lines.append(
            f"Fisher information of two tasks overlaps by {number(_mean(overlaps, 'all'))} on average, most between "
            f"tasks {most.tasks[0] + 1} and {most.tasks[1] + 1} ({number(most.all)})."
        )
    return lines


def _mean(rows: Sequence[Any], name: str) -> float:
    return float(np.mean([getattr(row, name) for row in rows]))


def number(value: float) -> str:
    """Format a number with three significant digits; a dash where it is not known."""
    return f"{value:.3g}" if math.isfinite(value) else "–"


def _swap_text(swap: Swap) -> str:
    start = (
        f"Task {swap.task + 1}: {MEASURES[swap.measure]} {number(swap.learned)} just learned, {number(swap.final)} "
        "at the end"
    )
    if not swap.lost:
        return f"{start}; nothing is lost, or less than a tenth."
    best = min(swap.swapped, key=lambda part: swap.swapped[part])
    shares = ", ".join(f"{part} {percent(swap.restored(part), 0)} %" for part in swap.swapped)
    verdict = f"the {best} restores the largest share" if swap.restored(best) > 0 else "no part restores any"
    return f"{start}; put back alone, {verdict} of what was lost ({shares})."


def write_diagnosis(found: Diagnosis, folder: Path) -> Path:
    """Write `diagnosis.html`, which needs no other file, and `diagnosis.json` with all numbers.

    Returns:
        The page.

    Raises:
        ResultsError: The files cannot be written.
    """
    page = save_page(
        folder / "diagnosis.html",
        "libero_eval.diagnosis",
        title=f"What {found.algorithm} loses, and where",
        facts=[("run", found.run), ("tasks learned", str(found.learned))],
        notes=found.notes,
        findings=findings(found)[len(found.notes) :],
        figure=as_svg(swap_figure(found)),
        tables=_tables(found),
    )
    with writing(folder, "the numbers"):
        write_json(folder / "diagnosis.json", asdict(found))
    return page


def _tables(found: Diagnosis) -> dict[str, Table]:
    parts = [part for part in PARTS if part in found.swaps[0].swapped]
    swaps, overlaps = [], []
    for swap in found.swaps:
        back = [
            Cell(number(swap.swapped[p]), f"{percent(swap.restored(p), 0)} %", strong=True) for p in parts
        ]
        name = f"{swap.task + 1}  {found.instructions[swap.task]}"
        swaps.append([name, MEASURES[swap.measure], number(swap.learned), *back, number(swap.final)])
    for pair in found.overlaps:
        shares = map(number, (pair.all, *(pair.parts[part] for part in parts)))
        overlaps.append([f"{pair.tasks[0] + 1} and {pair.tasks[1] + 1}", *shares])
    drifts = [[d.task + 1, d.place, number(d.cka), number(d.relative)] for d in found.drifts]
    updates = [
        [
            u.task + 1,
            u.part,
            *map(number, (u.relative, u.nuclear)),
            f"{percent(u.effective, 0)} %",
            number(u.stable),
        ]
        for u in found.updates
    ]
    ranks = ("relative norm", "nuclear norm", "effective rank", "stable rank")
    return {
        "swaps": Table(
            ["task", "measure", "just learned", *(f"{part} back" for part in parts), "at the end"], swaps, 2
        ),
        "drifts": Table(("task", "place", "CKA", "change"), drifts, 2),
        "updates": Table(("task", "part", *ranks), updates, 2),
        "moved": Table(("task", "KL"), [[one.task + 1, number(one.kl)] for one in found.moved]),
        "overlaps": Table(("tasks", "all weights", *parts), overlaps),
    }


@matplotlib.rc_context(STYLE)
def swap_figure(found: Diagnosis) -> Figure:
    """Draw the error on each old task just learned, with each part put back, and at the end."""
    swaps = [swap for swap in found.swaps if swap.measure == "error"]
    bars = {"just learned": [swap.learned for swap in swaps]}
    bars |= {f"{part} put back": [swap.swapped[part] for swap in swaps] for part in swaps[0].swapped}
    bars["at the end"] = [swap.final for swap in swaps]
    figure = Figure(figsize=(max(5.2, 1.0 + 0.9 * len(swaps)), 2.9), layout="constrained")
    axes, width = figure.subplots(), 0.8 / len(bars)
    for place, (label, values) in enumerate(bars.items()):
        middle = np.arange(len(swaps)) + (place - (len(bars) - 1) / 2) * width
        axes.bar(middle, values, width, color=LINE_COLOURS[place], label=label)
    axes.set_xticks(range(len(swaps)), [str(swap.task + 1) for swap in swaps])
    axes.set(xlabel="task", ylabel="error of actions")
    axes.grid(axis="y")
    legend_below(figure)
    return figure
