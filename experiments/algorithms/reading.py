"""What tables of the study are made of: kept records, metrics by method and seed, and how numbers are written."""

import functools
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from study import EARLIER, STUDIES, Planned, planned

from lifelong.results.log import ResultLog
from lifelong.results.results import Results
from lifelong.stats.intervals import Estimate
from lifelong.stats.methods import paired_difference
from lifelong.stats.metrics import metric_values


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], align: str = "---:|") -> list[str]:
    """The lines of a Markdown table, whose columns but the first are aligned as given."""
    lines = ["| " + " | ".join(heads) + " |", "|---|" + align * (len(heads) - 1)]
    return lines + ["| " + " | ".join(row) + " |" for row in rows]


@functools.cache
def finished(study: str) -> tuple[tuple[Planned, Results], ...]:
    """Return the finished runs of a study, each with its results."""
    found = []
    every = planned((*STUDIES, *EARLIER))
    for run in (run for run in every if run.study.name == study and run.is_done()):
        with tempfile.TemporaryDirectory() as scratch:
            found.append((run, ResultLog(run.unpack(Path(scratch)) / "results.jsonl").read()))
    return tuple(found)


def results_of(study: str, method: str) -> list[tuple[Planned, Results]]:
    """Return the finished runs of a method of a study, each with its results."""
    return [(run, results) for run, results in finished(study) if run.method == method]


def of_method(study: str) -> dict[str, dict[int, Results]]:
    """Return the results of each finished run, by method and seed."""
    found: dict[str, dict[int, Results]] = {}
    for run, results in finished(study):
        found.setdefault(run.method, {})[run.seed] = results
    return found


def measures(study: str, name: str) -> dict[str, dict[int, float]]:
    """A metric of each finished run, by method and seed."""
    return {
        method: {seed: values[name] for seed, values in runs.items()}
        for method, runs in _metrics(study).items()
    }


@functools.cache
def _metrics(study: str) -> dict[str, dict[int, dict[str, float]]]:
    return {
        method: {seed: metric_values(results.scores()) for seed, results in runs.items()}
        for method, runs in of_method(study).items()
    }


def paired(one: dict[int, float], other: dict[int, float]) -> list[float]:
    """Return the differences of two methods by seed, of the seeds that both have."""
    return [one[seed] - other[seed] for seed in sorted(one.keys() & other.keys())]


def difference(values: Sequence[float]) -> str:
    """The mean of differences in points, with Student's interval of these alone."""
    return in_points(paired_difference(np.array(values)).estimate) if len(values) else "–"


def in_points(found: Estimate) -> str:
    """An estimate in percentage points, with its interval."""
    ends = "" if math.isnan(found.low) else f" [{100 * found.low:z.1f}, {100 * found.high:z.1f}]"
    return f"{100 * found.value:+z.1f}{ends}"


def by_seed(values: Sequence[float]) -> str:
    """Differences of every seed in points."""
    return ", ".join(f"{100 * v:+z.1f}" for v in values) if len(values) else "–"
