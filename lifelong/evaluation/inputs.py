"""What a policy is given under a protocol, and what its answers mean: the interface between protocols and actors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

Obs = Mapping[str, np.ndarray]  # name -> (B, ...)


@dataclass(frozen=True)
class PolicyInput:
    """Observation of one simulation, as a protocol defines it.

    Attributes:
        images: Image of each camera by the original's name, `agentview` or `robot0_eye_in_hand`: (H, W, 3) uint8, after
            the protocol's turning, resizing and cropping.
        state: Proprioception in the protocol's order, rotation convention and dtype, (8,) in most protocols.
        prompt: Instruction, after the protocol's template.
        extra: Further vectors that a protocol sends by name, such as vla-eval's `controller_states`.
    """

    images: Mapping[str, np.ndarray]
    state: np.ndarray
    prompt: str
    extra: Mapping[str, np.ndarray] = field(default_factory=dict)


class Adapter(Protocol):
    """Converts observations of simulations to a protocol's inputs, and predicted actions to the simulations' own.

    An adapter belongs to one task and keeps no state, so that episodes do not depend on each other.
    """

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras that the simulations render, in the protocol's order."""

    @property
    def observations(self) -> tuple[str, ...]:
        """Names of the observations that `inputs` reads, arguments of `libero_env.envs.config.EnvConfig`."""

    def inputs(self, obs: Obs, rows: Sequence[int] | None = None) -> list[PolicyInput]:
        """Return the inputs of some simulations.

        Args:
            obs: (B, ...) arrays by name, as of `libero_env.envs.batch.BatchEnv` with `cameras` and `observations`.
            rows: Indices of the simulations; by default all.
        """

    def actions(self, predicted: np.ndarray) -> np.ndarray:
        """Return the simulations' actions for predicted ones.

        Args:
            predicted: (..., 7) actions of a policy in the protocol's convention.

        Returns:
            (..., 7) float64 actions; the gripper opens at -1 and closes at +1.

        Raises:
            PolicyError: The last dimension is not 7, or a value is not finite.
        """
