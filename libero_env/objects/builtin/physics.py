"""Physical parameters of the builtin objects, measured on the original's and stored in `parameters/`."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from importlib.resources import files
from typing import Any

from libero_env.objects.model import ROOT_BODY, ObjectModel
from libero_env.storage import parse_yaml
from libero_env.validation import validate

Vector3 = tuple[float, float, float]
Range = tuple[float, float]

# Contact parameters of the original's objects: as stiff as the timestep allows (refsafe).
CONTACT: Mapping[str, Sequence[float]] = {
    "friction": (0.95, 0.3, 0.1),
    "solref": (0.001, 1.0),
    "solimp": (0.998, 0.998, 0.001, 0.5, 2.0),
}
_ROOT_KEYS = ("mass", "com", "inertia", "boxes", "sites")


@dataclass(frozen=True)
class Physics:
    """Physics and placement of one category, SI units; `ObjectModel` documents the fields that are not listed.

    Attributes:
        bodies: Name -> keys of a body as in `parameters/`, where groceries.yaml explains them; the root is the first.
        contact: Contact parameters of collision shapes that do not set their own.
    """

    bodies: Mapping[str, Mapping[str, Any]]
    contact: Mapping[str, Sequence[float]]
    bottom_offset: Vector3
    top_offset: Vector3
    horizontal_radius: float
    rotation: Mapping[str, Range] = field(default_factory=dict)
    rotation_axis: str | None = None
    articulation: Mapping[str, Range] = field(default_factory=dict)
    joint_damping: float = 0.0005

    @property
    def of_model(self) -> dict[str, Any]:
        """Values of the fields of an `ObjectModel` that are not those of its MJCF."""
        return {f.name: getattr(self, f.name) for f in fields(ObjectModel) if hasattr(self, f.name)}


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


@cache
def load_physics(category: str) -> Physics:
    """Return the physics of a builtin category.

    Raises:
        KeyError: No builtin object has this name.
    """
    raw = read_section("parameters", category)
    root = {key: raw.pop(key) for key in _ROOT_KEYS if key in raw}
    contact = {key: raw.pop(key, usual) for key, usual in CONTACT.items()}
    bodies = {ROOT_BODY: root, **raw.pop("parts", {})}
    return validate(Physics, {"bodies": bodies, "contact": contact, **raw}, source=category)
