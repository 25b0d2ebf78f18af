"""Two policies in the same episodes: exact and sequential tests, intervals, and what chance alone makes.

An episode is identified by its task and its initial state, so the outcomes of two policies are pairs, and only pairs
in which they differ (discordant ones) carry evidence. The tests and intervals hold for the two sets of weights that
were evaluated; how much training again would change needs several runs of each.
"""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy  # its parts are imported when they are first used
from numpy.typing import NDArray

from lifelong.stats.intervals import ALPHA, CONFIDENCE, LEAST_EPISODES, UNKNOWN, Estimate, Floats

DRAWS = 9999
SEED = 2023


@dataclass(frozen=True)
class Pairs:
    """Outcomes of two policies in the same episodes, one row for each start of each task.

    Attributes:
        tasks: (N,) position of the task, from 0.
        starts: (N,) initial state of the episode.
        first: (N, R) successes of the first policy in its R runs.
        second: (N, S) successes of the second policy in its S runs.
    """

    tasks: NDArray[np.int64]
    starts: NDArray[np.int64]
    first: NDArray[np.bool_]
    second: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.tasks)

    @property
    def single(self) -> bool:
        """Whether each policy has one run, so that each pair is one episode of each."""
        return self.first.shape[1] == self.second.shape[1] == 1

    @property
    def differences(self) -> Floats:
        """(N,) success of the first minus that of the second, each the mean over its runs."""
        return self.first.mean(axis=1) - self.second.mean(axis=1)

    def of_tasks(self, tasks: Sequence[int]) -> "Pairs":
        """Return the pairs of some of the tasks."""
        chosen = np.isin(self.tasks, tasks)
        return Pairs(self.tasks[chosen], self.starts[chosen], self.first[chosen], self.second[chosen])


@dataclass(frozen=True)
class Counts:
    """Pairs by their outcome."""

    both: int
    only_first: int
    only_second: int
    neither: int

    @property
    def pairs(self) -> int:
        """Number of pairs."""
        return self.both + self.only_first + self.only_second + self.neither

    @property
    def lost(self) -> float:
        """Share of the first's successes that the second does not have; NaN without any."""
        won = self.both + self.only_first
        return self.only_first / won if won else math.nan

    @property
    def discordant(self) -> int:
        """Number of pairs in which exactly one of the two succeeded."""
        return self.only_first + self.only_second


@dataclass(frozen=True)
class PairedDifference:
    """The difference of two policies in success, first minus second.

    Attributes:
        pairs: Number of starts that both were evaluated in.
        first: Success rate of the first in these.
        second: Success rate of the second in these.
        value: First minus second.
        counts: Pairs by outcome; None if a policy has several runs.
        p_value: Two-sided p-value of equal success.
        score: Tango's score interval; None if a policy has several runs.
        bootstrap: Interval of the bootstrap that draws starts within each task: the tasks are fixed.
        over_tasks: Interval of the bootstrap that draws whole tasks: other tasks of the same kind; None for fewer
            than two.
        by_chance: Largest absolute difference that chance alone makes in 19 of 20 evaluations of two equal policies
            which differ in as many pairs; None if a policy has several runs.
    """

    pairs: int
    first: float
    second: float
    value: float
    counts: Counts | None
    test: str
    p_value: float
    score: Estimate | None
    bootstrap: Estimate
    over_tasks: Estimate | None
    by_chance: float | None

    @property
    def interval(self) -> Estimate:
        """The interval to report: Tango's, or the bootstrap's if a policy has several runs."""
        return self.score or self.bootstrap


