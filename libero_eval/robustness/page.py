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
from libero_env.text import Cell, Table
from libero_eval.evaluation_file import suite_label
from libero_eval.judging.page import interval_text, p_text
from libero_eval.robustness.results import Axis, Outcomes, Robustness, differences, name_of
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
from lifelong.stats.intervals import ALPHA

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
    outcomes = policy.outcomes
    events, pairs = event_table(policy), pair_table(policy)
    lines = [
        f"{policy.label}: success in percent by severity, 0 is without perturbation",
        str(kind_table(policy)),
        *([f"starts: {len(outcomes.starts)}{lost}"] if (lost := _lost_text(outcomes)) else []),
        *(["", EVENTS_TEXT, str(events)] if events else []),
        *(["", str(pairs)] if pairs else []),
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
    suites: dict[str, list[str]] = {}
    for task in outcomes.tasks:
        suites.setdefault(task.partition("/")[0], []).append(task)
    episodes = len(outcomes.tasks) * len(outcomes.starts)
    paths = (os.path.relpath(path, folder) for policy in policies for path in policy.paths)
    page = save_page(
        folder / "robustness.html",
        "libero_eval.robustness",
        title=f"Robustness of {first.label}",
        facts=[
            ("tasks", ", ".join(suite_label(suite, tasks) for suite, tasks in suites.items())),
            ("protocol", ", ".join(dict.fromkeys(policy.protocol for policy in policies))),
            ("starts", f"{len(outcomes.starts)} a task" + _lost_text(outcomes)),
            ("conditions", str(len(outcomes.conditions))),
            ("episodes", str(outcomes.successes.size)),
            ("control steps at most", _horizons_text(policies)),
        ],
        verdict=verdict(first),
        differences=differences(policies),
        kinds=[
            (
                f"{policy.label}, {percent(policy.outcomes.success(()).value)} % without perturbation",
                kind_table(policy, units),
            )
            for policy in policies
        ],
        curves=as_svg(curves_figure(axes, units)),
        events=[(policy.label, found) for policy in policies if (found := event_table(policy))],
        pairs=[(policy.label, found) for policy in policies if (found := pair_table(policy))],
        events_text=EVENTS_TEXT,
        redrawn=Table(
            ("perturbation", "drawn again", "episodes"),
            [[name, count, episodes] for name, count in first.redrawn.items() if count],
        ),
        paths=[path for path in paths if path != "."],
    )
    with writing(folder, "the numbers"):
        write_json(folder / "robustness.json", {"policies": [_content(policy) for policy in policies]})
    return page


def kind_table(policy: Robustness, units: Mapping[str, str] | None = None) -> Table:
    """Return the table of success by kind and severity.

    Args:
        units: What severity 1 is, by kind.
    """
    heads = ["kind", *(f"{s:g}" for s in policy.severities), "area", "95 %", "kept", "half at"]
    rows = []
    for axis in policy.outcomes.axes:
        successes = [axis.at(s) for s in policy.severities]
        half = (
            f"[{axis.half.low:.2f}, {severity_text(axis.half.high)}]" if math.isfinite(axis.half.low) else ""
        )
        rows.append(
            [
                Cell(axis.kind, (units or {}).get(axis.kind, "")),
                *("–" if e is None else percent(e.value, 0) for e in successes),
                Cell(percent(axis.area.value, 0), strong=True),
                interval_text(axis.area),
                Cell(percent(axis.kept.value, 0), interval_text(axis.kept)),
                Cell(severity_text(axis.half.value), half),
                p_text(policy.adjusted[axis.kind]),
            ]
        )
    return Table(
        [*heads, Cell("Holm", title="p of no effect at all, adjusted for the number of kinds")], rows
    )


def event_table(policy: Robustness) -> Table:
    """Return the table of what events take, success in percent; without rows where there were none."""
    rows = []
    for row in policy.event_rows:
        counts, cells = row.counts, ["–"] * 5
        if counts.pairs:
            rates = [(counts.both + only) / counts.pairs for only in (counts.only_first, counts.only_second)]
            value = f"{100 * row.difference.value:+.1f}".replace("-", "−")
            cells = [*map(percent, rates), value, interval_text(row.difference), percent(counts.lost)]
        rows.append([row.name, f"{row.began} of {row.episodes}", row.solved, *cells, p_text(row.p_value)])
    p = Cell("p", title="McNemar's, of no effect")
    return Table(("event", "began", "solvable", "without", "with", "difference", "95 %", "lost", p), rows)


def pair_table(policy: Robustness) -> Table:
    """Return the table of what two perturbations take together; without rows where none were run."""
    rows = [
        [
            name_of(pair.condition),
            *(percent(value, 0) for value in (pair.success.value, pair.expected)),
            Cell(percent(pair.excess.value, 0), strong=True),
            interval_text(pair.excess),
        ]
        for pair in policy.outcomes.interactions
    ]
    return Table(("two at once", "success", "expected", "excess", "95 %"), rows)


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
