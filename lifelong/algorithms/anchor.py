"""Weights to stay near, each with its importance: what EWC, SI and MAS have in common."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from lifelong.checkpoints import Weights
from lifelong.errors import CheckpointError
from lifelong.policies.base import Policy

ANCHOR_FORM = {"importance": Weights(), "anchor": Weights()}


class Anchor:
    """Surrogate `sum_i Omega_i (theta_i - anchor_i)^2` of the loss on earlier tasks when weights move.

    Attributes:
        importance: Omega by parameter name, each of the parameter's shape and never negative.
        weights: Anchored values by parameter name; empty before the first task ends.
    """

    def __init__(self) -> None:
        self.importance: dict[str, Tensor] = {}
        self.weights: dict[str, Tensor] = {}

    def penalty(self, policy: Policy, strength: float) -> Tensor | None:
        """Return the surrogate times `strength`, a scalar; None before the first task ends."""
        if not self.weights:
            return None
        terms = [
            (self.importance[name] * (p - self.weights[name]).square()).sum()
            for name, p in policy.named_parameters()
            if name in self.weights
        ]
        return strength * torch.stack(terms).sum()

    @torch.no_grad()
    def gradient(self, name: str, value: Tensor) -> Tensor:
        """Return the surrogate's derivative at a parameter's value, of its shape; zero before the first task ends."""
        if name not in self.weights:
            return torch.zeros_like(value)
        return 2 * self.importance[name] * (value - self.weights[name])

    @torch.no_grad()
    def move(self, policy: Policy, added: Mapping[str, Tensor], decay: float = 1.0) -> None:
        """Add a task's importance and anchor the weights at their present values.

        Args:
            policy: Policy with the present weights.
            added: Importance of the task by parameter name; only these parameters are anchored.
            decay: Factor on the importance of earlier tasks.
        """
        for name, value in added.items():
            old = self.importance.get(name)
            self.importance[name] = value if old is None else old.mul(decay).add_(value)
        self.weights = {n: p.detach().clone() for n, p in policy.named_parameters() if n in added}

    def state_dict(self) -> dict[str, Any]:
        """Return importance and anchored weights, by parameter name."""
        return {"importance": dict(self.importance), "anchor": dict(self.weights)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            CheckpointError: Other weights are anchored than have an importance.
        """
        if odd := sorted(state["importance"].keys() ^ state["anchor"].keys()):
            raise CheckpointError(f"{odd[0]} has an importance or an anchor, but not both")
        self.importance, self.weights = dict(state["importance"]), dict(state["anchor"])
