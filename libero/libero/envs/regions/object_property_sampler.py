"""Joint positions of articulated objects at the start."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from libero_env.errors import UnknownNameError


class ObjectPropertySampler:
    """Samples a joint position from a range.

    Args:
        name: Name of the sampler in messages.
        state_type: State that the position stands for, such as `open`.
        mujoco_objects: Object with the joint.
        joint_ranges: Range (low, high), rad or m.
        rng: Generator of the position.

    Raises:
        UnknownNameError: The sampler does not have the state.
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
        self.name, self.state_type = name, state_type
        self.mujoco_objects: list[Any] = []
        self.add_objects(() if mujoco_objects is None else mujoco_objects)
        self.joint_ranges = tuple(joint_ranges)
        self.rng = np.random.default_rng() if rng is None else rng

    def add_objects(self, mujoco_objects: Any) -> None:
        """Add objects with the joint."""
        self.mujoco_objects += mujoco_objects if isinstance(mujoco_objects, Iterable) else [mujoco_objects]

    def reset(self) -> None:
        """Remove all objects."""
        self.mujoco_objects = []

    def sample(self) -> float:
        """Return a position in the range."""
        return float(self.rng.uniform(min(self.joint_ranges), max(self.joint_ranges)))


class OpenCloseSampler(ObjectPropertySampler):
    """Samples how far an object is open."""

    states = ("open", "close")


class TurnOnOffSampler(ObjectPropertySampler):
    """Samples how far a knob is turned."""

    states = ("turnon", "turnoff")
