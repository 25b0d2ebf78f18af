"""A self-contained page about the robustness of policies with its figures, and the same as text and JSON."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from libero_env.perturbations import KINDS
from libero_env.storage import write_json
from libero_env.text import text_table
from libero_eval.judging.page import interval_text, p_text
from libero_eval.robustness.results import Axis, EventRow, Outcomes, Robustness, differences, name_of
from lifelong.errors import writing
from lifelong.report.figures import (
    LINE_COLOURS,
    LINE_MARKERS,
    STYLE,
    as_svg,
    legend_below,
    shorten,
)
from lifelong.report.tables import percent, save_page
from lifelong.stats.intervals import ALPHA, Estimate

COLUMNS = 4
EVENTS_TEXT = (
    "In how many episodes each event began, and in how many of these the expert, planning anew from the state just "
    "after it, solves the rest. In the latter: success in percent of the matched episodes without the event, and with "
    "it, and the share of the former's successes that is lost."
)


def verdict(policy: Robustness) -> str:
    """Return two sentences on what the kinds take."""
    axes = [axis for axis in policy.outcomes.axes if not math.isnan(axis.kept.value)]
    if not axes:
        return "Without perturbation nothing succeeds, so there is nothing to lose."
    lost = [axis for axis in axes if axis.kept.value < 1 and policy.adjusted[axis.kind] <= ALPHA]
    halved = [axis.kind for axis in axes if math.isfinite(axis.half.value)]
    text = f"{policy.label} loses success to {len(lost)} of {len(axes)} kinds (p at most {ALPHA}, Holm)"
    text += f", most to {_listed([axis.kind for axis in lost[:3]])}. " if lost else ". "
    return text + (
        f"Half of it is lost to {_listed(halved)} within the measured severities."
        if halved
        else "No kind takes half of it within the measured severities."
    )


def render(policy: Robustness) -> str:
    """Return the tables as plain text for a terminal."""
    severities = policy.severities
    rows: list[list[object]] = [
        ["kind", *(f"{s:g}" for s in severities), "area", "95 %", "kept", "half at", "Holm"]
    ]
    for axis in policy.outcomes.axes:
        successes = [axis.at(s) for s in severities]
        rows.append(
            [
                axis.kind,
                *("–" if e is None else f"{100 * e.value:.0f}" for e in successes),
                f"{100 * axis.area.value:.0f}",
                interval_text(axis.area),
                "–" if math.isnan(axis.kept.value) else f"{100 * axis.kept.value:.0f}",
                severity_text(axis.half.value),
                p_text(policy.adjusted[axis.kind]),
            ]
        )
    events: list[list[object]] = [
        ["event", "began", "solvable", "without", "with", "difference", "95 %", "lost"]
    ]
    for row in policy.event_rows:
        events.append([row.name, f"{row.began} of {row.episodes}", row.solved, *_event_cells(row)])
    lines = [
        f"{policy.label}: success in percent by severity, 0 is without perturbation",
        text_table(rows),
        *([f"starts: {len(policy.outcomes.starts)}{lost}"] if (lost := _lost_text(policy.outcomes)) else []),
        *(["", EVENTS_TEXT, text_table(events)] if len(events) > 1 else []),
        *(
            f"{name_of(pair.condition)}: {percent(pair.success.value, 0)}, expected {percent(pair.expected, 0)}, "
            f"excess {percent(pair.excess.value, 0)} {interval_text(pair.excess)}".rstrip()
            for pair in policy.outcomes.interactions
        ),
    ]
    return "\n".join([*lines, "", verdict(policy)])


def write_robustness(policies: Sequence[Robustness], folder: Path) -> Path:
    """Write `robustness.html`, which needs no other file, and `robustness.json` with all numbers and outcomes.

    Args:
        policies: The policies; the page is about the first, and the others are drawn beside it.
        folder: Folder of the two files.

    Returns:
        The page.

    Raises:
        ResultsError: The files cannot be written.
    """
    first, axes = policies[0], {policy.label: policy.outcomes.axes for policy in policies}
    outcomes = first.outcomes
    kinds = {axis.kind: KINDS.get(axis.kind.partition("@")[0]) for axis in outcomes.axes}
    units = {name: f"{kind.at_one:g} {kind.unit}" if kind else "1 s" for name, kind in kinds.items()}
    suites = ", ".join(dict.fromkeys(task.partition("/")[0] for task in outcomes.tasks))
    episodes = len(outcomes.tasks) * len(outcomes.starts)
    page = save_page(
        folder / "robustness.html",
        "libero_eval.robustness",
        title=f"Robustness of {first.label}",
        facts=[
            ("tasks", f"{len(outcomes.tasks)} of {suites}"),
            ("starts", f"{len(outcomes.starts)} a task" + _lost_text(outcomes)),
            ("conditions", str(len(outcomes.conditions))),
            ("episodes", str(outcomes.successes.size)),
            ("control steps at most", _horizons_text(policies)),
        ],
        verdict=verdict(first),
        differences=differences(policies),
        policies=policies,
        units=units,
        curves=as_svg(curves_figure(axes, units)),
        radar=as_svg(radar_figure(axes)) if len(outcomes.axes) > 2 else "",
        interactions=[
            {"label": policy.label, "name": name_of(pair.condition), "pair": pair}
            for policy in policies
            for pair in policy.outcomes.interactions
        ],
        event_cells=_event_cells,
        events_text=EVENTS_TEXT,
        redrawn=[(name, count, episodes) for name, count in first.redrawn.items() if count],
        paths=[os.path.relpath(path, folder) for policy in policies for path in policy.paths],
        interval=interval_text,
        p_text=p_text,
        severity=severity_text,
        severities=_severities_text,
    )
    with writing(folder, "the numbers"):
        write_json(folder / "robustness.json", {"policies": [_content(policy) for policy in policies]})
    return page


def _event_cells(row: EventRow) -> list[str]:
    """Return success without and with an event, their difference and its interval, and the share lost: in percent."""
    counts = row.counts
    if not counts.pairs:
        return ["–"] * 5
    rates = [100 * (counts.both + only) / counts.pairs for only in (counts.only_first, counts.only_second)]
    lost = "–" if math.isnan(counts.lost) else f"{100 * counts.lost:.1f}"
    value = f"{100 * row.difference.value:+.1f}".replace("-", "−")
    return [f"{rates[0]:.1f}", f"{rates[1]:.1f}", value, interval_text(row.difference), lost]


def severity_text(severity: float) -> str:
    """Format a severity; a dash where it is infinite."""
    return f"{severity:.2f}" if math.isfinite(severity) else "–"


def _lost_text(outcomes: Outcomes) -> str:
    return f", {outcomes.lost} left out, where a simulation error ended an episode" if outcomes.lost else ""


def _horizons_text(policies: Sequence[Robustness]) -> str:
    texts = {policy.label: _horizon_text(policy) for policy in policies}
    named = [f"{text} ({label})" for label, text in texts.items()]
    return ", ".join(named) if len({*texts.values()}) > 1 else texts[policies[0].label]


def _horizon_text(policy: Robustness) -> str:
    """Return the control steps of a policy's episodes, by suite where there are several."""
    if not isinstance(policy.horizon, Mapping):
        return str(policy.horizon)
    suites = dict.fromkeys(task.partition("/")[0] for task in policy.outcomes.tasks)
    values = policy.horizon.values()  # variants have those of their base task's suite
    steps = {suite: policy.horizon.get(suite, f"{min(values)} to {max(values)}") for suite in suites}
    return " / ".join(f"{count} {suite}" if len(steps) > 1 else str(count) for suite, count in steps.items())


