"""Memory aware synapses."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from lifelong.algorithms.anchor import Anchor
from lifelong.algorithms.base import Algorithm, WindowDataset
from lifelong.policies.base import Policy


class MAS(Algorithm):
    """Pull each weight towards its last anchor, as hard as the policy's answers depend on it.

    Aljundi et al. 2018, "Memory aware synapses: learning what (not) to forget". After a task
    `Omega_i += mean over windows of |d |h(x)|^2 / d theta_i|` (section 4.1), h being the policy's
    deterministic actions, their square summed over dimensions and averaged over the window's steps; the loss
    of later tasks gains `strength * sum_i Omega_i (theta_i - anchor_i)^2`. No labels are needed.
    """

    def __init__(self, *, strength: float = 1.0, windows: int = 512):
        """Make the algorithm.

        Args:
            strength: Weight of the penalty (lambda); 1 as in the paper, not tuned for behaviour cloning.
            windows: How many windows, drawn without replacement, the estimate looks at, one by one; 0 means
                all.
        """
        self.strength, self.windows = strength, windows
        self.anchor = Anchor()

    def penalty(self, policy: Policy) -> Tensor | None:
        """`strength * sum Omega (theta - anchor)^2`, a scalar; None during the first task."""
        surrogate = self.anchor.penalty(policy)
        return None if surrogate is None else self.strength * surrogate

    def end_task(
        self, task_index: int, dataset: WindowDataset, policy: Policy, generator: torch.Generator
    ) -> None:
        """Add the task's importance and move the anchor to the present weights."""
        self.anchor.move(policy, self.estimate(dataset, policy, generator))

    def estimate(
        self, dataset: WindowDataset, policy: Policy, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Mean absolute sensitivity of the squared actions, in evaluation mode: parameter name -> its shape."""
        count = len(dataset) if not self.windows else min(self.windows, len(dataset))
        order = torch.randperm(len(dataset), generator=generator)[:count]
        named = {n: p for n, p in policy.named_parameters() if p.requires_grad}
        total = {n: torch.zeros_like(p, memory_format=torch.preserve_format) for n, p in named.items()}
        device = next(iter(named.values())).device
        was_training = policy.training
        policy.eval()
        for index in order.split(1):
            size = policy.predict(dataset.batch(index).to(device)).square().sum(-1).mean()
            grads = torch.autograd.grad(size, list(named.values()), allow_unused=True)
            for name, grad in zip(named, grads, strict=True):
                if grad is not None:
                    total[name].add_(grad.abs(), alpha=1 / count)
        policy.train(was_training)
        return total

    def state_dict(self) -> dict[str, Any]:
        """Importance and anchor, by parameter name."""
        return {"anchor": self.anchor.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, WindowDataset]) -> None:
        """Take up what `state_dict` gave."""
        self.anchor.load_state_dict(state["anchor"])
