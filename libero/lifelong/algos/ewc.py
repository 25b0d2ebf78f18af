"""Online elastic weight consolidation."""

from typing import Any

from libero.lifelong.algos.base import Sequential
from lifelong import algorithms
from lifelong.algorithms.importance import BatchFisher


class EWC(Sequential):
    """Pulls weights towards their values after earlier tasks; see `lifelong.algorithms.EWC`.

    The Fisher information is the original's estimate from batches of all windows, which `lifelong.e_lambda` is for.
    """

    def make_hooks(self, cfg: Any) -> algorithms.Algorithm:
        """See `Sequential`."""
        return algorithms.EWC(
            strength=float(cfg.lifelong.e_lambda),
            gamma=cfg.lifelong.gamma,
            estimator=BatchFisher(windows=0, batch_size=cfg.train.batch_size),
        )