def difference(pairs: Pairs, *, draws: int = DRAWS, seed: int = SEED) -> PairedDifference:
    """Compare two policies in the same episodes.

    Args:
        pairs: The outcomes, at least one pair.
        draws: Number of draws of each bootstrap and of the permutation test; 0 for no bootstrap, of policies with one
            run each.

    Raises:
        ValueError: There are no pairs.
    """
    if len(pairs) == 0:
        raise ValueError("no pairs: the policies were not evaluated in the same starts")
    counts = count(pairs) if pairs.single else None
    value = float(pairs.differences.mean())
    return PairedDifference(
        pairs=len(pairs),
        first=float(pairs.first.mean()),
        second=float(pairs.second.mean()),
        value=value,
        counts=counts,
        test="McNemar, exact" if counts else "sign flips of each start's difference",
        p_value=mcnemar_exact(counts) if counts else sign_flip_test(pairs.differences, draws, seed),
        score=score_interval(counts) if counts else None,
        bootstrap=bootstrap_starts(pairs, draws=draws, seed=seed) if draws else replace(UNKNOWN, value=value),
        over_tasks=bootstrap_tasks(pairs, draws=draws, seed=seed) if draws else None,
        by_chance=chance_difference(counts) if counts else None,
    )


def count(pairs: Pairs) -> Counts:
    """Return the pairs by outcome, of two policies with one run each."""
    first, second = pairs.first[:, 0], pairs.second[:, 0]
    cells = (first & second, first & ~second, ~first & second, ~first & ~second)
    return Counts(*(int(c.sum()) for c in cells))


def mcnemar_exact(counts: Counts) -> float:
    """Return McNemar's exact two-sided p-value (McNemar 1947).

    Given the number of discordant pairs, those that the first policy wins are binomial with share 1/2 if both are
    equally good in every start. Where they are equal on average only, the test rejects less often than it may.
    """
    m = counts.discordant
    return float(scipy.stats.binomtest(counts.only_first, m).pvalue) if m else 1.0


def fisher_exact(successes: int, episodes: int, other_successes: int, other_episodes: int) -> float:
    """Return Fisher's exact two-sided p-value of two success rates in episodes that are not paired (Fisher 1935)."""
    failed, other_failed = episodes - successes, other_episodes - other_successes
    return float(scipy.stats.fisher_exact([[successes, failed], [other_successes, other_failed]]).pvalue)


def agreeing_successes(successes: int, episodes: int, others: int, alpha: float = ALPHA) -> tuple[int, int]:
    """Return the fewest and the most successes in other episodes with which Fisher's exact test does not reject.

    Args:
        successes: Number of successes that are known.
        episodes: Number of their episodes.
        others: Number of episodes of the other evaluation.
        alpha: Level of the test, which rejects less often than that.
    """
    middle = round(others * successes / episodes)

    def p_value(other: int) -> float:
        return fisher_exact(successes, episodes, other, others)

    low = bisect_right(range(middle), alpha, key=p_value)
    return low, middle + bisect_left(range(middle + 1, others + 1), -alpha, key=lambda s: -p_value(s))


def sign_flip_test(differences: Floats, draws: int = DRAWS, seed: int = SEED) -> float:
    """Return the two-sided p-value of the paired permutation test, which swaps the policies in random starts.

    For single runs it is McNemar's exact test. Starts with several runs remain whole, as their runs are not
    independent. Exact if there are few differences, by random swaps otherwise (see `scipy.stats.permutation_test`).

    Args:
        differences: (N,) difference of each start.
        draws: Number of random swaps.
        seed: Seed of the swaps.
    """
    moved = differences[differences != 0]  # the others stay what they are when they are swapped
    if len(moved) < 2:
        return 1.0
    found = scipy.stats.permutation_test(
        (moved, np.zeros_like(moved)),
        lambda x, y, axis: (x - y).sum(axis=axis),
        permutation_type="samples",
        vectorized=True,
        n_resamples=draws,
        batch=1000,
        rng=np.random.default_rng(seed),
    )
    return float(found.pvalue)


