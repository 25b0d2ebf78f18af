"""Tables of pages, and the templates that show them: self-contained HTML in one style."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from libero_env.storage import atomic_write_text
from libero_env.text import duration, quantity
from lifelong.errors import writing
from lifelong.report.comparison import costs_of
from lifelong.report.figures import cell_colours
from lifelong.report.runs import Run, stage_of
from lifelong.results.failures import FailureScore, Tally
from lifelong.results.results import Results
from lifelong.results.shifts import ShiftScore
from lifelong.results.subgoals import AtomRates, Subgoals
from lifelong.stats.intervals import mean_and_half_width, wilson_interval

# costs by their names in `lifelong.training.costs`: head of the column, its tooltip, and how a value is shown
_bytes, _flop = (partial(quantity, unit=unit) for unit in ("B", "FLOP"))
COST_COLUMNS: dict[str, tuple[str, str, Callable[[float], str]]] = {
    "training_seconds": ("Training", "wall time of training on a task", duration),
    "evaluation_seconds": ("Evaluation", "wall time of rollouts while and after learning a task", duration),
    "end_task_seconds": ("Between tasks", "wall time of what the algorithm does after a task", duration),
    "flops_per_step": ("A step", "operations of a training step, replay and penalties included", _flop),
    "flops_per_action": ("An action", "operations of one action with a full history", _flop),
    "parameters": ("Parameters", "of the policy and of what the algorithm trains beside it", quantity),
    "parameters_trained": ("Trained", "parameters that training may change", quantity),
    "stored_bytes": ("Stored", "kept from task to task: state, and frames to replay", _bytes),
    "peak_gpu_bytes": ("GPU memory", "largest while learning a task", _bytes),
    "peak_memory_bytes": ("Memory", "largest of the process so far", _bytes),
}


@cache
def page_template(name: str, package: str = "lifelong.report") -> jinja2.Template:
    """Return a template of a package, with the filters `percent` and `quantity`; an undefined name is an error.

    Args:
        name: File of the template, which extends `base.html` of `lifelong.report`.
        package: Package whose folder holds it.
    """
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(p, ".") for p in (package, "lifelong.report")]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(percent=percent, quantity=quantity)
    return environment.get_template(name)


def save_page(path: Path, package: str, template: str = "page.html", **values: Any) -> Path:
    """Write a page that needs no other file and no network, and return its path.

    Raises:
        ResultsError: The page cannot be written.
    """
    page = page_template(template, package).render(values)
    with writing(path, "the page"):
        atomic_write_text(path, page)
    return path


def percent(value: float | None, digits: int = 1) -> str:
    """Format a share as percent with a typographic minus sign; a dash where it is undefined."""
    if value is None or np.isnan(value):
        return "–"
    text = f"{100 * value:.{digits}f}"
    return text.removeprefix("-") if float(text) == 0 else text.replace("-", "−")


def triangle(found: Mapping[str, Any], metric: str) -> list[dict[str, Any]]:
    """Return a row for each method but the last: its differences to all that follow it, where all pairs are compared.

    Args:
        found: Result of `lifelong.report.comparison.compare`.
        metric: Metric whose differences are shown.
    """
    labels = list(found["groups"])
    of = {(d["of"], d["less"]): d["metrics"][metric] for d in found["differences"]}
    if len(labels) < 3 or len(of) < len(labels) * (len(labels) - 1) / 2:
        return []
    return [{"label": row, "cells": [of.get((row, column)) for column in labels[1:]]} for row in labels[:-1]]


def cost_table(rows: Sequence[tuple[str, Mapping[str, float]]]) -> dict[str, Any] | None:
    """Return labelled rows of costs, with the columns that any row has; None if there are none."""
    columns = {
        name: column for name, column in COST_COLUMNS.items() if any(name in costs for _, costs in rows)
    }
    if not columns:
        return None

    def text(costs: Mapping[str, float], name: str) -> str:
        return columns[name][2](costs[name]) if np.isfinite(costs.get(name, np.nan)) else "–"

    texts = [(label, [text(costs, name) for name in columns]) for label, costs in rows if costs]
    return {"columns": [(head, title) for head, title, _ in columns.values()], "rows": texts}


def task_costs(run: Run, labels: Sequence[str]) -> dict[str, Any] | None:
    """Return the costs of every task of a run, of tasks that are learned together in one row, and their average."""
    rows = []
    for last, costs in run.results.costs_by_task().items():
        first = stage_of(run, last)[0]
        name = f"{last + 1}  {labels[last]}" if first == last else f"{first + 1} to {last + 1}, together"
        rows.append((name, costs))
    return cost_table([*rows, ("average of a task; largest memory", costs_of([run]))]) if rows else None


def atom_rows(found: Subgoals, labels: Sequence[str]) -> list[dict[str, Any]]:
    """Return a row for each atom of each task; the first of a task has the task's label."""
    rows: list[dict[str, Any]] = []
    for atom in found.atoms:
        first = not rows or rows[-1]["atom"].task != atom.task
        rows.append(
            {"atom": atom, "text": atom.atom.strip("()"), "label": labels[atom.task] if first else ""}
        )
    return rows


