"""What every start adds to the metrics of a run.

A run is evaluated again and again from the same initial states: after every task, and, where algorithms or seeds are
compared, in every run. Outcomes of one (task, start) are therefore no independent evidence. Every metric of eq. 3 is a
weighted sum of success rates, so it is a sum over (task, start) clusters; the deviations of these from their task's
mean carry the variance, whatever the outcomes inside a cluster have to do with each other (Liang & Zeger, Biometrika
1986; with learned tasks as strata). A column of repeated rollouts, as of PackNet, then has no NBT to vary.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lifelong.results.curves import Floats
from lifelong.results.scores import METRIC_NAMES, Scores, curve_weights, matrix_weights

Cluster = tuple[str, int]  # name of the task, initial state


@dataclass(frozen=True)
class Contributions:
    """The (task, start) clusters of a run, and what each adds to the metrics.

    Attributes:
        clusters: N clusters.
        strata: N strata: the task, and whether the start is one of its matrix and of its learning curve.
        deviations: (N,) for each metric, how far the cluster moves it from its value; scaled so that the sum of their
            squares estimates the variance over the choice of starts.
        noise: For each metric, the sum of the squared weights of all different rollouts: its variance is at most a
            quarter of this if they are independent. 0 where the metric cannot vary.
    """

    clusters: tuple[Cluster, ...]
    strata: tuple[tuple[str, bool, bool], ...]
    deviations: dict[str, Floats]
    noise: dict[str, float]


@dataclass(frozen=True)
class _Source:
    """Outcomes of a set of starts that enter the metrics with one weight each."""

    task: str
    starts: NDArray[np.int64]
    outcomes: Floats
    weights: Floats  # of each of METRIC_NAMES
    rollouts: tuple[object, ...]  # equal for repeated rollouts


def contributions(scores: Scores) -> Contributions:
    """Return what every start adds to the metrics of a run whose outcomes are known.

    Raises:
        ValueError: Only success rates are known.
    """
    if not scores.has_outcomes:
        raise ValueError("contributions need the outcome of every episode")
    sources = [*_of_matrix(scores), *_of_curves(scores)]
    used: dict[Cluster, set[object]] = {}
    for source in sources:
        for start in source.starts.tolist():
            used.setdefault((source.task, start), set()).add(source.rollouts[0])
    place = {cluster: i for i, cluster in enumerate(used)}
    deviations = np.zeros((len(METRIC_NAMES), len(used)))
    different: dict[tuple[object, ...], tuple[int, Floats]] = {}
    for source in sources:
        count = len(source.starts)
        where = [place[source.task, start] for start in source.starts.tolist()]
        moved = (source.outcomes - source.outcomes.mean()) / np.sqrt(count * max(count - 1, 1))
        np.add.at(deviations.T, where, np.outer(moved, source.weights))
        _, total = different.setdefault(source.rollouts, (count, np.zeros(len(METRIC_NAMES))))
        total += source.weights
    noise = sum((total**2 / count for count, total in different.values()), np.zeros(len(METRIC_NAMES)))
    # weights such as 1 - 1/3 - 1/3 - 1/3 leave rounding errors
    deviations, noise = np.where(abs(deviations) < 1e-12, 0, deviations), np.where(noise < 1e-20, 0, noise)
    return Contributions(
        tuple(used),
        tuple((task, "matrix" in seen, "curve" in seen) for (task, _), seen in used.items()),
        dict(zip(METRIC_NAMES, deviations, strict=True)),
        dict(zip(METRIC_NAMES, noise.tolist(), strict=True)),
    )


def _of_matrix(scores: Scores) -> Iterator[_Source]:
    size = len(scores.curves)
    weights = np.stack([matrix_weights(size)[name] for name in METRIC_NAMES])
    if scores.group_sizes:  # a group's success is the mean over its tasks
        weights = weights / np.array(scores.group_sizes)
    weights = np.nan_to_num(weights)  # NBT of a single task
    for cell in scores.cells:
        rollouts = ("matrix", cell.task, cell.column, cell.same_as)
        own = weights[:, cell.row, cell.column]
        yield _Source(cell.task, cell.starts, cell.successes.astype(float), own, rollouts)


def _of_curves(scores: Scores) -> Iterator[_Source]:
    weights = np.stack([curve_weights(len(scores.curves))[name] for name in METRIC_NAMES])
    for place, curve in enumerate(scores.curves):
        terms = curve.by_episode(scores.transfer)
        if terms is None or curve.starts is None:
            continue
        for number, task in enumerate(curve.tasks):
            own = weights[:, place] / len(curve.tasks)
            yield _Source(task, curve.starts, terms[:, number], own, ("curve", task, place))
