"""Methods rather than weights: aggregates over several runs of each, with rliable.

A run is one evaluated result, such as that of one training seed; its score on a task is its success rate there. The
intervals draw runs anew for every task, as Agarwal et al., "Deep reinforcement learning at the edge of the statistical
precipice" (NeurIPS 2021) recommend; so they say what training again would change, which no number of episodes of one
set of weights can. With fewer than five runs they are too narrow.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from libero_env.errors import require_package
from lifelong.stats.intervals import Estimate, Floats

DRAWS = 2000
SEED = 2023
THRESHOLDS = np.linspace(0, 1, 51)


@dataclass(frozen=True)
class Profile:
    """Performance profile: the share of runs and tasks whose success is above a threshold.

    Attributes:
        thresholds: (T,) success rates.
        shares: (T,) shares above them.
        low: (T,) lower ends of their 95 % intervals.
        high: (T,) upper ends.
    """

    thresholds: Floats
    shares: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True)
class GroupScores:
    """Aggregates of groups of runs.

    Attributes:
        runs: Number of runs of each group.
        mean: Mean success.
        iqm: Interquartile mean: that of the middle half of runs and tasks.
        improvement: (first, second) -> probability that a run of the first does better on a task than one of the
            second.
        profiles: Performance profiles.
    """

    runs: Mapping[str, int]
    mean: Mapping[str, Estimate]
    iqm: Mapping[str, Estimate]
    improvement: Mapping[tuple[str, str], Estimate]
    profiles: Mapping[str, Profile]


def group_scores(scores: Mapping[str, Floats]) -> GroupScores:
    """Aggregate the runs of each group.

    Args:
        scores: (runs, tasks) success rates of each group, in [0, 1]; the same tasks in each, at least two runs.

    Raises:
        MissingPackageError: rliable is not installed.
    """
    require_package("rliable")
    from rliable import library, metrics

    with _seeded():
        values, ends = library.get_interval_estimates(
            dict(scores),
            lambda x: np.array([metrics.aggregate_mean(x), metrics.aggregate_iqm(x)]),
            reps=DRAWS,
        )
        pairs = {f"{a}\0{b}": [scores[a], scores[b]] for a, b in combinations(scores, 2)}
        chances, chance_ends = library.get_interval_estimates(
            pairs, lambda x, y: np.array([improvement(x, y)]), reps=DRAWS
        )
        shares, share_ends = library.create_performance_profile(dict(scores), THRESHOLDS, reps=DRAWS // 4)
    return GroupScores(
        runs={name: len(rows) for name, rows in scores.items()},
        mean={name: _estimate(values[name], ends[name], 0) for name in scores},
        iqm={name: _estimate(values[name], ends[name], 1) for name in scores},
        improvement={
            tuple(key.split("\0")): _estimate(chances[key], chance_ends[key], 0)  # type: ignore[misc]
            for key in pairs
        },
        profiles={name: Profile(THRESHOLDS, shares[name], *share_ends[name]) for name in scores},
    )


def improvement(first: Floats, second: Floats) -> float:
    """Return the probability that a run of the first does better on a task than one of the second, a tie being half.

    It is rliable's `probability_of_improvement`, without its rank test for every task, which takes minutes here.

    Args:
        first: (runs, tasks) scores.
        second: (other runs, tasks) scores.
    """
    gaps = first[:, None] - second[None]
    return float((gaps > 0).mean() + (gaps == 0).mean() / 2)


def _estimate(values: Floats, ends: Floats, place: int) -> Estimate:
    return Estimate(float(values[place]), float(ends[0][place]), float(ends[1][place]))


@contextmanager
def _seeded() -> Iterator[None]:
    """Seed NumPy's global generator, which rliable 1.2 draws from, and leave it as it was."""
    before = np.random.get_state()  # noqa: NPY002
    np.random.seed(SEED)  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(before)  # noqa: NPY002
