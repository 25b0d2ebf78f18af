"""Comparison of groups of runs: means over seeds, intervals, differences, forgetting by task, costs.

The number after ± is the standard error over seeds; the intervals are those of `lifelong.results.bootstrap`.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from libero_env.storage import atomic_write_text
from lifelong.report.runs import Group, Run
from lifelong.results.bootstrap import DRAWS, Member, Resamples, resample
from lifelong.results.metrics import METRIC_NAMES, Estimate, mean_and_standard_error
from lifelong.results.summary import json_safe

CONFIDENCE = 0.95
SEED = 2023  # of the bootstrap


def compare(groups: Sequence[Group]) -> dict[str, Any]:
    """Compute all statistics of the groups, as plain data with NaN where something is unknown.

    Args:
        groups: Groups of runs that differ in seed and order only. Runs without a learned task are ignored.

    Returns:
        `groups`: by label, with `runs`, `seeds`, `orders`, `metrics` (mean, standard_error, low, high and the value of
        each run), `forgetting_by_task` (NBT by task name), `subgoals` and `costs`; `differences`: of each pair, the
        first minus the second; `bootstrap`: the parameters of the intervals.
    """
    measured = {g.label: [r for r in g.runs if r.metrics is not None] for g in groups}
    drawn = {
        label: resample([Member(r.results.scores(), r.record.tasks) for r in runs], seed=(SEED, number))
        for number, (label, runs) in enumerate(measured.items())
        if runs
    }
    return {
        "groups": {g.label: _group(g, measured[g.label], drawn.get(g.label)) for g in groups},
        "differences": [
            {
                "of": a,
                "less": b,
                "metrics": {n: _interval(drawn[a].difference(drawn[b], n)) for n in METRIC_NAMES},
            }
            for a, b in combinations(drawn, 2)
        ],
        "bootstrap": {
            "draws": DRAWS,
            "seed": SEED,
            "confidence": CONFIDENCE,
            "levels": ["order", "run", "episode"],
        },
    }


def write_comparison(found: Mapping[str, Any], path: Path) -> None:
    """Write the result of `compare` as JSON, in one step; NaN becomes null."""
    atomic_write_text(
        path, json.dumps(json_safe(found), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    )


def _group(group: Group, runs: Sequence[Run], drawn: Resamples | None) -> dict[str, Any]:
    return {
        "runs": [str(r.path) for r in group.runs],
        "seeds": [r.record.seed for r in group.runs],
        "orders": len({r.record.tasks for r in group.runs}),
        "measured": len(runs),
        "metrics": {n: _metric(n, runs, drawn) for n in METRIC_NAMES},
        "forgetting_by_task": _forgetting(runs),
        "subgoals": _subgoals(runs),
        "costs": costs_of(runs),
    }


def _metric(name: str, runs: Sequence[Run], drawn: Resamples | None) -> dict[str, Any]:
    values = [getattr(r.metrics, name).value for r in runs]
    mean, error = mean_and_standard_error(values)
    interval = drawn.interval(name, CONFIDENCE) if drawn else Estimate(np.nan, np.nan, np.nan)
    return {
        "mean": mean,
        "standard_error": error,
        "low": interval.low,
        "high": interval.high,
        "values": values,
    }


def _interval(estimate: Estimate) -> dict[str, float]:
    return {"value": estimate.value, "low": estimate.low, "high": estimate.high}


def _forgetting(runs: Sequence[Run]) -> dict[str, dict[str, float]]:
    """Return NBT_k of every task by its name, over the runs in which another task followed it."""
    found: dict[str, list[float]] = {}
    for run in runs:
        assert run.metrics is not None
        followed = run.record.group(run.learned - 1).start
        for name, value in zip(run.record.tasks[:followed], run.metrics.nbt_by_task, strict=False):
            found.setdefault(name, []).append(float(value))
    return {name: _mean(values) for name, values in found.items()}


def _subgoals(runs: Sequence[Run]) -> dict[str, dict[str, dict[str, float]]]:
    """Return how often each predicate was reached right after learning, at the end, and the difference."""
    rows = [p for run in runs for p in run.results.subgoals().predicates]
    return {
        name: {
            what: _mean([getattr(p, what).value for p in rows if p.predicate == name])
            for what in ("learned", "final", "forgotten")
        }
        for name in dict.fromkeys(p.predicate for p in rows)
    }


def costs_of(runs: Sequence[Run]) -> dict[str, float]:
    """Return the costs of a method: storage at the end, the largest peaks, and means over tasks of everything else.

    Costs that no run recorded are omitted.
    """
    by_task: list[dict[str, float]] = []
    last: list[dict[str, float]] = []
    for run in runs:
        tasks = [t for t in range(len(run.record.tasks)) if run.results.costs(t)]
        rows = [run.results.costs(t) | _seconds(run, t) for t in tasks]
        by_task += rows
        last += rows[-1:]
    reduced: dict[str, tuple[list[dict[str, float]], Callable[[Any], Any]]] = {
        "stored_bytes": (last, np.mean),
        "peak_gpu_bytes": (by_task, np.max),
        "peak_memory_bytes": (by_task, np.max),
    }
    names = dict.fromkeys(name for row in by_task for name in row)
    found = {}
    for name in names:
        rows, reduce = reduced.get(name, (by_task, np.mean))
        values = [row[name] for row in rows if name in row]
        found[name] = float(reduce(values)) if values else float("nan")
    return found


def _seconds(run: Run, task: int) -> dict[str, float]:
    return {f"{name}_seconds": value for name, value in run.results.task_seconds(task).items()}


def _mean(values: Sequence[float]) -> dict[str, float]:
    known = [v for v in values if not np.isnan(v)]
    mean, error = mean_and_standard_error(known)
    return {"mean": mean, "standard_error": error}
