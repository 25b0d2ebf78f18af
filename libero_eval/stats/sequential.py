"""Tests and intervals that hold at every moment, so that an evaluation may be stopped as soon as enough is known.

Their evidence e is what a bettor against a hypothesis has made of 1: a martingale of mean 1 if it is true, which ever
reaches 1/α with probability at most α (Ville 1939; Ramdas et al., "Game-theoretic statistics and safe anytime-valid
inference", Statistical Science 2023). Outcomes are taken in rounds over all tasks, which may differ: of a round of
independent episodes, a hypothesis about their mean needs no more, as Π(1 + λ(p_t - m)) is at most 1 where the mean of
the p_t is m.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # its parts are imported when they are first used
from numpy.typing import NDArray

from libero_eval.stats.episodes import Pairs
from lifelong.stats.intervals import ALPHA, CONFIDENCE, Estimate, Floats

_STAKES = 1000  # shares that a bet is spread over


@dataclass(frozen=True)
class SequentialTest:
    """The evidence after every pair.

    Attributes:
        log_e: (N,) natural logarithm of e after each pair.
        wins: (N,) pairs that the first won minus those that the second won, so far.
        alpha: Probability of a false decision.
        decided_after: Number of pairs after which e first reached 1/alpha; None if it never did.
        first_better: Whether the first policy led then; None if it is not decided.
        p_value: Anytime-valid p-value, 1 / the largest e so far.
    """

    log_e: Floats
    wins: NDArray[np.int64]
    alpha: float
    decided_after: int | None
    first_better: bool | None
    p_value: float


def sequential_test(pairs: Pairs, alpha: float = ALPHA) -> SequentialTest:
    """Test as the episodes come in, so that the evaluation may be stopped as soon as it is decided.

    If two policies are equally good in a start, each pair in which exactly one of them succeeds is won by either with
    probability 1/2. After m such pairs, w of them won by the first, the evidence against equality is

        e = ∫ (2π)^w (2(1 - π))^(m - w) dπ = 2^m / ((m + 1) · C(m, w)),

    the likelihood of a share π of wins, averaged over all shares, relative to that of 1/2 (Robbins, "Statistical
    methods related to the law of the iterated logarithm", 1970). The test may be stopped, and episodes added, at any
    time. Snyder et al. (arXiv 2503.10966 and 2603.13616) propose such tests for robot policies.
    A test of a number of pairs that was fixed beforehand needs fewer of them; a single look at the end should use
    McNemar's.

    The order is a start of every task, then the next start of every task, and so on, see `shuffled`. Rounds over all
    tasks keep every prefix balanced, so that a few tasks in which one policy is better do not decide alone; the order
    does not depend on outcomes, as the test requires.

    Args:
        pairs: Outcomes of two policies with one run each.
        alpha: Probability of a false decision.

    Raises:
        ValueError: A policy has several runs.
    """
    if not pairs.single:
        raise ValueError("the sequential test is for one run of each policy")
    order = rounds(pairs)
    signs = pairs.first[order, 0].astype(np.int64) - pairs.second[order, 0]
    log_e = log_evidence(np.cumsum(signs > 0), np.cumsum(signs < 0))
    reached = np.flatnonzero(log_e >= -np.log(alpha))
    wins = np.cumsum(signs)
    decided = int(reached[0]) if len(reached) else None
    return SequentialTest(
        log_e=log_e,
        wins=wins,
        alpha=alpha,
        decided_after=None if decided is None else decided + 1,
        first_better=None if decided is None else bool(wins[decided] > 0),
        p_value=float(min(1.0, np.exp(-max(log_e.max(initial=0.0), 0.0)))),
    )


def shuffled(starts: Sequence[int]) -> tuple[int, ...]:
    """Return starts in the order in which a sequential test sees them, which their numbers say nothing of.

    Tests need rounds that are alike but for chance, and difficulty may grow with a start's number. By multiples of the
    golden ratio, after any number of rounds the starts are spread evenly over all numbers (Knuth, The Art of Computer
    Programming 3, 6.4): 0, 34, 13, 47, 26, ... of fifty. The order is the same for every policy.
    """
    return tuple(sorted(starts, key=lambda start: start * 40503 % 65536))  # 2^16 over the golden ratio


def rounds(pairs: Pairs) -> NDArray[np.int64]:
    """Return the (N,) order of the pairs: the n-th start of every task, `shuffled`, before the (n+1)-th of any."""
    numbers = np.unique(pairs.starts)
    place = np.empty(len(numbers), dtype=np.int64)
    place[np.searchsorted(numbers, shuffled(numbers.tolist()))] = np.arange(len(numbers))
    by_task = np.lexsort((place[np.searchsorted(numbers, pairs.starts)], pairs.tasks))
    turn = np.empty(len(pairs), dtype=np.int64)
    for task in np.unique(pairs.tasks):
        mine = by_task[pairs.tasks[by_task] == task]
        turn[mine] = np.arange(len(mine))
    return np.lexsort((pairs.tasks, turn))


def anytime_interval(won: int, episodes: int, confidence: float = CONFIDENCE) -> Estimate:
    """Return an interval of the mean success over tasks that may be looked at after every round over them.

    It holds each rate m against which the evidence is below 1/α, with w successes in n episodes

        e(m) = ∫ (θ/m)^w ((1 - θ)/(1 - m))^(n - w) dBeta(θ; 1/2, 1/2),

    so that it ever misses the true one with probability at most α: a confidence sequence (Robbins 1970; Howard,
    Ramdas, McAuliffe & Sekhon, Annals of Statistics 49, 2021).

    Args:
        won: Number of successes.
        episodes: Number of episodes, from complete rounds.
        confidence: Two-sided confidence level.
    """
    value, lost = won / episodes if episodes else np.nan, episodes - won
    mixture = (
        scipy.special.betaln(won + 0.5, lost + 0.5) - scipy.special.betaln(0.5, 0.5) + np.log(1 - confidence)
    )

    def excess(m: float) -> float:
        return float(mixture - scipy.special.xlogy(won, m) - scipy.special.xlog1py(lost, -m))

    aside = 1e-12  # of 0 and 1, where the evidence is infinite
    low = scipy.optimize.brentq(excess, aside, value) if won else 0.0
    high = scipy.optimize.brentq(excess, value, 1 - aside) if lost else 1.0
    return Estimate(value, float(low), float(high))


def log_evidence(
    won: NDArray[np.int64],
    lost: NDArray[np.int64],
    tied: NDArray[np.int64] | None = None,
    margin: float = 0.0,
) -> Floats:
    """Return log e against a difference in success, first minus second, of minus the margin.

    Args:
        won: Numbers of pairs that only the first policy won, of any shape.
        lost: Numbers of pairs that only the second won.
        tied: Numbers of the others; without a margin, they say nothing.
        margin: Difference, in (-1, 1); other than 0, e holds at the ends of complete rounds.
    """
    if not margin:
        return (won + lost) * np.log(2.0) + scipy.special.betaln(won + 1, lost + 1)
    m = (1 - margin) / 2  # mean of 1 where the first won, 0 where it lost, 1/2 of ties
    stakes = ((np.arange(_STAKES) + 0.5) / _STAKES - m) / (m * (1 - m))
    gains = [np.log1p(stakes * (x - m)) for x in (1.0, 0.0, 0.5)]
    counts = [np.asarray(n)[..., None] for n in (won, lost, 0 if tied is None else tied)]
    logs = sum((n * gain for n, gain in zip(counts, gains, strict=True)), np.zeros(_STAKES))
    return np.asarray(scipy.special.logsumexp(logs, axis=-1) - np.log(_STAKES))
