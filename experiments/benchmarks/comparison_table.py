"""The lines of `compare_original.py`: what is set beside what, and which ratio is aimed at."""

import os
from pathlib import Path
from typing import Any, NamedTuple

BATCH, THREADS = 16, 2

Figures = dict[str, float]  # seconds of one call or step, and MB


class Row(NamedTuple):
    """A line of the table. `>=` bounds other / own, `<=` bounds own / other, and `MB` bounds own."""

    what: str
    other: str
    own: str
    target: str = ""


ROWS = {
    "physics": (
        Row("control step without cameras, one core", "original step", "step", ">= 5"),
        Row(f"  of {BATCH} simulations on {THREADS} threads, each", "original step", "batch step", ">= 10"),
    ),
    "pictures": (
        Row(
            "control step with two 128x128 cameras, our pack", "original camera step", "camera step", ">= 10"
        ),
        Row(
            "  the original's pack in both, ours simplified",
            "original camera step",
            "simplified camera step",
            ">= 4",
        ),
        Row(
            f"  {BATCH} simulations in one process, our pack, each",
            "original camera step",
            "batch camera step",
        ),
    ),
    "resets": (
        Row("reset to a stored state, two pictures", "original reset", "reset", ">= 50"),
        Row("  theirs as set_init_state alone", "original put", "reset"),
        Row("  reset to a new placement, ours settled", "original placement", "placement"),
    ),
    "construction": (
        Row("construction in a fresh process, after imports", "original build", "build", ">= 5"),
        Row("  with the first reset and pictures", "original build and reset", "build and reset"),
        Row("  imports and construction", "original import and build", "import and build"),
        Row("  imports alone", "original import", "import"),
    ),
    "limits": (
        Row("control step beside 25 bare mj_step, one core", "bare steps", "step beside bare", "<= 1.3"),
        Row("two pictures beside bare mjr_render", "bare drawing", "drawing", "<= 1.3"),
        Row("  beside mjr_render and mjr_readPixels", "bare drawing and reading", "drawing"),
    ),
    "memory": (Row("memory that resets with pictures add", "", "growth", "<= 50 MB"),),
}


def judged(row: Row, figures: Figures) -> dict[str, Any]:
    """A line with its figures, its ratio, and whether the target is met (None: it has none)."""
    own, other = figures[row.own], figures.get(row.other)
    sign, bound, unit = (*row.target.split(), "", "")[:3] if row.target else ("", "", "")
    value = own if unit or other is None else own / other if sign == "<=" else other / own
    met = None if not sign else value <= float(bound) if sign == "<=" else value >= float(bound)
    return {
        "what": row.what,
        "original_or_bare": other,
        "own": own,
        "ratio": value,
        "target": row.target,
        "met": met,
    }


def line(row: dict[str, Any]) -> str:
    """How a line is printed: times in ms."""
    other, own = row["original_or_bare"], row["own"]
    times = f"{'':>10} {'':>10}" if other is None else f"{1e3 * other:10.2f} {1e3 * own:10.3f}"
    verdict = {None: "", True: "met", False: "MISSED"}[row["met"]]
    return f"{row['what']:52} {times} {row['ratio']:8.2f} {row['target']:>9} {verdict}"


def machine() -> dict[str, Any]:
    """What the figures are taken on."""
    cpuinfo = Path("/proc/cpuinfo")
    names = (
        [x for x in cpuinfo.read_text().splitlines() if x.startswith("model name")]
        if cpuinfo.exists()
        else []
    )
    cpu = names[0].split(":")[1].strip() if names else "unknown"
    return {"cpu": cpu, "cores": os.cpu_count(), "gl": os.environ["MUJOCO_GL"], "load": os.getloadavg()}
