"""Kinds that change what is executed: late, scaled and noisy actions."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from libero_env.perturbations.channels import ActionChannel, ActionFilter
from libero_env.perturbations.drawing import DrawKey, sign
from libero_env.perturbations.kind import Kind


@dataclass(frozen=True)
class ActionDelay(ActionFilter):
    """Actions are executed later; until the first arrives, the robot holds its pose.

    Attributes:
        steps: Number of control steps.
    """

    steps: int

    def open(self, key: DrawKey) -> ActionChannel:
        """Return the channel of an episode."""
        return _DelayChannel(self.steps)


class _DelayChannel(ActionChannel):
    def __init__(self, steps: int):
        self._steps, self._waiting = steps, deque[np.ndarray]()

    def act(self, action: np.ndarray, step: int) -> np.ndarray:
        self._waiting.append(action.copy())
        if len(self._waiting) <= self._steps:
            return np.zeros_like(action)
        return self._waiting.popleft()


@dataclass(frozen=True)
class ActionGain(ActionFilter):
    """The movement of the arm is scaled; the gripper is not.

    Attributes:
        factor: Factor.
    """

    factor: float

    def open(self, key: DrawKey) -> ActionChannel:
        """Return the channel of an episode."""
        return _GainChannel(self.factor)


class _GainChannel(ActionChannel):
    def __init__(self, factor: float):
        self._factor = factor

    def act(self, action: np.ndarray, step: int) -> np.ndarray:
        scaled = action.copy()
        scaled[:-1] *= self._factor
        return scaled


@dataclass(frozen=True)
class ActionNoise(ActionFilter):
    """Independent normal noise on the movement of the arm, new in each step; the gripper has none.

    Attributes:
        deviation: Standard deviation, where actions are in [-1, 1].
    """

    deviation: float

    def open(self, key: DrawKey) -> ActionChannel:
        """Return the channel of an episode."""
        return _NoiseChannel(self.deviation, key)


class _NoiseChannel(ActionChannel):
    def __init__(self, deviation: float, key: DrawKey):
        self._deviation, self._key = deviation, key

    def act(self, action: np.ndarray, step: int) -> np.ndarray:
        noisy = action.copy()
        noisy[:-1] += self._deviation * self._key.generator(step).standard_normal(len(action) - 1)
        return noisy


KINDS = (
    Kind(
        "delay",
        "action",
        "control steps",
        4,
        "actions are executed this many steps of 50 ms later",
        lambda steps, rng: ActionDelay(int(steps)),
        scale="count",
        physical=True,
        is_drawn=False,
    ),
    Kind(
        "gain",
        "action",
        "ratio",
        2.0,
        "movements of the arm are larger or smaller by this factor",
        lambda ratio, rng: ActionGain(ratio ** sign(rng)),
        scale="ratio",
        physical=True,
    ),
    Kind(
        "action_noise",
        "action",
        "of the action's range",
        0.5,
        "normal noise on the arm's actions, with this standard deviation where actions are in [-1, 1]",
        lambda deviation, rng: ActionNoise(deviation),
        physical=True,
    ),
)
