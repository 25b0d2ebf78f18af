"""Tables of pages, and the templates that show them: self-contained HTML in one style."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from libero_env.storage import atomic_write_text
from libero_env.text import Cell, Table, counted, duration, quantity
from lifelong.errors import writing
from lifelong.report.comparison import costs_of
from lifelong.report.figures import cell_colours
from lifelong.report.runs import Run, stage_of
from lifelong.results.failures import FailureScore, Tally
from lifelong.results.records import CollectionRecord
from lifelong.results.results import Results
from lifelong.results.shifts import ShiftScore
from lifelong.results.subgoals import AtomRates, Subgoals
from lifelong.stats.intervals import Estimate, mean_and_half_width, wilson_interval

# costs by their names in `lifelong.training.costs`: head of the column, its tooltip, and how a value is shown
_bytes, _flop = (partial(quantity, unit=unit) for unit in ("B", "FLOP"))
_percent, _count = "{:.3g} %".format, "{:.0f}".format
COST_COLUMNS: dict[str, tuple[str, str, Callable[[float], str]]] = {
    "training_seconds": ("Training", "wall time of training on a task", duration),
    "evaluation_seconds": ("Evaluation", "wall time of rollouts while and after learning a task", duration),
    "end_task_seconds": ("Between tasks", "wall time of what the algorithm does after a task", duration),
    "flops_per_step": (
        "FLOPs a step",
        "matrix products and convolutions of a training step with replay, and a penalty's element-wise operations; "
        "not those of layers and optimiser",
        _flop,
    ),
    "flops_per_action": ("FLOPs an action", "operations of one action with a full history", _flop),
    "parameters": ("Parameters", "of the policy and of what the algorithm trains beside it", quantity),
    "parameters_trained": ("Trained", "parameters that training may change", quantity),
    "stored_bytes": ("Stored", "kept from task to task: state, and frames to replay", _bytes),
    "kept_share": ("Kept", "share of the windows of all tasks so far that is kept to replay", _percent),
    "updates": ("Updates", "of the weights while learning a task", _count),
    "peak_gpu_bytes": ("GPU memory", "largest while learning a task", _bytes),
    "peak_memory_bytes": ("Memory", "largest of the process so far", _bytes),
}


@cache
def page_template(name: str, package: str = "lifelong.report") -> jinja2.Template:
    """Return a template of a package, with filters `percent`, `quantity` and `counted`; an undefined name is an error.

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
    environment.filters.update(percent=percent, quantity=quantity, counted=counted)
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


def with_contents(page: str) -> str:
    """Return a page with a list of its sections under its head."""
    titles = re.findall("<h2>(.*?)</h2>", page)
    for number, title in enumerate(titles):
        page = page.replace(f"<h2>{title}</h2>", f'<h2 id="s{number}">{title}</h2>', 1)
    links = "".join(f'<a href="#s{number}">{title}</a>' for number, title in enumerate(titles))
    return page.replace("</header>", f'<nav class="contents">{links}</nav></header>', 1)


def cost_table(name: str, rows: Sequence[tuple[str, Mapping[str, float]]]) -> Table:
    """Return labelled rows of costs, with the columns that any row has; without rows if there are none.

    Args:
        name: Head of the labels.
    """
    columns = {
        name: column for name, column in COST_COLUMNS.items() if any(name in costs for _, costs in rows)
    }

    def text(costs: Mapping[str, float], name: str) -> str:
        return columns[name][2](costs[name]) if np.isfinite(costs.get(name, np.nan)) else "–"

    heads = [Cell(head, title=title) for head, title, _ in columns.values()]
    return Table(
        [name, *heads], [[label, *(text(costs, one) for one in columns)] for label, costs in rows if costs]
    )


def task_costs(run: Run, labels: Sequence[str]) -> Table:
    """Return the costs of every task of a run, of tasks that are learned together in one row, and their average."""
    rows = []
    for last, costs in run.results.costs_by_task().items():
        first = stage_of(run, last)[0]
        name = f"{last + 1}  {labels[last]}" if first == last else f"{first + 1} to {last + 1}, together"
        rows.append((name, costs))
    return cost_table("task", [*rows, ("average of a task; largest memory", costs_of([run]))] if rows else [])


