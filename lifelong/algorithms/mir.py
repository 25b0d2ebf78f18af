"""Maximally interfered retrieval: replay of what the coming step would harm most."""

from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from lifelong.algorithms.base import acting_with
from lifelong.algorithms.er import ER
from lifelong.data.memory import ReplayMemory
from lifelong.errors import ConfigError
from lifelong.policies.base import Policy, device_of, in_mode
from lifelong.types import Batch, Positive


class MIR(ER):
    """Replay, of windows drawn from the memory, those whose loss a step on the present task would raise most.

    Aljundi et al. 2019, "Online continual learning with maximally interfered retrieval" (NeurIPS, section 3.1, ER-MIR,
    criterion MI-1). With B the batch and C candidates drawn from the memory,

        theta_v = theta - rate * gradient of L(B; theta),    s(x) = l(x; theta_v) - l(x; theta) for x in C,

    and the windows with the largest s join B, as those of `ER` do.

    Departures: the virtual step is the paper's, plain gradient descent, while steps are those of the run's optimiser.
    Losses and the virtual gradient are those of evaluation mode, without dropout, on windows that are not augmented.
    The stream is not online: the memory is filled when a task ends.
    """

    needs_demonstrations = True  # for the virtual step

    def __init__(
        self,
        *,
        memory: ReplayMemory,
        ratio: Positive = 1.0,
        candidates: Annotated[float, Field(ge=1)] = 5.0,
        rate: Positive = 0.05,
    ):
        """Create the algorithm.

        Args:
            memory: Memory of earlier tasks' windows.
            ratio: Number of windows replayed for each window of the present task.
            candidates: Number of windows that are drawn for each one that is replayed, as far as the memory has them;
                5 in the paper (50 for 10).
            rate: Length of the virtual step as a factor of the gradient; 0.05 in the paper.
        """
        if getattr(memory, "batch_size", None):
            raise ConfigError(
                "algo.memory.batch_size and algo.candidates both say how many windows are drawn; leave the first out"
            )
        super().__init__(memory=memory, ratio=ratio)
        self.candidates, self.rate = candidates, rate
        self._policy: Policy | None = None

    def mode_train(self, policy: Policy) -> None:
        """Set training mode; the policy is the one that retrieval asks."""
        super().mode_train(policy)
        self._policy = policy

    def mix(self, batch: Batch, generator: torch.Generator) -> Batch:
        """Return the batch followed by the windows of earlier tasks that the coming step would harm most."""
        if not len(self.memory) or self._policy is None:
            return super().mix(batch, generator)
        wanted = max(1, round(self.ratio * len(batch)))
        count = max(wanted, min(round(self.candidates * wanted), len(self.memory)))  # beyond it they repeat
        drawn = self.memory.sample(count, generator).to(batch.actions.device)
        harm = interference(self._policy, batch, drawn, self.rate)
        return batch.join(drawn.rows(harm.topk(min(wanted, len(drawn))).indices.to(drawn.actions.device)))


def interference(policy: Policy, batch: Batch, drawn: Batch, rate: float) -> Tensor:
    """Return by how much a gradient step on a batch raises the loss of each drawn window, (B,).

    Args:
        policy: Policy, which is as before afterwards.
        batch: Windows of the step.
        drawn: Windows whose losses are compared.
        rate: Factor on the gradient.
    """
    device = device_of(policy)
    with in_mode(policy, training=False):
        named = {name: p for name, p in policy.named_parameters() if p.requires_grad}
        loss = policy.loss(batch.to(device))
        gradients = torch.autograd.grad(loss, list(named.values()), allow_unused=True)
        drawn = drawn.to(device)
        with torch.no_grad():
            moved = {
                name: p - rate * g
                for (name, p), g in zip(named.items(), gradients, strict=True)
                if g is not None
            }
            before = policy.window_losses(drawn)
            with acting_with(policy, moved):
                return policy.window_losses(drawn) - before
