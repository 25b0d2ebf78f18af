"""Comparison of groups of runs: means over seeds, intervals, differences, forgetting by task, costs.

The number after ± is the standard error over seeds; intervals and tests are those of `lifelong.report.statistics`.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from libero_env.storage import atomic_write_text
from lifelong.errors import ComparisonError
from lifelong.report.runs import Group, Run, other_demonstrations
from lifelong.report.statistics import statistics
from lifelong.results.metrics import METRIC_NAMES, mean_and_standard_error
from lifelong.results.results import has_later_tasks
from lifelong.results.samples import Member, metric_values
from lifelong.results.summary import json_safe

MUJOCO = "mujoco"  # back end of results that name none


def compare(groups: Sequence[Group]) -> dict[str, Any]:
    """Compute all statistics of the groups, as plain data with NaN where something is unknown.

    Args:
        groups: Groups of runs that differ in seed and order only. Runs without a learned task are ignored.

    Returns:
        `groups`: by label, with `runs`, `seeds`, `orders`, `metrics` (mean, standard_error, low, high, the value of
        each seed or order, standard deviations between these and of the starts), `published` (FWT and AUC of eq. 3 as
        written), `forgetting_by_task` (NBT by task name), `subgoals` and `costs`. `differences`: of each pair, the
        first minus the second, with its interval, its p-value, that adjusted for all pairs (`significant` if below
        0.05), the number of `seeds` needed to show it, and the difference `detectable` with the present ones.
        `statistics`: how they were computed. `after_base_stage`: `metrics` by label and `differences` over the later
        tasks alone, as if the sequence began with them, of the methods whose runs all learned a task after a base
        stage; None if there are none. `backend`: what simulated all rollouts. `other_demonstrations`: sentences about
        runs that learned from other demonstrations than the rest.

    Raises:
        ComparisonError: The runs are of different back ends.
    """
    measured = {g.label: [r for r in g.runs if r.metrics is not None] for g in groups}
    check_same_back_end(
        {f"{g.label} ({r.path})": r.record.backend for g in groups for r in measured[g.label]}
    )
    found = statistics({label: members_of(runs) for label, runs in measured.items() if runs})
    return {
        "backend": next((r.record.backend for runs in measured.values() for r in runs), MUJOCO),
        "groups": {g.label: _group(g, measured[g.label], found["metrics"].get(g.label)) for g in groups},
        "differences": found["differences"],
        "statistics": found["statistics"],
        "after_base_stage": _after_base_stage(measured),
        "other_demonstrations": other_demonstrations(groups),
    }


def _after_base_stage(measured: Mapping[str, Sequence[Run]]) -> dict[str, Any] | None:
    """Return metrics and differences over the later tasks alone, of the methods that learned some; None without any."""
    later = {
        label: [replace(m, scores=m.scores.without_first()) for m in members_of(runs)]
        for label, runs in measured.items()
        if runs and all(has_later_tasks(r.results) for r in runs)
    }
    found = statistics(later) if later else {}
    return {name: found[name] for name in ("metrics", "differences")} if found else None


def members_of(runs: Sequence[Run]) -> list[Member]:
    """Return runs as what the statistics take."""
    return [Member(r.results.scores(), r.record.seed, r.record.tasks) for r in runs]


def write_comparison(found: Mapping[str, Any], path: Path) -> None:
    """Write the result of `compare` as JSON, in one step; NaN becomes null."""
    atomic_write_text(
        path, json.dumps(json_safe(found), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    )


def _group(group: Group, runs: Sequence[Run], metrics: Mapping[str, Any] | None) -> dict[str, Any]:
    return {
        "runs": [str(r.path) for r in group.runs],
        "seeds": [r.record.seed for r in group.runs],
        "orders": len({r.record.tasks for r in group.runs}),
        "measured": len(runs),
        "metrics": metrics or {name: dict(_UNKNOWN) for name in METRIC_NAMES},
        "published": _published(runs),
        "forgetting_by_task": _forgetting(runs),
        "subgoals": _subgoals(runs),
        "costs": costs_of(runs),
    }


_UNKNOWN = {
    **dict.fromkeys(("mean", "standard_error", "low", "high", "sd_of_runs", "sd_of_starts"), float("nan")),
    "values": [],
}


def _published(runs: Sequence[Run]) -> dict[str, float]:
    """Return the means of FWT and AUC as eq. 3 is written, for comparison with published numbers."""
    values = [metric_values(r.results.scores("curve", "published")) for r in runs]
    return {name: float(np.mean([v[name] for v in values])) if values else np.nan for name in ("fwt", "auc")}


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


def check_same_back_end(of: Mapping[str, str]) -> None:
    """Check that results are of one back end: the physics and the pictures of others differ.

    Args:
        of: Back end of each result by its label.

    Raises:
        ComparisonError: There are several; the message names a result of each.
    """
    found = {name: label for label, name in of.items()}
    if len(found) > 1:
        names = ", ".join(f"{label} on backend={name}" for name, label in found.items())
        raise ComparisonError(
            f"results of different back ends are not compared: {names}; evaluate all on one, see --backend"
        )