def atom_table(found: Subgoals, labels: Sequence[str]) -> Table:
    """Return how often each atom of each task was reached; the first of a task has the task's label."""
    rows, task = list[list[object]](), -1
    for a in found.atoms:
        held = (
            "held from the start" if a.at_start == 1 else f"held from the start in {percent(a.at_start, 0)} %"
        )
        names = (a.task + 1, labels[a.task]) if a.task != task else ("", "")
        rates = (a.learned_ever, a.learned_end, a.final_ever, a.final_end, a.forgotten)
        note = held if a.at_start > 0 else ""
        rows.append([*names, Cell(a.atom.strip("()"), note), *(percent(rate, 0) for rate in rates)])
        task = a.task
    ever = [
        f"reached at any time, {when}" for when in ("right after learning the task", "after the last task")
    ]
    end = Cell("Held", title="held when the episode ended")
    heads = (Cell("Just learned", title=ever[0]), end, Cell("At the end", title=ever[1]), end, "forgotten")
    return Table(("#", "task", "atom", *heads), rows, left=3)


def collection_table(iterations: Mapping[int, Sequence[CollectionRecord]], labels: Sequence[str]) -> Table:
    """Return what each task that is learned from reward was learned from, and how that changed."""
    rows: list[list[object]] = []
    for task, found in iterations.items():
        ends = found[0], found[-1]
        numbers = [quantity(sum(getattr(r, name) for r in found)) for name in ("episodes", "steps")]
        numbers += [f"{percent(r.successes / max(1, r.episodes), 0)} %" for r in ends]
        numbers += [f"{np.mean([r.groups for r in found]):.1f}", *(f"{r.entropy:.2f}" for r in ends)]
        rows.append([task + 1, labels[task], *numbers, duration(sum(r.seconds for r in found))])
    heads = (
        Cell("Drawn, first", title="success of drawn actions in the first iteration"),
        Cell("Last", title="and in the last one"),
        Cell("Spread", title="mean number of groups with successes and failures"),
        Cell("Entropy, first", title="of the drawn actions in the first iteration, nat"),
        Cell("Last", title="and in the last one"),
    )
    return Table(("#", "task", "episodes", "control steps", *heads, "time"), rows, left=2)


def most_forgotten(atoms: Iterable[AtomRates], threshold: float = 0.005) -> list[AtomRates]:
    """Return the atoms that were forgotten most, worst first: at most three, above the given threshold."""
    lost = [a for a in atoms if a.forgotten > threshold and a.at_start < 1]
    return sorted(lost, key=lambda a: -a.forgotten)[:3]


def shift_table(score: ShiftScore, labels: Sequence[str]) -> Table:
    """Return the table of success and forgetting under a held-out shift.

    Args:
        score: Success under the shift.
        labels: Short names of the run's tasks.
    """
    names, ways = ("learned", "learned_shifted", "final", "final_shifted"), (False, True)
    rows: list[list[object]] = []
    for task in score.tasks:
        rates = [*map(task.rate, names), *(task.forgotten(shifted=way) for way in ways)]
        rows.append([task.task + 1, labels[task.task], *(percent(rate, 0) for rate in rates)])
    means = [*map(score.success, names), *(score.forgetting(shifted=way) for way in ways)]
    rows.append(["", Cell("mean", strong=True), *(estimate_cell(e, strong=True) for e in means)])
    heads = [part for name in ("just learned", "at the end", "forgotten") for part in (name, "under shift")]
    return Table(("#", "task", *heads), rows, left=2)


def estimate_cell(e: Estimate | None, digits: int = 0, *, strong: bool = False) -> Cell:
    """Return an estimate in percent with its interval behind it; a dash for none."""
    if e is None:
        return Cell("–")
    known = not np.isnan(e.low)
    note = f"[{percent(e.low, digits)}, {percent(e.high, digits)}]" if known else ""
    return Cell(percent(e.value), note, strong)


def interference_table(score: FailureScore | None, labels: Sequence[str]) -> Table | None:
    """Return how many rollouts of each task served another one; None where none did."""
    if score is None or not score.interference:
        return None
    tasks = sorted({task for pair in score.interference for task in pair})
    rows = [[t + 1, labels[t], *(score.interference.get((t, k), "") for k in tasks)] for t in tasks]
    return Table(("#", "task", *(task + 1 for task in tasks)), rows, left=2)


