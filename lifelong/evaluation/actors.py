"""Actors of rollouts: what answers observations with actions, such as a policy of this package."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np

if TYPE_CHECKING:  # judging needs no PyTorch
    import torch
    from torch import Tensor

    from libero_env.envs.batch import BatchEnv
    from libero_env.tasks import Task
    from lifelong.policies.base import Policy
    from lifelong.types import Observation, PolicySpec

Obs = Mapping[str, np.ndarray]  # name -> (B, ...)


class Actor(Protocol):
    """Answers the observations of many simulations at once."""

    @property
    def action_dim(self) -> int:
        """Dimension A of actions."""

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the observed images that recorded rollouts show."""

    def reset(self, num_envs: int) -> None:
        """Reset the history; the next observation is the first of new episodes."""

    def act(self, obs: Obs) -> np.ndarray:
        """Return (B, A) float64 actions for the observations."""


@runtime_checkable
class TakesNote(Protocol):
    """An actor that is told, before each `act` and at the end, which episodes are over."""

    def note(self, over: np.ndarray, success: np.ndarray) -> None:
        """Take note of which episodes are over, (B,) bool, and which have succeeded, (B,) bool."""


@runtime_checkable
class WatchesWorld(Protocol):
    """An actor that sees the whole state, as no policy does; it is given the simulations before the episodes."""

    def watch(self, env: BatchEnv) -> None:
        """Receive the simulations of the next episodes."""


@runtime_checkable
class Hears(Protocol):
    """An actor that is told, before `act`, of events after which something else is to be done."""

    def hear(self, i: int, task: Task) -> None:
        """Take note that an event has moved simulation i, and of the task that it has from now on."""


@dataclass
class PolicyActor:
    """A policy of this package with one instruction.

    Attributes:
        policy: Policy in evaluation mode.
        language: (L,) embedding of the instruction; (B, L) once some of the simulations have another one.
        precision: Precision of the policy, see `lifelong.training.settings.FitSettings`.
        draws: CPU generator of each simulation, for stochastic policies.
        embed: Function that returns the embedding of another task's instruction; None where there is no other task.
    """

    policy: Policy
    language: Tensor
    device: torch.device
    precision: str
    draws: Sequence[torch.Generator]
    embed: Callable[[Task], Tensor] | None = None
    observes = "always"

    @property
    def action_dim(self) -> int:
        """Dimension A of actions."""
        return self.policy.spec.action_dim

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the images the policy observes."""
        return self.policy.spec.views

    def reset(self, num_envs: int) -> None:
        """Reset the history; see `Actor`."""
        self.policy.reset(num_envs)

    def hear(self, i: int, task: Task) -> None:
        """Act by the instruction of a task in simulation i from now on; see `Hears`."""
        assert self.embed is not None, "evaluations with events give it"
        rows = self.language.expand(len(self.draws), -1).clone()
        rows[i] = self.embed(task)
        if not rows.equal(self.language.expand_as(rows)):
            self.language = rows

    @property
    def replan(self) -> int:
        """Number of actions of a chunk that the policy executes."""
        return self.policy.execute

    def act(self, obs: Obs) -> np.ndarray:
        """Return (B, A) float64 actions; see `Actor`."""
        return self._compute(obs, lambda seen: self.policy.act(seen, self.draws))

    def plan(
        self, obs: Obs, rows: Sequence[int], before: Mapping[int, tuple[np.ndarray, int]] | None = None
    ) -> np.ndarray:
        """Return chunks (len(rows), H, A) float64 of some simulations, and take note of what all observe.

        Args:
            rows: The simulations.
            before: What of the last chunk is left, and how many of these actions are probably executed until the next
                one is there, by simulation, for a policy that inpaints.
        """
        import torch

        from lifelong.types import Unfinished

        unfinished: dict[int, Unfinished] | None = None
        if before is not None:
            unfinished = {i: Unfinished(torch.from_numpy(left), delay) for i, (left, delay) in before.items()}
        return self._compute(obs, lambda seen: self.policy.plan(seen, rows, self.draws, unfinished))

    def _compute(self, obs: Obs, answer: Callable[[Observation], Tensor]) -> np.ndarray:
        """Return what the policy answers to an observation, float64, in its precision."""
        from lifelong.training.precision import autocast, float32_products

        seen = observe(obs, self.policy.spec, self.language, self.device)
        with autocast(self.device, self.precision), float32_products(self.precision):
            return answer(seen).cpu().numpy().astype(np.float64)


def observe(obs: Obs, spec: PolicySpec, language: Tensor, device: torch.device) -> Observation:
    """Convert observations of the simulations to a policy's input with T = 1.

    Args:
        obs: (B, ...) arrays by name.
        spec: Inputs of the policy.
        language: (L,) embedding of the instruction, or (B, L).
    """
    import torch

    from lifelong.types import Observation

    images = np.stack([obs[view] for view in spec.views], axis=1)[:, None]  # (B, 1, V, H, W, C)
    proprio = {name: torch.from_numpy(np.asarray(obs[name], np.float32))[:, None] for name in spec.proprio}
    languages = language.expand(len(images), -1)
    return Observation(torch.from_numpy(images), proprio, languages).to(device)
