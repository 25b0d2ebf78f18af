"""A paired comparison that may be looked at after every episode and stopped as soon as it is decided.

If two policies are equally good in a start, each pair in which exactly one of them succeeds is won by either with
probability 1/2. After m such pairs, w of them won by the first, the evidence against equality is

    e = ∫ (2π)^w (2(1 - π))^(m - w) dπ = 2^m / ((m + 1) · C(m, w)),

the likelihood of a share π of wins, averaged over all shares, relative to that of 1/2 (Robbins, "Statistical methods
related to the law of the iterated logarithm", 1970; as an e-process: Ramdas et al., "Game-theoretic statistics and
safe anytime-valid inference", Statistical Science 2023). While the policies are equal, e is a martingale of mean 1, so
it ever reaches 1/α with probability at most α (Ville 1939): the test may be stopped at any time, and more episodes may
be added at any time. Snyder et al. (arXiv 2503.10966 and 2603.13616) propose such tests for robot policies. A test of
a number of pairs that was fixed beforehand needs fewer of them; a single look at the end should use McNemar's.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lifelong.errors import require_package
from lifelong.results.differences import Pairs
from lifelong.results.metrics import Floats

ALPHA = 0.05


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
    """Test as the episodes come in: the first start of every task, then the second start of every task, and so on.

    Rounds over all tasks keep every prefix balanced, so that a few tasks in which one policy is better do not decide
    alone. The order does not depend on outcomes, as the test requires.

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


def rounds(pairs: Pairs) -> NDArray[np.int64]:
    """Return the (N,) order of the pairs: the n-th start of every task before the (n+1)-th of any."""
    by_task = np.lexsort((pairs.starts, pairs.tasks))
    turn = np.empty(len(pairs), dtype=np.int64)
    for task in np.unique(pairs.tasks):
        mine = by_task[pairs.tasks[by_task] == task]
        turn[mine] = np.arange(len(mine))
    return np.lexsort((pairs.tasks, turn))


def log_evidence(won: NDArray[np.int64], lost: NDArray[np.int64]) -> Floats:
    """Return log e for numbers of discordant pairs that the first policy won and lost, of any common shape."""
    require_package("scipy", "judge")
    from scipy.special import betaln

    return (won + lost) * np.log(2.0) + betaln(won + 1, lost + 1)
