"""The interface of skills, and what they have in common."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from libero_env.expert.arm.servo import OPEN, action_toward
from libero_env.expert.variation import MotionStyle
from libero_env.sim.state import StateView
from libero_env.timing import CONTROL_HZ

_STILL_HAND = 0.04  # [m/s] below which the hand hardly moves
_STOPPED_FINGERS = 4e-4  # [m] of finger motion in one step, below which the fingers have stopped


class Skill(ABC):
    """Base class of skills, which act until an atom of the goal holds.

    A skill moves through phases; a method of the same name gives the action of each. It plans when it begins, and
    begins again after a slip.

    Args:
        style: Motion style.

    Attributes:
        phase: Name of the phase, such as `reach`.
        retries: Number of times that the skill began again.
        failure_reason: Why the skill cannot continue, or "".
    """

    NOISE_SCALES: ClassVar[Mapping[str, float]] = {}  # phase -> noise scale; 0 without

    def __init__(self, style: MotionStyle):
        self.style = style
        self.phase, self.retries, self.failure_reason = "reach", 0, ""
        self._steps = 0  # since the phase began
        self._velocity = np.zeros(3)  # [m/s] of the grip site
        self._previous_pos: np.ndarray | None = None  # of the grip site one step ago, (3,)
        self._opening = 0.0  # [m] between the fingers one step ago

    @property
    def noise_scale(self) -> float:
        """Factor on the action noise that the phase tolerates, in [0, 1]."""
        return self.NOISE_SCALES.get(self.phase, 0.0)

    @abstractmethod
    def done(self, view: StateView) -> bool:
        """Return whether the atom holds and the hand is free for the next skill."""

    def act(self, view: StateView) -> np.ndarray:
        """Return the next action, (7,) in [-1, 1]."""
        pos = view.eef_pos
        self._velocity = (pos - (pos if self._previous_pos is None else self._previous_pos)) * CONTROL_HZ
        self._previous_pos = pos
        self._steps += 1
        return self._next_action(view)

    def fallback(self) -> "Skill | None":
        """Return the skill that takes over from one that failed; None where there is none, or no failure."""
        return None

    def _next_action(self, view: StateView) -> np.ndarray:
        """Return the next action; velocity and steps are up to date."""
        return self._run_phase(view)

    def _enter(self, phase: str) -> None:
        """Begin a phase."""
        self.phase, self._steps = phase, 0

    def _run_phase(self, view: StateView) -> np.ndarray:
        """Return the action of the phase."""
        return getattr(self, f"_{self.phase}")(view)

    def _start(self, phase: str, view: StateView) -> np.ndarray:
        """Begin a phase and return its first action."""
        self._enter(phase)
        return self._run_phase(view)

    def _rest(self, view: StateView) -> np.ndarray:
        """Return the action that keeps the hand in its place with open fingers."""
        return np.array([0.0] * 6 + [OPEN])

    def _rise(self) -> np.ndarray:
        """Return the action that lifts the open hand."""
        return np.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0, OPEN])

    def _is_still(self) -> bool:
        """Return whether the hand hardly moves."""
        return bool(np.linalg.norm(self._velocity) < _STILL_HAND)

    def _fingers_stopped(self, view: StateView, max_steps: int = 15) -> bool:
        """Return whether closing fingers have stopped, or have had the given number of steps."""
        opening = gripper_opening(view)
        stopped = abs(opening - self._opening) < _STOPPED_FINGERS
        self._opening = opening
        return self._steps > 4 + self.style.pause and stopped or self._steps > max_steps

    def _toward(
        self,
        view: StateView,
        pos: np.ndarray,
        mat: np.ndarray,
        gripper: float,
        lateral_scale: float = 1.0,
        speed_scale: float = 1.0,
    ) -> np.ndarray:
        """Return the action towards a pose of the grip site, in this motion style.

        Args:
            view: State of the simulation.
            pos: Target position of the grip site, (3,).
            mat: Target orientation of the grip site, (3, 3).
            gripper: Seventh entry of the action.
            lateral_scale: Factor on the horizontal part, in [0, 1].
            speed_scale: Factor on the largest translation, in [0, 1].
        """
        return action_toward(
            view.eef_pos,
            view.eef_mat,
            pos,
            mat,
            velocity=self._velocity,
            gripper=gripper,
            gain=self.style.gain,
            speed=speed_scale * self.style.speed,
            lateral_scale=lateral_scale,
        )


def gripper_opening(view: StateView) -> float:
    """Return the distance between the fingers, [m]."""
    return float(np.abs(view.finger_pos).sum())
