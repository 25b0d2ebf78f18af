"""Forward transfer, forgetting and their confidence intervals from success rates. Plain NumPy, no state.

Notation of Liu et al., "LIBERO: Benchmarking Knowledge Transfer for Lifelong Robot Learning"
(NeurIPS 2023), eq. 3: c[i,j,e] is the success rate on task j after e epochs on task i, c[i,j] that at
task i's best epoch, K the number of tasks. Tasks count from 0 here, from 1 in the paper.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Curve:
    """Success on a task while it is being learned: c[k,k,e] for every evaluated epoch e, ascending.

    Attributes:
        epochs: (E,) epochs already trained; 0 is zero-shot.
        rates: (E,) success rates in [0, 1].
        episodes: (E,) number of rollouts of each rate.
    """

    epochs: NDArray[np.int64]
    rates: Floats
    episodes: NDArray[np.int64]

    @property
    def best(self) -> int:
        """Position of e*, the earliest epoch with the highest success."""
        return int(np.argmax(self.rates))

    def held(self) -> Floats:
        """Return the (E,) rates with every epoch after e* counted as c[k,k,e*], as in eq. 3."""
        rates = np.array(self.rates, dtype=float)
        rates[self.best :] = rates[self.best]
        return rates


@dataclass(frozen=True)
class Scores:
    """The input of the metrics: the success rates of a run over K tasks.

    Attributes:
        curves: K learning curves, one for each task; empty curves make FWT and AUC undefined (NaN).
        matrix: (K, K) c[i,j], success on task j after learning task i; NaN above the diagonal.
        episodes: (K, K) number of rollouts of each cell, 0 above the diagonal.
        group_sizes: Number of tasks of each group that was learned together; () for one task at a time. K is then
            the number of groups, and each group counts as one task whose success is the mean over its tasks.
    """

    curves: tuple[Curve, ...]
    matrix: Floats
    episodes: NDArray[np.int64]
    group_sizes: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        k = len(self.curves)
        if self.matrix.shape != (k, k) or self.episodes.shape != (k, k):
            raise ValueError(
                f"scores of {k} tasks need ({k}, {k}) matrices, got rates {self.matrix.shape} "
                f"and episodes {self.episodes.shape}"
            )

    def without_first(self) -> "Scores":
        """Return the success rates without the first group's: those of the sequence after its base stage."""
        later = slice(1, None)
        return Scores(
            self.curves[later],
            self.matrix[later, later],
            self.episodes[later, later],
            self.group_sizes[later],
        )


@dataclass(frozen=True)
class Cells:
    """All success rates of a run in one row, and the weights of every metric: metric = weights · rates.

    Attributes:
        rates: (C,) success rates: the matrix up to its diagonal, then the learning curves.
        episodes: (C,) number of rollouts of each rate.
        weights: (C,) weights for each name of `METRIC_NAMES`, given the best epochs; NaN where undefined.
    """

    rates: Floats
    episodes: NDArray[np.int64]
    weights: dict[str, Floats]


