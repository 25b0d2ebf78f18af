"""`results.json`: the success matrix, learning curves, metrics and times of a run."""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from libero_env.storage import atomic_write_text
from lifelong.errors import ResultsError
from lifelong.results.conditions import resume_notes
from lifelong.results.records import DemonstrationsRecord, RunRecord, TaskEndRecord
from lifelong.results.results import Results
from lifelong.results.shifts import shift_summary
from lifelong.stats.intervals import wilson_interval
from lifelong.stats.metrics import METRIC_NAMES, Metrics, Scores, lifelong_metrics

# Grows when the same records give other metrics. 2: intervals of clusters, forward transfer without a held maximum.
STATISTICS = 2
_OF_EPISODES = ("phase", "learned", "epoch", "task", "init_states", "successes", "lengths")


def write_summary(path: Path | str, results: Results, config: Mapping[str, Any]) -> dict[str, Any]:
    """Write `results.json`: matrix, curves, metrics with intervals, configuration, versions and wall times.

    The file is replaced in one step, so a reader never sees half of it.

    Args:
        path: File to write, usually `run_dir/results.json`.
        results: Results so far; a run need not be finished.
        config: Resolved configuration as plain data.

    Returns:
        The content of the file. Rates are in [0, 1]; NaN is null.
    """
    summary = json_safe(summarize(results) | {"config": dict(config)})
    path = Path(path)
    try:
        atomic_write_text(path, compact_json(summary), fsync=True)
    except OSError as error:
        raise ResultsError(
            f"{path}: the summary cannot be written ({error}); results.jsonl is intact"
        ) from error
    return summary


def summarize(results: Results) -> dict[str, Any]:
    """Return the summary as plain data: the run, its success, metrics, costs and times."""
    run, size = results.run, results.learned_tasks()
    rates, episodes = results.success_matrix()
    low, high = wilson_interval(np.nan_to_num(rates) * episodes, episodes)
    unseen = np.isnan(rates)
    ends = {r.task: r.best_epoch for r in results.of(TaskEndRecord)}
    return {
        "run": _without_kind(run),
        "resumed_under_other_conditions": resume_notes(results),
        "demonstrations": _without_kind(results.demonstrations),
        "finished": results.finished,
        "tasks_learned": size,
        "statistics": {
            "version": STATISTICS,
            "interval": "Wilson's over the episodes, 95 %; none for FWT, NBT and AUC",
            "transfer": results.transfer,
        },
        "metrics": _metrics(results.scores()) if size else None,
        "metrics_after_base_stage": _metrics_after_base_stage(results),
        "metrics_diagonal_from_curve": _metrics(results.scores("curve", "published")) if size else None,
        "success_matrix": {
            "rates": rates.tolist(),
            "episodes": episodes.tolist(),
            "wilson_low": np.where(unseen, np.nan, low).tolist(),
            "wilson_high": np.where(unseen, np.nan, high).tolist(),
        },
        "curves": {
            str(task): {name: getattr(curve, name).tolist() for name in ("epochs", "rates", "episodes")}
            for task, curve in sorted(results.curves().items())
        },
        "losses": {
            str(task): {"epochs": epochs.tolist(), "losses": losses.tolist()}
            for task, (epochs, losses) in sorted(results.losses().items())
        },
        "best_epochs": {str(task): ends[task] for task in sorted(ends)},
        "subgoals": asdict(results.subgoals()),
        **({"shifts": shifts} if (shifts := shift_summary(results)) else {}),
        "costs": {
            str(task): results.costs(task)
            | {f"{k}_seconds": v for k, v in results.task_seconds(task).items()}
            for task in range(len(run.tasks))
            if results.costs(task)
        },
        "seconds_by_phase": results.seconds_by_phase(),
        "episodes": dict(zip(("run", "copied"), results.episodes(), strict=True)),
        "problems": list(results.problems),
        "evaluations": [
            {name: plain for name, plain in asdict(r).items() if name in _OF_EPISODES}
            for r in results.evaluations()
        ],
    }


def _without_kind(record: RunRecord | DemonstrationsRecord | None) -> dict[str, Any] | None:
    return None if record is None else {k: v for k, v in asdict(record).items() if k != "kind"}


def _metrics(scores: Scores) -> dict[str, Any]:
    return _as_data(lifelong_metrics(scores))


def _metrics_after_base_stage(results: Results) -> dict[str, Any] | None:
    """Return the metrics over the later tasks alone; None without a base stage, or before one of them is learned."""
    found = results.after_base_stage()
    return None if found is None else _as_data(found)


def _as_data(found: Metrics) -> dict[str, Any]:
    by_task = {name: getattr(found, f"{name}_by_task").tolist() for name in ("fwt", "nbt", "auc")}
    return {name: asdict(getattr(found, name)) for name in METRIC_NAMES} | {"by_task": by_task}


def compact_json(value: Any) -> str:
    """Return indented JSON with lists of numbers in one line each."""
    text = json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False)
    return re.sub(r"\[\n\s*([^\[\]{}\"]*?)\n\s*\]", lambda m: f"[{' '.join(m[1].split())}]", text)


def json_safe(value: Any) -> Any:
    """Return the same data with None for numbers that are not finite, as JSON has no NaN."""
    if isinstance(value, Mapping):
        return {str(k): json_safe(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [json_safe(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
