"""What an MJCF file from outside may contain, and which files it may name.

MuJoCo sees no file of a user: it gets the text that is written here from the elements that passed. Elements that belong
to a scene are left out; those that no object needs, or that grow without bound, are refused. Meshes and textures are
first read in a process with limits.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path, PurePath, PurePosixPath, PureWindowsPath
from typing import NoReturn
from xml.etree import ElementTree as ET

import numpy as np

from libero_env.errors import InvalidInputError
from libero_env.limited import call_limited
from libero_env.mujoco_compat import mujoco
from libero_env.objects.xml_file import explain, parse_xml, place_of, write_xml
from libero_env.text import suggest

# Largest number of elements, those that <replicate> makes included.
LIMITS = {"body": 1000, "geom": 2000, "site": 2000, "joint": 100, "mesh": 2000, "texture": 200}
MAX_FILE_BYTES = 256 << 20  # of a mesh or texture
_MAX_INCLUDES = 50
_LARGEST_NUMBER = 1e10  # as in MuJoCo
_LARGEST_LENGTH = {"size": 10.0, "fromto": 10.0, "pos": 1000.0, "offset": 1000.0}  # [m]
_LARGEST_RESOLUTION = 4096  # [pixels] of a generated texture; its other counts are below it too

_IN_BODY = frozenset({"body", "frame", "geom", "site", "joint", "freejoint", "inertial", "replicate"})
_NONE: frozenset[str] = frozenset()
# Element -> elements that it may contain.
_GRAMMAR: Mapping[str, frozenset[str]] = {
    "mujoco": frozenset({"compiler", "default", "asset", "worldbody", "contact", "equality", "tendon"}),
    "default": frozenset(
        {"default", "mesh", "material", "joint", "geom", "site", "pair", "equality", "tendon"}
    ),
    "asset": frozenset({"mesh", "texture", "material"}),
    "material": frozenset({"layer"}),
    **dict.fromkeys(("worldbody", "body", "frame", "replicate"), _IN_BODY),
    "contact": frozenset({"pair", "exclude"}),
    "equality": frozenset({"connect", "weld", "joint", "tendon"}),
    "tendon": frozenset({"spatial", "fixed"}),
    "spatial": frozenset({"site", "geom", "pulley"}),
    "fixed": frozenset({"joint"}),
}
# Elements of scenes and robots, without which an object is used. A note counts those of the first lines.
_COUNTED = frozenset({"light", "camera"})
_COUNTED_INSIDE = frozenset({"actuator", "sensor", "keyframe"})
_OMITTED = (
    _COUNTED
    | _COUNTED_INSIDE
    | {"option", "size", "visual", "statistic", "custom", "lengthrange"}
    | {"general", "motor", "position", "velocity", "intvelocity", "damper", "cylinder", "muscle", "adhesion"}
)
_FILES = frozenset({"file", *(f"file{side}" for side in ("right", "left", "up", "down", "front", "back"))})
_REAL_KEYS = (
    "pos quat axisangle xyaxes zaxis euler fromto size rgba friction solref solimp mass density margin gap range "
    "damping stiffness armature frictionloss ref springref diaginertia fullinertia scale refpos refquat vertex normal "
    "texcoord anchor relpose polycoef torquescale axis offset emission specular shininess reflectance"
)
_WHOLE_KEYS = "group condim contype conaffinity priority count width height nchannel maxhullvert"
_NAME_KEYS = (
    "name class childclass mesh material texture sidesite tendon body geom site joint user "
    "body1 body2 geom1 geom2 site1 site2 joint1 joint2 tendon1 tendon2"
)
_REALS, _WHOLE = frozenset(_REAL_KEYS.split()), frozenset(_WHOLE_KEYS.split())
_NAMES = _FILES | frozenset(_NAME_KEYS.split())
_LONGEST = 4096  # characters of a name or of another short value


@dataclass(frozen=True)
class Mjcf:
    """An MJCF file that passed.

    Attributes:
        root: Its elements, without those that are left out; files are named by absolute paths.
        text: The same as text for MuJoCo.
        omitted: Number of lights, cameras, actuators, sensors and keyframes that are left out.
        files: Meshes and textures that it names.
    """

    path: Path
    root: ET.Element
    text: str
    omitted: int
    files: tuple[Path, ...]
    _places: tuple[str, ...] = field(repr=False)

    def explain(self, error: Exception) -> str:
        """Return MuJoCo's message about `text` in one line, with file and line of the element that it is about."""
        return explain(error, self.path, self._places)


