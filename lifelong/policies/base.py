"""The contract every policy keeps.

Shape legend: B batch, T time, V views, H W C image, A action, L language embedding.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from lifelong.errors import PolicyError
from lifelong.types import Batch, Observation, PolicySpec


class Policy(nn.Module, ABC):
    """A network that is trained on windows and acts step by step.

    A subclass gives `window_losses`, `reset` and `_act`, and `predict` for algorithms that distil. What it computes
    on a window in training and what it computes when the same frames come one by one must be the same. It never
    changes a batch.
    """

    def __init__(self, spec: PolicySpec) -> None:
        super().__init__()
        self.spec = spec

    @abstractmethod
    def window_losses(self, batch: Batch) -> Tensor:
        """Loss of each window, mean over its steps, (B,) float32."""

    def loss(self, batch: Batch) -> Tensor:
        """Mean of `window_losses`, a scalar."""
        return self.window_losses(batch).mean()

    def predict(self, batch: Batch) -> Tensor:
        """The policy's own answer at every step of each window, (B, T, A) float32, with gradients.

        The mean of its action distribution: what distillation compares, and nothing random beyond dropout. Only the
        observations of the batch are read.

        Raises:
            PolicyError: the policy does not give it.
        """
        raise PolicyError(
            f"{type(self).__name__} has no predict(batch), which algorithms that distil need: "
            "give it one, or choose another algorithm"
        )

    @abstractmethod
    def reset(self, num_envs: int) -> None:
        """Forgets the past and makes ready for the first step of episodes in `num_envs` environments."""

    @abstractmethod
    def _act(self, observation: Observation, generators: Sequence[torch.Generator] | None) -> Tensor:
        """See `act`; called without gradients, in eval mode, with a checked observation."""

    def act(self, observation: Observation, generators: Sequence[torch.Generator] | None = None) -> Tensor:
        """The next action of every environment; advances the history.

        Args:
            observation: T = 1, one row per environment that `reset` announced.
            generators: one CPU generator per environment for policies that act at random, so that an action
                does not depend on which environments are stepped together. Not used otherwise.

        Returns:
            (B, A) float32 in [-1, 1].

        Raises:
            PolicyError: in training mode, before `reset`, or with an observation of the wrong shape.
        """
        if self.training:
            raise PolicyError("a policy acts in eval mode only (dropout is on); call policy.eval() first")
        self._check(observation)
        with torch.no_grad():
            return self._act(observation, generators).float().clamp(-1.0, 1.0)

    def _check(self, observation: Observation) -> None:
        expected = (1, len(self.spec.views), *self.spec.image_size, 3)
        if tuple(observation.images.shape[1:]) != expected:
            sizes = ", ".join(map(str, expected))
            raise PolicyError(
                f"images are {tuple(observation.images.shape)}; this policy acts on (B, {sizes})"
            )
        missing = [name for name in self.spec.proprio if name not in observation.proprio]
        if missing:
            raise PolicyError(f"the observation lacks {missing}; it has {sorted(observation.proprio)}")
