"""The runs of a table of episodes, `episodes.csv.gz` of a comparison, for whoever has no run directories."""

import csv
import gzip
import io
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from libero_env.validation import validate
from lifelong.errors import ResultsError
from lifelong.results.records import EvalRecord, Record, RunRecord, TaskEndRecord
from lifelong.results.results import Results
from lifelong.results.summary import COLUMNS


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
        orders: dict[str, dict[int, str]] = {}
        for row in reader:
            runs.setdefault((row["method"], row["run"]), []).append(row)
            orders.setdefault(row["order"], {})[int(row["position"])] = row["task"]
        return [(key[0], _results(rows, orders[rows[0]["order"]])) for key, rows in runs.items()]
    except (OSError, ValueError, LookupError, TypeError, EOFError, zlib.error) as error:
        raise ResultsError(f"{path}: the episodes cannot be read ({error})") from error


def _results(rows: list[dict[str, str]], names: Mapping[int, str]) -> Results:
    first = rows[0]
    count = sum(map(int, first["together"].split()))
    tasks = [names.get(place, f"not learned by any run of order {first['order']}") for place in range(count)]
    records: list[Record] = [_run(first, tasks)]
    cells: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for row in rows:
        cells.setdefault(tuple(row[c] for c in ("phase", "row", "epoch", "position")), []).append(row)
    kept: dict[int, int] = {}
    for episodes in cells.values():
        if not any(row["success"] for row in episodes):  # simulation errors ended all of them
            continue
        record = _evaluation(episodes)
        records.append(record)
        if record.phase == "matrix" or record.learned not in kept:
            kept[record.learned] = record.epoch
    records += [TaskEndRecord(task=task, best_epoch=epoch, seconds=0.0) for task, epoch in kept.items()]
    return Results(tuple(records))


def _run(row: Mapping[str, str], tasks: list[str]) -> RunRecord:
    values: dict[str, Any] = {
        **dict.fromkeys(("benchmark", "policy", "preset", "config_digest", "started"), ""),
        "algo": row["method"],
        "seed": int(row["seed"]),
        "data_seed": int(row["data_seed"]) if row["data_seed"] else None,
        "tasks": tasks,
        "instructions": [name.replace("_", " ") for name in tasks],
        "versions": {},
        "commit": None,
        "cpu_count": 0,
        "group_sizes": [int(size) for size in row["together"].split()],
        "transfer": row["transfer"],
        "cells": row["cells"],
        "cells_share": float(row["cells_share"]),
        "cells_seed": int(row["cells_seed"]) if row["cells_seed"] else None,
    }
    return validate(RunRecord, values)


def _evaluation(rows: list[dict[str, str]]) -> EvalRecord:
    lost = [(int(row["start"]), "") for row in rows if not row["success"]]
    rows = [row for row in rows if row["success"]]
    values: dict[str, Any] = {
        "phase": rows[0]["phase"],
        "learned": int(rows[0]["row"]),
        "epoch": int(rows[0]["epoch"]),
        "task": int(rows[0]["position"]),
        "successes": [bool(int(row["success"])) for row in rows],
        "lengths": [int(row["length"]) for row in rows],
        "init_states": [int(row["start"]) for row in rows],
        "simulation_errors": lost,
        "seconds": 0.0,
    }
    return validate(EvalRecord, values)
