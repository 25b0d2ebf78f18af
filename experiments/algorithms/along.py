"""What happens along a stream: plasticity, alone and beside single_task, forgetting by distance and likeness, and cost.

    python experiments/algorithms/along.py libero_130     # the finished runs of a stream of the study

Prints Markdown tables, a column for each method, means over its seeds. Plasticity is the success just after learning.
Forgotten is the share of it that is gone after a later task: 1 - sum(later) / sum(just learned), over measured cells.
"""

import argparse
import re
from collections.abc import Callable, Iterator
from itertools import combinations

import numpy as np
from kept import share
from reading import difference, of_method, table
from scipy.stats import linregress

from libero_env.text import duration, quantity
from libero_eval.stats.episodes import Counts, mcnemar_exact
from lifelong.language.encoder import embed
from lifelong.results.results import Results

DISTANCES = (1, 2, 4, 10, 30, 60, 130)  # tasks learned since; ends of bins
SIMILARITIES = (-1.0, 0.5, 0.7, 0.8, 0.9, 1.01)  # largest cosine to the instructions learned since
MOMENTS = (10, 30, 90, 130)  # tasks learned, at which cost is shown


def plasticity(results: Results) -> Iterator[tuple[str, float]]:
    """Yield the success just after learning in each fifth of the stream."""
    learned = np.diag(results.success_matrix()[0])
    for part in np.array_split(np.arange(len(learned)), 5):
        yield f"tasks {part[0] + 1} to {part[-1] + 1}", float(np.nanmean(learned[part]))


def trend(results: Results) -> Iterator[tuple[str, float]]:
    """Yield by how much a line through the success just after learning rises from the first task to the last."""
    learned = np.diag(results.success_matrix()[0])
    line = linregress(np.linspace(0, 1, len(learned)), learned)
    yield from {"from the first to the last": line.slope, "standard error, of a run": line.stderr}.items()


def beside_alone(runs: dict[str, dict[int, Results]]) -> list[str]:
    """Return a table of success just after learning less that of `single_task`, on the same tasks and starts."""
    alone, rows = runs["single_task"], []
    for method, by_seed in ((m, found) for m, found in runs.items() if m != "single_task"):
        slopes, second = [], []
        for seed, results in by_seed.items():
            less = np.diag(results.success_matrix()[0]) - np.diag(alone[seed].success_matrix()[0])
            slopes.append(linregress(np.linspace(0, 1, len(less) - 1), less[1:]).slope)
            second.append(less[1])
        pairs = [(results, alone[seed]) for seed, results in by_seed.items()]
        rows.append(
            [method, difference(slopes), *_episodes(pairs, 0, 1, 2), difference(second), *_episodes(pairs, 1)]
        )
    heads = [
        "just learned, less `single_task`",
        "rises from task 2 to 10",
        "tasks 1 to 3",
        "only it, only alone, p",
    ]
    return table([*heads, "task 2, by seed", "task 2", "only it, only alone, p"], rows)


def _episodes(pairs: list[tuple[Results, Results]], *tasks: int) -> tuple[str, str]:
    """Return the mean success of two runs on tasks just learned, and McNemar's test of their episodes."""
    found = []
    for task in tasks:
        for both in pairs:
            cells = [results.evaluation("matrix", task, task) for results in both]
            outcomes = [dict(zip(cell.init_states, cell.successes, strict=True)) for cell in cells]
            found += [(outcomes[0][start], outcomes[1][start]) for start in outcomes[0].keys() & outcomes[1]]
    x, y = np.array(found).T
    counts = Counts(*(int(c.sum()) for c in (x & y, x & ~y, ~x & y, ~x & ~y)))
    tested = f"{counts.only_first}, {counts.only_second}, {mcnemar_exact(counts):.2g}"
    return f"{x.mean():.2f} for {y.mean():.2f}", tested


def streams(stream: str) -> dict[str, dict[int, Results]]:
    """Return the results of the finished runs by method and seed; all tasks at once are no stream."""
    return {
        method: runs
        for method, runs in of_method(stream).items()
        if not any(np.isnan(results.success_matrix()[0][0, 0]) for results in runs.values())
    }


def cells(results: Results) -> Iterator[tuple[int, int, tuple[float, float]]]:
    """Yield (last task learned, earlier task, its success just learned and then) of the measured cells."""
    matrix, _ = results.success_matrix()
    for i, k in zip(*np.tril_indices(len(matrix), -1), strict=True):
        if not np.isnan(matrix[i, k]):
            yield int(i), int(k), (float(matrix[k, k]), float(matrix[i, k]))


def forgotten(pairs: list[tuple[float, float]]) -> float:
    """Return the share of the success just learned that is gone; of all cells together, as one has few episodes."""
    learned, later = (sum(values) for values in zip(*pairs, strict=True)) if pairs else (0.0, 0.0)
    return 1 - later / learned if learned else float("nan")


def binned(
    values: list[tuple[float, tuple[float, float]]], ends: tuple[float, ...], name: Callable
) -> Iterator[tuple[str, list[tuple[float, float]]]]:
    """Yield the cells between two ends."""
    for low, high in zip(ends[:-1], ends[1:], strict=True):
        yield name(low, high), [pair for at, pair in values if low <= at < high]


def by_distance(results: Results) -> Iterator[tuple[str, list[tuple[float, float]]]]:
    """Yield the measured cells by the number of tasks learned since."""
    values = [(float(i - k), pair) for i, k, pair in cells(results)]
    yield from binned(values, DISTANCES, lambda low, high: f"{low} to {high - 1} tasks since")


