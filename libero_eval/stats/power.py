"""How many episodes a difference in success needs, for policies evaluated in the same starts or in different ones."""

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy  # its parts are imported when they are first used

from libero_eval.stats.sequential import log_evidence
from lifelong.errors import ConfigError

MOST = 2_000_000  # episodes of each policy


@dataclass(frozen=True)
class Question:
    """A difference to be shown.

    Attributes:
        base: Success rate of the one policy, in (0, 1).
        difference: Success of the other minus `base`, not 0.
        discordance: Share of pairs in which exactly one of the two succeeds. None: as if the outcomes of a pair were
            independent, which is the most cautious assumption.
        power: Probability of showing it.
        alpha: Probability of a false difference, over all tests together.
        tests: Number of tests that share `alpha` (the first step of Holm's procedure, which is Bonferroni's).
    """

    base: float
    difference: float
    discordance: float | None = None
    power: float = 0.8
    alpha: float = 0.05
    tests: int = 1

    def __post_init__(self) -> None:
        other = self.base + self.difference
        if not 0 < self.base < 1:
            raise ConfigError(
                f"--base, the success of the first policy, is {self.base:g}; it has to be above 0 and below 1"
            )
        if not 0 <= other <= 1:
            raise ConfigError(
                f"success rates are between 0 and 1; these are {self.base:g} and {other:g} (base + difference)"
            )
        if self.difference == 0:
            raise ConfigError("a difference of 0 cannot be shown with any number of episodes")
        if not 0 < self.alpha < 1 or not self.alpha < self.power < 1 or self.tests < 1:
            raise ConfigError(
                "0 < alpha < power < 1 and at least one test are needed; "
                f"alpha is {self.alpha:g}, power {self.power:g}, tests {self.tests}"
            )
        low, high = self.discordance_range
        if self.discordance is not None and not low - 1e-12 <= self.discordance <= high + 1e-12:
            raise ConfigError(
                f"with success rates {self.base:g} and {other:g}, between {low:.3f} and {high:.3f} of the pairs "
                f"differ; a discordance of {self.discordance:g} is impossible"
            )

    @property
    def other(self) -> float:
        """Success rate of the other policy."""
        return self.base + self.difference

    @property
    def level(self) -> float:
        """Level of each test."""
        return self.alpha / self.tests

    @property
    def discordance_range(self) -> tuple[float, float]:
        """The smallest and largest share of pairs that can differ."""
        total = self.base + self.other
        return abs(self.difference), min(total, 2 - total)

    @property
    def differing(self) -> float:
        """The share of pairs that differ: given, or that of independent outcomes."""
        if self.discordance is not None:
            return self.discordance
        return self.base * (1 - self.other) + self.other * (1 - self.base)


def discordance_of(base: float, difference: float, correlation: float) -> float:
    """Return the share of pairs that differ if the outcomes of a pair have a correlation (phi)."""
    other = base + difference
    spread = math.sqrt(base * (1 - base) * other * (1 - other))
    return base * (1 - other) + other * (1 - base) - 2 * correlation * spread


def paired_power(question: Question, pairs: int) -> float:
    """Return the probability that McNemar's exact test of so many pairs shows the difference.

    Exact: the number of discordant pairs is binomial, and given it, so is the number of those that are won.
    """
    spread = 9 * math.sqrt(pairs * question.differing) + 12
    middle = pairs * question.differing
    m = np.arange(max(0, math.floor(middle - spread)), min(pairs, math.ceil(middle + spread)) + 1)
    share = min(1.0, (question.differing + abs(question.difference)) / (2 * question.differing))
    below = scipy.special.bdtr  # distribution function; scipy.stats takes a second to import
    level, bound = question.level / 2, np.zeros(len(m))
    some = below(0, m, 0.5) <= level
    bound[some] = np.floor(scipy.special.bdtrik(level, m[some], 0.5))
    bound += below(bound + 1, m, 0.5) <= level
    bound -= below(bound, m, 0.5) > level  # the largest count that is rejected, or -1
    count = np.maximum(bound, 0)
    rejected = below(count, m, share) + scipy.special.bdtrc(m - count - 1, m, share)
    differ = min(1.0, question.differing)
    chosen = scipy.special.gammaln(pairs + 1) - scipy.special.gammaln([m + 1, pairs - m + 1]).sum(axis=0)
    weight = np.exp(chosen + scipy.special.xlogy(m, differ) + scipy.special.xlog1py(pairs - m, -differ))
    return float(weight @ np.where(bound < 0, 0.0, rejected))


