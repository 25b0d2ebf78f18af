"""Synaptic intelligence."""

import torch
from torch import Tensor

from lifelong.algorithms.anchor import Anchored
from lifelong.checkpoints import Weights
from lifelong.data.windows import TaskWindows
from lifelong.policies.base import Policy
from lifelong.types import NonNegative, Positive


class SI(Anchored):
    """Pull each weight towards its last anchor, the harder the more it lowered the loss on its path there.

    Zenke et al. 2017, "Continual learning through synaptic intelligence". Along the path of a task each
    weight collects `omega_i = - sum over steps g_i dtheta_i` (eq. 3), its part of the loss's descent; g is
    the gradient of the loss without the penalty. At the task's end `Omega_i += omega_i / (Delta_i^2 + xi)`
    (eq. 5), Delta being the displacement from the path's start to its end, and the loss of later tasks gains
    `strength * sum_i Omega_i (theta_i - anchor_i)^2` (eq. 4). A weight whose omega is negative counts as
    unimportant: a negative Omega would push it away.

    Where the best epoch's weights are kept, these are the anchor; the importance is still that of the whole
    path, so that omega and Delta are of the same path.
    """

    state_form = {**Anchored.state_form, "omega": Weights(), "displacement": Weights()}
    tuned = {"strength": (0.01, 0.1, 1.0, 10.0, 100.0)}

    def __init__(self, *, strength: NonNegative = 0.1, damping: Positive = 1e-3):
        """Create the algorithm.

        Args:
            strength: Weight of the penalty (c). 1 would weigh old and new alike if omega were exact; the noise
                of small batches makes omega too large, so smaller values are the paper's advice.
            damping: Bound xi on the importance of weights that hardly moved (those whose displacement is well below
                sqrt(xi), 0.03 here).
        """
        super().__init__(strength)
        self.damping = damping
        self.omega: dict[str, Tensor] = {}
        self.displacement: dict[str, Tensor] = {}  # Delta
        self._step: dict[str, tuple[Tensor, Tensor]] = {}  # of one step: gradient, weights before it

    def begin_task(self, task_index: int, dataset: TaskWindows, policy: Policy) -> None:
        """Start a new path."""
        self.omega, self.displacement = {}, {}

    @torch.no_grad()
    def after_backward(self, policy: Policy) -> None:
        """Store the gradient without the penalty's, and the weights before the step."""
        self._step = {}
        for name, p in policy.named_parameters():
            if p.grad is not None:
                pull = torch.zeros_like(p)  # the penalty's gradient
                if name in self.anchor:
                    pull = 2 * self.importance[name] * (p - self.anchor[name])
                self._step[name] = p.grad - self.strength * pull, p.detach().clone()

    @torch.no_grad()
    def after_step(self, policy: Policy) -> None:
        """Add the step to the path: `omega <- omega - g dtheta`, `Delta <- Delta + dtheta`."""
        for name, p in policy.named_parameters():
            if name not in self._step:
                continue
            grad, before = self._step[name]
            moved = p - before
            self.omega[name] = self.omega.get(name, torch.zeros_like(p)) - grad * moved
            self.displacement[name] = self.displacement.get(name, torch.zeros_like(p)) + moved
        self._step = {}

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Turn the path into importance and move the anchor to the present weights."""
        added = {n: torch.zeros_like(v) for n, v in self.importance.items()}
        for name, omega in self.omega.items():
            added[name] = omega.clamp_min(0) / (self.displacement[name].square() + self.damping)
        self.move_anchor(policy, added)
        self.omega, self.displacement = {}, {}