def by_row(results: Results) -> Iterator[tuple[str, list[tuple[float, float]]]]:
    """Yield the measured cells after the last task, of all rows before, and of the 25 before."""
    found = list(cells(results))
    last = max(i for i, _, _ in found)
    yield "after the last task", [pair for i, _, pair in found if i == last]
    yield "after those before it", [pair for i, _, pair in found if i < last]
    yield "after the 25 before it", [pair for i, _, pair in found if last - 25 <= i < last]


def by_similarity(results: Results) -> Iterator[tuple[str, list[tuple[float, float]]]]:
    """Yield the measured cells by the likeness of the tasks learned since: of instructions, and the same scene."""
    run = results.run
    texts = embed(run.instructions).numpy()
    texts /= np.linalg.norm(texts, axis=1, keepdims=True)
    cosine, found = texts @ texts.T, list(cells(results))
    values = [(float(cosine[k, k + 1 : i + 1].max()), pair) for i, k, pair in found]
    yield from binned(
        values, SIMILARITIES, lambda low, high: f"nearest instruction {low:g} to {min(high, 1):g}"
    )
    scenes = [scene.group() if (scene := re.match(r"[A-Z_]+_SCENE\d+", name)) else None for name in run.tasks]
    again = [(scenes[k] in scenes[k + 1 : i + 1], pair) for i, k, pair in found if scenes[k] is not None]
    for same, title in ((True, "its scene was seen again"), (False, "its scene was not seen again")):
        yield title, [pair for is_same, pair in again if is_same == same]


def at_end(runs: dict[str, Results]) -> Iterator[list[str]]:
    """Yield of each two methods the tasks on which only one succeeds at the end, where a cell has one episode."""
    for (a, one), (b, other) in combinations(runs.items(), 2):
        rates, episodes = zip(
            *((m[-1], n[-1]) for m, n in (one.success_matrix(), other.success_matrix())), strict=True
        )
        if one.run.tasks == other.run.tasks and (np.array(episodes) == 1).all():
            x, y = (row == 1 for row in rates)
            counts = Counts(*(int(c.sum()) for c in (x & y, x & ~y, ~x & y, ~x & ~y)))
            yield [
                f"{a}, {b}",
                str(counts.only_first),
                str(counts.only_second),
                f"{mcnemar_exact(counts):.2g}",
            ]


def costs(results: Results) -> Iterator[tuple[str, str]]:
    """Yield the costs of a task after some numbers of tasks."""
    found = results.costs_by_task()
    for moment in (m for m in MOMENTS if m - 1 in found):
        last = [found[task] for task in range(max(0, moment - 5), moment) if task in found]
        seconds = [cost["training_seconds"] + cost.get("end_task_seconds", 0.0) for cost in last]
        yield f"a task's seconds, after {moment}", duration(float(np.median(seconds)))
        yield f"stored, after {moment}", quantity(found[moment - 1]["stored_bytes"], "B")
        yield f"memory of the process, after {moment}", quantity(found[moment - 1]["peak_memory_bytes"], "B")


def main() -> None:
    """Print the tables of a stream."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("stream", help="name of a stream of the study")
    stream = parser.parse_args().stream
    by_seed = streams(stream)
    runs = {method: list(found.values()) for method, found in by_seed.items()}
    for title, curve in (("just learned", plasticity), ("a line through it", trend)):
        show(title, {method: [dict(curve(r)) for r in found] for method, found in runs.items()})
    if "single_task" in runs:
        print("\n".join(beside_alone(by_seed)), end="\n\n")
    for measure in (by_distance, by_row, by_similarity):
        cut = {method: [dict(measure(results)) for results in found] for method, found in runs.items()}
        lost = {
            method: [{name: forgotten(pairs) for name, pairs in seed.items()} for seed in seeds]
            for method, seeds in cut.items()
        }
        first = next(iter(cut.values()))  # all methods are measured in the same cells with a seed
        show("forgotten", lost, {name: sum(len(seed[name]) for seed in first) for name in first[0]})
    if pairs := list(at_end({method: found[0] for method, found in runs.items()})):
        heads = ["at the end", "only the first", "only the second", "p (McNemar)"]
        print("\n".join(table(heads, pairs)), end="\n\n")
    spent = {method: dict(costs(found[0])) for method, found in runs.items()}
    for method, moments in spent.items():
        for learned in (m for m in MOMENTS if f"stored, after {m}" in moments):
            moments[f"windows kept, after {learned}"] = share(stream, method, learned)
    names = list(next(iter(spent.values())))
    print(
        "\n".join(
            table(["cost", *spent], [[name, *(spent[m].get(name, "–") for m in spent)] for name in names])
        )
    )


def show(title: str, columns: dict[str, list[dict[str, float]]], sizes: dict[str, int] | None = None) -> None:
    """Print a table of the means over the seeds of each method, and of the number of cells behind a row."""
    names = list(next(iter(columns.values()))[0])
    rows = [[n, *(_mean(np.array([seed[n] for seed in seeds])) for seeds in columns.values())] for n in names]
    rows = [row for row in rows if set(row[1:]) != {"–"}]  # more tasks apart than the stream has
    heads = [title, *columns]
    if sizes:
        heads, rows = [*heads, "cells"], [[*row, str(sizes[row[0]])] for row in rows]
    print("\n".join(table(heads, rows)), end="\n\n")


def _mean(values: np.ndarray) -> str:
    known = values[~np.isnan(values)]
    return f"{known.mean():z.2f}" if len(known) else "–"


if __name__ == "__main__":
    main()
