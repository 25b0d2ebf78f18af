"""Memory aware synapses."""

from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor

from lifelong.algorithms.anchor import ANCHOR_FORM, Anchor
from lifelong.algorithms.base import Algorithm
from lifelong.algorithms.importance import ActionSensitivity
from lifelong.data.windows import TaskWindows
from lifelong.policies.base import Policy
from lifelong.types import Natural, NonNegative


class MAS(Algorithm):
    """Pull each weight towards its last anchor, the harder the more the policy's actions depend on it.

    Aljundi et al. 2018, "Memory aware synapses: learning what (not) to forget". After a task
    `Omega_i += mean over windows of |d f(x) / d theta_i|` (section 4.1); the loss of later tasks gains
    `strength * sum_i Omega_i (theta_i - anchor_i)^2`. The paper's f is the squared length of the output, by which
    actions near zero count for nothing; here it is a random projection of it, see `ActionSensitivity`.
    """

    state_form = {"anchor": ANCHOR_FORM}
    tuned = {"strength": (0.01, 0.03, 0.1, 0.3, 1.0, 10.0)}
    plain_start = True

    def __init__(
        self,
        *,
        strength: NonNegative = 1.0,
        windows: Natural = 512,
        of: Literal["projected", "squared"] = "projected",
    ):
        """Create the algorithm.

        Args:
            strength: Weight of the penalty (lambda); 1 as in the paper.
            windows: Number of windows, drawn without replacement, that the estimate uses, one by one; 0: all.
            of: What a weight matters for: a random projection of the actions, or their squared length as in the paper.
        """
        self.strength, self.estimator = strength, ActionSensitivity(windows=windows, of=of)
        self.anchor = Anchor()

    def penalty(self, policy: Policy) -> Tensor | None:
        """Return `strength * sum Omega (theta - anchor)^2`, a scalar; None during the first task."""
        return self.anchor.penalty(policy, self.strength)

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Add the task's importance and move the anchor to the present weights."""
        self.anchor.move(policy, self.estimator.estimate(dataset, policy, generator))

    def state_dict(self) -> dict[str, Any]:
        """Return importance and anchor, by parameter name."""
        return {"anchor": self.anchor.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        """Restore what `state_dict` returned."""
        self.anchor.load_state_dict(state["anchor"])
