"""Online elastic weight consolidation."""

import torch

from lifelong.algorithms.anchor import Anchored
from lifelong.algorithms.importance import ImportanceEstimator, SampleFisher
from lifelong.data.windows import TaskWindows
from lifelong.policies.base import Policy
from lifelong.types import NonNegative


class EWC(Anchored):
    """Pull each weight towards its last anchor, the harder the more it mattered for the tasks so far.

    The loss gains `strength * sum_i F_i (theta_i - anchor_i)^2`, and after each task
    `F <- gamma * F + F_task` (Kirkpatrick et al. 2017, eq. 3; Schwarz et al. 2018, section 4, the online
    form; no factor 1/2, as in LIBERO). `F_task` is the diagonal of the Fisher information, as an estimator gives it.

    LIBERO's code has `BatchFisher` over all windows, augmented, and strength 5e4. With that go the results of
    Liu et al., table 8 (FWT / NBT / AUC of ResNet-T: LONG .13 / .22 / .02, SPATIAL .23 / .33 / .06,
    OBJECT .56 / .69 / .16, GOAL .32 / .48 / .06).
    """

    tuned = {"strength": (1.5, 15.0, 150.0, 1.5e3, 1.5e4), "gamma": (0.5, 0.9, 1.0)}
    plain_start = True

    def __init__(
        self,
        *,
        strength: NonNegative | None = None,
        gamma: NonNegative = 0.9,
        estimator: ImportanceEstimator | None = None,
    ):
        """Create the algorithm.

        Args:
            strength: Weight of the penalty (lambda); None takes the strength that goes with the estimator.
            gamma: Factor on the Fisher information of earlier tasks after each task.
            estimator: Estimator of the Fisher information, `SampleFisher` or `BatchFisher`; None: `SampleFisher()`.
        """
        self.estimator = SampleFisher() if estimator is None else estimator
        super().__init__(self.estimator.strength if strength is None else strength)
        self.gamma = gamma

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Add the task's Fisher information and move the anchor to the present weights."""
        fisher = self.estimator.estimate(dataset, policy, generator, self.augment)
        self.move_anchor(policy, fisher, decay=self.gamma)
