"""Values with confidence intervals, and p-values of several tests."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

Floats = NDArray[np.float64]
ALPHA = 0.05  # of tests
CONFIDENCE = 0.95


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
        episodes: Number of episodes n, same shape; where it is 0 the interval is [0, 1].
        confidence: Two-sided confidence level.

    Returns:
        Lower and upper ends in [0, 1], of the broadcast shape.
    """
    s, n = np.broadcast_arrays(np.asarray(successes, dtype=float), np.asarray(episodes, dtype=float))
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    safe = np.where(n > 0, n, 1.0)
    p = np.where(n > 0, s, 0.0) / safe
    centre = (p + z**2 / (2 * safe)) / (1 + z**2 / safe)
    half = z * np.sqrt(np.maximum(p * (1 - p), 0) / safe + z**2 / (4 * safe**2)) / (1 + z**2 / safe)
    # At the ends the bound is exactly 0 or 1; rounding must not put it on the wrong side of p.
    low, high = np.clip(centre - half, 0, p), np.clip(centre + half, p, 1)
    return np.where(n > 0, low, 0.0), np.where(n > 0, high, 1.0)


def combine_intervals(weights: ArrayLike, rates: ArrayLike, low: ArrayLike, high: ArrayLike) -> Estimate:
    """Return a weighted sum of independent rates, with the interval implied by theirs.

    MOVER (Zou & Donner, Statistics in Medicine 2008): for θ = Σ w·p,
    θ_low = θ - sqrt(Σ (w·(p - end))²) with the cell's end that lowers w·p, and likewise θ_high.

    Args:
        weights: (C,) weights w.
        rates: (C,) rates p.
        low: (C,) lower ends of their intervals.
        high: (C,) upper ends of their intervals.
    """
    w, p, lo, hi = (np.asarray(x, dtype=float) for x in (weights, rates, low, high))
    value = float(np.sum(w * p))
    down = np.where(w > 0, w * (p - lo), w * (p - hi))
    up = np.where(w > 0, w * (hi - p), w * (lo - p))
    return Estimate(value, value - float(np.hypot.reduce(down)), value + float(np.hypot.reduce(up)))


def mean_and_standard_error(values: ArrayLike) -> tuple[float, float]:
    """Return the mean over seeds and its standard error, s/sqrt(n) with n-1 in s; NaN for the error of one seed."""
    v = np.asarray(values, dtype=float)
    mean = float(v.mean()) if v.size else float("nan")
    return mean, float(v.std(ddof=1) / np.sqrt(v.size)) if v.size > 1 else float("nan")


def mean_and_half_width(values: ArrayLike) -> tuple[float, float]:
    """Return the mean over seeds and half of Student's t interval; NaN for the interval of one seed."""
    mean, error = mean_and_standard_error(values)
    df = np.size(values) - 1
    return mean, float(special.stdtrit(df, 0.5 + CONFIDENCE / 2)) * error if df > 0 else float("nan")


def holm(p_values: Sequence[float]) -> list[float]:
    """Return the p-values of a family of tests, adjusted by Holm: p_(i) · (m - i), never falling, at most 1.

    NaN stands for what was not tested: it stays, and does not count among the m (Holm, Scand. J. Stat. 1979).
    """
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p, kind="stable")[: np.isfinite(p).sum()]
    adjusted = np.full(len(p), np.nan)
    adjusted[order] = np.minimum(1, np.maximum.accumulate(p[order] * (len(order) - np.arange(len(order)))))
    return [float(value) for value in adjusted]
