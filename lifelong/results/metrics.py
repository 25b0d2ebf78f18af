"""The metrics of one run: forward transfer, forgetting, area under the curve, and their confidence intervals.

The formulas are in `lifelong.results.scores` and `lifelong.results.curves`, the intervals in
`lifelong.results.components`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lifelong.results.components import interval
from lifelong.results.curves import Curve, Floats, forward_transfer
from lifelong.results.intervals import Estimate, combine_intervals, wilson_interval
from lifelong.results.samples import Member, metric_values, samples
from lifelong.results.scores import (
    METRIC_NAMES,
    METRIC_RANGES,
    Scores,
    area_under_curve,
    average_success,
    curve_weights,
    matrix_weights,
    negative_backward_transfer,
)

__all__ = [
    "METRIC_NAMES",
    "METRIC_RANGES",
    "Curve",
    "Estimate",
    "Floats",
    "Metrics",
    "Scores",
    "area_under_curve",
    "average_success",
    "combine_intervals",
    "forward_transfer",
    "lifelong_metrics",
    "mean_and_standard_error",
    "negative_backward_transfer",
    "wilson_interval",
]


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


def lifelong_metrics(scores: Scores, confidence: float = 0.95) -> Metrics:
    """Compute FWT, NBT, AUC (eq. 3), final average success and mean just-learned success, with intervals.

    The intervals cover the choice of this run's starts, for these weights; the spread between seeds needs several runs
    (`lifelong.results.contrasts`). Outcomes of one start are one cluster, in whichever evaluations it occurs. Where
    only rates are known, they are taken as independent, and Wilson's intervals are combined (`combine_intervals`).

    Args:
        scores: Success rates of the run, with the outcomes behind them.
        confidence: Two-sided confidence level.
    """
    fwt = forward_transfer(scores.curves, scores.transfer)
    nbt, auc = negative_backward_transfer(scores.matrix), area_under_curve(fwt, scores.matrix)
    if scores.has_outcomes:
        found = samples({"": [Member(scores)]})
        estimates = {
            name: interval(found[name][""], METRIC_RANGES[name], confidence) for name in METRIC_NAMES
        }
    else:
        estimates = _of_rates(scores, confidence)
    if scores.group_sizes:  # every task has the value of its group
        fwt, nbt, auc = (np.repeat(values, scores.group_sizes) for values in (fwt, nbt, auc))
    return Metrics(**estimates, fwt_by_task=fwt, nbt_by_task=nbt, auc_by_task=auc)


def _of_rates(scores: Scores, confidence: float) -> dict[str, Estimate]:
    """Return the metrics with intervals for independent rates, given the best epochs."""
    size = len(scores.curves)
    cells = np.tril_indices(size)
    rates = np.concatenate([scores.matrix[cells], *(c.rates for c in scores.curves)])
    episodes = np.concatenate([scores.episodes[cells], *(c.episodes for c in scores.curves)])
    low, high = wilson_interval(rates * episodes, episodes, confidence)
    of_matrix, of_curves = matrix_weights(size), curve_weights(size)
    values, found = metric_values(scores), {}
    for name in METRIC_NAMES:
        held = [w * _held_weights(c, scores) for w, c in zip(of_curves[name], scores.curves, strict=True)]
        weights = np.concatenate([of_matrix[name][cells], *held])
        found[name] = Estimate(np.nan, np.nan, np.nan)
        if np.isfinite(values[name]):
            found[name] = combine_intervals(weights, rates, low, high)
    return found


def _held_weights(curve: Curve, scores: Scores) -> Floats:
    """Return (E,) weights w with Σ w·c[k,k,e] = FWT_k, given the best epoch, which also counts for those after it."""
    size = len(curve.rates)
    last = size - 1 if scores.transfer == "plain" else curve.best if size else 0
    weights = np.where(np.arange(size) < last, 1.0, 0.0)
    weights[last:][:1] = size - last
    return weights / max(size, 1)


def mean_and_standard_error(values: ArrayLike) -> tuple[float, float]:
    """Return the mean over seeds and its standard error, s/sqrt(n) with n-1 in s; NaN for the error of one seed."""
    v = np.asarray(values, dtype=float)
    mean = float(v.mean()) if v.size else float("nan")
    return mean, float(v.std(ddof=1) / np.sqrt(v.size)) if v.size > 1 else float("nan")