def read_mjcf(path: Path) -> Mjcf:
    """Read the MJCF file of an object, with the files that it includes.

    Args:
        path: File to read. The files that it names must lie in its folder or below.

    Raises:
        InvalidInputError: The file is not MJCF, has an element or a value that an object may not have, or names a file
            that is missing, too large, or elsewhere; the message starts with file:line.
    """
    root = parse_xml(path)
    _include(root, path.parent, set())
    omitted = _omit(root)
    if root.tag != "mujoco":
        _refuse(root, f"<{root.tag}> is not MJCF; expected <mujoco>")
    for parent in root.iter():
        for child in parent:
            _check_child(parent, child)
        _check_values(parent)
    _check_counts(root)
    _check_joined(root)
    files = tuple(_resolve_files(root, path.parent))
    text, places = write_xml(root)
    mjcf = Mjcf(path, root, text, omitted, files, places)
    if files or root.find("asset/texture") is not None:
        stamps = tuple((file, file.stat().st_mtime_ns, file.stat().st_size) for file in files)
        if error := _compile_error_of(text, stamps, str(path)):
            raise InvalidInputError(mjcf.explain(ValueError(error)))
    return mjcf


def file_inside(folder: Path, name: str, where: str, what: str = "file") -> Path:
    """Return the file that a name stands for, an absolute path.

    Args:
        folder: Folder that the name is relative to.
        name: Name as it is written in a file, with the folders below `folder`.
        where: `file:line` or the like of the name, with which messages start.
        what: Kind of the file, for messages.

    Raises:
        InvalidInputError: The name leads out of the folder, also by a link, or the file is missing or too large.
    """
    plain = name.replace("\\", "/")
    parts = PurePosixPath(plain).parts
    if "\0" in name or not parts:
        raise InvalidInputError(f"{where}: {name!r} is not the name of a file")
    if PurePosixPath(plain).is_absolute() or PureWindowsPath(name).drive or ":" in parts[0] or ".." in parts:
        raise InvalidInputError(
            f"{where}: {what} {name!r} is outside of the folder {folder}; only files in it or below are read: copy "
            "it there, and write its name relative to the folder"
        )
    file = folder.absolute() / plain
    try:
        if not file.is_file():
            raise InvalidInputError(f"{where}: {what} {file} is missing; put it there, or fix the name")
        if not file.resolve().is_relative_to(folder.resolve()):
            raise InvalidInputError(
                f"{where}: {what} {file} is a link to {file.resolve()}, outside of the folder; copy the file itself"
            )
    except (OSError, RuntimeError, ValueError) as error:
        if isinstance(error, InvalidInputError):
            raise
        raise InvalidInputError(f"{where}: {what} {name[:80]!r}: {error}") from error
    check_size(file, where)
    return file


def check_size(file: Path, where: str) -> None:
    """Check that a file is not empty and not larger than `MAX_FILE_BYTES`.

    Raises:
        InvalidInputError: It is.
    """
    size = file.stat().st_size
    if not size:
        raise InvalidInputError(f"{where}: {file} is empty")
    if size > MAX_FILE_BYTES:
        raise InvalidInputError(
            f"{where}: {file} has {size >> 20} MiB; up to {MAX_FILE_BYTES >> 20} MiB are read: simplify it"
        )


def compile_error(text: str) -> str:
    """Return what MuJoCo finds wrong with an MJCF text and the files that it names: call it with `call_limited`."""
    try:
        mujoco.MjSpec.from_string(text).compile()
    except ValueError as error:
        return str(error)
    return ""


@lru_cache(maxsize=64)
def _compile_error_of(text: str, stamps: tuple[tuple[Path, int, int], ...], about: str) -> str:
    """Return `compile_error` of a text once for each state of the files that it names."""
    return call_limited(compile_error, text, about=about)


def _refuse(node: ET.Element, text: str) -> NoReturn:
    raise InvalidInputError(f"{place_of(node)}: {text}")


def _include(node: ET.Element, folder: Path, seen: set[Path]) -> None:
    """Put the content of included files in the place of <include>, each once."""
    for index in range(len(node) - 1, -1, -1):
        child = node[index]
        if child.tag != "include":
            _include(child, folder, seen)
            continue
        file = file_inside(folder, child.get("file", ""), place_of(child), "included file")
        if file in seen or len(seen) == _MAX_INCLUDES:
            _refuse(child, f"{file.name} is included twice, or more than {_MAX_INCLUDES} files are included")
        seen.add(file)
        content = parse_xml(file)
        _include(content, folder, seen)
        node[index : index + 1] = list(content)


