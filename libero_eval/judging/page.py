"""A self-contained page about a comparison of evaluated policies."""

from pathlib import Path
from typing import Any

from libero_env.storage import atomic_write_text
from libero_eval.judging import text
from libero_eval.judging.comparison import Comparison, Judgement
from libero_eval.judging.figures import forest_figure, profile_figure, sequential_figure
from lifelong.errors import ResultsError
from lifelong.report.figures import as_svg
from lifelong.report.tables import page_template


def write_page(found: Judgement, path: Path) -> Path:
    """Write the page; it needs no other file and no network.

    Args:
        found: The comparison.
        path: File to write.

    Raises:
        ResultsError: The file cannot be written.
    """
    tests = {f"{c.first} − {c.second}": c.sequential for c in found.comparisons if c.sequential}
    page = page_template("page.html", "libero_eval.judging").render(
        title=_title(found),
        rates=found.rates,
        comparisons=[_comparison(c, found) for c in found.comparisons],
        controls=[_control(c) for c in found.controls],
        notes=found.notes,
        groups=found.groups,
        alpha=found.alpha,
        sequential=as_svg(sequential_figure(tests)) if tests else None,
        profiles=as_svg(profile_figure(found.groups.profiles)) if found.groups else None,
        p_text=text.p_text,
        interval_text=text.interval_text,
    )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write_text(path, page)
    except OSError as error:
        raise ResultsError(f"{path}: the page cannot be written ({error})") from error
    return path


def _title(found: Judgement) -> str:
    names = [r.label for r in found.rates] or [found.controls[0].first, found.controls[0].second]
    return " against ".join(names) if len(names) < 4 else f"{len(names)} policies compared"


def _comparison(c: Comparison, found: Judgement) -> dict[str, Any]:
    return {
        "comparison": c,
        "parts": (c.total, *c.suites),
        "verdict": text.verdict(c, found.alpha),
        "sequential": text.sequential_text(c) if c.sequential else None,
        "forest": as_svg(forest_figure(c, found.controls[0] if found.controls else None)),
    }


def _control(c: Comparison) -> dict[str, Any]:
    return {"comparison": c, "parts": (c.total, *c.suites), "verdict": text.chance_text(c)}
