"""The dataclass `ObjectModel`: one object as a MuJoCo model of its own."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from libero_env.geometry import quat_from_axis_angle
from libero_env.mujoco_compat import mujoco

ROOT_BODY = "main"
VISUAL_GEOM: Mapping[str, Any] = {"group": 1, "contype": 0, "conaffinity": 0, "mass": 0.0}
GLOW_GROUP = 2  # geom group of sites that are visible only while their object is turned on

OPPOSITE_STATES = {"open": "close", "close": "open", "turnon": "turnoff", "turnoff": "turnon"}
"""State of joints -> the state at the other end; the predicate of a state is its name, capitalised."""


@dataclass(frozen=True, kw_only=True)
class ObjectProperties:
    """What scenes need to know of a category of object besides its MJCF.

    Attributes:
        joint_damping: Damping of the free joint that the scene adds, [N s/m] and [N m s/rad].
        rotation: Axis (`x`, `y` or `z`) -> (low, high) of the rotation at rest, [rad]; empty for none.
        rotation_axis: Axis of a range that the original gives without an axis; None where it has none.
        bottom_offset: Lowest point relative to the root, (3,) [m]; for placement.
        top_offset: Highest point relative to the root, (3,) [m]; for placement.
        horizontal_radius: Radius that placement keeps free around the object, [m].
        articulation: State (`open`, `close`, `turnon`, `turnoff`) -> (low, high) of the joints, [rad] or [m]: the range
            for an initial condition of that name, and the threshold from which the state holds.
    """

    joint_damping: float = 0.0005
    rotation: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    rotation_axis: str | None = None
    bottom_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    top_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    horizontal_radius: float = 0.0
    articulation: Mapping[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class ObjectModel(ObjectProperties):
    """One category of object, ready to be attached to a scene; see also `ObjectProperties`.

    Attributes:
        category: Name in task files, such as `alphabet_soup`.
        spec: Model whose world body has one child, `main`, without a free joint (the scene adds it). Collision geoms
            `g0`, `g1`, ... are in group 0, visual geoms in group 1 without mass or contacts.
        digest: Digest of the files it was read from, for caches of scenes with it; "" for a model made in code.
    """

    category: str
    spec: mujoco.MjSpec
    digest: str = field(default="", kw_only=True)

    def rest_quat(self, rng: np.random.Generator | None = None) -> np.ndarray:
        """Return the orientation at rest, (4,) wxyz; see the function `rest_quat`."""
        return rest_quat(self.rotation, rng)


def add_visual(body: mujoco.MjsBody, name: str, mesh: mujoco.MjsMesh, **look: Any) -> None:
    """Add a mesh to a body as a geom that is only seen; `look` are its attributes in MJCF, such as `material`."""
    kind = mujoco.mjtGeom.mjGEOM_MESH
    body.add_geom(name=name, type=kind, meshname=mesh.name, **VISUAL_GEOM, **look)


def rest_quat(
    rotation: Mapping[str, tuple[float, float]], rng: np.random.Generator | None = None
) -> np.ndarray:
    """Return the orientation at rest of an object.

    The original composes rotations as (x, y, z, w), and MuJoCo then reads the four numbers as (w, x, y, z). The ranges
    and the original's initial states rely on this: `{"x": (0, 0)}` is half a turn about the vertical, and
    `{"z": (pi/2, pi/2)}` makes a can stand.

    Args:
        rotation: Axis -> (low, high), [rad]; applied in this order.
        rng: Generator that samples the angle of each axis; None takes the middle of each range.

    Returns:
        Unit quaternion (4,), wxyz. Without ranges: the identity.
    """
    if not rotation:
        return np.array([1.0, 0.0, 0.0, 0.0])
    total = np.array([1.0, 0.0, 0.0, 0.0])
    for axis, (low, high) in rotation.items():
        angle = 0.5 * (low + high) if rng is None else rng.uniform(low, high)
        product = np.zeros(4)
        mujoco.mju_mulQuat(product, quat_from_axis_angle(np.eye(3)["xyz".index(axis)], angle), total)
        total = product
    return np.roll(total, -1)  # (w, x, y, z) -> (x, y, z, w), deliberately
