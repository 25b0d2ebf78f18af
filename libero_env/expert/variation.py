"""What differs between two demonstrations of the same task: the motion style, and noise on the executed actions."""

from dataclasses import dataclass

import numpy as np

_MEMORY = 0.8  # autoregression coefficient of the noise: a memory of five steps
_PUSH = 0.7  # norm of a push, in units of the action


@dataclass(frozen=True)
class MotionStyle:
    """Parameters of the motion of one demonstration.

    Their ranges are small and continuous, so that the action stays nearly a function of the state.

    Attributes:
        gain: Action per full-scale position error.
        speed: Largest translation of an action.
        hover: Height of the fingertips over the object on the way in, [m].
        funnel_slope: Slope of the funnel in which the hand descends.
        grasp_shift: Shift of the grasp along the finger pads, [m].
        yaw_error: Rotation of the grasp about its approach direction, [rad].
        carry_clearance: Height of a carried object over what it passes, [m].
        place_shift: Shift of the place, (x, y), [m].
        drop_depth: Depth below the rim of a container at which an object is released, [m].
        pause: Steps of waiting before lifting, and before dropping into a container.
    """

    gain: float = 1.6
    speed: float = 1.0
    hover: float = 0.02
    funnel_slope: float = 3.0
    grasp_shift: float = 0.0
    yaw_error: float = 0.0
    carry_clearance: float = 0.02
    place_shift: tuple[float, float] = (0.0, 0.0)
    drop_depth: float = 0.01
    pause: int = 0

    @classmethod
    def sample(cls, rng: np.random.Generator) -> "MotionStyle":
        """Sample a motion style."""
        return cls(  # the order of the draws is part of what a seed means
            gain=rng.uniform(1.45, 1.75),
            speed=rng.uniform(0.9, 1.0),
            hover=rng.uniform(0.01, 0.03),
            funnel_slope=rng.uniform(2.5, 3.5),
            grasp_shift=rng.uniform(-0.004, 0.004),
            yaw_error=rng.normal(0.0, 0.02),
            carry_clearance=rng.uniform(0.015, 0.025),
            place_shift=tuple(rng.uniform(-0.01, 0.01, 2)),
            drop_depth=rng.uniform(0.0, 0.015),
            pause=int(rng.integers(0, 2)),
        )


class ActionNoise:
    """Smooth noise on the executed actions, and occasional pushes, from which the expert then recovers.

    Noise on the supervisor's actions makes it demonstrate the states that a clone will visit (Laskey et al., "DART:
    Noise injection for robust imitation learning", CoRL 2017). The gripper is never disturbed.

    Args:
        rng: Generator of the noise and the pushes.
        level: Standard deviation of the smooth noise on the translation, in units of the action; half of it on the
            rotation.
        push_rate: Pushes started per step.
    """

    def __init__(self, rng: np.random.Generator, level: float = 0.12, push_rate: float = 0.02):
        self._rng, self._level, self._push_rate = rng, level, push_rate
        self._noise, self._push, self._push_steps = np.zeros(6), np.zeros(3), 0

    def apply(self, action: np.ndarray, scale: float = 1.0) -> np.ndarray:
        """Return the action that is executed.

        Args:
            action: Action of the expert, (7,) in [-1, 1].
            scale: Factor on the noise, in [0, 1]; see `Expert.noise_scale`.

        Returns:
            Action (7,) in [-1, 1].
        """
        rng = self._rng
        deviation = self._level * np.array([1, 1, 1, 0.5, 0.5, 0.5])
        self._noise = _MEMORY * self._noise + np.sqrt(1 - _MEMORY**2) * deviation * rng.standard_normal(6)
        start, direction, length = rng.uniform(), rng.standard_normal(3), int(rng.integers(2, 5))
        if self._push_steps == 0 and start < self._push_rate:
            self._push, self._push_steps = _PUSH * direction / np.linalg.norm(direction), length
        executed = action.copy()
        executed[:6] += scale * self._noise
        if self._push_steps:
            executed[:3] += scale * self._push
            self._push_steps -= 1
        return np.clip(executed, -1.0, 1.0)
