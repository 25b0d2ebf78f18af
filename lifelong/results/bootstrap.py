"""Confidence intervals over all random factors of an experiment: task orders, seeds and episodes.

Few runs of an algorithm are affordable, and each has thousands of episodes; an interval over one of the two alone is
too narrow. The bootstrap here resamples every level of the experiment with replacement, from the top down: orders,
within them runs, within these the episodes of every cell of the success matrix and of the learning curves. The
interval consists of percentiles of the mean over runs, as Agarwal et al., "Deep reinforcement learning at the edge of
the statistical precipice" (NeurIPS 2021) recommend for few runs over several tasks; for resampling on several levels
see Davison & Hinkley, "Bootstrap methods and their application" (1997), section 3.8. A level with a single member adds
no spread: a single run gives the interval of its episodes.

The best epochs, and so the evaluated checkpoints, are taken as given.
"""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from lifelong.results.metrics import METRIC_NAMES, METRIC_RANGES, Cells, Estimate, Floats, Scores, cells

DRAWS = 4000


@dataclass(frozen=True)
class Member:
    """One run of a group.

    Attributes:
        scores: Success rates of the run.
        order: Identifier of its task order.
    """

    scores: Scores
    order: Hashable = None


@dataclass(frozen=True)
class Resamples:
    """Metrics of a group of runs, measured and resampled.

    Attributes:
        values: Mean over the runs, by metric.
        draws: (draws,) means of the resampled experiments, by metric.
    """

    values: Mapping[str, float]
    draws: Mapping[str, Floats]

    def interval(self, name: str, confidence: float = 0.95) -> Estimate:
        """Return the percentile interval of a metric, within the values that it can have."""
        return _percentiles(self.values[name], self.draws[name], confidence, METRIC_RANGES[name])

    def difference(self, other: "Resamples", name: str, confidence: float = 0.95) -> Estimate:
        """Return this group's metric minus the other's, which was resampled independently (with another seed)."""
        value, (low, high) = self.values[name] - other.values[name], METRIC_RANGES[name]
        draws = self.draws[name] - other.draws[name]
        return _percentiles(value, draws, confidence, (low - high, high - low))


def resample(members: Sequence[Member], *, seed: int | Sequence[int] = 0, draws: int = DRAWS) -> Resamples:
    """Resample an experiment: orders, runs within them, episodes within cells.

    Args:
        members: Runs of the group; those with the same order are exchangeable.
        seed: Seed of the generator. Use different seeds for groups that are compared.
        draws: Number of resampled experiments.

    Raises:
        ValueError: There are no runs.
    """
    if not members:
        raise ValueError("a bootstrap needs at least one run")
    rng = np.random.default_rng(seed)
    rows = [cells(m.scores) for m in members]
    values = {n: float(np.mean([_weighted_sum(row, n, row.rates) for row in rows])) for n in METRIC_NAMES}
    experiment, picked = _draw_runs([m.order for m in members], draws, rng)
    found = {name: np.zeros(draws) for name in METRIC_NAMES}
    for run, row in enumerate(rows):
        mine = experiment[picked == run]
        rates = _resample_rates(row, len(mine), rng)
        for name in METRIC_NAMES:
            np.add.at(found[name], mine, _weighted_sum(row, name, rates))
    sizes = np.bincount(experiment, minlength=draws)
    return Resamples(values, {name: sums / sizes for name, sums in found.items()})


def _draw_runs(
    orders: Sequence[Hashable], draws: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Draw the runs of every resampled experiment, as pairs: index of the experiment, index of the run.

    Orders are drawn with replacement, and then, within each drawn order, as many runs as it has.
    """
    groups = [np.flatnonzero([o == name for o in orders]) for name in dict.fromkeys(orders)]
    chosen = rng.integers(len(groups), size=(draws, len(groups)))
    experiments, picked = [], []
    for number, runs in enumerate(groups):
        hits = np.nonzero(chosen == number)[0]  # twice where an experiment drew the order twice
        experiments.append(np.repeat(hits, len(runs)))
        picked.append(runs[rng.integers(len(runs), size=len(hits) * len(runs))])
    return np.concatenate(experiments), np.concatenate(picked)


def _resample_rates(row: Cells, draws: int, rng: np.random.Generator) -> Floats:
    """Resample the episodes of every cell, and return (draws, C) success rates.

    Drawing n episodes with replacement out of s successes is a binomial draw with p = s/n, which never varies
    where all succeeded or all failed. So the draw is made with the centre of Wilson's interval, (s + z²/2) / (n + z²),
    and shifted back: the mean is p, and the variance is above 0 everywhere. Single rates may leave [0, 1].
    """
    n, z2 = row.episodes.astype(float), NormalDist().inv_cdf(0.975) ** 2
    centre = (np.nan_to_num(row.rates) * n + z2 / 2) / (n + z2)  # NaN where there were no episodes
    drawn = rng.binomial(row.episodes, centre, size=(draws, len(n))) / np.maximum(n, 1)
    return row.rates + np.where(n > 0, drawn - centre, 0.0)


def _weighted_sum(row: Cells, name: str, rates: Floats) -> Floats:
    """Return a metric of (..., C) rates, NaN where it is undefined."""
    used = row.weights[name] != 0
    return rates[..., used] @ row.weights[name][used]


def _percentiles(value: float, draws: Floats, confidence: float, possible: tuple[float, float]) -> Estimate:
    """Return percentiles of the draws, cut off where the metric ends; shifted rates leave [0, 1] for few episodes."""
    tail = (1 - confidence) / 2
    low, high = np.quantile(draws, [tail, 1 - tail]) if np.isfinite(draws).all() else (np.nan, np.nan)
    return Estimate(value, *(float(np.clip(end, *possible)) for end in (low, high)))
