"""The interface of skills, and what they have in common: the funnel of an approach, backing off from an obstacle."""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from libero_env.expert.arm import OPEN, action_toward
from libero_env.expert.variation import MotionStyle
from libero_env.sim.predicates import evaluate
from libero_env.sim.state import StateView
from libero_env.tasks.expression import Atom
from libero_env.timing import CONTROL_HZ

_STILL_HAND = 0.04  # [m/s] below which the hand hardly moves
_STOPPED_FINGERS = 4e-4  # [m] of finger motion in one step, below which the fingers have stopped


class Skill:
    """Base class of skills, which act until an atom of the goal holds.

    A skill moves through phases; a method of the same name gives the action of each. It plans when it begins, and
    begins again after a slip, at most `MAX_RETRIES` times.

    Args:
        atom: Atom to make true.

    Attributes:
        phase: Name of the phase, such as `reach`.
        retries: Number of times that the skill began again.
        failure_reason: Why the skill cannot continue, or "".
    """

    NOISE_SCALES: ClassVar[Mapping[str, float]] = {}  # phase -> noise scale; 0 without
    MAX_RETRIES: ClassVar[int] = 5

    def __init__(self, atom: Atom, style: MotionStyle):
        self.atom, self.style = atom, style
        self._plan: Any = None  # what the phases follow; None where it is to be made
        self.phase, self.retries, self.failure_reason = "reach", 0, ""
        self._steps = 0  # since the phase began
        self._velocity = np.zeros(3)  # [m/s] of the grip site
        self._previous_pos: np.ndarray | None = None  # of the grip site one step ago, (3,)
        self._opening = 0.0  # [m] between the fingers one step ago

    @property
    def noise_scale(self) -> float:
        """Factor on the action noise that the phase tolerates, in [0, 1]."""
        return self.NOISE_SCALES.get(self.phase, 0.0)

    def done(self, view: StateView) -> bool:
        """Return whether the atom holds and the hand is free for the next skill."""
        return self.phase in ("reach", "rest") and evaluate(self.atom, view)

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

    def _retry(self) -> None:
        """Begin again with another plan."""
        self.retries += 1
        self._plan = None
        if self.retries > self.MAX_RETRIES:
            self.failure_reason = f"{self.atom} not reached in {self.retries} attempts"
        self._enter("reach")

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
            pos: Target position of the grip site, (3,).
            mat: Target orientation of the grip site, (3, 3).
            gripper: Seventh entry of the action.
            lateral_scale: Factor on the horizontal part, in [0, 1].
            speed_scale: Factor on the largest translation, in [0, 1].
        """
        pos, lateral_scale = self._steadied(view, pos, lateral_scale)
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

    def _steadied(self, view: StateView, pos: np.ndarray, lateral: float) -> tuple[np.ndarray, float]:
        """Return position and lateral scale for `_toward`, changed where a skill needs it."""
        return pos, lateral


def gripper_opening(view: StateView) -> float:
    """Return the distance between the fingers, [m]."""
    return float(np.abs(view.finger_pos).sum())


class BackOff:
    """Detection of a finger that stands on something; the hand then goes back until it is clear.

    Attributes:
        active: Whether the hand goes back.
        count: Number of times that the hand went back.
    """

    def __init__(self) -> None:
        self.active, self.count, self._standing_steps = False, 0, 0

    def update(self, *, standing: bool, clear: bool) -> None:
        """Go back after three steps of standing, until the hand is clear.

        Args:
            standing: Whether the hand is further away than intended, and hardly moves.
            clear: Whether the fingers are clear of the object and the hand is over its target.
        """
        self._standing_steps = self._standing_steps + 1 if standing else 0
        if self._standing_steps >= 3 and not self.active:
            self.active, self.count = True, self.count + 1
        if clear:
            self.active = False

    def stop(self) -> None:
        """Stop going back; the count stays."""
        self.active, self._standing_steps = False, 0


def funnel_lift(slope: float, distance: float, angle: float, largest: float) -> float:
    """Return how far a hand stays back from its target, so that it approaches within a funnel, [m].

    Args:
        distance: Lateral distance from the target beyond the tolerance, [m].
        angle: Angle from the target orientation beyond the tolerance, [rad].
        largest: Height of the funnel, [m].
    """
    return float(np.clip(slope * distance + 0.3 * max(angle, 0.0), 0.0, largest))
