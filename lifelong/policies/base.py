"""The contract of all policies.

Shape legend: B batch, T time, V views, H W C image, A action, L language embedding.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from lifelong.data.settings import Statistics
from lifelong.data.windows import WindowDataset
from lifelong.errors import PolicyError
from lifelong.types import Batch, Observation, PolicySpec, Unfinished


class Policy(nn.Module, ABC):
    """Network that is trained on windows and acts step by step.

    A subclass implements `window_losses`, `reset` and `_act`, and `predict` for algorithms that distil. What it
    computes on a window in training and what it computes when the same frames come one by one must be the same. It
    never changes a batch.

    Args:
        spec: What the policy observes and does.

    Attributes:
        by_window: Whether the first axis of what its layers are given is that of the windows.
        uses_history: Whether it needs earlier frames to act well, which it learns from windows of several steps.
        chunk: Number of actions that it predicts at once.
        execute: Number of these that are executed before it predicts again.
        inpaints: Whether a chunk can continue what is being executed, see `plan`.
        statistics: What it normalises by where `data.statistics` does not say.

    Examples:
        A policy that sees the joints only:

        >>> import torch
        >>> from lifelong.data.fake import fake_batch, fake_observation
        >>> class JointPolicy(Policy):
        ...     def __init__(self, *, spec: PolicySpec):
        ...         super().__init__(spec)
        ...         self.linear = torch.nn.Linear(spec.proprio["joint_states"], spec.action_dim)
        ...
        ...     def predict(self, batch):
        ...         return self.linear(batch.observation.proprio["joint_states"]).tanh()
        ...
        ...     def window_losses(self, batch):
        ...         return (self.predict(batch) - batch.actions).square().mean((1, 2))
        ...
        ...     def reset(self, num_envs): ...
        ...
        ...     def _act(self, observation, generators):
        ...         return self.linear(observation.proprio["joint_states"][:, 0]).tanh()
        >>> spec, draws = PolicySpec(image_size=(32, 32)), torch.Generator().manual_seed(0)
        >>> policy = JointPolicy(spec=spec)
        >>> policy.window_losses(fake_batch(spec, 4, draws)).shape
        torch.Size([4])
        >>> policy.eval().reset(num_envs=2)
        >>> policy.act(fake_observation(spec, 2, draws, steps=1)).shape
        torch.Size([2, 7])
    """

    by_window = True
    uses_history = False
    chunk: int = 1
    execute: int = 1
    inpaints: bool = False
    statistics: Statistics = "constants"

    def __init__(self, spec: PolicySpec) -> None:
        super().__init__()
        self.spec = spec

    @abstractmethod
    def window_losses(self, batch: Batch) -> Tensor:
        """Return the loss of each window, mean over its steps, (B,) float32."""

    def loss(self, batch: Batch) -> Tensor:
        """Return the mean of `window_losses`, a scalar."""
        return self.window_losses(batch).mean()

    def predict(self, batch: Batch) -> Tensor:
        """Return the mean action at every step of each window, (B, T, A) float32, with gradients.

        Distillation compares it. Nothing is random beyond dropout, and only the observations of the batch are read.

        Raises:
            PolicyError: The policy does not implement it.
        """
        raise PolicyError(
            f"{type(self).__name__} has no predict(batch), which algorithms that distil need: "
            "implement it, or choose another algorithm"
        )

    def answers(self, batch: Batch) -> dict[str, Tensor]:
        """Return what a student learns from at every step of each window, each (B, T, ...); by default `predict`."""
        return {"mean": self.predict(batch)}

    def divergence(self, batch: Batch, teacher: Mapping[str, Tensor]) -> Tensor:
        """Return how far the policy is from a teacher at every step, (B, T): zero, and least, where they agree.

        By default the squared distance of the mean actions, summed over their dimensions.

        Args:
            batch: Windows.
            teacher: The teacher's answers on them, as of `answers`.
        """
        return (self.predict(batch) - teacher["mean"]).square().sum(-1)

    def meet_task(self, dataset: WindowDataset, instruction: str) -> None:
        """Take note of a task before it is learned, such as of its text. By default nothing.

        What is noted must be in the policy's `state_dict`.

        Args:
            instruction: The instruction as text.
        """

    def normalise(self, moments: Tensor, *, once: bool) -> None:
        """Normalise by statistics of the frames that `data.statistics` names, from the coming task on.

        They must be in the policy's `state_dict`.

        Args:
            moments: Mean, standard deviation, least and largest value (4, D + A) of the readings of `spec.proprio`, in
                order, and of the actions.
            once: Whether statistics that the policy has are kept.

        Raises:
            PolicyError: The policy does not implement it.
        """
        raise PolicyError(
            f"{type(self).__name__} has no normalise(moments, once=...), which data.statistics needs: implement it, or "
            "set data.statistics=constants"
        )

    def rate_factors(self) -> Mapping[str, float]:
        """Return factors of the learning rate: beginning of parameters' names -> factor. By default none."""
        return {}

    def save_beside(self, folder: Path) -> None:
        """Write the policy in the format of another package into a folder, where it has one. By default nothing."""

    @classmethod
    def saved_arguments(cls, values: Mapping[str, Any], folder: Path) -> Mapping[str, Any]:
        """Return the values of the arguments that build the policy of a run from its folder, not from elsewhere."""
        return values

    @abstractmethod
    def reset(self, num_envs: int) -> None:
        """Forget the past; the next step is the first one of episodes in `num_envs` environments."""

    @abstractmethod
    def _act(self, observation: Observation, generators: Sequence[torch.Generator] | None) -> Tensor:
        """Return the next actions, see `act`; called without gradients, in eval mode, with a checked observation."""

    def act(self, observation: Observation, generators: Sequence[torch.Generator] | None = None) -> Tensor:
        """Return the next action of every environment and advance the history.

        Args:
            observation: Observation with T = 1 and one row for each environment of `reset`.
            generators: One CPU generator per environment for policies that sample actions, so that an action
                does not depend on which environments are stepped together. Not used otherwise.

        Returns:
            Actions (B, A) float32 in [-1, 1].

        Raises:
            PolicyError: The policy is in training mode or was not reset, or the observation has a wrong shape.
        """
        self._check(observation)
        with torch.no_grad():
            return self._act(observation, generators).float().clamp(-1.0, 1.0)

    def plan(
        self,
        observation: Observation,
        rows: Sequence[int],
        generators: Sequence[torch.Generator] | None = None,
        before: Mapping[int, Unfinished] | None = None,
    ) -> Tensor:
        """Return all actions that are predicted for some environments, and advance the history of all.

        Args:
            observation: As of `act`; it is called at every step, also where nobody asks.
            rows: Environments whose actions are asked for; only their generators are drawn from.
            generators: As of `act`.
            before: What environments still execute of their last chunk, by row, for a policy that inpaints.

        Returns:
            Actions (len(rows), H, A) float32 in [-1, 1].

        Raises:
            PolicyError: As of `act`.
        """
        self._check(observation)
        with torch.no_grad():
            return self._plan(observation, rows, generators, before).float().clamp(-1.0, 1.0)

    def _plan(
        self,
        observation: Observation,
        rows: Sequence[int],
        generators: Sequence[torch.Generator] | None,
        before: Mapping[int, Unfinished] | None,
    ) -> Tensor:
        """Return the actions of `plan`; by default one, for a policy that has planned no others."""
        return self._act(observation, generators)[list(rows), None]

    def _check(self, observation: Observation) -> None:
        if self.training:
            raise PolicyError("a policy acts in eval mode only (dropout is on); call policy.eval() first")
        expected = (1, len(self.spec.views), *self.spec.image_size, 3)
        if tuple(observation.images.shape[1:]) != expected:
            sizes = ", ".join(map(str, expected))
            raise PolicyError(
                f"images are {tuple(observation.images.shape)}; this policy acts on (B, {sizes})"
            )
        missing = [name for name in self.spec.proprio if name not in observation.proprio]
        if missing:
            raise PolicyError(f"the observation lacks {missing}; it has {sorted(observation.proprio)}")


def has_hooks(policy: nn.Module) -> bool:
    """Return whether functions are attached to layers, which neither weights nor another process have."""
    return any(module._forward_hooks or module._forward_pre_hooks for module in policy.modules())


def device_of(policy: nn.Module) -> torch.device:
    """Return the device of a policy's weights."""
    return next(policy.parameters()).device


def copy_weights(policy: nn.Module) -> dict[str, Tensor]:
    """Return a copy of all parameters and buffers by name."""
    return {name: tensor.detach().clone() for name, tensor in policy.state_dict().items()}


@contextmanager
def in_mode(policy: nn.Module, *, training: bool) -> Iterator[None]:
    """Put a policy in training or in evaluation mode within the context; its own mode is restored."""
    before = policy.training
    policy.train(training)
    try:
        yield
    finally:
        policy.train(before)
