"""Physical parameters of the builtin objects, measured on the original's and stored in `parameters/`."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from importlib.resources import files
from typing import Any

from libero_env.objects.model import ROOT_BODY, ObjectProperties
from libero_env.storage import parse_yaml
from libero_env.validation import validate

# Contact parameters of the original's objects: as stiff as the timestep allows (refsafe).
CONTACT: Mapping[str, Sequence[float]] = {
    "friction": (0.95, 0.3, 0.1),
    "solref": (0.001, 1.0),
    "solimp": (0.998, 0.998, 0.001, 0.5, 2.0),
}
_ROOT_KEYS = ("mass", "com", "inertia", "boxes", "sites")


@dataclass(frozen=True, kw_only=True)
class Physics(ObjectProperties):
    """Physics and placement of one category, SI units.

    Attributes:
        bodies: Name -> keys of a body as in `parameters/`, where groceries.yaml explains them; the root is the first.
        contact: Contact parameters of collision shapes that do not set their own.
    """

    bodies: Mapping[str, Mapping[str, Any]]
    contact: Mapping[str, Sequence[float]]

    @property
    def of_model(self) -> dict[str, Any]:
        """The `ObjectProperties` by their names."""
        return {field.name: getattr(self, field.name) for field in fields(ObjectProperties)}


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
