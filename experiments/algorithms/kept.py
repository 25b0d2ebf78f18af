"""Which part of the data a method keeps, and how much it computes: what methods have beside bytes.

A run of `er` stores a fixed number of bytes a window, so its records tell how many windows each task has as long as its
memory is not full. The other tasks' windows are the mean of the same task's with other seeds, or of all tasks.
"""

import functools
import math
from collections.abc import Iterator, Mapping
from statistics import fmean
from typing import Any

import numpy as np
from reading import by_seed, difference, finished, measures, of_method, paired, table
from study import WINDOW

from libero_env.text import quantity
from lifelong.results.records import LossRecord
from lifelong.results.results import Results
from lifelong.stats.intervals import holm
from lifelong.stats.methods import paired_difference

INDEX = 8  # bytes that the state of a memory has beside a window
SAME_DATA = {"memory": "goal"}  # a stream whose demonstrations are another one's
SPENT = ("stored", "windows kept", "updates a task", "operations a task")
LITTLE = 30e6  # bytes
WHOLE = 10_000  # windows that the preset's memory holds


@functools.cache
def windows(study: str) -> dict[int, list[float]]:
    """Return the number of windows of each task of a stream, by seed; see the top of this file."""
    known: dict[str, list[float]] = {}
    runs: dict[int, tuple[Results, list[float]]] = {}
    for run, results in finished(SAME_DATA.get(study, study)):
        if run.method == "er":
            totals = [costs["stored_bytes"] / (WINDOW + INDEX) for costs in results.costs_by_task().values()]
            counts = [b - a for a, b in zip([0.0, *totals], totals, strict=False) if b < WHOLE]
            runs[run.seed] = results, counts
            for name, count in zip(results.run.tasks, counts, strict=False):
                known.setdefault(name, []).append(count)
    usual = fmean(count for counts in known.values() for count in counts)
    return {
        seed: [
            counts[i] if i < len(counts) else fmean(known.get(name, [usual]))
            for i, name in enumerate(results.run.tasks)
        ]
        for seed, (results, counts) in runs.items()
    }


def kept(study: str, config: Mapping[str, Any], results: Results, learned: int | None = None) -> float:
    """Return the share of the windows of all tasks so far that a run keeps, after so many tasks.

    Args:
        config: Configuration of the run.
        learned: Number of tasks; None: all.
    """
    algorithm = config["algo"]
    tasks = learned or len(results.run.tasks)
    counts = windows(study)[results.run.seed][:tasks]
    if algorithm["_target_"].endswith("Multitask"):
        return 1.0
    if algorithm["_target_"].endswith("CompressedER"):
        budget = algorithm["budget"] / _picture_bytes(study)
    else:
        budget = algorithm.get("memory", algorithm).get("budget", 0)
    return min(budget, sum(counts)) / sum(counts)


@functools.cache
def _picture_bytes(study: str) -> float:
    """Return the mean number of bytes of a compressed window, over the tasks that fit whole."""
    sizes = []
    for run, results in finished(study):
        if run.config["algo"]["_target_"].endswith("CompressedER"):
            totals = [costs["stored_bytes"] for costs in results.costs_by_task().values()]
            budget = run.config["algo"]["budget"]
            whole = [
                (a, b) for a, b in zip([0.0, *totals], totals, strict=False) if b < 0.9 * budget and b > a
            ]
            counts = windows(study)[run.seed]
            sizes += [(b - a) / count for (a, b), count in zip(whole, counts, strict=False)]
    return fmean(sizes)


def share(study: str, method: str, learned: int | None = None) -> str:
    """Return the mean over seeds of the share of all windows that a method keeps, in percent."""
    found = [kept(study, r.config, results, learned) for r, results in finished(study) if r.method == method]
    value = 100 * fmean(found)
    return f"{value:.0f} %" if value >= 9.5 else f"{value:.2g} %"


def updates(study: str, method: str) -> float:
    """Return the mean number of updates of a task; of all divided by their number, where they are learned at once."""
    run, results = next((r, found) for r, found in finished(study) if r.method == method)
    stages = {record.task for record in results.of(LossRecord)}
    epochs, tasks = len(results.of(LossRecord)), len(results.run.tasks)
    at_once = tasks if len(stages) == 1 else 1
    return epochs * run.config["train"]["steps_per_epoch"] * at_once / tasks


def operations(study: str, method: str) -> float:
    """Return the mean operations of a task's updates."""
    costs = [
        fmean(c["flops_per_step"] for c in results.costs_by_task().values())
        for run, results in finished(study)
        if run.method == method
    ]
    return fmean(costs) * updates(study, method)


def spent(study: str, method: str, stored: float) -> list[str]:
    """What a method keeps and computes: bytes, share of all windows, updates and operations of a task."""
    done = updates(study, method), operations(study, method)
    return [quantity(stored, "B"), share(study, method), f"{done[0]:.0f}", quantity(done[1], "FLOP")]


def by_bytes() -> Iterator[tuple[str, list[str]]]:
    """Final success of replay with each memory, compressed and not, in the same bytes; less that with 247 MB.

    P-values of the differences are Holm's over the memories.
    """
    by_method, largest = measures("memory", "final_success"), measures("goal", "final_success").get("er", {})
    sizes = dict.fromkeys(method.partition(" ")[2] for method in by_method)
    rows, tested = [], []
    for size in sizes:
        plain, compressed = (by_method.get(f"{name} {size}", {}) for name in ("er", "compressed_er"))
        less = paired(compressed, plain)
        tested.append(paired_difference(np.array(less)).p_value if less else math.nan)
        means = (
            f"{fmean(v.values()):.2f} ({share('memory', f'{name} {size}')})" if v else "–"
            for name, v in (("er", plain), ("compressed_er", compressed))
        )
        to_largest = (difference(paired(v, largest)) for v in (plain, compressed))
        rows.append([size, str(len(less)), *means, difference(less), by_seed(less), *to_largest])
    for row, p in zip(rows, holm(tested), strict=True):
        row.insert(6, f"{p:.2g}")
    heads = ["memory", "seeds", "`er` (windows kept)", "`compressed_er` (windows kept)"]
    heads += ["`compressed_er` less `er`", "each seed", "p (Holm)"]
    heads += ["`er` less 247 MB", "`compressed_er` less 247 MB of `er`"]
    if rows:
        yield "memory: by bytes", table(heads, rows)


def equal_bytes() -> Iterator[tuple[str, list[str]]]:
    """Final success of what stores little, of the seeds that `memory` has, less that of replay of 10 MB; best first."""
    memory, goal = (measures(study, "final_success") for study in ("memory", "goal"))
    replay = {f"{name} 10 MB": memory[f"{name} 10 MB"] for name in ("er", "compressed_er")}
    rows = []
    for study, method in (*(("memory", m) for m in memory), *(("goal", m) for m in goal if m != "multitask")):
        stored = fmean(
            found.costs(max(found.costs_by_task()))["stored_bytes"]
            for found in of_method(study)[method].values()
        )
        if stored > LITTLE:
            continue
        values = measures(study, "final_success")[method]
        success = fmean(value for seed, value in values.items() if seed in replay["er 10 MB"])
        less = [[] if method == name else paired(own, values) for name, own in replay.items()]
        row = [method, *spent(study, method, stored), f"{success:.2f}"]
        rows.append((success, [*row, difference(less[0]), by_seed(less[0]), difference(less[1])]))
    heads = ["algorithm", *SPENT, "final", "`er` 10 MB less it", "each seed", "`compressed_er` 10 MB less it"]
    yield "memory: at equal bytes", table(heads, [row for _, row in sorted(rows, reverse=True)])
