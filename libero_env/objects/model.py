"""What the catalog hands to the scene builder: one object as a model of its own."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np

from libero_env.geometry import quat_from_axis_angle

ROOT_BODY = "main"
GLOW_GROUP = 2  # group of the sites that are seen only while their object is turned on


@dataclass(frozen=True)
class ObjectModel:
    """One category of object, ready to be attached to a scene.

    Attributes:
        category: name in task files, such as `alphabet_soup`.
        spec: fresh model; the world body has one child, `main`, without a free joint (the scene adds it).
            Collision geoms `g0`, `g1`, ... are in group 0, the visual in group 1 without mass or contacts.
        joint_damping: damping of the free joint that the scene adds, SI units.
        rotation: axis (x, y, z) -> (low, high), radians: range of the rest rotation; empty for none.
        rotation_axis: axis that a plain range was given for in the original, None where it had none.
        bottom_offset: lowest point relative to the root, (3,), metres; placement uses it.
        top_offset: highest point relative to the root, (3,), metres; placement uses it.
        horizontal_radius: radius that placement keeps free around the object, metres.
        articulation: `open`, `close`, `turnon`, `turnoff` -> (low, high) of the joints, rad or m: where an object is
            put for an initial condition of that name, and from where on it counts.
        digest: of the files it was read from, for what is kept of scenes with it; "" where code says what it is.
    """

    category: str
    spec: mujoco.MjSpec
    joint_damping: float = 0.0005
    rotation: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    rotation_axis: str | None = None
    bottom_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    top_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    horizontal_radius: float = 0.0
    articulation: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    digest: str = ""

    def rest_quat(self, rng: np.random.Generator | None = None) -> np.ndarray:
        """Orientation at rest, wxyz (4,), as `rest_quat` below gives it for this object's ranges."""
        return rest_quat(self.rotation, rng)


def rest_quat(
    rotation: Mapping[str, tuple[float, float]], rng: np.random.Generator | None = None
) -> np.ndarray:
    """Orientation at rest of an object with these rotation ranges.

    The original composes its rotations as (x, y, z, w) and MuJoCo then reads the four numbers as
    (w, x, y, z); its initial states, and with them the ranges, only make sense that way: half a turn
    about the vertical for `{"x": (0, 0)}`, a can that stands for `{"z": (pi/2, pi/2)}`.

    Args:
        rotation: axis -> (low, high), radians; applied in this order.
        rng: draws the angle of each axis; without it the middle of each range is taken.

    Returns:
        Unit quaternion (4,), w first, for MuJoCo. Without ranges: no rotation.
    """
    if not rotation:
        return np.array([1.0, 0.0, 0.0, 0.0])
    total = np.array([1.0, 0.0, 0.0, 0.0])
    for axis, (low, high) in rotation.items():
        angle = 0.5 * (low + high) if rng is None else rng.uniform(low, high)
        product = np.zeros(4)
        mujoco.mju_mulQuat(product, quat_from_axis_angle(np.eye(3)["xyz".index(axis)], angle), total)
        total = product
    return np.roll(total, -1)  # (w, x, y, z) -> (x, y, z, w), kept in this order on purpose
