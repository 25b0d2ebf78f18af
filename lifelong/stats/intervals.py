"""Values with confidence intervals, and p-values of several tests."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
import scipy  # its parts are imported when they are first used
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
ALPHA = 0.05  # of tests
CONFIDENCE = 0.95
LEAST_EPISODES = 5  # that an interval is given of


@dataclass(frozen=True)
class Estimate:
    """A value with its confidence interval, whose ends are NaN where it is not known."""

    value: float
    low: float
    high: float


UNKNOWN = Estimate(float("nan"), float("nan"), float("nan"))


def wilson_interval(
    successes: ArrayLike, episodes: ArrayLike, confidence: float = CONFIDENCE
) -> tuple[Floats, Floats]:
    """Return Wilson's score interval of a success rate; its width is above 0 also at 0 % and 100 %.

    With p = s/n and z the normal quantile:
    (p + z²/2n ± z·sqrt(p(1-p)/n + z²/4n²)) / (1 + z²/n)   (Wilson 1927).

    Args:
        successes: Number of successes s, any shape.
        episodes: Number of episodes n, same shape.
        confidence: Two-sided confidence level.

    Returns:
        Lower and upper ends in [0, 1], of the broadcast shape; NaN of fewer than five episodes.
    """
    s, n = np.broadcast_arrays(np.asarray(successes, dtype=float), np.asarray(episodes, dtype=float))
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    safe = np.where(n > 0, n, 1.0)
    p = np.where(n > 0, s, 0.0) / safe
    centre = (p + z**2 / (2 * safe)) / (1 + z**2 / safe)
    half = z * np.sqrt(np.maximum(p * (1 - p), 0) / safe + z**2 / (4 * safe**2)) / (1 + z**2 / safe)
    # At the ends the bound is exactly 0 or 1; rounding must not put it on the wrong side of p.
    low, high, enough = np.clip(centre - half, 0, p), np.clip(centre + half, p, 1), n >= LEAST_EPISODES
    return np.where(enough, low, np.nan), np.where(enough, high, np.nan)


def mean_success(successes: ArrayLike, episodes: ArrayLike) -> Estimate:
    """Return the mean of success rates over tasks, with Wilson's interval at this mean over all their episodes.

    Tasks count alike, so T tasks with n_k episodes are worth n = T² / Σ(1/n_k) episodes: their sum where all have the
    same number. Where tasks differ in difficulty the interval is rather too wide, as independent trials whose chances
    differ vary less than as many with the mean chance (Hoeffding, Annals of Mathematical Statistics 27, 1956).

    Args:
        successes: (T,) number of successes of each task.
        episodes: (T,) number of episodes of each task.
    """
    s, n = np.broadcast_arrays(np.asarray(successes, dtype=float), np.asarray(episodes, dtype=float))
    if not s.size or n.min() <= 0:
        return UNKNOWN
    count = n.sum() if np.ptp(n) == 0 else n.size**2 / (1 / n).sum()
    value = s.sum() / count if np.ptp(n) == 0 else (s / n).mean()
    low, high = wilson_interval(value * count, count)
    return Estimate(float(value), float(low), float(high))


def difference_of(first: Estimate, second: Estimate, share: float = 1.0) -> Estimate:
    """Return a share of the difference of two independent success rates, with Newcombe's interval.

    It is method 10 of Newcombe (Statistics in Medicine 17, 1998): with p and q in [p_low, p_high] and [q_low, q_high],
    p - q - sqrt((p - p_low)² + (q_high - q)²), and likewise above.
    """
    value = first.value - second.value
    down = np.hypot(first.value - first.low, second.high - second.value)
    up = np.hypot(first.high - first.value, second.value - second.low)
    return Estimate(*(float(share * end) for end in (value, value - down, value + up)))


def mean_and_standard_error(values: ArrayLike) -> tuple[float, float]:
    """Return the mean over seeds and its standard error, s/sqrt(n) with n-1 in s; NaN for the error of one seed."""
    v = np.asarray(values, dtype=float)
    mean = float(v.mean()) if v.size else float("nan")
    return mean, float(v.std(ddof=1) / np.sqrt(v.size)) if v.size > 1 else float("nan")


def mean_and_half_width(values: ArrayLike) -> tuple[float, float]:
    """Return the mean over seeds and half of Student's t interval; NaN for the interval of one seed."""
    mean, error = mean_and_standard_error(values)
    df = np.size(values) - 1
    return mean, float(scipy.special.stdtrit(df, 0.5 + CONFIDENCE / 2)) * error if df > 0 else float("nan")


def holm(p_values: Sequence[float]) -> list[float]:
    """Return the p-values of a family of tests, adjusted by Holm: p_(i) · (m - i), never falling, at most 1.

    NaN stands for what was not tested: it stays, and does not count among the m (Holm, Scand. J. Stat. 1979).
    """
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p, kind="stable")[: np.isfinite(p).sum()]
    adjusted = np.full(len(p), np.nan)
    adjusted[order] = np.minimum(1, np.maximum.accumulate(p[order] * (len(order) - np.arange(len(order)))))
    return [float(value) for value in adjusted]
