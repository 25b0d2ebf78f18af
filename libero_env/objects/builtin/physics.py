"""Physical parameters of the builtin objects, measured on the original's and stored in `parameters/`."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cache
from importlib.resources import files
from typing import Any

from pydantic import TypeAdapter

from libero_env.objects.model import ObjectModel
from libero_env.storage import parse_yaml

Vector = tuple[float, ...]
Vector3 = tuple[float, float, float]
Range = tuple[float, float]

# Contact parameters of the original's objects: as stiff as the timestep allows (refsafe).
FRICTION: Vector = (0.95, 0.3, 0.1)
SOLREF: Vector = (0.001, 1.0)
SOLIMP: Vector = (0.998, 0.998, 0.001)


@dataclass(frozen=True)
class CollisionShape:
    """Primitive collision geom in the frame of its body; contact parameters that are None are those of the object.

    Attributes:
        pos: Centre, (3,) [m].
        size: Size as MuJoCo expects it for `type` (half extents of a box), [m].
        quat: Orientation, (4,) wxyz.
        type: MuJoCo geom type in lower case, such as `box`.
        friction: Sliding, torsional and rolling friction, (3,).
        solref: MuJoCo's time constant [s] and damping ratio, (2,).
        solimp: First three of MuJoCo's impedance parameters, (3,).
    """

    pos: Vector
    size: Vector
    quat: Vector = (1.0, 0.0, 0.0, 0.0)
    type: str = "box"
    friction: Vector | None = None
    solref: Vector | None = None
    solimp: Vector | None = None


@dataclass(frozen=True)
class Site:
    """Named region on an object.

    Attributes:
        name: Name that task files use, such as `contain_region`.
        type: MuJoCo geom type in lower case.
        pos: Centre in the frame of the body, (3,) [m].
        size: Size as MuJoCo expects it for `type`, [m].
        quat: Orientation, (4,) wxyz.
    """

    name: str
    type: str
    pos: Vector
    size: Vector
    quat: Vector = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Joint:
    """Joint between a part and its parent.

    Attributes:
        name: Name within the object.
        type: `hinge` or `slide`.
        axis: Axis in the frame of the part, (3,).
        range: Lower and upper limit, (2,) [rad] or [m].
        pos: Anchor in the frame of the part, (3,) [m].
        damping: Damping, [N m s/rad] or [N s/m].
    """

    name: str
    type: str
    axis: Vector
    range: Vector
    pos: Vector = (0.0, 0.0, 0.0)
    damping: float = 0.0


@dataclass(frozen=True)
class Part:
    """One body: the root, or a descendant of it.

    Attributes:
        mass: Mass, [kg].
        com: Centre of mass in the frame of the body, (3,) [m].
        inertia: Ixx, Iyy, Izz, Ixy, Ixz, Iyz about `com`, [kg m^2]; empty for a body without mass.
        sites: Named regions.
        parent: Name of the parent body; "" for the root.
        pos: Origin in the frame of the parent, (3,) [m].
        quat: Orientation in the frame of the parent, (4,) wxyz.
        joint: Joint to the parent; None where the body is fixed to it.
    """

    mass: float = 0.0
    com: Vector = (0.0, 0.0, 0.0)
    inertia: Vector = ()
    boxes: tuple[CollisionShape, ...] = ()
    sites: tuple[Site, ...] = ()
    parent: str = ""
    pos: Vector = (0.0, 0.0, 0.0)
    quat: Vector = (1.0, 0.0, 0.0, 0.0)
    joint: Joint | None = None


@dataclass(frozen=True)
class Physics:
    """Physics and placement of one category, SI units; `ObjectModel` documents the fields that are not listed.

    Attributes:
        parts: Name -> body below the root.
        friction: Friction of collision shapes that do not set their own, (3,).
        solref: As `friction`, for MuJoCo's `solref`.
        solimp: As `friction`, for MuJoCo's `solimp`.
    """

    root: Part
    bottom_offset: Vector3
    top_offset: Vector3
    horizontal_radius: float
    parts: Mapping[str, Part] = field(default_factory=dict)
    rotation: Mapping[str, Range] = field(default_factory=dict)
    rotation_axis: str | None = None
    articulation: Mapping[str, Range] = field(default_factory=dict)
    friction: Vector = FRICTION
    solref: Vector = SOLREF
    solimp: Vector = SOLIMP
    joint_damping: float = 0.0005

    @property
    def of_model(self) -> dict[str, Any]:
        """Values of the fields of an `ObjectModel` that are not those of its MJCF."""
        return {f.name: getattr(self, f.name) for f in fields(ObjectModel) if hasattr(self, f.name)}

    @property
    def mass(self) -> float:
        """Total mass of all bodies, [kg]."""
        return self.root.mass + sum(part.mass for part in self.parts.values())


def categories() -> tuple[str, ...]:
    """Return the categories that have parameters."""
    return tuple(_texts("parameters"))


def read_section(folder: str, category: str) -> dict[str, Any]:
    """Return what a folder of YAML files beside this module says about a category, parsed at each call.

    Raises:
        KeyError: No builtin object has this name.
    """
    return parse_yaml(_texts(folder)[category])[category]


@cache
def _texts(folder: str) -> dict[str, str]:
    """Return category -> its section of the files, not yet parsed: a scene needs a few of many."""
    paths = [path for path in (files(__package__) / folder).iterdir() if path.name.endswith(".yaml")]
    sections = [
        section
        for path in paths
        for section in re.split(r"^(?=\w+:)", path.read_text(encoding="utf-8"), flags=re.M)
    ]
    return {section.split(":", 1)[0]: section for section in sections if not section.startswith("#")}


_ROOT_KEYS = ("mass", "com", "inertia", "boxes", "sites")


@cache
def load_physics(category: str) -> Physics:
    """Return the physics of a builtin category.

    Raises:
        KeyError: No builtin object has this name.
    """
    raw = read_section("parameters", category)
    root = {key: raw.pop(key) for key in _ROOT_KEYS if key in raw}
    return _checker().validate_python({"root": root, **raw})


@cache
def _checker() -> TypeAdapter[Physics]:
    return TypeAdapter(Physics)
