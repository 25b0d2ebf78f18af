"""Actors of rollouts: a policy of this package, or any object that answers observations with actions."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from libero_env.errors import code_of
from lifelong.errors import MissingObservationError, PolicyError
from lifelong.evaluation.inputs import Adapter, Obs, PolicyInput
from lifelong.policies.base import Policy
from lifelong.training.precision import autocast
from lifelong.types import Observation, PolicySpec

if TYPE_CHECKING:
    from libero_env.envs.batch import BatchEnv

ACTION_DIM = 7


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

    def watch(self, env: "BatchEnv") -> None:
        """Receive the simulations of the next episodes."""


@dataclass
class PolicyActor:
    """A policy of this package with one instruction.

    Attributes:
        policy: Policy in evaluation mode.
        language: (L,) embedding of the instruction.
        device: Device of the policy.
        precision: Precision of the policy, see `lifelong.training.settings.FitSettings`.
        draws: CPU generator of each simulation, for stochastic policies.
    """

    policy: Policy
    language: Tensor
    device: torch.device
    precision: str
    draws: Sequence[torch.Generator]

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

    def act(self, obs: Obs) -> np.ndarray:
        """Return (B, A) float64 actions; see `Actor`."""
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
    """Return observations as LIBERO's own environments name them, with flipped images and xyzw quaternions."""
    found = {}
    for name, value in obs.items():
        if name.endswith("_rgb"):
            value = value[:, ::-1]
        elif name == "ee_quat":
            value = np.roll(value, -1, axis=-1)
        found[ORIGINAL_NAMES.get(name, name)] = value
    return found


class Observations(dict[str, Any]):
    """Observations by name; a name that is not among them is an error that says which there are."""

    def __missing__(self, name: str) -> Any:
        hint = "protocols with the original's names have no others; --names native gives this package's"
        if name in ORIGINAL_NAMES.values():
            hint = "--names original gives the original's names"
        raise MissingObservationError(f"there is no observation {name!r}, but {', '.join(self)}; {hint}")


@dataclass
class CallableActor:
    """A user-defined object with `predict(observations) -> actions`.

    `predict` receives the observations of `libero_env.envs.batch.BatchEnv`, (B, ...) arrays by name, with upright
    images, and the instruction as text under "instruction". Finished episodes keep their rows; actions for them are
    ignored. It returns (B, 7) actions; the gripper opens at -1 and closes at +1. An optional
    `reset(instruction, num_envs)` is called before each task's episodes.

    Attributes:
        policy: The object.
        instruction: Instruction that the object receives.
        views: Names of the observed images that recorded rollouts show.
        original: Whether observations are those of LIBERO's own environments, see `as_original`.
        action_dim: Dimension A of actions.
    """

    policy: Any
    instruction: str
    views: tuple[str, ...]
    original: bool = False
    action_dim: int = ACTION_DIM

    def reset(self, num_envs: int) -> None:
        """Call the object's `reset`, if it has one; see `Actor`."""
        if hasattr(self.policy, "reset"):
            with code_of(f"the policy's {_name(self.policy, 'reset')}"):
                self.policy.reset(self.instruction, num_envs)

    def act(self, obs: Obs) -> np.ndarray:
        """Return the object's actions; see `Actor`.

        Raises:
            PolicyError: The actions have the wrong shape, or are not finite.
        """
        given = as_original(obs) if self.original else obs
        name = _name(self.policy, "predict")
        with code_of(f"the policy's {name}"):
            answer = self.policy.predict(Observations(given, instruction=self.instruction))
        actions = _as_array(answer, name)
        expected = (len(next(iter(obs.values()))), self.action_dim)
        if actions.shape != expected:
            raise PolicyError(f"{name} returned actions of shape {actions.shape}; expected {expected}")
        if not np.isfinite(actions).all():
            raise PolicyError(f"{name} returned actions that are not finite")
        return actions


