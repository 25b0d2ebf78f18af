"""Measured figures of the builtin objects, read from the YAML files in `figures/`."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Any

from libero_env.storage import parse_yaml

Vector = tuple[float, ...]

# How the original's objects touch: as stiff as the timestep allows (refsafe).
FRICTION: Vector = (0.95, 0.3, 0.1)
SOLREF: Vector = (0.001, 1.0)
SOLIMP: Vector = (0.998, 0.998, 0.001)


@dataclass(frozen=True)
class Solid:
    """Collision shape: `size` as MuJoCo takes it for this `type` (half extents of a box), metres, wxyz.

    How it touches is what the object says where it says nothing itself.
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
    """Named place on an object; `size` as MuJoCo takes it for this `type`."""

    name: str
    type: str
    pos: Vector
    size: Vector
    quat: Vector = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Joint:
    """How a part moves against its parent: `hinge` (rad) or `slide` (m)."""

    name: str
    type: str
    axis: Vector
    range: Vector
    pos: Vector = (0.0, 0.0, 0.0)
    damping: float = 0.0


@dataclass(frozen=True)
class Part:
    """One body: the root, or one below it in the frame of its parent.

    `inertia` is Ixx, Iyy, Izz, Ixy, Ixz, Iyz about `com`; a body without mass has neither.
    """

    mass: float = 0.0
    com: Vector = (0.0, 0.0, 0.0)
    inertia: Vector = ()
    boxes: tuple[Solid, ...] = ()
    sites: tuple[Site, ...] = ()
    parent: str = ""
    pos: Vector = (0.0, 0.0, 0.0)
    quat: Vector = (1.0, 0.0, 0.0, 0.0)
    joint: Joint | None = None


@dataclass(frozen=True)
class Facts:
    """Physics and placement figures of one category, SI units; the rest is described at `ObjectModel`."""

    root: Part
    parts: Mapping[str, Part]
    rotation: Mapping[str, Vector]
    rotation_axis: str | None
    bottom_offset: Vector
    top_offset: Vector
    horizontal_radius: float
    articulation: Mapping[str, Vector] = field(default_factory=dict)
    friction: Vector = FRICTION
    solref: Vector = SOLREF
    solimp: Vector = SOLIMP
    joint_damping: float = 0.0005

    @property
    def mass(self) -> float:
        """Of all bodies together, kg."""
        return self.root.mass + sum(part.mass for part in self.parts.values())


_OF_PART = ("mass", "com", "inertia", "boxes", "sites")


@cache
def load_facts(category: str) -> Facts:
    """Figures of a builtin category."""
    raw = parse_yaml(_texts()[category])[category]
    root = _part({key: raw.pop(key) for key in _OF_PART if key in raw})
    parts = {name: _part(part) for name, part in raw.pop("parts", {}).items()}
    for key in ("rotation", "articulation"):
        raw[key] = MappingProxyType(_tuples(raw.get(key, {})))
    return Facts(root=root, parts=MappingProxyType(parts), **_tuples(raw))


def _part(raw: Mapping[str, Any]) -> Part:
    facts = dict(raw)
    facts["boxes"] = tuple(Solid(**_tuples(box)) for box in facts.get("boxes", ()))
    facts["sites"] = tuple(Site(**_tuples(site)) for site in facts.get("sites", ()))
    if "joint" in facts:
        facts["joint"] = Joint(**_tuples(facts["joint"]))
    return Part(**_tuples(facts))


@cache
def _texts() -> dict[str, str]:
    """Category -> its part of the files, unread: a scene needs a few of many."""
    folder = files(__package__) / "figures"
    texts = [file.read_text(encoding="utf-8") for file in folder.iterdir() if file.name.endswith(".yaml")]
    parts = [part for text in texts for part in re.split(r"^(?=\w+:\n)", text, flags=re.M)]
    return {part.split(":", 1)[0]: part for part in parts if not part.startswith("#")}


def _tuples(mapping: Mapping[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in mapping.items()}