def _severities_text(e: Estimate) -> str:
    if not math.isfinite(e.low):
        return ""
    return f"[{e.low:.2f}, {severity_text(e.high)}]"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:-1]) + (" and " if len(names) > 1 else "") + names[-1]


def _content(policy: Robustness) -> dict[str, Any]:
    outcomes = policy.outcomes
    return {
        "label": policy.label,
        "tasks": outcomes.tasks,
        "starts": outcomes.starts,
        "success": asdict(outcomes.success(())),
        "axes": [{**asdict(axis), "adjusted": policy.adjusted[axis.kind]} for axis in policy.outcomes.axes],
        "interactions": [
            {**asdict(pair), "condition": name_of(pair.condition)} for pair in policy.outcomes.interactions
        ],
        "redrawn": dict(policy.redrawn),
        "events": [
            {**asdict(row), "difference": asdict(row.difference), "p_value": row.p_value}
            for row in policy.event_rows
        ],
        "outcomes": {
            name_of(condition): rows.astype(int).tolist()
            for condition, rows in zip(outcomes.conditions, outcomes.successes, strict=True)
        },
    }


@matplotlib.rc_context(STYLE)
def curves_figure(policies: Mapping[str, Sequence[Axis]], units: Mapping[str, str]) -> Figure:
    """Draw success against severity with intervals, one panel for each kind, in the order of the first policy.

    Args:
        policies: Label of each policy and its axes.
        units: What severity 1 is, by kind; a second line of the panel's title.
    """
    first = next(iter(policies.values()))
    columns, rows = min(COLUMNS, len(first)), math.ceil(len(first) / COLUMNS)
    figure = Figure(figsize=(2.15 * columns + 0.4, 1.95 * rows + 0.3), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for axes in grid.flat[len(first) :]:
        axes.set_axis_off()
    named = set[str]()  # policies that are in the legend
    for place, kind in enumerate(axis.kind for axis in first):
        axes = grid.flat[place]
        for number, (label, curves) in enumerate(policies.items()):
            axis = next((a for a in curves if a.kind == kind), None)
            if axis is not None:
                _draw_axis(axes, axis, number, "" if label in named else shorten(label, 60))
                named.add(label)
        axes.set_title(f"{kind}\n{shorten(units.get(kind, ''), 34)}".strip(), loc="left", fontsize=8)
        largest = first[place].severities[-1]
        axes.set(xlim=(-0.03 * largest, 1.03 * largest), ylim=(0, 102))
        middle = "½" if largest == 1 else f"{largest / 2:g}"
        axes.set_xticks((0, largest / 2, largest), ("0", middle, f"{largest:g}"))
        axes.grid(axis="y")
        if place % columns == 0:
            axes.set_ylabel("success (%)")
        if place + columns >= len(first):
            axes.set_xlabel("severity")
    legend_below(figure)
    return figure


@matplotlib.rc_context(STYLE)
def radar_figure(policies: Mapping[str, Sequence[Axis]]) -> Figure:
    """Draw the success that is to be expected along each kind, its area, as a radar picture.

    Args:
        policies: Label of each policy and its axes; kinds are in the order of the first, by name.
    """
    kinds = sorted(axis.kind for axis in next(iter(policies.values())))
    angles = np.linspace(0, 2 * np.pi, len(kinds), endpoint=False)
    figure = Figure(figsize=(4.4, 4.2), layout="constrained")
    axes = figure.add_subplot(projection="polar")
    axes.set_theta_offset(np.pi / 2)  # type: ignore[attr-defined]  # of polar axes
    axes.set_theta_direction(-1)  # type: ignore[attr-defined]
    for number, (label, curves) in enumerate(policies.items()):
        areas = {axis.kind: 100 * axis.area.value for axis in curves}
        values = [areas.get(kind, np.nan) for kind in kinds]
        look = _look(number, shorten(label, 60))
        closed = [*angles, angles[0]], [*values, values[0]]
        axes.plot(*closed, lw=1.5, ms=2.5, **look)
        if number == 0:
            axes.fill(*closed, color=look["color"], alpha=0.15, lw=0)
    axes.set_ylim(0, 100)
    axes.set_yticks((25, 50, 75, 100), ("25", "50", "75", "100 %"), fontsize=6.5)
    axes.set_xticks(angles, kinds)
    axes.tick_params(axis="x", pad=2)
    for text, angle in zip(axes.get_xticklabels(), angles, strict=True):
        side = round(np.sin(angle), 3)  # labels grow away from the circle
        text.set_horizontalalignment("left" if side > 0 else "right" if side < 0 else "center")
    axes.set_rlabel_position(180 / len(kinds))  # type: ignore[attr-defined]  # between two kinds
    axes.grid(alpha=0.4)
    axes.spines["polar"].set_linewidth(0.5)
    legend_below(figure)
    return figure


def _draw_axis(axes: matplotlib.axes.Axes, axis: Axis, number: int, label: str) -> None:
    look = _look(number, label)
    low, mean, high = (
        100 * np.array([getattr(e, name) for e in axis.success]) for name in ("low", "value", "high")
    )
    alpha = 0.16 if number == 0 else 0.08
    axes.fill_between(axis.severities, low, high, color=look["color"], alpha=alpha, lw=0)
    axes.plot(axis.severities, mean, lw=1.4, ms=3, clip_on=False, **look)


def _look(number: int, label: str) -> dict[str, Any]:
    """Return how a policy is drawn; markers show a kind without neighbours."""
    return {
        "color": LINE_COLOURS[number % len(LINE_COLOURS)],
        "marker": LINE_MARKERS[number % len(LINE_MARKERS)],
        "ls": "-" if number == 0 else "--",
        "label": label or None,
    }
