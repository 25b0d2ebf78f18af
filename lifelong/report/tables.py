"""Rows of a report's tables of costs and subgoals."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lifelong.report.comparison import costs_of
from lifelong.report.runs import Run
from lifelong.results.shifts import ShiftScore
from lifelong.results.subgoals import AtomRates, Subgoals


def episodes_text(run: int, copied: int) -> str:
    """Return a sentence about the episodes of a run, with a blank before it; nothing without any."""
    if not run + copied:
        return ""
    rest = f"; {copied} more would have repeated these to the bit and were copied" if copied else ""
    return f" {run} episodes were run{rest}."


def duration(seconds: float) -> str:
    """Format seconds for readers: 0.4 s, 42 s, 3 min 20 s, 2 h 05 min."""
    if seconds < 1:
        return f"{seconds:.1g} s" if seconds else "0 s"
    seconds = round(seconds)
    if seconds < 60:
        return f"{seconds} s"
    if seconds < 3600:
        return f"{seconds // 60} min {seconds % 60:02d} s"
    return f"{seconds // 3600} h {seconds % 3600 // 60:02d} min"


def quantity(value: float, unit: str = "") -> str:
    """Format a number with three digits and its SI prefix: 5.38 M, 1.20 TFLOP, 512 B."""
    for power, prefix in ((12, "T"), (9, "G"), (6, "M"), (3, "k")):
        if value >= 10**power:
            digits = f"{value / 10**power:#.3g}".rstrip(".")
            return f"{digits} {prefix}{unit}".rstrip()
    return f"{value:.0f} {unit}".rstrip()


@dataclass(frozen=True)
class Column:
    """A column of the table of costs.

    Attributes:
        name: Name of the cost, as in `lifelong.training.costs`.
        head: Head of the column.
        title: Tooltip of the head.
        text: Function that formats a value.
    """

    name: str
    head: str
    title: str
    text: Callable[[float], str]


def _flops(value: float) -> str:
    return quantity(value, "FLOP")


def _bytes(value: float) -> str:
    return quantity(value, "B")


COST_COLUMNS = (
    Column("training_seconds", "Training", "wall time of training on a task", duration),
    Column(
        "evaluation_seconds", "Evaluation", "wall time of rollouts while and after learning a task", duration
    ),
    Column(
        "end_task_seconds", "Between tasks", "wall time of what the algorithm does after a task", duration
    ),
    Column(
        "flops_per_step", "A step", "operations of a training step, replay and penalties included", _flops
    ),
    Column("flops_per_action", "An action", "operations of one action with a full history", _flops),
    Column("parameters", "Parameters", "of the policy and of what the algorithm trains beside it", quantity),
    Column("parameters_trained", "Trained", "parameters that the optimiser moves", quantity),
    Column("stored_bytes", "Stored", "kept from task to task: state, and frames to replay", _bytes),
    Column("peak_gpu_bytes", "GPU memory", "largest while learning a task", _bytes),
    Column("peak_memory_bytes", "Memory", "largest of the process so far", _bytes),
)


def cost_table(rows: Sequence[tuple[str, Mapping[str, float]]]) -> dict[str, Any] | None:
    """Return labelled rows of costs, with the columns that any row has; None if there are none."""
    columns = [c for c in COST_COLUMNS if any(c.name in costs for _, costs in rows)]
    if not columns:
        return None
    texts = [
        (label, [c.text(costs[c.name]) if np.isfinite(costs.get(c.name, np.nan)) else "–" for c in columns])
        for label, costs in rows
        if costs
    ]
    return {"columns": columns, "rows": texts}


def task_costs(run: Run, labels: Sequence[str]) -> dict[str, Any] | None:
    """Return the costs of every task of a run, and their average."""
    results = run.results
    recorded = [task for task in range(len(labels)) if results.costs(task)]
    rows = [
        (
            f"{t + 1}  {labels[t]}",
            results.costs(t) | {f"{k}_seconds": v for k, v in results.task_seconds(t).items()},
        )
        for t in recorded
    ]
    return cost_table([*rows, ("average; largest memory", costs_of([run]))]) if rows else None


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
    names = ("learned", "learned_shifted", "final", "final_shifted")
    rows = [
        {
            "number": task.task + 1,
            "label": labels[task.task],
            "cells": [
                *(task.rate(name) for name in names),
                *(task.forgotten(shifted=shifted) for shifted in (False, True)),
            ],
        }
        for task in score.tasks
    ]
    means = [*map(score.success, names), *(score.forgetting(shifted=shifted) for shifted in (False, True))]
    return {"name": score.shift, "rows": rows, "means": means}