def _omit(node: ET.Element) -> int:
    """Remove the elements that an object is used without; return the number of those that a note counts."""
    count = 0
    for child in list(node):
        if child.tag not in _OMITTED:
            count += _omit(child)
            continue
        count += (
            len(child) if child.tag in _COUNTED_INSIDE else child.tag in _COUNTED and node.tag != "default"
        )
        node.remove(child)
    return count


def _check_child(parent: ET.Element, child: ET.Element) -> None:
    valid = _GRAMMAR.get(parent.tag, _NONE)
    if child.tag not in valid:
        listed = f"valid there: {', '.join(sorted(valid))}" if valid else "it has no elements in it"
        _refuse(
            child,
            f"<{child.tag}> in <{parent.tag}> is not used in objects;{suggest(child.tag, valid)} {listed}",
        )


def _check_values(node: ET.Element) -> None:
    """Check that numbers are finite and of a usual size."""
    for key, text in node.attrib.items():
        if key not in _REALS and len(text) > _LONGEST:
            _refuse(node, f"{key} of <{node.tag}> has {len(text)} characters; expected at most {_LONGEST}")
        if key in _NAMES:
            continue
        try:
            numbers = np.array(text.split(), float)
        except ValueError:
            if key in _REALS or key in _WHOLE:
                shown = text if len(text) < 60 else f"{text[:60]}..."
                _refuse(node, f"{key} of <{node.tag}> is {shown!r}; expected numbers")
            continue  # a word, such as a type
        largest = _LARGEST_RESOLUTION if node.tag == "texture" else _LARGEST_LENGTH.get(key, _LARGEST_NUMBER)
        if not (np.abs(numbers) <= largest).all():
            wrong = next(value for value in numbers if not abs(value) <= largest)
            _refuse(
                node, f"{key} of <{node.tag}> has the value {wrong:g}; expected numbers up to {largest:g}"
            )
        if key in _WHOLE and (numbers.size != 1 or numbers[0] != round(numbers[0])):
            _refuse(node, f"{key} of <{node.tag}> is {text!r}; expected a whole number")


def _check_counts(root: ET.Element) -> None:
    counts: Counter[str] = Counter()
    for tag, number in _counted(root, 1):
        counts[tag] += number
    for tag, largest in LIMITS.items():
        if counts[tag] > largest:
            _refuse(root, f"it has {counts[tag]} elements <{tag}>; an object has at most {largest}")


def _counted(node: ET.Element, times: int) -> Iterator[tuple[str, int]]:
    """Yield tag and number of each element, with what <replicate> makes of it."""
    if node.tag == "replicate":
        count = node.get("count", "1")
        times = min(times * int(float(count)), 1 << 60)
    yield node.tag, times
    for child in node:
        yield from _counted(child, times)


def _check_joined(root: ET.Element) -> None:
    """Check that constraints join two parts of the object: with one, they would fix it to the world."""
    for node in (*root.iterfind("equality/connect"), *root.iterfind("equality/weld")):
        parts = [node.get("body1"), node.get("body2")]
        sites = node.get("site1") and node.get("site2")
        if not sites and (None in parts or "world" in parts):
            _refuse(node, f"<{node.tag}> fixes the object to the world; name two of its own bodies")


def _resolve_files(root: ET.Element, folder: Path) -> list[Path]:
    """Replace the names of files by absolute paths, and remove the settings that say where to search them."""
    settings: dict[str, str] = {}
    for compiler in root.findall("compiler"):
        for key in ("assetdir", "meshdir", "texturedir", "strippath"):
            if key in compiler.attrib:
                settings[key] = compiler.attrib.pop(key)
    asset_folder = settings.get("assetdir", "")
    folders = {
        "mesh": settings.get("meshdir", asset_folder),
        "texture": settings.get("texturedir", asset_folder),
    }
    files = []
    for node in root.iter():
        for key in _FILES & set(node.attrib):
            if node.tag not in folders:
                _refuse(node, f"<{node.tag}> names a file; only meshes and textures do")
            name = node.attrib[key]
            if settings.get("strippath") == "true":
                name = PurePath(name.replace("\\", "/")).name
            within = f"{folders[node.tag]}/{name}" if folders[node.tag] else name
            file = file_inside(folder, within, place_of(node), node.tag)
            if node.tag == "mesh" and file.suffix.lower() not in (".obj", ".stl", ".msh"):
                _refuse(node, f"{file} has an unknown format; valid: .obj, .stl, .msh")
            node.set(key, str(file))
            files.append(file)
    return files