@dataclass(frozen=True)
class Estimate:
    """A value with its confidence interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Metrics:
    """The metrics of one run. `fwt_by_task` and its like are (K,); fwt, nbt and auc are their means."""

    fwt: Estimate
    nbt: Estimate
    auc: Estimate
    final_success: Estimate
    just_learned: Estimate
    fwt_by_task: Floats
    nbt_by_task: Floats
    auc_by_task: Floats


METRIC_NAMES = ("fwt", "nbt", "auc", "final_success", "just_learned")
METRIC_RANGES = {name: (-1.0 if name == "nbt" else 0.0, 1.0) for name in METRIC_NAMES}


def forward_transfer(curves: Sequence[Curve]) -> Floats:
    """Return (K,) FWT_k = mean over e of c[k,k,e], with epochs after e* counted as c[k,k,e*] (eq. 3)."""
    return np.array([c.held().mean() if len(c.rates) else np.nan for c in curves], dtype=float)


def negative_backward_transfer(matrix: ArrayLike) -> Floats:
    """Return (K,) NBT_k = mean over t > k of (c[k,k] - c[t,k]) (eq. 3): how much of task k is forgotten.

    No task follows the last one; its empty mean is 0 and still counts among the K terms of the average,
    as in the authors' own evaluation notebook. Of a single task it is undefined (NaN): nothing could be forgotten.
    """
    c = np.asarray(matrix, dtype=float)
    if len(c) == 1:
        return np.array([np.nan])
    drops = [(c[k, k] - c[k + 1 :, k]).mean() for k in range(len(c) - 1)]
    return np.array([*drops, 0.0][: len(c)], dtype=float)


def area_under_curve(fwt: ArrayLike, matrix: ArrayLike) -> Floats:
    """Return (K,) AUC_k = (FWT_k + sum over t > k of c[t,k]) / (number of tasks from k on) (eq. 3)."""
    c, fwt = np.asarray(matrix, dtype=float), np.asarray(fwt, dtype=float)
    size = len(c)
    return np.array([(fwt[k] + c[k + 1 :, k].sum()) / (size - k) for k in range(size)], dtype=float)


def average_success(matrix: ArrayLike) -> Floats:
    """Return (K,) the mean over j <= i of c[i,j]: success over the tasks learned so far, after each task."""
    c = np.asarray(matrix, dtype=float)
    return np.array([c[i, : i + 1].mean() for i in range(len(c))], dtype=float)


def lifelong_metrics(scores: Scores, confidence: float = 0.95) -> Metrics:
    """Compute FWT, NBT, AUC (eq. 3), final average success and mean just-learned success, with intervals.

    Given the best epochs, every metric is a weighted sum of independent success rates, so the intervals combine
    the cells' Wilson intervals (see `combine_intervals`). Their width is above 0 also where every episode succeeded
    or every one failed, and they need no random numbers. They cover the chance in the episodes of this run, given
    its checkpoints; the spread between seeds is `mean_and_standard_error`, and `lifelong.results.bootstrap` has
    intervals over both.

    Args:
        scores: Success rates of the run.
        confidence: Two-sided confidence level.
    """
    fwt = forward_transfer(scores.curves)
    nbt = negative_backward_transfer(scores.matrix)
    auc = area_under_curve(fwt, scores.matrix)
    row = cells(scores)
    low, high = wilson_interval(row.rates * row.episodes, row.episodes, confidence)
    estimates = {name: combine_intervals(w, row.rates, low, high) for name, w in row.weights.items()}
    if scores.group_sizes:  # every task has the value of its group
        fwt, nbt, auc = (np.repeat(values, scores.group_sizes) for values in (fwt, nbt, auc))
    return Metrics(**estimates, fwt_by_task=fwt, nbt_by_task=nbt, auc_by_task=auc)


def wilson_interval(
    successes: ArrayLike, episodes: ArrayLike, confidence: float = 0.95
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
    half = z * np.sqrt(p * (1 - p) / safe + z**2 / (4 * safe**2)) / (1 + z**2 / safe)
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
    used = w != 0
    w, p, lo, hi = w[used], p[used], lo[used], hi[used]
    value = float(np.sum(w * p))
    down = np.where(w > 0, w * (p - lo), w * (p - hi))
    up = np.where(w > 0, w * (hi - p), w * (lo - p))
    return Estimate(value, value - float(np.hypot.reduce(down)), value + float(np.hypot.reduce(up)))


def mean_and_standard_error(values: ArrayLike) -> tuple[float, float]:
    """Return the mean over seeds and its standard error, s/sqrt(n) with n-1 in s; NaN for the error of one seed."""
    x = np.asarray(values, dtype=float)
    if x.size == 0:
        return float("nan"), float("nan")
    error = float(x.std(ddof=1) / np.sqrt(x.size)) if x.size > 1 else float("nan")
    return float(x.mean()), error


def cells(scores: Scores) -> Cells:
    """Return the success rates of a run in one row, with the weights of the metrics of eq. 3."""
    size = len(scores.curves)
    rows, cols = np.tril_indices(size)
    counts = [scores.episodes[rows, cols], *(c.episodes for c in scores.curves)]
    rates = np.concatenate([scores.matrix[rows, cols], *(c.rates for c in scores.curves)])
    episodes = np.concatenate(counts)

    after = rows > cols
    later = size - 1 - cols  # tasks learned after column k
    matrix_weights = {
        "fwt": np.zeros(len(rows)),
        "nbt": np.where(after, -1 / np.maximum(later, 1), (later > 0).astype(float)) / size,
        "auc": np.where(after, 1 / (later + 1), 0.0) / size,
        "final_success": (rows == size - 1) / size,
        "just_learned": (rows == cols) / size,
    }
    held = [_held_weights(c) / size for c in scores.curves]
    none = [np.zeros_like(h) for h in held]
    curve_weights = {"fwt": held, "auc": [h / (size - k) for k, h in enumerate(held)]}
    weights = {n: np.concatenate([w, *curve_weights.get(n, none)]) for n, w in matrix_weights.items()}
    if size == 1:  # nothing follows the only task
        weights["nbt"] = np.full(len(rates), np.nan)
    if any(len(c.rates) == 0 for c in scores.curves):  # a task without a learning curve
        weights["fwt"] = weights["auc"] = np.full(len(rates), np.nan)
    return Cells(rates, episodes, weights)


def _held_weights(curve: Curve) -> Floats:
    """Return (E,) weights w with Σ w·c[k,k,e] = FWT_k: the best epoch also counts for those after it."""
    size = len(curve.rates)
    if size == 0:
        return np.zeros(0)
    weights = np.where(np.arange(size) < curve.best, 1.0, 0.0)
    weights[curve.best] = size - curve.best
    return weights / size
