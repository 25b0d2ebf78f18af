"""Learning curves, and forward transfer from them with and without the bias of a chosen maximum.

Eq. 3 of Liu et al. (NeurIPS 2023) counts every epoch after the best one as the best. Where the best epoch is chosen by
the rollouts that also measure it, this is biased upwards: of several equal points, the one that had luck is chosen and
then held. `cross_fitted` chooses without the start that it measures; `plain` holds nothing, for runs that keep the last
epoch's weights whatever the curve says; `published` is eq. 3 as written.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Transfer = Literal["cross_fitted", "plain", "published"]


@dataclass(frozen=True)
class Curve:
    """Success on a task while it is being learned: c[k,k,e] for every evaluated epoch e, ascending.

    Attributes:
        epochs: (E,) epochs already trained; 0 is zero-shot.
        rates: (E,) success rates in [0, 1].
        episodes: (E,) number of rollouts of each rate.
        successes: (E, n, G) outcomes of the n episodes on each of the G tasks that are learned together (usually 1),
            in [0, 1]; None where they are not known, or where the points have different starts.
        starts: (n,) initial states of these episodes.
        tasks: Names of the G tasks.
    """

    epochs: NDArray[np.int64]
    rates: Floats
    episodes: NDArray[np.int64]
    successes: Floats | None = None
    starts: NDArray[np.int64] | None = None
    tasks: tuple[str, ...] = ()

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
        found = self.by_episode(kind)
        return float(self.held().mean() if found is None else found.mean())

    def by_episode(self, kind: Transfer) -> Floats | None:
        """Return the (n, G) terms whose mean is FWT_k, one for each episode; None where outcomes are not known."""
        if self.successes is None:
            return None
        size, count, _ = self.successes.shape
        if kind == "plain":
            return np.asarray(self.successes.mean(axis=0))
        chosen = np.full(count, self.best)
        if kind == "cross_fitted" and count > 1:
            others = self.successes.sum(axis=(1, 2), keepdims=True)
            others = others - self.successes.sum(axis=2, keepdims=True)  # (E, n, 1): without the episode
            chosen = np.argmax(np.round(others[..., 0], 9), axis=0)  # of equals, the earliest
        before = np.arange(size)[:, None] < chosen  # (E, n)
        kept = self.successes[chosen, np.arange(count)] * (size - chosen)[:, None]
        return np.asarray(((self.successes * before[..., None]).sum(axis=0) + kept) / size)


def forward_transfer(curves: Sequence[Curve], kind: Transfer = "published") -> Floats:
    """Return (K,) FWT_k = mean over e of c[k,k,e]; by default with epochs after e* counted as c[k,k,e*] (eq. 3)."""
    return np.array([c.transfer(kind) for c in curves], dtype=float)


def mean_curve(curves: Sequence[Curve]) -> Curve:
    """Return the mean of the curves of tasks that are learned together, with the episodes of all."""
    if len(curves) == 1:
        return curves[0]
    epochs = sorted(set.intersection(*(set(c.epochs.tolist()) for c in curves)))
    points = [np.isin(c.epochs, epochs) for c in curves]
    known = [c.successes[p] for c, p in zip(curves, points, strict=True) if c.successes is not None]
    starts = curves[0].starts
    alike = len(known) == len(curves) and all(np.array_equal(c.starts, starts) for c in curves)  # type: ignore[arg-type]
    return Curve(
        np.array(epochs, dtype=np.int64),
        np.mean([c.rates[p] for c, p in zip(curves, points, strict=True)], axis=0),
        np.sum([c.episodes[p] for c, p in zip(curves, points, strict=True)], axis=0),
        np.concatenate(known, axis=2) if alike else None,
        starts if alike else None,
        tuple(name for c in curves for name in c.tasks),
    )
