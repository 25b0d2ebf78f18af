"""The user's own objects on disk: a folder each, with an MJCF file, its meshes and pictures, and `object.yaml`.

Nothing is read before a scene asks for a name, and files may be edited by hand: they are what counts.
"""

import hashlib
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import yaml

from libero_env.errors import LiberoError, UnknownNameError
from libero_env.objects.model import ROOT_BODY, ObjectModel
from libero_env.paths import objects_dir

MODEL, FACTS, PREVIEW = "object.xml", "object.yaml", "preview.png"
_FIGURES = ("bottom_offset", "top_offset", "horizontal_radius")
_MAY_SAY = ("joint_damping", "rotation", "rotation_axis", "articulation")


def names() -> tuple[str, ...]:
    """The user's objects, sorted; none where there is no folder."""
    root = objects_dir()
    return tuple(sorted(path.parent.name for path in root.glob(f"*/{FACTS}"))) if root.is_dir() else ()


def find(name: str) -> Path | None:
    """The folder of one of the user's objects; None where there is none of this name."""
    place = objects_dir() / name
    return place if name.isidentifier() and (place / FACTS).is_file() else None


def folder_of(name: str) -> Path:
    """As `find`.

    Raises:
        UnknownNameError: none of the user's objects has this name; the message lists them.
    """
    place = find(name)
    if place is None:
        raise UnknownNameError(f"object of your own in {objects_dir()}", name, names())
    return place


def remove(name: str) -> Path:
    """Remove one of the user's objects and say where it was.

    Raises:
        UnknownNameError: there is none of this name.
    """
    place = folder_of(name)
    shutil.rmtree(place)
    return place


def read_facts(place: Path) -> dict[str, Any]:
    """What `object.yaml` says.

    Raises:
        LiberoError: it is no YAML, or a figure that scenes need is missing.
    """
    path = place / FACTS
    try:
        facts = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError) as error:
        raise LiberoError(f"{path}: {error}; mend it, or add the object anew with --replace") from error
    missing = [key for key in _FIGURES if not isinstance(facts, dict) or key not in facts]
    if missing:
        raise LiberoError(f"{path} does not say {', '.join(missing)}; add the object anew with --replace")
    return facts


def load(place: Path, category: str) -> ObjectModel:
    """The model of an object's folder, anew at each call.

    Raises:
        LiberoError: a file is missing or broken.
    """
    facts = read_facts(place)
    spec = read_spec(place / MODEL)
    bodies = [body.name for body in spec.worldbody.bodies]
    if bodies != [ROOT_BODY]:
        raise LiberoError(f"{place / MODEL}: expected one body {ROOT_BODY!r} in the world, found {bodies}")
    figures: dict[str, Any] = {key: facts[key] for key in _MAY_SAY if key in facts}
    bottom, top = (tuple(map(float, facts[key])) for key in ("bottom_offset", "top_offset"))
    return ObjectModel(
        category,
        spec,
        bottom_offset=(bottom[0], bottom[1], bottom[2]),
        top_offset=(top[0], top[1], top[2]),
        horizontal_radius=float(facts["horizontal_radius"]),
        digest=digest(place),
        **figures,
    )


def read_spec(path: Path) -> mujoco.MjSpec:
    """An MJCF file with the files that it names by their whole paths, so that it can be attached to any scene.

    Raises:
        LiberoError: it cannot be read, or a mesh or picture is missing.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except (ValueError, OSError) as error:
        raise LiberoError(f"{path}: {error}") from error
    folders: Mapping[str, str] = {"mesh": spec.meshdir, "texture": spec.texturedir}
    for kind, elements in (("mesh", spec.meshes), ("texture", spec.textures)):
        for element in elements:
            if element.file:
                file = path.parent.absolute() / folders[kind] / element.file
                if not file.is_file():
                    raise LiberoError(
                        f"{path}: {kind} {file} is missing; put it there, or mend the file's path"
                    )
                element.file = str(file)
    spec.meshdir = spec.texturedir = ""
    return spec


def digest(place: Path) -> str:
    """Of the files that a scene is built from; 16 hex digits."""
    hashed = hashlib.sha256()
    for path in sorted(place.iterdir()):
        if path.is_file() and path.name not in (PREVIEW, FACTS):
            hashed.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return hashed.hexdigest()[:16]


def write_facts(place: Path, facts: Mapping[str, Any]) -> None:
    """Write `object.yaml`."""
    text = yaml.safe_dump(dict(facts), sort_keys=False, allow_unicode=True, width=110)
    (place / FACTS).write_text(text, encoding="utf-8")