def most_forgotten(atoms: Iterable[AtomRates], threshold: float = 0.005) -> list[AtomRates]:
    """Return the atoms that were forgotten most, worst first: at most three, above the given threshold."""
    lost = [a for a in atoms if a.forgotten > threshold and a.at_start < 1]
    return sorted(lost, key=lambda a: -a.forgotten)[:3]


def shift_table(score: ShiftScore, labels: Sequence[str]) -> dict[str, Any]:
    """Return the template's table of success and forgetting under a held-out shift.

    Args:
        score: Success under the shift.
        labels: Short names of the run's tasks.
    """
    names, ways = ("learned", "learned_shifted", "final", "final_shifted"), (False, True)
    rows = [
        {
            "number": task.task + 1,
            "label": labels[task.task],
            "cells": [*map(task.rate, names), *(task.forgotten(shifted=way) for way in ways)],
        }
        for task in score.tasks
    ]
    means = [*map(score.success, names), *(score.forgetting(shifted=way) for way in ways)]
    return {"name": score.shift, "rows": rows, "means": means}


def failure_table(score: FailureScore | None, labels: Sequence[str]) -> dict[str, Any] | None:
    """Return the template's tables of causes and of interference; None without a score.

    Args:
        score: Why the rollouts of a run failed.
        labels: Short names of the run's tasks.
    """
    if score is None:
        return None
    tasks = sorted({task for pair in score.interference for task in pair})
    served = [(task, labels[task], [score.interference.get((task, k), 0) for k in tasks]) for task in tasks]
    return {**(tally_table(score, labels) or {}), "tasks": tasks, "served": served}


def tally_table(score: Tally | None, labels: Sequence[str]) -> dict[str, Any] | None:
    """Return the template's tables of rollouts by outcome; None without a score.

    Args:
        score: Numbers of rollouts.
        labels: Short names of the run's tasks.
    """
    if score is None:
        return None
    tables = [
        (head, [(k, labels[k], [found.get(one, 0) for one in score.outcomes]) for k, found in rows.items()])
        for head, rows in (("Task, at the end", score.by_task), ("All tasks, after learning", score.after))
    ]
    return {"outcomes": score.outcomes, "tables": tables}


def run_heatmap(results: Results, labels: Sequence[str]) -> dict[str, Any]:
    """Return the cells of one run's matrix: percent, colours, and Wilson's interval as the tooltip."""
    rates, episodes = results.success_matrix()
    low, high = wilson_interval(np.nan_to_num(rates) * episodes, episodes)
    spread = "{} of {} episodes; 95 % interval {} to {} %"

    def hint(i: int, j: int) -> str:
        ends = (f"{100 * end[i, j]:.0f}" for end in (low, high))
        return spread.format(round(rates[i, j] * episodes[i, j]), episodes[i, j], *ends)

    def detail(i: int, j: int) -> str:
        return f"{100 * low[i, j]:.0f}–{100 * high[i, j]:.0f}"

    return _grid(rates, labels, hint, detail)


def mean_heatmap(matrices: np.ndarray, mean: np.ndarray, labels: Sequence[str]) -> dict[str, Any]:
    """Return the cells of the mean over runs, with Student's t interval as the tooltip."""

    def hint(i: int, j: int) -> str:
        values = matrices[:, i, j][~np.isnan(matrices[:, i, j])]
        half = 100 * mean_and_half_width(values)[1]
        return f"mean of {len(values)} runs ± {half:.1f} (95 %)" if len(values) > 1 else "one run"

    return _grid(mean, labels, hint, lambda i, j: "")


def _grid(
    rates: np.ndarray,
    labels: Sequence[str],
    hint: Callable[[int, int], str],
    detail: Callable[[int, int], str],
) -> dict[str, Any]:
    """Return the rows of the table; cells without an evaluation are None."""

    def cell(i: int, j: int) -> dict[str, str] | None:
        if np.isnan(rates[i, j]):
            return None
        back, ink = cell_colours(float(rates[i, j]))
        text = f"{100 * rates[i, j]:.0f}"
        where = f"after task {i + 1} ({labels[i]}), on task {j + 1} ({labels[j]}): {text} %"
        tooltip = f"{where}\n{hint(i, j)}"
        return {"text": text, "detail": detail(i, j), "hint": tooltip, "back": back, "ink": ink}

    size, rows = len(rates), []
    for i in range(size):
        known = rates[i, : i + 1]
        average = f"{100 * known.mean():.0f}" if not np.isnan(known).any() else ""
        rows.append({"label": labels[i], "cells": [cell(i, j) for j in range(size)], "average": average})
    return {"rows": rows, "size": size, "title": ""}