def paired_episodes(question: Question) -> int:
    """Return the number of pairs, so of episodes of each policy, with which McNemar's exact test has the power.

    Raises:
        ConfigError: More than two million would be needed.
    """
    high = 8
    while paired_power(question, high) < question.power:
        high *= 2
        if high > MOST:
            raise ConfigError(
                f"a difference of {question.difference:g} needs more than {MOST:,} episodes of each policy"
            )
    low = high // 2
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if paired_power(question, middle) >= question.power else (middle, high)
    return high


def unpaired_episodes(question: Question) -> int:
    """Return the number of episodes of each policy if their starts differ.

    Of the z-test of two proportions (Fleiss, Levin & Paik, "Statistical Methods for Rates and Proportions", 2003,
    eq. 4.14).
    """
    first, second = question.base, question.other
    mean = (first + second) / 2
    pooled = -scipy.special.ndtri(question.level / 2) * math.sqrt(2 * mean * (1 - mean))
    apart = scipy.special.ndtri(question.power) * math.sqrt(first * (1 - first) + second * (1 - second))
    return math.ceil(((pooled + apart) / question.difference) ** 2)


def shown_difference(
    question: Question, pairs: int, *, discordance: float | None = None, correlation: float | None = None
) -> float:
    """Return the smallest difference, in steps of 0.001, that so many pairs show with the power; NaN if none.

    Args:
        question: Success rate of the one policy, power and level; of its difference, the sign counts.
        pairs: Number of pairs.
        discordance: Share of pairs that differ, as far as the rates of each difference allow it; None: as if outcomes
            were independent.
        correlation: Correlation of the outcomes (phi), from which the discordance follows.
    """
    sign = math.copysign(1.0, question.difference)
    room = (1 - question.base) if sign > 0 else question.base
    for step in range(1, math.floor(1000 * room + 1e-9) + 1):
        moved = replace(question, difference=sign * step / 1000, discordance=None)
        share = discordance
        if correlation is not None:
            share = discordance_of(moved.base, moved.difference, correlation)
        if share is not None:
            low, high = moved.discordance_range
            moved = replace(moved, discordance=min(max(share, low), high))
        if paired_power(moved, pairs) >= question.power:
            return step / 1000
    return math.nan


@dataclass(frozen=True)
class Stopping:
    """When the sequential test stops, simulated.

    Attributes:
        limit: Number of pairs after which it is given up.
        median: Half of the evaluations are decided after so many pairs; NaN if fewer are decided at all.
        power: Share that is decided, for the better policy, at the limit.
    """

    limit: int
    median: float
    power: float


def sequential_stopping(question: Question, limit: int, *, simulations: int = 2000) -> Stopping:
    """Simulate the sequential test of a true difference.

    Args:
        question: The difference.
        limit: Number of pairs after which the evaluation is given up.
        simulations: Number of simulated evaluations.
    """
    rng = np.random.default_rng(2023)
    won = (question.differing + abs(question.difference)) / 2
    found = np.full(simulations, np.inf)
    better = np.zeros(simulations, dtype=bool)
    for part in np.array_split(np.arange(simulations), max(1, simulations * limit // 5_000_000)):
        draw = rng.random((len(part), limit))
        wins = np.cumsum(draw < won, axis=1)
        losses = np.cumsum((draw >= won) & (draw < question.differing), axis=1)
        reached = log_evidence(np.asarray(wins, np.int64), np.asarray(losses, np.int64)) >= -np.log(
            question.level
        )
        decided = reached.any(axis=1)
        at = reached.argmax(axis=1)
        rows = np.arange(len(part))
        found[part] = np.where(decided, at + 1, np.inf)
        better[part] = decided & (wins[rows, at] > losses[rows, at])
    median = float(np.median(found))
    return Stopping(limit, median if np.isfinite(median) else math.nan, float(better.mean()))
