"""What differs between two demonstrations of the same task: the manner, and the disturbances to recover from."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class MotionStyle:
    """The manner of one demonstration. Small and continuous on purpose: what to do stays a function of the state."""

    gain: float = 1.6  # action per full-scale error
    speed: float = 1.0  # largest action
    hover: float = 0.02  # m, of the fingertips over the body on the way in
    slope: float = 3.0  # of the funnel that the approach descends in
    grasp_along: float = 0.0  # m, shift of the grasp along the jaws, where the body is long enough
    yaw: float = 0.0  # rad, error of the grasp's yaw
    margin: float = 0.02  # m, between what is carried and what it is carried over
    place_xy: tuple[float, float] = (0.0, 0.0)  # m, shift of the place
    depth: float = 0.01  # m, how far below the rim the body is let go
    pause: int = 0  # steps of waiting before lifting and before letting go

    @classmethod
    def sample(cls, rng: np.random.Generator) -> "MotionStyle":
        """A manner at random."""
        return cls(
            gain=rng.uniform(1.45, 1.75),
            speed=rng.uniform(0.9, 1.0),
            hover=rng.uniform(0.01, 0.03),
            slope=rng.uniform(2.5, 3.5),
            grasp_along=rng.uniform(-0.004, 0.004),
            yaw=rng.normal(0.0, 0.02),
            margin=rng.uniform(0.015, 0.025),
            place_xy=tuple(rng.uniform(-0.01, 0.01, 2)),
            depth=rng.uniform(0.0, 0.015),
            pause=int(rng.integers(0, 2)),
        )


class ActionNoise:
    """Smooth noise on the executed action, and now and then a push; the expert then shows how to recover.

    Injecting noise into the supervisor keeps a clone on the states that it will visit (Laskey et al., "DART: Noise
    injection for robust imitation learning", CoRL 2017). The gripper is never disturbed.

    Args:
        rng: draws everything.
        level: standard deviation of the smooth noise on the translation, in units of the action; rotation gets half.
        push_rate: pushes started per step.
    """

    def __init__(self, rng: np.random.Generator, level: float = 0.12, push_rate: float = 0.02):
        self._rng, self._level, self._push_rate = rng, level, push_rate
        self._noise, self._push, self._left = np.zeros(6), np.zeros(3), 0

    def apply(self, action: np.ndarray, strength: float = 1.0) -> np.ndarray:
        """The action (7,) as it is executed; `strength` in [0, 1] says how much disturbance the moment bears."""
        rng, keep = self._rng, 0.8  # an autoregression with a memory of five steps
        scale = self._level * np.array([1, 1, 1, 0.5, 0.5, 0.5])
        self._noise = keep * self._noise + np.sqrt(1 - keep**2) * scale * rng.standard_normal(6)
        start, direction, length = rng.uniform(), rng.standard_normal(3), int(rng.integers(2, 5))
        if self._left == 0 and start < self._push_rate:
            self._push, self._left = 0.7 * direction / np.linalg.norm(direction), length
        total = action.copy()
        total[:6] += strength * self._noise
        if self._left:
            total[:3] += strength * self._push
            self._left -= 1
        return np.clip(total, -1.0, 1.0)
