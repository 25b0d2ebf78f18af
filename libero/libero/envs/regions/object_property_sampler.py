"""Joint positions of articulated objects at the start."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from libero_env.errors import UnknownNameError


class ObjectPropertySampler:
    """Draws one number from a range.

    Args:
        name: what messages call it.
        state_type: what the number stands for.
        mujoco_objects: the object it is for.
        joint_ranges: (low, high), rad or m.
        rng: draws the number.
    """

    states: Sequence[str] = ()

    def __init__(
        self,
        name: str,
        state_type: str,
        mujoco_objects: Any = None,
        joint_ranges: Sequence[float] = (0.0, 0.0),
        rng: np.random.Generator | None = None,
    ):
        if self.states and state_type not in self.states:
            raise UnknownNameError(f"state of {name}", state_type, self.states)
        self.name, self.state_type, self.mujoco_objects = name, state_type, mujoco_objects
        self.joint_ranges = tuple(joint_ranges)
        self.rng = np.random.default_rng() if rng is None else rng

    def sample(self) -> float:
        """A number of the range."""
        return float(self.rng.uniform(min(self.joint_ranges), max(self.joint_ranges)))


class OpenCloseSampler(ObjectPropertySampler):
    """How far a thing is open."""

    states = ("open", "close")


class TurnOnOffSampler(ObjectPropertySampler):
    """How far a knob is turned."""

    states = ("turnon", "turnoff")