def tally_tables(score: Tally | None, labels: Sequence[str]) -> list[Table]:
    """Return tables of rollouts by outcome: of each task at the end, and of all after learning each.

    Args:
        score: Numbers of rollouts.
        labels: Short names of the run's tasks.
    """
    if score is None:
        return []
    return [
        Table(
            ("#", head, *score.outcomes),
            [[k + 1, labels[k], *(found.get(one, 0) for one in score.outcomes)] for k, found in rows.items()],
            left=2,
        )
        for head, rows in (("task, at the end", score.by_task), ("all tasks, after learning", score.after))
    ]


def run_heatmap(results: Results, labels: Sequence[str]) -> dict[str, Any]:
    """Return the cells of one run's matrix: percent, colours, and Wilson's interval as the tooltip."""
    rates, episodes = results.success_matrix()
    low, high = wilson_interval(np.nan_to_num(rates) * episodes, episodes)

    def hint(i: int, j: int) -> str:
        found = f"{round(rates[i, j] * episodes[i, j])} of {episodes[i, j]} episodes"
        return found + (f"; 95 % interval {text.replace('–', ' to ')} %" if (text := detail(i, j)) else "")

    def detail(i: int, j: int) -> str:
        return "" if np.isnan(low[i, j]) else f"{100 * low[i, j]:.0f}–{100 * high[i, j]:.0f}"

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


def shift_tables(found: Mapping[str, Any], references: Sequence[str]) -> dict[str, Table]:
    """Return by held-out shift a row for each method that was evaluated under it, beside the references."""
    groups: Mapping[str, Any] = found["groups"]
    tables = {}
    for shift in dict.fromkeys(shift for group in groups.values() for shift in group["shifts"]):
        own = {label: group["shifts"][shift] for label, group in groups.items() if shift in group["shifts"]}
        names = [name for name in references if name in own]
        rows: list[list[object]] = []
        for label, values in own.items():
            lost = [values["lost"], *map(values["lost_less"].get, names)]
            cells = [estimate_cell(one and Estimate(**one), 1) for one in lost]
            rows.append(
                [label, values["runs"], *map(percent, (values["final"], values["final_shifted"])), *cells]
            )
        heads = ("method", "runs", "at the end", "under shift", "lost", *(f"less {name}'s" for name in names))
        tables[shift] = Table(heads, rows)
    return tables


def method_table(
    found: dict[str, Any], key: str, digits: int, texts: Mapping[str, str] | None = None
) -> Table:
    """Return a row for each task or predicate, with its value in each method, ± half of Student's interval.

    Args:
        key: What a group has the values under.
        digits: Digits of percents.
        texts: The names in the order of the rows, each with its text; by default the names in the groups.
    """

    def cell(value: Mapping[str, Any] | None) -> Cell:
        if value is None:
            return Cell("–")
        shown, of = value.get("forgotten", value), value.get("learned")
        half = "" if np.isnan(shown["half_width"]) else f"± {percent(shown['half_width'], digits)}"
        note = f"{half} of {percent(of['mean'], 0)}".strip() if of else half
        return Cell(percent(shown["mean"], digits), note)

    tables = [group[key] for group in found["groups"].values()]
    rows = texts or {name: name.replace("_", " ") for table in tables for name in table}
    return Table(
        ("", *map(Cell, found["groups"])),
        [
            [text, *(cell(table.get(name)) for table in tables)]
            for name, text in rows.items()
            if any(name in table for table in tables)
        ],
    )


def subgoal_table(found: Subgoals) -> Table:
    """Return how often each predicate was reached."""
    rows = []
    for p in found.predicates:
        low, high = percent(p.forgotten.low, 0), percent(p.forgotten.high, 0)
        forgotten = Cell(percent(p.forgotten.value, 0), strong=True)
        rates = [percent(e.value, 0) for e in (p.learned, p.final)]
        rows.append([p.predicate, len(p.tasks), *rates, forgotten, "–" if low == "–" else f"{low} to {high}"])
    return Table(("predicate", "tasks", "just learned", "at the end", "forgotten", "95 % interval"), rows)
