"""User-defined objects on disk: a folder each, with an MJCF file, its meshes and textures, and `object.yaml`.

Files are read when a scene requests the object, so that they may be edited by hand.
"""

import hashlib
import os
import shutil
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired

import yaml
from pydantic import AfterValidator, BeforeValidator, Field
from typing_extensions import TypedDict

from libero_env.errors import InvalidInputError, UnknownNameError
from libero_env.mujoco_compat import mujoco
from libero_env.objects.mjcf import MAX_FILE_BYTES, Mjcf, read_mjcf
from libero_env.objects.model import ObjectModel, ObjectProperties
from libero_env.paths import objects_dir
from libero_env.storage import read_bounded, read_yaml_file
from libero_env.validation import validate

MODEL, PROPERTIES, PREVIEW = "object.xml", "object.yaml", "preview.png"
_MAX_METRES = 10.0  # of an object
_MAX_ANGLE = 100.0  # [rad], or [m] of a joint that slides


def _number(value: Any) -> Any:
    """Return the value of a text such as `1e-3`, which is not a number in YAML."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def _complete(grasp: Any) -> Any:
    if isinstance(grasp, dict) and (key := "reason" if grasp.get("width") is None else "height") not in grasp:
        raise ValueError(f"{key} is missing; expected width and height, or width: null and reason")
    return grasp


def _ordered(values: list[float]) -> list[float]:
    if values[1] < values[0]:
        raise ValueError(f"{values} is no range; expected [low, high] with low <= high")
    return values


Metres = Annotated[float, Field(ge=-_MAX_METRES, le=_MAX_METRES), BeforeValidator(_number)]
Point = Annotated[list[Metres], Field(min_length=3, max_length=3)]
Length = Annotated[float, Field(ge=0, le=_MAX_METRES), BeforeValidator(_number)]
Angle = Annotated[float, Field(ge=-_MAX_ANGLE, le=_MAX_ANGLE), BeforeValidator(_number)]
Amount = Annotated[float, Field(ge=0, le=1e6), BeforeValidator(_number)]
Pair = Annotated[list[Angle], Field(min_length=2, max_length=2)]
Text = Annotated[str, Field(max_length=1000)]


class Collision(TypedDict):
    """How collision geoms were made."""

    method: Text
    pieces: Annotated[int, Field(ge=0)]


class Grasp(TypedDict):
    """The best grasp from above; width null and a reason where there is none."""

    width: Length | None
    height: NotRequired[Metres]
    reason: NotRequired[Text]


class Properties(TypedDict):
    """Content of `object.yaml`: what placement needs, and what the trial of the object found."""

    bottom_offset: Point
    top_offset: Point
    horizontal_radius: Length
    name: NotRequired[Text]
    source: NotRequired[Text]
    mass: NotRequired[Amount]
    watertight: NotRequired[bool]
    collision: NotRequired[Collision]
    size: NotRequired[Annotated[list[Length], Field(min_length=3, max_length=3)]]
    grasp: NotRequired[Annotated[Grasp | None, BeforeValidator(_complete)]]
    stands: NotRequired[bool]
    joint_damping: NotRequired[Amount]
    rotation: NotRequired[dict[Literal["x", "y", "z"], Annotated[Pair, AfterValidator(_ordered)]]]
    rotation_axis: NotRequired[Literal["x", "y", "z"] | None]
    articulation: NotRequired[dict[Literal["open", "close", "turnon", "turnoff"], Pair]]


def names() -> tuple[str, ...]:
    """Return the names of the user-defined objects, sorted; empty where the folder does not exist."""
    root = objects_dir()
    found = (path.parent.name for path in root.glob(f"*/{PROPERTIES}")) if root.is_dir() else ()
    return tuple(sorted(name for name in found if name.isidentifier()))


def find(name: str) -> Path | None:
    """Return the folder of a user-defined object; None where it does not exist."""
    directory = objects_dir() / name
    return directory if name.isidentifier() and os.path.isfile(directory / PROPERTIES) else None


def remove(name: str) -> Path:
    """Remove a user-defined object and return the folder that it was in.

    Raises:
        UnknownNameError: The object does not exist; the message lists the existing ones.
    """
    if (directory := find(name)) is None:
        raise UnknownNameError(f"user-defined object in {objects_dir()}", name, names())
    if directory.is_symlink():
        directory.unlink()  # the link, not what it leads to
    else:
        shutil.rmtree(directory)
    return directory


def read_properties(directory: Path) -> dict[str, Any]:
    """Return the content of `object.yaml`.

    Raises:
        InvalidInputError: The file is not valid YAML, a key is missing or unknown, or a value is not valid; the message
            has file and line.
    """
    file = read_yaml_file(directory / PROPERTIES)
    properties = validate(Properties, file.data, source=file.source, line_of=file.line_of)
    if (name := properties.get("name", directory.name)) != directory.name:
        raise InvalidInputError(
            f"{file.at(('name',))}: the name {name!r:.60} is not that of its folder {directory.name}; change one"
        )
    if properties["top_offset"][2] < properties["bottom_offset"][2]:
        raise InvalidInputError(
            f"{file.at(('top_offset',))}: its highest point is below its lowest, bottom_offset"
        )
    return properties


def load(directory: Path, category: str) -> ObjectModel:
    """Return a new model of the object in a folder at each call.

    Raises:
        LiberoError: A file is missing or broken.
    """
    properties = read_properties(directory)
    names = {field.name for field in fields(ObjectProperties)}
    given: dict[str, Any] = {key: properties[key] for key in names & properties.keys()}
    given |= {key: tuple(properties[key]) for key in ("bottom_offset", "top_offset")}
    return ObjectModel(category, read_spec(directory / MODEL), digest=digest(directory), **given)


def read_spec(path: Path) -> mujoco.MjSpec:
    """Return an MJCF file of an object with absolute paths of its meshes and textures, so that any scene can attach it.

    Raises:
        InvalidInputError: The file cannot be read, has what an object may not have, or a mesh or texture is missing or
            elsewhere; see `libero_env.objects.mjcf`.
    """
    return spec_of(read_mjcf(path))


def spec_of(file: Mjcf) -> mujoco.MjSpec:
    """Return the content of an MJCF file as MuJoCo reads it.

    Raises:
        InvalidInputError: MuJoCo cannot read it.
    """
    try:
        return mujoco.MjSpec.from_string(file.text)
    except ValueError as error:
        raise InvalidInputError(file.explain(error)) from error


def digest(directory: Path) -> str:
    """Return a digest of the files that a scene is built from, 16 hexadecimal digits.

    Raises:
        InvalidInputError: A file cannot be read, or is too large.
    """
    hashed = hashlib.sha256()
    for path in sorted(directory.rglob("*")):
        if path.is_file() and path.name != PREVIEW:
            name = path.relative_to(directory).as_posix()
            try:
                content = read_bounded(path, MAX_FILE_BYTES)
            except OSError as error:
                raise InvalidInputError(f"{path}: {error.strerror or error}") from error
            hashed.update(name.encode() + b"\0" + hashlib.sha256(content).digest())
    return hashed.hexdigest()[:16]


def write_properties(directory: Path, properties: Mapping[str, Any]) -> None:
    """Write `object.yaml`."""
    text = yaml.safe_dump(dict(properties), sort_keys=False, allow_unicode=True, width=110)
    (directory / PROPERTIES).write_text(text, encoding="utf-8")
