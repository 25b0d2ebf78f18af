"""Estimates of how much each weight matters for a task, from gradients on the task's windows."""

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from lifelong.data.windows import WindowDataset
from lifelong.policies.base import Policy, in_mode
from lifelong.types import Batch, Count, Natural, NonNegative, to_device


class ImportanceEstimator:
    """Diagonal Fisher information: mean over windows of the squared gradient of the policy's loss.

    A subclass may say of what the gradient is taken (`objective`) and how it counts (`accumulate`).

    Args:
        windows: Number of windows, drawn without replacement, that the estimate uses; 0: all.
        batch_size: Number of windows per gradient.
        augment: Whether the windows are augmented as in training.
        strength: Strength of a penalty that goes with the estimate.

    Attributes:
        training: Whether the policy is in training mode meanwhile.
    """

    training = False

    def __init__(
        self,
        *,
        windows: Natural = 512,
        batch_size: Count = 1,
        augment: bool = False,
        strength: NonNegative = 1.0,
    ):
        self.windows, self.batch_size, self.augment = windows, batch_size, augment
        self.strength = strength

    def objective(self, policy: Policy, batch: Batch, draws: torch.Generator) -> Tensor:
        """Return the scalar whose gradient is taken; `draws` is a CPU generator."""
        return policy.loss(batch)

    def accumulate(self, total: Tensor, grad: Tensor, weight: float) -> None:
        """Add the importance of a gradient, times a weight, to the total in place."""
        total.addcmul_(grad, grad, value=weight)

    def estimate(
        self,
        dataset: WindowDataset,
        policy: Policy,
        generator: torch.Generator,
        augment: Callable[[Batch, torch.Generator], Batch] | None = None,
    ) -> dict[str, Tensor]:
        """Estimate the importance of a policy's weights for a task.

        Args:
            policy: Policy with the weights after the task; its mode is restored.
            generator: Generator of the windows' order, of their augmentation, and of what the objective draws.
            augment: Augmentation of training, for estimators that augment.

        Returns:
            Parameter name -> tensor of the parameter's shape.
        """
        count = min(self.windows, len(dataset)) if self.windows else len(dataset)
        batches = torch.randperm(len(dataset), generator=generator)[:count].split(self.batch_size)
        named = {n: p for n, p in policy.named_parameters() if p.requires_grad}
        total = {n: torch.zeros_like(p, memory_format=torch.preserve_format) for n, p in named.items()}
        device = next(iter(named.values())).device
        with in_mode(policy, training=self.training):
            for indices in batches:
                batch = dataset.batch(indices)
                if self.augment and augment is not None:
                    batch = augment(batch, generator)
                objective = self.objective(policy, batch.to(device), generator)
                grads = torch.autograd.grad(objective, list(named.values()), allow_unused=True)
                for name, grad in zip(named, grads, strict=True):
                    if grad is not None:
                        self.accumulate(total[name], grad, 1 / len(batches))
        return total


class SampleFisher(ImportanceEstimator):
    """Diagonal Fisher information: mean squared gradient of single windows' losses, in evaluation mode.

    It does not depend on the batch size of training.

    Args:
        windows: Number of windows, drawn without replacement, that the estimate uses; 0: all.
        augment: Whether the windows are augmented as in training.
        strength: Strength of a penalty that goes with the estimate.
    """

    def __init__(self, *, windows: Natural = 512, augment: bool = False, strength: NonNegative = 1500.0):
        super().__init__(windows=windows, augment=augment, strength=strength)


class BatchFisher(ImportanceEstimator):
    """Mean squared gradient of batches' mean losses, in training mode: the estimate of LIBERO's code.

    Its expectation near an optimum is that of `SampleFisher` divided by the batch size, so the published strength of
    5e4 at batch size 32 corresponds to about 5e4 / 32 = 1500 per sample.

    Args:
        windows: Number of windows, drawn without replacement, that the estimate uses; 0: all.
        batch_size: Number of windows per gradient.
        augment: Whether the windows are augmented as in training.
        strength: Strength of a penalty that goes with the estimate.
    """

    training = True

    def __init__(
        self,
        *,
        windows: Natural = 512,
        batch_size: Count = 32,
        augment: bool = False,
        strength: NonNegative = 5e4,
    ):
        super().__init__(windows=windows, batch_size=batch_size, augment=augment, strength=strength)


class ActionSensitivity(ImportanceEstimator):
    """Mean absolute gradient of the actions of single windows, in evaluation mode. No labels are needed.

    `squared` is Aljundi et al. 2018, section 4.1: `|d |h(x)|^2 / d theta|`, h being the policy's deterministic actions,
    their square summed over dimensions and averaged over the window's steps. That is `2 |h . dh/dtheta|`: a weight on
    which actions near zero depend, the precise ones before a grasp, counts for nothing.

    `projected` takes the gradient of `r . h(x)` with r normal and independent, of variance 1, for every window, step
    and dimension, instead. Its mean absolute value is `sqrt(2 / pi) |dh/dtheta|` whatever the actions are: each output
    counts alike. (That a random projection's gradient has the whole Jacobian's column norms in expectation is
    Hutchinson's estimator, as in curvature from sampled outputs: Martens 2020, arXiv:1412.1193, section 9.)

    Args:
        windows: Number of windows, drawn without replacement, that the estimate uses; 0: all.
        of: What the gradient is taken of, `projected` or `squared` actions.
    """

    def __init__(self, *, windows: Natural = 512, of: Literal["projected", "squared"] = "projected"):
        super().__init__(windows=windows)
        self.of = of

    def objective(self, policy: Policy, batch: Batch, draws: torch.Generator) -> Tensor:
        """Return a random projection of the actions, or their squared length, mean over steps."""
        actions = policy.predict(batch)
        if self.of == "squared":
            return actions.square().sum(-1).mean()
        directions = to_device(torch.randn(actions.shape, generator=draws), actions.device)
        steps = actions.shape[:-1].numel()
        return (directions * actions).sum() / steps**0.5  # of variance |h|^2

    def accumulate(self, total: Tensor, grad: Tensor, weight: float) -> None:
        """Add the gradient's absolute value."""
        total.add_(grad.abs(), alpha=weight)
