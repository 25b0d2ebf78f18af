"""Online elastic weight consolidation."""

from typing import Any

import torch
from torch import Tensor

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

    def get_params(self) -> Tensor:
        """Return all weights of the policy, (P,)."""
        return torch.cat([p.reshape(-1) for p in self.policy.parameters()])

    def get_grads(self) -> Tensor:
        """Return the gradients of all weights, (P,); 0 where there is none."""
        grads = [torch.zeros_like(p) if p.grad is None else p.grad for p in self.policy.parameters()]
        return torch.cat([grad.reshape(-1) for grad in grads])

    def penalty(self) -> Tensor:
        """Return the penalty on the present weights, without the factor `lifelong.e_lambda`."""
        found = self.hooks.penalty(self.policy)
        return torch.zeros(()) if found is None else found / self.cfg.lifelong.e_lambda
