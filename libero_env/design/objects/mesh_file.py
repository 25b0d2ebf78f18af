"""Reading of mesh files (OBJ, GLB, glTF, STL, PLY) as surfaces: upright, in metres, centred at the origin."""

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import log
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from libero_env.design.objects.mesh_gate import Folder, check_finite, check_mesh_file, check_picture
from libero_env.errors import InvalidInputError
from libero_env.objects.references import check_faces

FORMATS = (".obj", ".glb", ".gltf", ".stl", ".ply")
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
        rgba: Colour, in [0, 1]; white where there is a texture.
    """

    vertices: np.ndarray
    faces: np.ndarray
    texcoords: np.ndarray | None = None
    image: Image.Image | None = None
    rgba: tuple[float, ...] = _GREY


def read_mesh(path: Path, *, size: float | None, up: str | None, notify: Notify) -> list[Surface]:
    """Return the surfaces of a mesh file, z up, the origin at the centre of their bounds.

    Args:
        path: File to read.
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
    check_mesh_file(path)
    parts = _parts(path)
    check_faces(sum(len(part.faces) for part in parts), str(path))
    surfaces = [_surface(part, path) for part in parts]
    if not surfaces:
        raise InvalidInputError(f"{path}: it contains no triangles; export the object as a mesh")
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


def merge_vertices(surfaces: list[Surface]) -> tuple[np.ndarray, np.ndarray]:
    """Return all surfaces as one mesh, (n, 3) and (f, 3); vertices at the same position are merged, also at seams."""
    starts = np.cumsum([0, *(len(s.vertices) for s in surfaces)])
    points = np.concatenate([s.vertices for s in surfaces])
    faces = np.concatenate([s.faces + start for s, start in zip(surfaces, starts, strict=False)])
    grain = 1e-5 * np.ptp(points, axis=0).max()
    _, first, where = np.unique(np.round(points / grain), axis=0, return_index=True, return_inverse=True)
    faces = where.reshape(-1)[faces]
    return points[first], faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]


def is_closed(faces: np.ndarray) -> bool:
    """Return whether every edge of the triangles (f, 3) belongs to two triangles of consistent orientation."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    base = int(edges.max(initial=0)) + 1  # an edge as one number, which sorts faster than two
    there, back = np.unique(edges @ (base, 1)), np.unique(edges @ (1, base))
    return len(there) == len(edges) and np.array_equal(there, back)


def signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the volume of a closed mesh, [m^3]; it is negative if the mesh is inside out."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def _parts(path: Path) -> list[Any]:
    """Return the meshes of a file as trimesh reads them, transformed into the frame of the scene."""
    import trimesh

    try:
        found = trimesh.load(str(path), resolver=Folder(path), force="scene").dump()
    except Exception as error:  # noqa: BLE001 - readers of formats raise errors of many types
        if isinstance(error, InvalidInputError):
            raise
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InvalidInputError(f"{path}: it cannot be read ({reason}); export it again") from error
    return [part for part in found if len(getattr(part, "faces", ()))]


def _surface(part: Any, path: Path) -> Surface:
    vertices, faces = np.array(part.vertices, float), np.array(part.faces, np.int64)
    check_finite(vertices, path)
    if not 0 <= faces.min() <= faces.max() < len(vertices):
        raise InvalidInputError(f"{path}: a triangle names a vertex that it does not have; export it again")
    material = getattr(part.visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    texcoords = getattr(part.visual, "uv", None)
    if image is not None and texcoords is not None:
        points = np.array(texcoords, float)[:, :2]
        check_finite(points, path)
        if len(points) != len(vertices):
            raise InvalidInputError(
                f"{path}: {len(vertices)} vertices have {len(points)} texture coordinates"
            )
        return Surface(vertices, faces, points, _picture(image, path), (1.0,) * 4)
    known = getattr(part.visual, "defined", False) or material is not None
    colour = getattr(material if material is not None else part.visual, "main_color", None) if known else None
    rgba = _GREY if colour is None else tuple(round(float(value) / 255, 4) for value in colour)
    return Surface(vertices, faces, rgba=rgba)


def _picture(image: Image.Image, path: Path) -> Image.Image:
    check_picture(image, str(path))
    try:
        return image.convert("RGB")
    except (OSError, SyntaxError, ValueError, struct.error, zlib.error) as error:
        raise InvalidInputError(f"{path}: a texture is damaged ({error}); save it again") from error


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
