"""What a run leaves for others: `results.json`, and every episode of one or several runs as a table.

results.json     the success matrix, learning curves, metrics and times of a run
episodes.csv.gz  one row an episode: the method's label, the run's number among those of its method, seeds of the run
                 and its demonstrations, its order, `transfer` (how its forward transfer is estimated), `together`
                 (numbers of tasks learned together), which `cells` of the matrix were measured, their share, the seed
                 by which they were drawn (empty: one drawing for all runs), the evaluation (`phase` curve or matrix,
                 `row`: position of the task learned last, `epoch` trained on it), the task (`position` in the sequence,
                 and its name), `start` (initial state), `success` (0 or 1), `length` [control steps]; the last two are
                 empty where a simulation error ended the episode. Of a run that is not finished, the episodes of the
                 tasks that it has learned
"""

import csv
import gzip
import io
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from libero_env.storage import atomic_path, atomic_write_text
from libero_env.text import json_safe, to_json
from lifelong.errors import ResultsError, writing
from lifelong.results.failures import rollout_summary
from lifelong.results.provenance import resume_notes
from lifelong.results.records import DemonstrationsRecord, RunRecord, TaskEndRecord
from lifelong.results.results import Results
from lifelong.results.shifts import shift_summary
from lifelong.stats.intervals import wilson_interval
from lifelong.stats.metrics import METRIC_NAMES, Metrics, lifelong_metrics

COLUMNS = (
    *("method", "run", "seed", "data_seed", "order", "transfer", "together"),
    *("cells", "cells_share", "cells_seed"),
    *("phase", "row", "epoch", "position", "task", "start", "success", "length"),
)
_OF_EPISODES = (
    *("phase", "learned", "epoch", "task"),
    *("init_states", "successes", "lengths", "simulation_errors"),
)


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
        atomic_write_text(path, _compact(to_json(summary)), fsync=True)
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
            "interval": "Wilson's over the episodes, 95 %; none for FWT, NBT and AUC",
            "transfer": results.transfer,
        },
        "metrics": _as_data(lifelong_metrics(results.scores())) if size else None,
        "metrics_after_base_stage": _as_data(results.after_base_stage()),
        "metrics_diagonal_from_curve": (
            _as_data(lifelong_metrics(results.scores("curve", "published"))) if size else None
        ),
        "metrics_of_other_conventions": results.other_conventions() if size else None,
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
        **rollout_summary(results),
        "costs": {str(task): costs for task, costs in results.costs_by_task().items()},
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


def _as_data(metrics: Metrics | None) -> dict[str, Any] | None:
    if metrics is None:
        return None
    by_task = {name: getattr(metrics, f"{name}_by_task").tolist() for name in ("fwt", "nbt", "auc")}
    return {name: asdict(getattr(metrics, name)) for name in METRIC_NAMES} | {"by_task": by_task}


def _compact(text: str) -> str:
    """Return indented JSON with lists of numbers in one line each."""
    return re.sub(r"\[\n\s*([^\[\]{}\"]*?)\n\s*\]", lambda m: f"[{' '.join(m[1].split())}]", text)


def write_episodes(path: Path, runs: Iterable[tuple[str, Results]]) -> Path:
    """Write all episodes of runs as CSV, compressed if the name ends in .gz; equal runs give equal bytes.

    Args:
        runs: Label of the method and results of each run.

    Raises:
        ResultsError: The file cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    orders: dict[tuple[str, ...], int] = {}
    numbers = Counter[str]()
    for method, results in runs:
        order = orders.setdefault(results.run.tasks, len(orders))
        numbers[method] += 1
        writer.writerows(_rows(method, numbers[method], order, results))
    content = text.getvalue().encode()
    with writing(path, "the episodes"), atomic_path(path) as part:
        part.write_bytes(gzip.compress(content, mtime=0) if path.suffix == ".gz" else content)
    return path


def _rows(method: str, number: int, order: int, results: Results) -> Iterator[tuple[Any, ...]]:
    run = results.run
    together = " ".join(str(len(group)) for group in run.groups)
    cells = (run.cells, run.cells_share, run.cells_seed)
    seeds, kind = (run.seed, run.data_seed), (results.transfer, together, *cells)
    learned = results.learned_tasks()
    for record in (r for r in results.evaluations() if r.learned < learned):
        place = (record.learned, record.epoch, record.task, run.tasks[record.task])
        key = (method, number, *seeds, order, *kind, record.phase, *place)
        for start, won, length in zip(record.init_states, record.successes, record.lengths, strict=True):
            yield (*key, start, int(won), length)
        yield from ((*key, start, "", "") for start, _ in record.simulation_errors)
