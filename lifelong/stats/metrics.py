"""The metrics of a run: forward transfer, forgetting, area under the curve (Liu et al., NeurIPS 2023, eq. 3).

c[i,j,e] is the success rate on task j after e epochs on task i, c[i,j] that of the weights that are kept of task i, K
the number of tasks. Tasks count from 0 here, from 1 in the paper.

Eq. 3 counts every epoch after the best one as the best. Where the best epoch is chosen by the rollouts that also
measure it, this is biased upwards: of several equal points, the one that had luck is chosen and then held.
"cross_fitted" chooses without the episode that it measures; "plain" holds nothing, for runs that keep the last epoch's
weights whatever the curve says; "published" is eq. 3 as written.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lifelong.stats.intervals import Estimate, Floats, wilson_interval

Transfer = Literal["cross_fitted", "plain", "published"]
METRIC_NAMES = ("fwt", "nbt", "auc", "final_success", "just_learned")
METRIC_RANGES = {name: (-1.0 if name == "nbt" else 0.0, 1.0) for name in METRIC_NAMES}


@dataclass(frozen=True)
class Curve:
    """Success on a task while it is being learned: c[k,k,e] for every evaluated epoch e, ascending.

    Attributes:
        epochs: (E,) epochs already trained; 0 is zero-shot.
        rates: (E,) success rates in [0, 1].
        episodes: (E,) number of rollouts of each rate.
        successes: (E, n, G) outcomes of the n episodes on each of the G tasks that are learned together (usually 1),
            in [0, 1]; None where they are not known.
    """

    epochs: NDArray[np.int64]
    rates: Floats
    episodes: NDArray[np.int64]
    successes: Floats | None = None

    @property
    def best(self) -> int:
        """Position of e*, the earliest epoch with the highest success."""
        return int(np.argmax(self.rates))

    def held(self) -> Floats:
        """Return the (E,) rates with every epoch after e* counted as c[k,k,e*], as in eq. 3."""
        rates = np.array(self.rates, dtype=float)
        rates[self.best :] = rates[self.best]
        return rates

    def transfer(self, kind: Transfer = "published") -> float:
        """Return FWT_k, the mean over epochs; NaN without points.

        Args:
            kind: Estimate, see the module. "cross_fitted" needs the outcomes of at least two episodes a point, and is
                "published" without them.
        """
        if len(self.rates) == 0:
            return float("nan")
        if kind == "plain":
            return float(self.rates.mean())
        if kind == "published" or self.successes is None or self.successes.shape[1] < 2:
            return float(self.held().mean())
        by_episode = self.successes.mean(axis=2)  # (E, n)
        others = np.round(by_episode.sum(axis=1, keepdims=True) - by_episode, 9)  # without the episode
        chosen = np.argmax(others, axis=0)  # (n,), of equals the earliest
        size, count = by_episode.shape
        before = np.where(np.arange(size)[:, None] < chosen, by_episode, 0.0).sum(axis=0)
        held = by_episode[chosen, np.arange(count)] * (size - chosen)
        return float(((before + held) / size).mean())


@dataclass(frozen=True)
class Scores:
    """The input of the metrics: the success rates of a run over K tasks.

    Attributes:
        curves: K learning curves, one for each task; empty curves make FWT and AUC undefined (NaN).
        matrix: (K, K) c[i,j], success on task j after learning task i; NaN above the diagonal.
        episodes: (K, K) number of rollouts of each cell, 0 above the diagonal.
        group_sizes: Number of tasks of each group that was learned together; () for one task at a time. K is then
            the number of groups, and each group counts as one task whose success is the mean over its tasks; only
            final success and that just learned count tasks.
        transfer: Estimate of forward transfer, see the module.
        sampled: Whether the matrix is `estimate_cells` of a sample, so that only what is linear in it means something.
    """

    curves: tuple[Curve, ...]
    matrix: Floats
    episodes: NDArray[np.int64]
    group_sizes: tuple[int, ...] = ()
    transfer: Transfer = "published"
    sampled: bool = False

    def __post_init__(self) -> None:
        k = len(self.curves)
        if self.matrix.shape != (k, k) or self.episodes.shape != (k, k):
            raise ValueError(
                f"scores of {k} tasks need ({k}, {k}) matrices, got rates {self.matrix.shape} "
                f"and episodes {self.episodes.shape}"
            )

    def without_first(self) -> "Scores":
        """Return the success rates without the first group's: those of the sequence after its base stage."""
        return replace(
            self,
            curves=self.curves[1:],
            matrix=self.matrix[1:, 1:],
            episodes=self.episodes[1:, 1:],
            group_sizes=self.group_sizes[1:],
        )

    def episodes_of(self, metric: str) -> int:
        """Return the number of different episodes, each a (task, initial state), that a metric rests on.

        The same initial states are used again after every task, and at every point of a curve: each counts once.
        """
        if metric == "fwt":
            return sum(int(c.episodes.max(initial=0)) for c in self.curves)
        last = self.episodes[-1] if metric == "final_success" else np.diag(self.episodes)
        return int(last.sum())


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


