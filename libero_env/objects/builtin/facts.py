"""Measured figures of the builtin objects, read from the YAML files beside this module."""

from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import yaml

Vector = tuple[float, ...]


@dataclass(frozen=True)
class Box:
    """Collision box: centre, half extents (metres), orientation wxyz, all in the root frame."""

    pos: Vector
    size: Vector
    quat: Vector = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Site:
    """Named place on an object; `size` as MuJoCo takes it for this `type`."""

    name: str
    type: str
    pos: Vector
    size: Vector
    quat: Vector = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Facts:
    """Physics and placement figures of one category, SI units, root frame.

    `inertia` is Ixx, Iyy, Izz, Ixy, Ixz, Iyz about `com`; the rest is described at `ObjectModel`.
    """

    mass: float
    com: Vector
    inertia: Vector
    boxes: tuple[Box, ...]
    rotation: dict[str, tuple[float, float]]
    rotation_axis: str | None
    bottom_offset: Vector
    top_offset: Vector
    horizontal_radius: float
    sites: tuple[Site, ...] = ()
    friction: Vector = (0.95, 0.3, 0.1)
    joint_damping: float = 0.0005


@cache
def load_facts(category: str) -> Facts:
    """Figures of a builtin category."""
    raw = dict(_all_facts()[category])
    raw["boxes"] = tuple(Box(**_tuples(box)) for box in raw["boxes"])
    raw["sites"] = tuple(Site(**_tuples(site)) for site in raw.get("sites", ()))
    raw["rotation"] = _tuples(raw["rotation"])
    return Facts(**_tuples(raw))


@cache
def _all_facts() -> dict[str, dict]:
    text = files(__package__).joinpath("groceries.yaml").read_text(encoding="utf-8")
    return yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))


def _tuples(mapping: dict) -> dict:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in mapping.items()}