@dataclass
class ProtocolActor:
    """A user-defined object that is given a protocol's inputs, and answers in the protocol's convention.

    Its `predict` receives for the running simulations that need actions: an array (B, H, W, 3) by name of each camera,
    `state` (B, 8), and `instruction`. It returns (B, 7) actions, or chunks (B, H, 7), of which the protocol executes as
    many as it says before it asks again.

    Attributes:
        policy: The object.
        adapter: Conversion of observations and actions under the protocol.
        replan: Number of actions of a chunk that are executed; None for all.
        views: Names of the observed images that recorded rollouts show.
        action_dim: Dimension A of actions.
    """

    policy: Any
    adapter: Adapter
    replan: int | None
    views: tuple[str, ...]
    action_dim: int = ACTION_DIM

    def reset(self, num_envs: int) -> None:
        """Forget what was predicted, and call the object's `reset`, if it has one; see `Actor`."""
        self._waiting: list[np.ndarray] = []
        self._num_envs = num_envs
        self._reset_policy = True

    def act(self, obs: Obs) -> np.ndarray:
        """Return the object's actions; see `Actor`.

        Raises:
            PolicyError: The actions have the wrong shape, are too few, or are not finite.
        """
        if not self._waiting:
            inputs = self.adapter.inputs(obs)
            if self._reset_policy and hasattr(self.policy, "reset"):
                with code_of(f"the policy's {_name(self.policy, 'reset')}"):
                    self.policy.reset(inputs[0].prompt, self._num_envs)
            self._reset_policy = False
            self._waiting = self._predict(inputs)
        return self._waiting.pop(0)

    @property
    def sees_next(self) -> bool:
        """Whether the next observation is given to the object."""
        return not self._waiting

    def _predict(self, inputs: Sequence[PolicyInput]) -> list[np.ndarray]:
        """Return the actions (B, A) of the next steps."""
        images = {name: np.stack([one.images[name] for one in inputs]) for name in inputs[0].images}
        given = Observations(
            images, state=np.stack([one.state for one in inputs]), instruction=inputs[0].prompt
        )
        name = _name(self.policy, "predict")
        with code_of(f"the policy's {name}"):
            answer = self.policy.predict(given)
        found = _as_array(answer, name)
        chunks = found[:, None] if found.ndim == 2 else found
        if chunks.ndim != 3 or chunks.shape[::2] != (len(inputs), self.action_dim):
            raise PolicyError(
                f"{name} returned actions of shape {found.shape}; expected ({len(inputs)}, {self.action_dim}), or "
                f"chunks ({len(inputs)}, H, {self.action_dim})"
            )
        count = chunks.shape[1] if self.replan is None or found.ndim == 2 else self.replan
        if chunks.shape[1] < count:
            raise PolicyError(
                f"{name} returned {chunks.shape[1]} actions; the protocol executes {count} of them"
            )
        return list(self.adapter.actions(chunks[:, :count]).swapaxes(0, 1))


def _name(policy: Any, method: str) -> str:
    return f"{type(policy).__name__}.{method}"


def _as_array(answer: Any, name: str) -> np.ndarray:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", np.exceptions.ComplexWarning)
            return np.asarray(answer.detach().cpu() if isinstance(answer, Tensor) else answer, np.float64)
    except (TypeError, ValueError, np.exceptions.ComplexWarning) as error:
        raise PolicyError(
            f"{name} returned a {type(answer).__name__} that is no array of numbers ({error})"
        ) from None


def observe(obs: Obs, spec: PolicySpec, language: Tensor, device: torch.device) -> Observation:
    """Convert observations of the simulations to a policy's input with T = 1.

    Args:
        obs: (B, ...) arrays by name.
        spec: Inputs of the policy.
        language: (L,) embedding of the instruction.
        device: Device of the policy.
    """
    images = np.stack([obs[view] for view in spec.views], axis=1)[:, None]  # (B, 1, V, H, W, C)
    proprio = {
        name: torch.from_numpy(np.asarray(obs[name], np.float32))[:, None].to(device) for name in spec.proprio
    }
    languages = language.to(device).expand(len(images), -1)
    return Observation(torch.from_numpy(images).to(device), proprio, languages)
