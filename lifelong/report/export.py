"""Runs as a table for other programs: a pandas DataFrame, CSV, Parquet, and LaTeX for a paper."""

import math
import re
import sys
from collections.abc import Mapping, Sequence
from glob import glob
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from libero_env.errors import need
from libero_env.storage import atomic_path, files_below
from libero_env.text import Table, counted, flatten
from lifelong.errors import LifelongError
from lifelong.report.comparison import compare, costs_of
from lifelong.report.runs import Group, Run, group_runs, load_run
from lifelong.results.provenance import few_of
from lifelong.results.summary import summarize
from lifelong.stats.metrics import METRIC_NAMES

if TYPE_CHECKING:
    import pandas as pd

_TITLES = {"final_success": "final", "just_learned": "just learned"}


def load_runs(*patterns: str | Path) -> "pd.DataFrame":
    """Return a table of runs, a row each.

    Columns: `path`, `method` (the label of the reports), `algo`, `benchmark`, `policy`, `preset`, `seed`, `counted`
    (whether reports count it: not a further run of a seed, nor one behind others of its method), `finished`, `tasks`,
    `tasks_learned`, `transfer` (how forward transfer is estimated); the metrics `fwt`, `nbt`, `auc`, `final_success`,
    `just_learned`, each with `_low` and `_high` of its interval, and those of other conventions; `cost.NAME`, the
    costs of the reports (bytes, seconds, parameters, FLOPs); `config.KEY` for every key of the configuration.

    Args:
        patterns: Run directories, folders that hold some at any depth, or patterns such as `runs/*/er/*`.

    Raises:
        MissingPackageError: pandas is not installed.
        LifelongError: A pattern holds no run, or a run cannot be read.
    """
    return need("pandas").DataFrame(_rows(patterns))


def _rows(patterns: Sequence[str | Path]) -> list[dict[str, object]]:
    """Return what `load_runs` has of each run."""
    runs = find_runs(patterns)
    groups = {
        run.path: group for group in group_runs(runs) for run in (*group.runs, *group.repeats, *group.behind)
    }
    return [_row(run, groups[run.path]) for run in runs]


def find_runs(patterns: Sequence[str | Path]) -> list[Run]:
    """Return the runs that patterns name, in the order of their paths; see `load_runs`.

    Pretrainings and those that `resume=false` moved aside (`.old1`) are left out, unless one is named itself.
    """
    found: dict[Path, None] = {}
    for pattern in map(str, patterns):
        folders = [Path(name) for name in sorted(glob(pattern))] or [Path(pattern)]
        logs = [log for folder in folders for log in sorted(files_below(folder, "results.jsonl"))]
        inside = [
            run
            for log in logs
            if (run := log.parent) == Path(pattern)
            or not (re.search(r"\.old\d+$", run.name) or run.parent.parent.name == "pretrain")
        ]
        if not inside:
            raise LifelongError(f"{pattern}: no run directory is there (with a file results.jsonl)")
        found |= dict.fromkeys(inside)
    return [load_run(path) for path in found]


def export_runs(
    patterns: Sequence[str | Path], form: Literal["csv", "latex", "parquet"], target: Path
) -> Path:
    """Write runs as `csv` or `parquet`, a row each (`load_runs`), or as `latex`, a row a method over its seeds.

    The LaTeX table is of the package booktabs: the mean over seeds and its 95 % interval, in percent.

    Raises:
        MissingPackageError: pandas or pyarrow, which write `parquet`, is not installed.
        LifelongError: The runs cannot be read or compared, or the file cannot be written.
    """
    content = _latex(find_runs(patterns)) if form == "latex" else _csv(patterns) if form == "csv" else ""
    table = load_runs(*patterns) if form == "parquet" and need("pyarrow") else None
    try:
        with atomic_path(target) as part:
            if table is None:
                part.write_bytes(content.encode())
            else:
                table.to_parquet(part, index=False)
    except OSError as error:
        raise LifelongError(f"{target}: the table cannot be written: {error}") from error
    return target


def _csv(patterns: Sequence[str | Path]) -> str:
    rows = _rows(patterns)
    keys = list(dict.fromkeys(chain(*rows)))
    cells = [[row.get(key, "") for key in keys] for row in rows]
    return Table(keys, [["" if value != value else value for value in row] for row in cells]).csv()


def _row(run: Run, group: Group) -> dict[str, object]:
    record = run.record
    row: dict[str, object] = {
        "path": str(run.path),
        "method": group.label,
        **{name: getattr(record, name) for name in ("algo", "benchmark", "policy", "preset", "seed")},
        "counted": run in group.runs,
        "finished": run.results.finished,
        "tasks": len(record.tasks),
        "tasks_learned": run.learned,
        "transfer": run.results.transfer,
    }
    if run.metrics is not None:
        for name in METRIC_NAMES:
            estimate = getattr(run.metrics, name)
            row |= {name: estimate.value, f"{name}_low": estimate.low, f"{name}_high": estimate.high}
        row |= summarize(run.results)["metrics_of_other_conventions"]
    costs = costs_of([run])
    return (
        row
        | {f"cost.{k}": v for k, v in costs.items()}
        | {f"config.{k}": v for k, v in flatten(run.config).items()}
    )


def _latex(runs: Sequence[Run]) -> str:
    """Return the table of the runs that are finished: the fewer tasks are learned, the better they look."""
    behind = [
        f"{run.path}: {run.learned} of {counted(len(run.record.tasks), 'task')} learned"
        for run in runs
        if not run.results.finished
    ]
    if len(behind) == len(runs):
        raise LifelongError(f"no run is finished, and a paper's table is of finished runs: {few_of(behind)}")
    for text in behind:
        print(f"note: left out, as it is not finished: {text}", file=sys.stderr)
    found = compare(group_runs([run for run in runs if run.results.finished]))
    lines = [f"% left out, not finished: {' '.join(text.split())}" for text in behind]
    lines += [f"% {' '.join(text.split())}" for text in found["conditions"]]
    lines += [rf"\begin{{tabular}}{{l{'r' * (1 + len(METRIC_NAMES))}}}", r"\toprule"]
    lines.append(
        " & ".join(["method", "runs", *(_TITLES.get(name, name.upper()) for name in METRIC_NAMES)]) + r" \\"
    )
    lines.append(r"\midrule")
    for label, group in found["groups"].items():
        cells = [_cell(group["metrics"][name]) for name in METRIC_NAMES]
        lines.append(" & ".join([_escaped(label), str(group["measured"]), *cells]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def _cell(metric: Mapping[str, float]) -> str:
    mean, low, high = (100 * metric[name] for name in ("mean", "low", "high"))
    if math.isnan(mean):
        return "--"
    return f"${mean:.1f}$" + ("" if math.isnan(low) else f" $[{low:.1f}, {high:.1f}]$")


def _escaped(text: str) -> str:
    special = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    return "".join(special.get(c, f"\\{c}" if c in "&%$#_{}" else c) for c in text)
