"""Every episode of one or several runs as a table (CSV), so that others can test again, and back.

One row an episode: the method's label, seed and order of the run, `transfer` (how its forward transfer is estimated),
`together` (numbers of tasks learned together), the evaluation (`phase` curve or matrix, `row`: position of the task
learned last, `epoch` trained on it), the task (`position` in the sequence, and its name), `start` (initial state),
`success` (0 or 1), `length` [control steps].
"""

import csv
import gzip
import io
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from libero_env.storage import atomic_path
from libero_env.validation import validate
from lifelong.errors import ResultsError
from lifelong.results.records import EvalRecord, Record, RunRecord, TaskEndRecord
from lifelong.results.results import Results

COLUMNS = (
    *("method", "seed", "order", "transfer", "together", "phase", "row", "epoch", "position", "task"),
    *("start", "success", "length"),
)


def write_episodes(path: Path, runs: Iterable[tuple[str, Results]]) -> Path:
    """Write all episodes of runs as CSV, compressed if the name ends in .gz; equal runs give equal bytes.

    Args:
        path: File to write.
        runs: Label of the method and results of each run.

    Raises:
        ResultsError: The file cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    orders: dict[tuple[str, ...], int] = {}
    for method, results in runs:
        order = orders.setdefault(results.run.tasks, len(orders))
        writer.writerows(_rows(method, order, results))
    content = text.getvalue().encode()
    try:
        with atomic_path(path) as part:
            part.write_bytes(gzip.compress(content, mtime=0) if path.suffix == ".gz" else content)
    except OSError as error:
        raise ResultsError(f"{path}: the episodes cannot be written ({error})") from error
    return path


def _rows(method: str, order: int, results: Results) -> Iterator[tuple[Any, ...]]:
    run = results.run
    together = " ".join(str(len(group)) for group in run.groups)
    for record in results.evaluations():
        task = run.tasks[record.task] if record.task < len(run.tasks) else ""
        key = (method, run.seed, order, results.transfer, together, record.phase, record.learned)
        for start, won, length in zip(record.init_states, record.successes, record.lengths, strict=True):
            yield (*key, record.epoch, record.task, task, start, int(won), length)


def read_episodes(path: Path) -> list[tuple[str, Results]]:
    """Return the runs of a table as (label, results), enough for all metrics, intervals and tests.

    Raises:
        ResultsError: The file is missing or is no such table.
    """
    try:
        content = path.read_bytes()
        text = (gzip.decompress(content) if path.suffix == ".gz" else content).decode()
        reader = csv.DictReader(io.StringIO(text))
        if tuple(reader.fieldnames or ()) != COLUMNS:
            raise ResultsError(f"{path} is no table of episodes; expected the columns {', '.join(COLUMNS)}")
        runs: dict[tuple[str, ...], list[dict[str, str]]] = {}
        for row in reader:
            runs.setdefault(tuple(row[c] for c in COLUMNS[:3]), []).append(row)
        return [(key[0], _results(rows)) for key, rows in runs.items()]
    except (OSError, ValueError, KeyError, TypeError, EOFError) as error:
        raise ResultsError(f"{path}: the episodes cannot be read ({error})") from error


def _results(rows: list[dict[str, str]]) -> Results:
    names = {int(row["position"]): row["task"] for row in rows}
    tasks = [names[place] for place in range(max(names) + 1)]
    first = rows[0]
    records: list[Record] = [_run(first, tasks)]
    cells: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for row in rows:
        cells.setdefault(tuple(row[c] for c in ("phase", "row", "epoch", "position")), []).append(row)
    kept: dict[int, int] = {}
    for episodes in cells.values():
        record = _evaluation(episodes)
        records.append(record)
        if record.phase == "matrix":
            kept[record.learned] = record.epoch
    records += [TaskEndRecord(task=task, best_epoch=epoch, seconds=0.0) for task, epoch in kept.items()]
    return Results(tuple(records))


def _run(row: Mapping[str, str], tasks: list[str]) -> RunRecord:
    values: dict[str, Any] = {
        **dict.fromkeys(("benchmark", "policy", "preset", "config_digest", "started"), ""),
        "algo": row["method"],
        "seed": int(row["seed"]),
        "tasks": tasks,
        "instructions": [name.replace("_", " ") for name in tasks],
        "versions": {},
        "commit": None,
        "cpu_count": 0,
        "group_sizes": [int(size) for size in row["together"].split()],
        "transfer": row["transfer"],
    }
    return validate(RunRecord, values)


def _evaluation(rows: list[dict[str, str]]) -> EvalRecord:
    values: dict[str, Any] = {
        "phase": rows[0]["phase"],
        "learned": int(rows[0]["row"]),
        "epoch": int(rows[0]["epoch"]),
        "task": int(rows[0]["position"]),
        "successes": [bool(int(row["success"])) for row in rows],
        "lengths": [int(row["length"]) for row in rows],
        "init_states": [int(row["start"]) for row in rows],
        "seconds": 0.0,
    }
    return validate(EvalRecord, values)
