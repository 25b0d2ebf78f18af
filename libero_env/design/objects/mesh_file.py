"""Reading of mesh files (OBJ, GLB, glTF, STL, PLY) as surfaces: upright, in metres, centred at the origin."""

import json
import os
import shlex
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import log
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from PIL import Image

from libero_env.errors import InvalidInputError
from libero_env.limited import call_limited
from libero_env.objects.mjcf import check_size, file_inside
from libero_env.text import shown

FORMATS = (".obj", ".glb", ".gltf", ".stl", ".ply")
MAX_FACES = 1_000_000
PICTURES = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF", "GIF")  # formats of textures
_FARTHEST = 1e9  # of a vertex
_Y_UP = (".glb", ".gltf")  # formats whose specification says so
_UNITS = {"centimetres": 0.01, "millimetres": 0.001}
_PLAUSIBLE_METRES = (0.01, 0.6)  # longest side of files that are assumed to be in metres
_TYPICAL = 0.1  # [m] longest side that a guess of the unit should give
_GREY = (0.7, 0.7, 0.7, 1.0)

Notify = Callable[[str], None]


@dataclass(frozen=True)
class Surface:
    """A part of an object that has one material.

    Attributes:
        vertices: Vertices, (n, 3) [m].
        faces: Vertex indices, (f, 3).
        texcoords: Texture coordinates, (n, 2), v = 0 at the lower edge of the image; None for a plain colour.
        image: Texture; None for a plain colour.
        rgba: Colour, in [0, 1], by which a texture is multiplied.
    """

    vertices: np.ndarray
    faces: np.ndarray
    texcoords: np.ndarray | None = None
    image: Image.Image | None = None
    rgba: tuple[float, ...] = _GREY


def read_mesh(path: Path, *, size: float | None, up: str | None, notify: Notify) -> list[Surface]:
    """Return the surfaces of a mesh file, z up, the origin at the centre of their bounds.

    Args:
        size: Desired longest side, [m]; None keeps that of the file, whose unit is guessed.
        up: Axis of the file that points up, `z` or `y`; None is the convention of the format.
        notify: Function that receives a message about each assumption.

    Raises:
        InvalidInputError: The format is not supported, there are no triangles, too many or broken ones, or a texture is
            missing or elsewhere; the message names the file.
    """
    if path.suffix.lower() not in FORMATS:
        raise InvalidInputError(
            f"{path}: unknown format {path.suffix!r}; valid: .xml (MJCF), {', '.join(FORMATS)}"
        )
    if not path.is_file():
        raise InvalidInputError(f"{path}: no such file")
    check_size(path, str(path))
    surfaces = call_limited(load_surfaces, path, about=str(path))
    if up is None:
        up = "y" if path.suffix.lower() in _Y_UP else "z"
    if up == "y":
        surfaces = [replace(s, vertices=s.vertices[:, [0, 2, 1]] * (1, -1, 1)) for s in surfaces]
    low, high = bounds(surfaces)
    if not min(high - low) > 1e-4 * max(high - low):
        raise InvalidInputError(f"{path}: it is flat and cannot be grasped; give it a thickness")
    scale = size / max(high - low) if size else _unit(float(max(high - low)), path, notify)
    centre = (low + high) / 2
    return [replace(s, vertices=(s.vertices - centre) * scale) for s in surfaces]


