"""What acts in a rollout: a policy of this package, or any object that answers observations with actions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from lifelong.errors import PolicyError
from lifelong.policies.base import Policy
from lifelong.training.precision import autocast
from lifelong.types import Observation, PolicySpec

Obs = Mapping[str, np.ndarray]  # name -> (B, ...)
ACTION_DIM = 7


class Actor(Protocol):
    """Answers the observations of many simulations at once."""

    @property
    def action_dim(self) -> int:
        """A."""

    @property
    def views(self) -> tuple[str, ...]:
        """Entries of the observation that a recorded rollout shows."""

    def reset(self, num_envs: int) -> None:
        """Forget the past; the next observation is the first of new episodes."""

    def act(self, obs: Obs) -> np.ndarray:
        """Actions (B, A) float64."""


@dataclass
class PolicyActor:
    """A policy of this package, told one instruction.

    Attributes:
        policy: In evaluation mode.
        language: (L,) embedding of the instruction.
        device: Where the policy is.
        precision: See `lifelong.training.settings.FitSettings`.
        draws: A CPU generator per simulation, for policies that act at random.
    """

    policy: Policy
    language: Tensor
    device: torch.device
    precision: str
    draws: Sequence[torch.Generator]

    @property
    def action_dim(self) -> int:
        """A."""
        return self.policy.spec.action_dim

    @property
    def views(self) -> tuple[str, ...]:
        """The cameras it looks through."""
        return self.policy.spec.views

    def reset(self, num_envs: int) -> None:
        """See `Actor`."""
        self.policy.reset(num_envs)

    def act(self, obs: Obs) -> np.ndarray:
        """See `Actor`."""
        observation = observe(obs, self.policy.spec, self.language, self.device)
        with autocast(self.device, self.precision):
            return self.policy.act(observation, self.draws).cpu().numpy().astype(np.float64)


ORIGINAL_NAMES = {
    "agentview_rgb": "agentview_image",
    "eye_in_hand_rgb": "robot0_eye_in_hand_image",
    "joint_states": "robot0_joint_pos",
    "joint_velocities": "robot0_joint_vel",
    "gripper_states": "robot0_gripper_qpos",
    "gripper_velocities": "robot0_gripper_qvel",
    "ee_pos": "robot0_eef_pos",
    "ee_quat": "robot0_eef_quat",
}


def as_original(obs: Obs) -> dict[str, np.ndarray]:
    """Observations under the names of LIBERO's own environments: pictures bottom up, quaternions xyzw."""
    found = {}
    for name, value in obs.items():
        if name.endswith("_rgb"):
            value = value[:, ::-1]
        elif name == "ee_quat":
            value = np.roll(value, -1, axis=-1)
        found[ORIGINAL_NAMES.get(name, name)] = value
    return found


@dataclass
class CallableActor:
    """An object of somebody else's with `predict(observations) -> actions`.

    `predict` is given what `libero_env.envs.batch.BatchEnv` observes, (B, ...) arrays by name, with upright pictures,
    and under "instruction" the text. Rows of episodes that are over stay in it; what is answered for them is not
    used. It returns (B, 7) actions; the gripper opens at -1 and closes at +1. An optional
    `reset(instruction, num_envs)` is called before each task's episodes.

    Attributes:
        policy: The object.
        instruction: What it is told.
        views: Entries of the observation that a recorded rollout shows.
        original: Give observations as LIBERO's own environments do, see `as_original`.
    """

    policy: Any
    instruction: str
    views: tuple[str, ...]
    original: bool = False
    action_dim: int = ACTION_DIM

    def reset(self, num_envs: int) -> None:
        """See `Actor`."""
        if hasattr(self.policy, "reset"):
            self.policy.reset(self.instruction, num_envs)

    def act(self, obs: Obs) -> np.ndarray:
        """See `Actor`.

        Raises:
            PolicyError: The answer has another shape, or is not finite.
        """
        seen = as_original(obs) if self.original else obs
        answer = self.policy.predict({**seen, "instruction": self.instruction})
        actions = np.asarray(answer.detach().cpu() if isinstance(answer, Tensor) else answer, np.float64)
        wanted = (len(next(iter(obs.values()))), self.action_dim)
        name = f"{type(self.policy).__name__}.predict"
        if actions.shape != wanted:
            raise PolicyError(f"{name} returned actions of shape {actions.shape}; expected {wanted}")
        if not np.isfinite(actions).all():
            raise PolicyError(f"{name} returned actions that are not finite")
        return actions


def observe(obs: Obs, spec: PolicySpec, language: Tensor, device: torch.device) -> Observation:
    """What the simulations show, as a policy takes it: T = 1.

    Args:
        obs: (B, ...) arrays by name.
        spec: What the policy sees.
        language: (L,) embedding of the instruction.
        device: Where the policy is.
    """
    images = np.stack([obs[view] for view in spec.views], axis=1)[:, None]  # (B, 1, V, H, W, C)
    proprio = {
        name: torch.from_numpy(np.asarray(obs[name], np.float32))[:, None].to(device) for name in spec.proprio
    }
    told = language.to(device).expand(len(images), -1)
    return Observation(torch.from_numpy(images).to(device), proprio, told)
