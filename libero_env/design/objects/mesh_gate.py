"""Checks of mesh files before they are read: which files they name, and how much they hold."""

import json
import re
import shlex
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import unquote

import numpy as np
from PIL import Image
from pydantic import Field

from libero_env.errors import InvalidInputError
from libero_env.objects.references import (
    MAX_FACES,
    check_faces,
    check_pixels,
    check_size,
    file_inside,
    mesh_faces,
)
from libero_env.validation import validate

PICTURES = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF", "GIF")  # formats of textures
_MAX_NUMBERS = 30 * MAX_FACES  # of all arrays of a glTF file
_MAX_NODES = 10_000
_FARTHEST = 1e9  # of a vertex
_MAX_JSON = 64 << 20  # [bytes]
_GLB = 0x46546C67
_JSON_CHUNK = 0x4E4F534A

Count = Annotated[int, Field(ge=0)]


class Folder:
    """Access of trimesh to the files that a mesh file names: those in its folder or below.

    Attributes:
        file_name: Name of the mesh file.
    """

    def __init__(self, path: Path):
        self.file_name = path.name
        self._path = path

    def get(self, name: str) -> bytes:
        """Return the content of a file."""
        plain = name.strip()
        folder = self._path.parent
        known = plain if (folder / plain.replace("\\", "/")).is_file() else unquote(plain)
        return file_inside(folder, known, str(self._path)).read_bytes()

    __getitem__ = get

    def keys(self) -> tuple[str, ...]:
        """Return no names: files are only read by the name that the mesh file has."""
        return ()


def check_mesh_file(path: Path) -> None:
    """Check a mesh file and the files that it names.

    Raises:
        InvalidInputError: It names a file that is missing or outside of its folder, or holds too much.
    """
    check_size(path, str(path))
    suffix = path.suffix.lower()
    if suffix == ".obj":
        mesh_faces(path, "mesh")
        _check_obj(path)
    elif suffix in (".gltf", ".glb"):
        _check_gltf(path)
    elif suffix == ".ply":
        _check_ply(path)
    elif suffix == ".stl":
        _check_stl(path)


def check_picture(image: Image.Image, where: str) -> None:
    """Check format and size of a texture by its header, before it is decoded.

    Raises:
        InvalidInputError: The format is none of `PICTURES`, or there are too many pixels.
    """
    if image.format not in (None, *PICTURES):
        raise InvalidInputError(
            f"{where}: a texture is in the format {image.format}; valid: {', '.join(PICTURES)}"
        )
    check_pixels(*image.size, f"{where}: a texture")


def _check_obj(path: Path) -> None:
    """Check the materials of an OBJ file; trimesh would omit those that are missing silently."""
    for number, line in _lines(path):
        word, _, rest = line.partition(" ")
        if word == "v" and not _is_usual(rest):
            raise InvalidInputError(
                f"{path}:{number}: {line[:60]!r} is not finite, or beyond 1e9; fix the mesh"
            )
        if word != "mtllib" or not rest.strip():
            continue
        name = _name(path.parent, rest)
        if not (path.parent / name).exists():
            raise InvalidInputError(
                f"{path}:{number}: its material file {name} is missing; put it beside it, or remove the line mtllib"
            )
        _check_materials(file_inside(path.parent, name, f"{path}:{number}", "material file"))


def _is_usual(text: str) -> bool:
    try:
        return all(abs(float(word)) <= _FARTHEST for word in text.split())
    except ValueError:
        return True  # the reader says what is wrong


def _check_materials(library: Path) -> None:
    for number, line in _lines(library):
        word, _, rest = line.partition(" ")
        if word.lower() != "map_kd" or not rest.strip():
            continue
        name, where = _name(library.parent, rest), f"{library}:{number}"
        if not (library.parent / name).exists():
            raise InvalidInputError(
                f"{where}: its texture {name} is missing; put it at {library.parent / name}, or remove the line map_Kd"
            )
        _check_picture_file(file_inside(library.parent, name, where, "texture"), where)


def _check_picture_file(file: Path, where: str) -> None:
    try:
        with Image.open(file, formats=PICTURES) as image:
            check_picture(image, f"{where}: {file}")
    except (OSError, SyntaxError, ValueError, struct.error, Image.DecompressionBombError) as error:
        if isinstance(error, InvalidInputError):
            raise
        raise InvalidInputError(
            f"{where}: {file} is no picture that can be read ({error}); valid: {', '.join(PICTURES)}"
        ) from error


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    text = path.read_text(encoding="utf-8", errors="replace")
    for number, line in enumerate(text.split("\n"), 1):
        yield number, line.strip()


def _name(folder: Path, rest: str) -> str:
    """Return the name of a file from a line: options may come before it, and names may contain blanks."""
    whole = rest.strip()
    try:
        if (folder / whole).is_file():
            return whole
        return shlex.split(whole)[-1].replace("\\", "/")
    except (ValueError, OSError, IndexError):  # a quotation without an end, or too long a name
        return whole