def lifelong_metrics(scores: Scores) -> Metrics:
    """Compute FWT, NBT, AUC (eq. 3), final average success and mean just-learned success.

    Success rates have Wilson's interval over their episodes, which says what other episodes of these weights would
    change. FWT, NBT and AUC have none (NaN): how far they vary, several seeds say (`lifelong.stats.methods`).

    Args:
        scores: Learning curves, and the success matrix: row the task learned last, column the task evaluated.

    Examples:
        >>> epochs, counts = np.array([0, 5, 10]), np.full(3, 20)
        >>> rates = (np.array([0.0, 0.5, 0.8]), np.array([0.1, 0.6, 0.6]))
        >>> matrix = np.array([[0.8, np.nan], [0.3, 0.6]])
        >>> curves = tuple(Curve(epochs, rate, counts) for rate in rates)
        >>> found = lifelong_metrics(Scores(curves, matrix, np.array([[20, 0], [20, 20]])))
        >>> round(found.fwt.value, 4), round(found.nbt.value, 4)
        (0.4333, 0.25)
    """
    fwt = forward_transfer(scores.curves, scores.transfer)
    nbt, auc = negative_backward_transfer(scores.matrix), area_under_curve(fwt, scores.matrix)
    values, estimates = metric_values(scores), {}
    for name in METRIC_NAMES:
        low = high = np.nan
        if name in ("final_success", "just_learned") and np.isfinite(values[name]):
            count = scores.episodes_of(name)
            low, high = map(float, wilson_interval(values[name] * count, count))
        estimates[name] = Estimate(values[name], low, high)
    if scores.group_sizes:  # every task has the value of its group
        fwt, nbt, auc = (np.repeat(v, scores.group_sizes) for v in (fwt, nbt, auc))
    return Metrics(**estimates, fwt_by_task=fwt, nbt_by_task=nbt, auc_by_task=auc)


def metric_values(scores: Scores) -> dict[str, float]:
    """Return the value of every metric; NaN where it is undefined."""
    fwt, matrix = forward_transfer(scores.curves, scores.transfer), scores.matrix
    sizes = scores.group_sizes or None  # success is that of all tasks, the others are of groups
    return {
        "fwt": float(fwt.mean()),
        "nbt": float(negative_backward_transfer(matrix).mean()),
        "auc": float(area_under_curve(fwt, matrix).mean()),
        "final_success": float(np.average(matrix[-1], weights=sizes)),
        "just_learned": float(np.average(np.diag(matrix), weights=sizes)),
    }


def forward_transfer(curves: Sequence[Curve], kind: Transfer = "published") -> Floats:
    """Return (K,) FWT_k = mean over e of c[k,k,e]; by default with epochs after e* counted as c[k,k,e*] (eq. 3)."""
    return np.array([c.transfer(kind) for c in curves], dtype=float)


def negative_backward_transfer(matrix: ArrayLike) -> Floats:
    """Return (K,) NBT_k = mean over t > k of (c[k,k] - c[t,k]) (eq. 3): how much of task k is forgotten.

    No task follows the last one; its empty mean is 0 and still counts among the K terms of the average,
    as in the authors' own evaluation notebook. Of a single task it is undefined (NaN): nothing could be forgotten.
    """
    c = np.asarray(matrix, dtype=float)
    if len(c) == 1:
        return np.array([np.nan])
    drops = [(c[k, k] - c[k + 1 :, k]).mean() for k in range(len(c) - 1)]
    return np.array([*drops, 0.0], dtype=float)


def area_under_curve(fwt: ArrayLike, matrix: ArrayLike) -> Floats:
    """Return (K,) AUC_k = (FWT_k + sum over t > k of c[t,k]) / (number of tasks from k on) (eq. 3)."""
    c, fwt = np.asarray(matrix, dtype=float), np.asarray(fwt, dtype=float)
    size = len(c)
    return np.array([(fwt[k] + c[k + 1 :, k].sum()) / (size - k) for k in range(size)], dtype=float)


def average_success(matrix: ArrayLike) -> Floats:
    """Return (K,) the mean over j <= i of c[i,j]: success over the tasks learned so far, after each task."""
    c = np.asarray(matrix, dtype=float)
    return np.array([c[i, : i + 1].mean() for i in range(len(c))], dtype=float)