def bounds(surfaces: list[Surface]) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest corner, (3,) and (3,)."""
    points = np.concatenate([s.vertices for s in surfaces])
    return points.min(axis=0), points.max(axis=0)


def load_surfaces(path: Path) -> list[Surface]:
    """Return the surfaces of a mesh file in its frame and unit, as trimesh reads them: call it with `call_limited`.

    Raises:
        InvalidInputError: There are no triangles, too many or broken ones, or a file that it names is missing, broken
            or outside of its folder.
    """
    import trimesh

    named = _NamedFiles(path)
    scene = trimesh.load(str(path), resolver=named, force="scene", process=False)
    if named.errors:  # trimesh omits materials and textures that it cannot read
        raise named.errors[0]
    if path.suffix.lower() in _Y_UP:
        _check_addresses(path)
    parts = [part for part in scene.dump() if len(getattr(part, "faces", ()))]
    if not parts:
        raise InvalidInputError(f"{path}: it contains no triangles; export the object as a mesh")
    if (count := sum(len(part.faces) for part in parts)) > MAX_FACES:
        raise InvalidInputError(f"{path}: it has {count} triangles; simplify it to {MAX_FACES} or fewer")
    return [_surface(part, path) for part in parts]


def _check_addresses(path: Path) -> None:
    """Raise an InvalidInputError if a picture of a glTF file has an address that is not text; trimesh omits it."""
    data = path.read_bytes()
    if data.startswith(b"glTF"):  # binary: the first chunk, whose length comes before it, is the JSON
        data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    for i, image in enumerate(json.loads(data).get("images", ())):
        if not isinstance(uri := image.get("uri", ""), str):
            raise InvalidInputError(f"{path}: images[{i}].uri is {shown(uri)}; expected the name of a file")


class _NamedFiles:
    """Access of trimesh to the files that a mesh file names: those in its folder or below.

    Attributes:
        file_name: Name of the mesh file.
        errors: Why files could not be read.
    """

    def __init__(self, path: Path):
        self.file_name = path.name
        self.errors: list[InvalidInputError] = []
        self._path = path

    def get(self, name: str) -> bytes:
        """Return the content of a file."""
        if name == "model.gltf":  # what trimesh asks for where the file is not JSON
            raise FileNotFoundError(name)
        folder, names = self._path.parent, [name.strip(), unquote(name.strip())]
        with suppress(ValueError, IndexError):
            names.append(shlex.split(names[-1])[-1])  # the name of a texture comes after its options
        try:
            known = next((one for one in names if os.path.isfile(folder / one.replace("\\", "/"))), names[-1])
            file = file_inside(folder, known, str(self._path))
            if file.suffix.lower() in Image.registered_extensions():
                with Image.open(file, formats=PICTURES) as image:
                    _picture(image, f"{self._path}: {file}")
        except InvalidInputError as error:
            self.errors.append(error)
            raise
        except (OSError, ValueError, Image.DecompressionBombError) as error:
            text = f"{self._path}: {file} is not a picture that can be read: {error}"
            self.errors.append(InvalidInputError(text))
            raise
        return file.read_bytes()

    __getitem__ = get

    def keys(self) -> tuple[str, ...]:
        """Return no names: files are only read by the name that the mesh file has."""
        return ()


def _surface(part: Any, path: Path) -> Surface:
    _check_finite(part.vertices, path)
    part.process()  # merges vertices; it would remove those that are not finite
    vertices, faces = np.array(part.vertices, float), np.array(part.faces, np.int64)
    if not len(faces) or not 0 <= faces.min() <= faces.max() < len(vertices):
        raise InvalidInputError(f"{path}: a triangle names a vertex that it does not have; export it again")
    material = getattr(part.visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    texcoords = getattr(part.visual, "uv", None)
    if image is not None and texcoords is not None:
        points = np.array(texcoords, float)[:, :2]
        _check_finite(points, path)
        if len(points) != len(vertices):
            raise InvalidInputError(
                f"{path}: {len(vertices)} vertices have {len(points)} texture coordinates"
            )
        factor = getattr(material, "baseColorFactor", None)  # of glTF, by which the texture is multiplied
        rgba = (1.0,) * 4 if factor is None else _rgba(factor)
        return Surface(vertices, faces, points, _picture(image, str(path)), rgba)
    known = getattr(part.visual, "defined", False) or material is not None
    colour = getattr(material if material is not None else part.visual, "main_color", None) if known else None
    return Surface(vertices, faces, rgba=_GREY if colour is None else _rgba(colour))


def _rgba(colour: Sequence[int]) -> tuple[float, ...]:
    return tuple(round(float(value) / 255, 4) for value in colour)


def _check_finite(points: np.ndarray, path: Path) -> None:
    if not (np.abs(points) <= _FARTHEST).all():
        raise InvalidInputError(f"{path}: it has vertices that are not finite, or beyond 1e9; fix the mesh")


def _picture(image: Image.Image, where: str) -> Image.Image:
    if image.format not in (None, *PICTURES):
        raise InvalidInputError(
            f"{where}: a texture is in the format {image.format}; valid: {', '.join(PICTURES)}"
        )
    try:
        return image.convert("RGB")
    except Exception as error:
        raise InvalidInputError(f"{where}: a texture is damaged ({error}); save it again") from error


def _unit(longest: float, path: Path, notify: Notify) -> float:
    """Return the length of one unit of the file, [m], guessed from its longest side."""
    if _PLAUSIBLE_METRES[0] <= longest <= _PLAUSIBLE_METRES[1]:
        return 1.0
    if longest < _PLAUSIBLE_METRES[0]:
        notify(f"{path.name} is {1000 * longest:.3g} mm long in metres; if that is wrong, give --size (m)")
        return 1.0
    name, unit = min(_UNITS.items(), key=lambda item: abs(log(longest * item[1] / _TYPICAL)))
    notify(
        f"{path.name} is {longest:.4g} units long: assuming {name}, it is {100 * longest * unit:.3g} cm; "
        "if that is wrong, give --size (m)"
    )
    return unit