def score_interval(counts: Counts, confidence: float = CONFIDENCE) -> Estimate:
    """Return Tango's score interval of the difference of paired proportions.

    The interval holds every difference d that the score test does not reject: with b pairs that only the first won,
    c that only the second won, and n pairs, |b - c - n·d| <= z·sqrt(n·(2q + d·(1 - d))), where q is the most likely
    share of the latter given d (Tango, Statistics in Medicine 17, 1998). Fagerland, Lydersen & Laake (2014) recommend
    it for small samples. Its width is above 0 also where the policies never differ. Unknown of fewer than five pairs.

    Args:
        counts: Pairs by outcome.
        confidence: Two-sided confidence level.
    """
    b, c, n = counts.only_first, counts.only_second, counts.pairs
    if n < LEAST_EPISODES:
        return replace(UNKNOWN, value=(b - c) / n if n else math.nan)
    value, z = (b - c) / n, float(scipy.special.ndtri(0.5 + confidence / 2))

    def excess(d: float) -> float:
        root = 2 * n * d - (b - c) * d - b - c
        q = (math.sqrt(max(root**2 + 8 * n * c * d * (1 - d), 0.0)) - root) / (4 * n)
        return (b - c - n * d) ** 2 - z**2 * n * (2 * q + d * (1 - d))

    aside = 1e-12  # at the value itself the excess is at most 0, and exactly 0 at the edges
    low = -1.0 if value == -1 else scipy.optimize.brentq(excess, -1.0, value - aside)
    high = 1.0 if value == 1 else scipy.optimize.brentq(excess, value + aside, 1.0)
    return Estimate(value, float(low), float(high))


def bootstrap_starts(pairs: Pairs, *, draws: int = DRAWS, seed: int = SEED) -> Estimate:
    """Return the percentile interval of the difference over the choice of starts, drawn within each task.

    A start is drawn with both policies' episodes in it. NaN if no task has two starts, or there are fewer
    than five; width 0 where every pair agrees, as a bootstrap cannot draw what was not seen: then read Tango's.
    """
    differences = pairs.differences
    strata = [differences[pairs.tasks == t] for t in np.unique(pairs.tasks)]
    return _bootstrap(strata, draws, seed)


def bootstrap_tasks(pairs: Pairs, *, draws: int = DRAWS, seed: int = SEED) -> Estimate | None:
    """Return the percentile interval of the mean over tasks of the difference, over the choice of tasks.

    With fewer than ten tasks such an interval is too narrow; NaN for fewer than five, None for fewer than two.
    """
    tasks = np.unique(pairs.tasks)
    if len(tasks) < 2:
        return None
    differences = pairs.differences
    return _bootstrap([np.array([differences[pairs.tasks == t].mean() for t in tasks])], draws, seed)


def _bootstrap(strata: Sequence[Floats], draws: int, seed: int) -> Estimate:
    """Return the percentile interval of the mean of all values, which are drawn within their strata."""
    sizes = np.array([len(s) for s in strata])
    value = float(np.concatenate(strata).mean())
    if sizes.max() < 2 or sizes.sum() < LEAST_EPISODES:
        return Estimate(value, math.nan, math.nan)
    fixed = sum(float(s.sum()) for s in strata if len(s) == 1)  # nothing to be drawn
    drawn = [s for s in strata if len(s) > 1]
    total = sizes.sum()

    def mean(*samples: Floats, axis: int) -> Floats:
        return (fixed + sum(s.sum(axis=axis) for s in samples)) / total

    found = scipy.stats.bootstrap(
        drawn,
        mean,
        n_resamples=draws,
        confidence_level=CONFIDENCE,
        method="percentile",
        vectorized=True,
        batch=500,
        rng=np.random.default_rng(seed),
    )
    return Estimate(value, float(found.confidence_interval.low), float(found.confidence_interval.high))


def chance_difference(counts: Counts) -> float:
    """Return the absolute difference that two equal policies with as many discordant pairs exceed in 1 of 20 cases."""
    m = counts.discordant
    most = scipy.stats.binom.ppf(0.5 + CONFIDENCE / 2, m, 0.5)
    return float(abs(2 * most - m) / counts.pairs)