def estimate_cells(matrix: ArrayLike, rows: Sequence[tuple[int, int]]) -> Floats:
    """Return a matrix (K, K) whose every cell, and so NBT and AUC, is unbiased over the samples that may be drawn.

    Of each row, a uniform sample of the earlier tasks is measured, of the last row all. The mean of a task's success
    just learned and at the end predicts what lies between, and what is measured there corrects the prediction, weighted
    by its chance to be drawn: the difference estimator (Särndal, Swensson and Wretman, Model Assisted Survey Sampling,
    1992, section 6.3). Single cells may lie outside of [0, 1]. Before the last row is measured, the others are NaN.

    Args:
        matrix: Success rates c[i,j], NaN where they were not measured.
        rows: Row and number of earlier tasks of each step of the sequence, in order.
    """
    c = np.array(matrix, dtype=float)
    learned = np.concatenate([c[row, earlier : row + 1] for row, earlier in rows])
    for row, earlier in rows[:-1]:
        seen, predicted = np.isfinite(c[row, :earlier]), (learned + c[-1])[:earlier] / 2
        if not seen.all():
            weight = earlier / max(1, seen.sum())
            c[row, :earlier] = predicted + np.where(seen, weight * (c[row, :earlier] - predicted), 0.0)
    return c


def other_conventions(matrix: ArrayLike) -> dict[str, float]:
    """Return what other papers print of forgetting, from the same matrix (K, K); NaN with one task or a missing cell.

    The K - 1 tasks that others follow are averaged:

    - `bwt`: c[K,k] - c[k,k] (Lopez-Paz and Ranzato, NeurIPS 2017, eq. 3); above 0 later tasks helped.
    - `forgetting`: the best of c[k,k] ... c[K-1,k] less c[K,k] (Chaudhry et al., ECCV 2018, eq. 3).
    - `nbt_of_followed`: NBT_k of eq. 3 without the empty term of the last task.
    - `relative_nbt`: NBT_k / c[k,k], over the tasks that were learned at all (c[k,k] > 0).
    """
    c = np.asarray(matrix, dtype=float)
    if len(c) < 2:
        return dict.fromkeys(("bwt", "forgetting", "nbt_of_followed", "relative_nbt"), float("nan"))
    learned, nbt = np.diag(c)[:-1], negative_backward_transfer(c)[:-1]
    best = np.array([c[k:-1, k].max() for k in range(len(c) - 1)])
    some = learned > 0
    return {
        "bwt": float((c[-1, :-1] - learned).mean()),
        "forgetting": float((best - c[-1, :-1]).mean()),
        "nbt_of_followed": float(nbt.mean()),
        "relative_nbt": float((nbt[some] / learned[some]).mean()) if some.any() else float("nan"),
    }


def unseen_transfer(before: ArrayLike, initial: ArrayLike) -> dict[str, float]:
    """Return what was known of tasks before they were learned; NaN where it was not measured.

    - `fwt_of_gem`: c[k-1,k] - b[k] (Lopez-Paz and Ranzato, NeurIPS 2017, eq. 4), over all tasks but the first.
    - `zero_shot_next`: c[k-1,k], success on a task just before it is learned.
    - `zero_shot`: c[i,k] over all i < k.

    Args:
        before: c, (K, K), of which the cells above the diagonal count.
        initial: b, (K,), success on each task of the policy that the first task begins with.
    """
    c, b = np.asarray(before, dtype=float), np.asarray(initial, dtype=float)
    ahead, above = np.diag(c, 1), c[np.triu_indices(len(c), 1)]
    means = {"fwt_of_gem": ahead - b[1:], "zero_shot_next": ahead, "zero_shot": above}
    return {name: float(values.mean()) if len(values) else float("nan") for name, values in means.items()}


def intransigence(matrix: ArrayLike, reference: ArrayLike) -> float:
    """Return the mean of a[k] - c[k,k]: how much worse tasks are learned than by a reference (Chaudhry et al., eq. 4).

    Args:
        matrix: c, (K, K).
        reference: a, (K,), success on each task of a policy that learned it alone, or all tasks together.
    """
    return float((np.asarray(reference, dtype=float) - np.diag(np.asarray(matrix, dtype=float))).mean())


def mean_curve(curves: Sequence[Curve]) -> Curve:
    """Return the mean of the curves of tasks that are learned together, at their common epochs."""
    if len(curves) == 1:
        return curves[0]
    epochs = sorted(set.intersection(*(set(c.epochs.tolist()) for c in curves)))
    points = [np.isin(c.epochs, epochs) for c in curves]
    outcomes = [c.successes[p] for c, p in zip(curves, points, strict=True) if c.successes is not None]
    known = len(outcomes) == len(curves) and len({o.shape[1] for o in outcomes}) == 1
    return Curve(
        np.array(epochs, dtype=np.int64),
        np.mean([c.rates[p] for c, p in zip(curves, points, strict=True)], axis=0),
        np.sum([c.episodes[p] for c, p in zip(curves, points, strict=True)], axis=0),
        np.concatenate(outcomes, axis=2) if known else None,
    )
