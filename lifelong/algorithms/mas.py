"""Memory aware synapses."""

from typing import Literal

import torch

from lifelong.algorithms.anchor import Anchored
from lifelong.algorithms.importance import ActionSensitivity
from lifelong.data.windows import TaskWindows
from lifelong.policies.base import Policy
from lifelong.types import Natural, NonNegative


class MAS(Anchored):
    """Pull each weight towards its last anchor, the harder the more the policy's actions depend on it.

    Aljundi et al. 2018, "Memory aware synapses: learning what (not) to forget". After a task
    `Omega_i += mean over windows of |d f(x) / d theta_i|` (section 4.1); the loss of later tasks gains
    `strength * sum_i Omega_i (theta_i - anchor_i)^2`. The paper's f is the squared length of the output, by which
    actions near zero count for nothing; here it is a random projection of it, see `ActionSensitivity`.
    """

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
        super().__init__(strength)
        self.estimator = ActionSensitivity(windows=windows, of=of)

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Add the task's importance and move the anchor to the present weights."""
        self.move_anchor(policy, self.estimator.estimate(dataset, policy, generator))
