"""A self-contained page about the robustness of policies, and the same as text and JSON."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from libero_env.storage import atomic_write_text
from libero_eval.judging.text import interval_text, p_text
from libero_eval.robustness.figures import curves_figure, radar_figure
from libero_eval.robustness.results import Axis, Interaction, Outcomes, name_of
from lifelong.errors import ResultsError
from lifelong.report.figures import as_svg
from lifelong.report.templates import page_template
from lifelong.results.summary import json_safe
from lifelong.stats.intervals import Estimate, holm

ALPHA = 0.05  # of the kinds together


@dataclass(frozen=True)
class Robustness:
    """What perturbations do to one policy.

    Attributes:
        label: Name of the policy.
        outcomes: Outcomes of all conditions.
        paths: Folders of the results.
        redrawn: Number of draws that were given up, by condition.
    """

    label: str
    outcomes: Outcomes
    paths: tuple[str, ...] = ()
    redrawn: Mapping[str, int] = field(default_factory=dict)

    @property
    def base(self) -> Estimate:
        """Success without perturbation."""
        return self.outcomes.success(())

    @cached_property
    def axes(self) -> tuple[Axis, ...]:
        """Every kind that was run by itself, the most harmful first."""
        return self.outcomes.axes()

    @cached_property
    def interactions(self) -> tuple[Interaction, ...]:
        """Every pair of which each was also run by itself."""
        return self.outcomes.interactions()

    @cached_property
    def adjusted(self) -> dict[str, float]:
        """P-value of each kind, adjusted by Holm over all of them."""
        return dict(
            zip((axis.kind for axis in self.axes), holm([axis.p_value for axis in self.axes]), strict=True)
        )

    @property
    def severities(self) -> tuple[float, ...]:
        """All severities of any kind, ascending, from 0."""
        return tuple(sorted({s for axis in self.axes for s in axis.severities}))

    @staticmethod
    def at(axis: Axis, severity: float) -> Estimate | None:
        """Return the success of a kind at a severity; None if it was not measured."""
        found = dict(zip(axis.severities, axis.success, strict=True))
        return found.get(severity)


def verdict(found: Robustness) -> str:
    """Return two sentences on what the kinds take."""
    axes = [axis for axis in found.axes if not math.isnan(axis.kept.value)]
    if not axes:
        return "Without perturbation nothing succeeds, so there is nothing to lose."
    lost = [axis for axis in axes if axis.kept.value < 1 and found.adjusted[axis.kind] <= ALPHA]
    halved = [axis.kind for axis in axes if math.isfinite(axis.half.value)]
    text = f"{found.label} loses success to {len(lost)} of {len(axes)} kinds (p at most {ALPHA}, Holm)"
    text += f", most to {_listed([axis.kind for axis in lost[:3]])}. " if lost else ". "
    return text + (
        f"Half of it is lost to {_listed(halved)} within the measured severities."
        if halved
        else "No kind takes half of it within the measured severities."
    )


def render(found: Robustness) -> str:
    """Return the tables as plain text for a terminal."""
    severities = found.severities
    width = max([4, *(len(axis.kind) for axis in found.axes)])
    heads = "".join(f"{s:>6g}" for s in severities)
    lines = [
        f"{found.label}: success in percent by severity, 0 is without perturbation",
        f"{'kind':<{width}}{heads}{'area':>7}{'95 %':>15}{'kept':>7}{'half at':>9}{'Holm':>9}",
    ]
    for axis in found.axes:
        row = [found.at(axis, s) for s in severities]
        cells = "".join(f"{'–':>6}" if e is None else f"{100 * e.value:>6.0f}" for e in row)
        lines.append(
            f"{axis.kind:<{width}}{cells}{100 * axis.area.value:>7.0f}{interval_text(axis.area):>15}"
            f"{100 * axis.kept.value:>7.0f}{severity_text(axis.half.value):>9}"
            f"{p_text(found.adjusted[axis.kind]):>9}"
        )
    for pair in found.interactions:
        lines.append(
            f"{name_of(pair.condition)}: {100 * pair.success.value:.0f}, expected {100 * pair.expected:.0f}, "
            f"excess {100 * pair.excess.value:+.0f} {interval_text(pair.excess)}".replace("+-", "-")
        )
    return "\n".join([*lines, "", verdict(found)])


def write_robustness(
    policies: Sequence[Robustness],
    folder: Path,
    *,
    units: Mapping[str, str],
    facts: Sequence[tuple[str, str]] = (),
    notes: Sequence[str] = (),
) -> Path:
    """Write `robustness.html`, which needs no other file, and `robustness.json` with all numbers and outcomes.

    Args:
        policies: The policies; the page is about the first, and the others are drawn beside it.
        folder: Folder of the two files.
        units: What severity 1 is, by kind.
        facts: What was run, as pairs of name and value.
        notes: What a reader has to know.

    Returns:
        The page.

    Raises:
        ResultsError: The files cannot be written.
    """
    first, axes = policies[0], {policy.label: policy.axes for policy in policies}
    page = page_template("page.html", "libero_eval.robustness").render(
        title=f"Robustness of {first.label}",
        facts=facts,
        notes=notes,
        verdict=verdict(first),
        policies=policies,
        units=units,
        curves=as_svg(curves_figure(axes, units)),
        radar=as_svg(radar_figure(axes)),
        interactions=[
            {"label": policy.label, "name": name_of(found.condition), "found": found}
            for policy in policies
            for found in policy.interactions
        ],
        redrawn=_redrawn(first),
        paths=[path for policy in policies for path in policy.paths],
        interval=interval_text,
        p_text=p_text,
        severity=severity_text,
        severities=_severities_text,
    )
    content = json.dumps(json_safe({"policies": [_plain(policy) for policy in policies]}), indent=1)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        atomic_write_text(folder / "robustness.html", page)
        atomic_write_text(folder / "robustness.json", content + "\n")
    except OSError as error:
        raise ResultsError(f"{folder}: the page cannot be written ({error})") from error
    return folder / "robustness.html"


def severity_text(severity: float) -> str:
    """Format a severity; a dash where it is infinite."""
    return f"{severity:.2f}" if math.isfinite(severity) else "–"


def _severities_text(e: Estimate) -> str:
    if not math.isfinite(e.low):
        return ""
    return f"[{e.low:.2f}, {severity_text(e.high)}]"


def _redrawn(found: Robustness) -> list[tuple[str, int, int]]:
    episodes = len(found.outcomes.tasks) * len(found.outcomes.starts)
    return [(name, count, episodes) for name, count in found.redrawn.items() if count]


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:-1]) + (" and " if len(names) > 1 else "") + names[-1]


def _plain(found: Robustness) -> dict[str, Any]:
    outcomes = found.outcomes
    return {
        "label": found.label,
        "tasks": outcomes.tasks,
        "starts": outcomes.starts,
        "success": asdict(found.base),
        "axes": [{**asdict(axis), "adjusted": found.adjusted[axis.kind]} for axis in found.axes],
        "interactions": [
            {**asdict(pair), "condition": name_of(pair.condition)} for pair in found.interactions
        ],
        "redrawn": dict(found.redrawn),
        "outcomes": {
            name_of(condition): rows.astype(int).tolist()
            for condition, rows in zip(outcomes.conditions, outcomes.successes, strict=True)
        },
    }
