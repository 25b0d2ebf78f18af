"""Weights to stay near, each with its importance: what EWC, SI and MAS have in common."""

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from lifelong.algorithms.base import Algorithm
from lifelong.checkpoints import Weights
from lifelong.data.windows import TaskWindows
from lifelong.errors import CheckpointError
from lifelong.policies.base import Policy


class WeightedDistance(torch.autograd.Function):
    """`sum_i Omega_i (theta_i - anchor_i)^2` over all tensors at once, with its gradient `2 Omega (theta - anchor)`."""

    @staticmethod
    def forward(ctx: Any, anchors: list[Tensor], importance: list[Tensor], *weights: Tensor) -> Tensor:
        """Return the sum, a scalar."""
        moved = torch._foreach_sub(weights, anchors)
        ctx.pulls = torch._foreach_mul(moved, importance)
        torch._foreach_mul_(moved, ctx.pulls)
        return torch.stack([part.sum() for part in moved]).sum()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        """Return the gradients by weights, times that of what follows."""
        return None, None, *torch._foreach_mul(ctx.pulls, 2 * grads[0])


class Anchored(Algorithm):
    """Surrogate `strength * sum_i Omega_i (theta_i - anchor_i)^2` of the loss on earlier tasks when weights move.

    A subclass calls `move_anchor` when a task ends.

    Attributes:
        strength: Weight of the surrogate.
        importance: Omega by parameter name, each of the parameter's shape and never negative.
        anchor: Anchored values by parameter name; empty before the first task ends.
    """

    state_form: ClassVar[Any] = {"importance": Weights(), "anchor": Weights()}

    def __init__(self, strength: float) -> None:
        self.strength = strength
        self.importance: dict[str, Tensor] = {}
        self.anchor: dict[str, Tensor] = {}

    def penalty(self, policy: Policy) -> Tensor | None:
        """Return `strength * sum Omega (theta - anchor)^2`, a scalar; None before the first task ends."""
        if not self.anchor:
            return None
        weights = {name: p for name, p in policy.named_parameters() if name in self.anchor}
        anchors, importance = ([of[name] for name in weights] for of in (self.anchor, self.importance))
        return self.strength * WeightedDistance.apply(anchors, importance, *weights.values())

    @torch.no_grad()
    def move_anchor(self, policy: Policy, added: Mapping[str, Tensor], decay: float = 1.0) -> None:
        """Add a task's importance and anchor the weights at their present values.

        Args:
            policy: Policy with the present weights.
            added: Importance of the task by parameter name; only these parameters are anchored.
            decay: Factor on the importance of earlier tasks.
        """
        for name, value in added.items():
            old = self.importance.get(name)
            self.importance[name] = value if old is None else old.mul(decay).add_(value)
        self.anchor = {n: p.detach().clone() for n, p in policy.named_parameters() if n in added}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            CheckpointError: Other weights are anchored than have an importance.
        """
        if odd := sorted(state["importance"].keys() ^ state["anchor"].keys()):
            raise CheckpointError(f"{odd[0]} has an importance or an anchor, but not both")
        super().load_state_dict(state, datasets)
