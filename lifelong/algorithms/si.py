"""Synaptic intelligence."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from lifelong.algorithms.anchor import Anchor
from lifelong.algorithms.base import Algorithm
from lifelong.data.windows import TaskWindows
from lifelong.policies.base import Policy


class SI(Algorithm):
    """Pull each weight towards its last anchor, as hard as it lowered the loss on its way there.

    Zenke et al. 2017, "Continual learning through synaptic intelligence". Along the path of a task each
    weight collects `omega_i = - sum over steps g_i dtheta_i` (eq. 3), its part of the loss's descent; g is
    the gradient of the loss without the penalty. At the task's end `Omega_i += omega_i / (Delta_i^2 + xi)`
    (eq. 5), Delta being the way from the path's start to its end, and the loss of later tasks gains
    `strength * sum_i Omega_i (theta_i - anchor_i)^2` (eq. 4). A weight whose omega is negative counts as
    unimportant: a negative Omega would push it away.

    Where the best epoch's weights are kept, these are the anchor; the importance is still that of the whole
    path, by which omega and Delta belong together.
    """

    def __init__(self, *, strength: float = 0.1, damping: float = 1e-3):
        """Make the algorithm.

        Args:
            strength: Weight of the penalty (c). 1 would weigh old and new alike if omega were exact; the noise
                of small batches makes omega too large, so smaller values are the paper's advice.
            damping: xi, bounds the importance of weights that hardly moved (those whose way is well below
                sqrt(xi), 0.03 here).
        """
        self.strength, self.damping = strength, damping
        self.anchor = Anchor()
        self._omega: dict[str, Tensor] = {}
        self._way: dict[str, Tensor] = {}  # Delta
        self._step: dict[str, tuple[Tensor, Tensor]] = {}  # of one step: gradient, weights before it

    def begin_task(self, task_index: int, dataset: TaskWindows, policy: Policy) -> None:
        """A new path begins."""
        self._omega, self._way = {}, {}

    def penalty(self, policy: Policy) -> Tensor | None:
        """`strength * sum Omega (theta - anchor)^2`, a scalar; None during the first task."""
        return self.anchor.penalty(policy, self.strength)

    @torch.no_grad()
    def after_backward(self, policy: Policy) -> None:
        """Note the gradient, less the penalty's share of it, and the weights before the step."""
        self._step = {
            name: (p.grad - self.strength * self.anchor.gradient(name, p), p.detach().clone())
            for name, p in policy.named_parameters()
            if p.grad is not None
        }

    @torch.no_grad()
    def after_step(self, policy: Policy) -> None:
        """`omega <- omega - g dtheta`, `Delta <- Delta + dtheta`."""
        for name, p in policy.named_parameters():
            if name not in self._step:
                continue
            grad, before = self._step[name]
            moved = p - before
            self._omega[name] = self._omega.get(name, torch.zeros_like(p)) - grad * moved
            self._way[name] = self._way.get(name, torch.zeros_like(p)) + moved
        self._step = {}

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Turn the path into importance and move the anchor to the present weights."""
        added = {n: torch.zeros_like(v) for n, v in self.anchor.importance.items()}
        for name, omega in self._omega.items():
            added[name] = omega.clamp_min(0) / (self._way[name].square() + self.damping)
        self.anchor.move(policy, added)
        self._omega, self._way = {}, {}

    def state_dict(self) -> dict[str, Any]:
        """Importance and anchor, and the path of the task being learned."""
        return {"anchor": self.anchor.state_dict(), "omega": dict(self._omega), "way": dict(self._way)}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        """Take up what `state_dict` gave."""
        self.anchor.load_state_dict(state["anchor"])
        self._omega, self._way = dict(state["omega"]), dict(state["way"])