def _check_stl(path: Path) -> None:
    data = path.read_bytes()
    count = struct.unpack_from("<I", data, 80)[0] if len(data) >= 84 else -1
    if count * 50 + 84 == len(data):
        mesh_faces(path, "mesh")
        return
    check_faces(data.count(b"endfacet"), str(path))
    if re.search(rb"vertex[^\n]*(nan|inf)", data, re.IGNORECASE):
        raise InvalidInputError(f"{path}: it has numbers that are not finite; fix the mesh")


def _check_ply(path: Path) -> None:
    with path.open("rb") as file:
        head = file.read(1 << 16).partition(b"end_header")[0]
    for kind, count in re.findall(rb"element\s+(\w+)\s+(\d+)", head):
        if int(count) > 3 * MAX_FACES:
            raise InvalidInputError(
                f"{path}: it says that it has {int(count)} elements {kind.decode()}; simplify it"
            )
    for name in re.findall(rb"comment\s+TextureFile\s+([^\r\n]+)", head, re.IGNORECASE):
        file_inside(path.parent, name.decode("utf-8", "replace").strip(), str(path), "texture")


def _check_gltf(path: Path) -> None:
    """Check names and numbers of a glTF or GLB file; trimesh would omit pictures that it cannot read silently."""
    content = _gltf_json(path)
    if not isinstance(content, dict):
        raise InvalidInputError(f"{path}: it is no glTF; export it again")
    for kind in ("buffers", "images"):
        for number, part in enumerate(_list(content, kind, path)):
            uri = part.get("uri")
            if uri is None or (isinstance(uri, str) and uri.startswith("data:")):
                continue
            where = f"{path}: {kind}[{number}]"
            if not isinstance(uri, str):
                raise InvalidInputError(f"{where}: uri is {uri!r}; expected the name of a file")
            name = uri if (path.parent / uri).is_file() else unquote(uri)
            file = file_inside(path.parent, name, where, kind[:-1])
            if kind == "images":
                _check_picture_file(file, where)
    accessors = _list(content, "accessors", path)
    counts = [
        _count(part.get("count", 0), f"{path}: accessors[{k}].count") for k, part in enumerate(accessors)
    ]
    if sum(counts) > _MAX_NUMBERS:
        raise InvalidInputError(
            f"{path}: its arrays have {sum(counts)} elements; at most {_MAX_NUMBERS} are read"
        )
    _check_nodes(content, counts, path)


def _check_nodes(content: Mapping[str, Any], counts: list[int], path: Path) -> None:
    """Check that nodes form a tree, and how many triangles they show: a mesh may be shown many times."""
    meshes, nodes = _list(content, "meshes", path), _list(content, "nodes", path)
    corners = []
    for mesh in meshes:
        parts = [part for part in mesh.get("primitives") or () if isinstance(part, dict)]
        used = [part.get("indices", (part.get("attributes") or {}).get("POSITION")) for part in parts]
        corners.append(sum(counts[k] for k in used if isinstance(k, int) and 0 <= k < len(counts)))
    children = [child for node in nodes for child in node.get("children") or ()]
    if len(nodes) > _MAX_NODES or len(children) != len(set(map(str, children))):
        raise InvalidInputError(f"{path}: its nodes are no tree, or more than {_MAX_NODES}; export it again")
    shown = [node.get("mesh") for node in nodes]
    total = sum(corners[k] for k in shown if isinstance(k, int) and 0 <= k < len(corners))
    check_faces(total // 3, str(path))


def _gltf_json(path: Path) -> Any:
    with path.open("rb") as file:
        head = file.read(20) if path.suffix.lower() == ".glb" else b""
        size = _MAX_JSON + 1
        if head:
            magic, _, _, size, kind = struct.unpack("<5I", head) if len(head) == 20 else (0,) * 5
            if magic != _GLB or kind != _JSON_CHUNK:
                raise InvalidInputError(f"{path}: it is no GLB file; export it again")
        data = file.read(min(size, _MAX_JSON + 1))
    if len(data) > _MAX_JSON:
        raise InvalidInputError(
            f"{path}: its description is larger than {_MAX_JSON >> 20} MiB; export it as GLB"
        )
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InvalidInputError(f"{path}: it is no glTF ({error}); export it again") from error


def _list(content: Mapping[str, Any], kind: str, path: Path) -> list[dict[str, Any]]:
    found = content.get(kind, [])
    if not isinstance(found, list) or not all(isinstance(part, dict) for part in found):
        raise InvalidInputError(f"{path}: {kind} is no list of objects; export it again")
    return found


def _count(value: Any, where: str) -> int:
    return int(validate(Count, value, prefix=(where,)))


def check_finite(vertices: np.ndarray, path: Path) -> None:
    """Check the vertices of a mesh.

    Raises:
        InvalidInputError: Some are not finite, or beyond 1e9.
    """
    if not (np.abs(vertices) <= _FARTHEST).all():
        raise InvalidInputError(f"{path}: it has vertices that are not finite, or beyond 1e9; fix the mesh")
