"""Intervals over everything that chance decides in an experiment: orders of the tasks, seeds, and episodes.

Few runs of an algorithm are affordable, and each has thousands of episodes; an interval over one of the two alone is
too narrow. The bootstrap here resamples every level of the experiment with replacement, from the top down: orders,
within them runs, within these the episodes of every cell of the success matrix and of the learning curves. Percentiles
of the mean over runs are the interval, as Agarwal et al., "Deep reinforcement learning at the edge of the statistical
precipice" (NeurIPS 2021) recommend for few runs over several tasks; for resampling on several levels see Davison &
Hinkley, "Bootstrap methods and their application" (1997), section 3.8. A level with a single member has no spread that
could be known: a single run gives the interval of its episodes.

Which epochs are best, and so which checkpoints were evaluated, is taken as it is.
"""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from lifelong.results.metrics import METRIC_NAMES, Cells, Estimate, Floats, Scores, cells

DRAWS = 4000


@dataclass(frozen=True)
class Member:
    """One run among those that are pooled."""

    scores: Scores
    order: Hashable = None  # what its order of tasks is called


@dataclass(frozen=True)
class Resamples:
    """Metrics of a group of runs, as found and as redrawn.

    Attributes:
        values: Mean over the runs, by metric.
        draws: (draws,) the same of redrawn experiments.
    """

    values: Mapping[str, float]
    draws: Mapping[str, Floats]

    def interval(self, name: str, confidence: float = 0.95) -> Estimate:
        """The percentile interval of a metric."""
        return _percentiles(self.values[name], self.draws[name], confidence)

    def difference(self, other: "Resamples", name: str, confidence: float = 0.95) -> Estimate:
        """This group's metric less the other's, which was redrawn independently (with another seed)."""
        value = self.values[name] - other.values[name]
        return _percentiles(value, self.draws[name] - other.draws[name], confidence)


def resample(members: Sequence[Member], *, seed: int | Sequence[int] = 0, draws: int = DRAWS) -> Resamples:
    """Redraws an experiment: orders, runs within them, episodes within cells.

    Args:
        members: The runs; those with the same order are exchangeable.
        seed: Whole numbers from which the draws follow. Groups that are compared get different ones.
        draws: Number of redrawn experiments.

    Raises:
        ValueError: No runs.
    """
    if not members:
        raise ValueError("a bootstrap needs at least one run")
    rng = np.random.default_rng(seed)
    rows = [cells(m.scores) for m in members]
    values = {n: float(np.mean([_weigh(row, n, row.rates) for row in rows])) for n in METRIC_NAMES}
    experiment, picked = _pick([m.order for m in members], draws, rng)
    found = {name: np.zeros(draws) for name in METRIC_NAMES}
    for run, row in enumerate(rows):
        mine = experiment[picked == run]
        rates = _redraw(row, len(mine), rng)
        for name in METRIC_NAMES:
            np.add.at(found[name], mine, _weigh(row, name, rates))
    sizes = np.bincount(experiment, minlength=draws)
    return Resamples(values, {name: sums / sizes for name, sums in found.items()})


def _pick(
    orders: Sequence[Hashable], draws: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The runs of every redrawn experiment, as pairs: number of the experiment, number of the run.

    Orders are drawn with replacement, and for each drawn order as many of its runs as it has.
    """
    groups = [np.flatnonzero([o == name for o in orders]) for name in dict.fromkeys(orders)]
    chosen = rng.integers(len(groups), size=(draws, len(groups)))
    experiments, picked = [], []
    for number, runs in enumerate(groups):
        hits = np.nonzero(chosen == number)[0]  # an experiment that drew the order twice is in here twice
        experiments.append(np.repeat(hits, len(runs)))
        picked.append(runs[rng.integers(len(runs), size=len(hits) * len(runs))])
    return np.concatenate(experiments), np.concatenate(picked)


def _redraw(row: Cells, draws: int, rng: np.random.Generator) -> Floats:
    """Every cell's episodes drawn anew, (draws, C) rates.

    Drawing n episodes with replacement out of s successes is a binomial draw with p = s/n, which never varies
    where all succeeded or all failed. So it is made with the centre of Wilson's interval, (s + z²/2) / (n + z²),
    and shifted back: the mean is p, and the variance is above 0 everywhere. Single rates may leave [0, 1].
    """
    n, z2 = row.episodes.astype(float), NormalDist().inv_cdf(0.975) ** 2
    centre = (np.nan_to_num(row.rates) * n + z2 / 2) / (n + z2)  # NaN where there were no episodes
    drawn = rng.binomial(row.episodes, centre, size=(draws, len(n))) / np.maximum(n, 1)
    return row.rates + np.where(n > 0, drawn - centre, 0.0)


def _weigh(row: Cells, name: str, rates: Floats) -> Floats:
    """A metric of (..., C) rates, NaN where it is undefined."""
    used = row.weights[name] != 0
    return rates[..., used] @ row.weights[name][used]


def _percentiles(value: float, draws: Floats, confidence: float) -> Estimate:
    tail = (1 - confidence) / 2
    low, high = np.quantile(draws, [tail, 1 - tail]) if np.isfinite(draws).all() else (np.nan, np.nan)
    return Estimate(value, float(low), float(high))
