"""Weights to stay near, each with its importance: what SI and MAS have in common."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from lifelong.policies.base import Policy


class Anchor:
    """The surrogate `sum_i Omega_i (theta_i - anchor_i)^2` of what earlier tasks lose when weights move."""

    def __init__(self) -> None:
        self.importance: dict[str, Tensor] = {}  # Omega, by parameter name; never negative
        self.weights: dict[str, Tensor] = {}

    def penalty(self, policy: Policy) -> Tensor | None:
        """The surrogate, a scalar; None before the first task is finished."""
        if not self.weights:
            return None
        terms = [
            (self.importance[name] * (p - self.weights[name]).square()).sum()
            for name, p in policy.named_parameters()
            if name in self.weights
        ]
        return torch.stack(terms).sum()

    @torch.no_grad()
    def gradient(self, name: str, value: Tensor) -> Tensor:
        """The surrogate's derivative at a parameter's value, of its shape; zero before the first task ends."""
        if name not in self.weights:
            return torch.zeros_like(value)
        return 2 * self.importance[name] * (value - self.weights[name])

    @torch.no_grad()
    def move(self, policy: Policy, added: Mapping[str, Tensor]) -> None:
        """Add a task's importance, by parameter name, and anchor these parameters where they are now."""
        self.importance = {n: self.importance.get(n, torch.zeros_like(v)) + v for n, v in added.items()}
        self.weights = {n: p.detach().clone() for n, p in policy.named_parameters() if n in added}

    def state_dict(self) -> dict[str, Any]:
        """Importance and anchored weights, by parameter name."""
        return {"importance": dict(self.importance), "anchor": dict(self.weights)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take up what `state_dict` gave."""
        self.importance, self.weights = dict(state["importance"]), dict(state["anchor"])
