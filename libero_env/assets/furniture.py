"""Furniture of the builtin pack: the pieces that a file lists become one mesh and one small palette texture.

A whole room is one geom, so that rendering it costs one draw call.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any

import mujoco
import numpy as np

from libero_env.assets.styles import add_texture
from libero_env.objects.builtin.mesh import Mesh, Ring, box, loft, merge, quad
from libero_env.storage import read_yaml

_CELLS = 8  # colours along a side of the palette
_CELL_PIXELS = 8  # side of a colour's square
_FACES = ("front", "back", "left", "right", "top", "bottom")
_COVERS = ("red", "navy", "teal", "cream", "yellow", "black", "orange", "white", "walnut")  # colours of books


def add_furniture(spec: mujoco.MjSpec, sets: tuple[str, ...]) -> None:
    """Add sets of furniture, such as `kitchen`, as one geom without collisions."""
    if sets:
        add_visual_mesh(spec, spec.worldbody, "furniture", furniture(sets))


def add_visual_mesh(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, mesh: Mesh, material: str | None = None
) -> None:
    """Add a mesh to a body as a geom without collisions.

    Args:
        spec: Scene to extend.
        body: Body that carries the geom.
        name: Name of the mesh and the geom.
        mesh: Mesh in the frame of the body, [m].
        material: Name of its material; None adds one with the furniture's palette.
    """
    if material is None:
        material = f"{name}_colours"
        added = spec.add_material(name=material, specular=0.1, shininess=0.1)
        add_texture(spec, added, palette_texture())
    added = spec.add_mesh(
        name=name,
        uservert=mesh.vertices.ravel(),
        userface=mesh.faces.ravel(),
        usertexcoord=mesh.texcoords.ravel(),
    )
    added.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=name,
        material=material,
        group=1,
        contype=0,
        conaffinity=0,
        mass=0.0,
    )


@cache
def furniture(sets: tuple[str, ...]) -> Mesh:
    """Return all pieces of the given sets as one mesh in the world frame."""
    return merge([shape for name in sets for piece in _read_furniture()[name] for shape in _shapes(piece)])


def palette_texture() -> np.ndarray:
    """Return the palette texture, one square for each colour, (64, 64, 3) uint8."""
    cells = np.zeros((_CELLS * _CELLS, 3))
    colours = list(_read_furniture()["palette"].values())
    cells[: len(colours)] = colours
    image = cells.reshape(_CELLS, _CELLS, 3).repeat(_CELL_PIXELS, 0).repeat(_CELL_PIXELS, 1)
    return np.clip(image * 255, 0, 255).astype(np.uint8)


def _shapes(piece: Mapping[str, Any]) -> Iterator[Mesh]:
    times, *step = piece.get("repeat", [1, 0.0, 0.0, 0.0])
    for i in range(times):
        for shape in _shape(piece):
            yield Mesh(shape.vertices + np.multiply(step, i), shape.faces, shape.texcoords)


def _shape(piece: Mapping[str, Any]) -> list[Mesh]:
    if "books" in piece:
        return _books(piece["books"], piece["count"])
    if "leaves" in piece:
        return _leaves(piece)
    return [_painted(solid_mesh(piece), piece["in"])]


def solid_mesh(piece: Mapping[str, Any]) -> Mesh:
    """Return the mesh of a `box` between two corners, or of a `round`: a stack of ellipses or rounded rectangles."""
    if "box" in piece:
        low, high = np.array(piece["box"][:3]), np.array(piece["box"][3:])
        return box((high - low) / 2, (high + low) / 2, dict.fromkeys(_FACES, (0.0, 0.0, 1.0, 1.0)))
    corner = piece.get("corner", 2.0)
    rings = [Ring(z, rx, ry, z, corner, crease=True) for z, rx, ry in piece["round"]]
    return loft(rings, piece.get("sides", 16), tuple(piece["at"]))


def _books(bounds: Sequence[float], count: int) -> list[Mesh]:
    """Return a row of books along y with heights and thicknesses that vary, the same at each call."""
    x0, y0, z0, x1, y1, z1 = bounds
    rng = np.random.default_rng(count)
    widths = rng.uniform(0.6, 1.4, count)
    edges = y0 + (y1 - y0) * np.concatenate([[0.0], np.cumsum(widths) / widths.sum()])
    tops = z0 + (z1 - z0) * rng.uniform(0.75, 1.0, count)
    fronts = x1 - rng.uniform(0.0, 0.03, count)
    return [
        _painted(
            solid_mesh({"box": (x0, left, z0, front, right - 0.004, top)}), _COVERS[i * 4 % len(_COVERS)]
        )
        for i, (left, right, top, front) in enumerate(zip(edges[:-1], edges[1:], tops, fronts, strict=True))
    ]


def _leaves(piece: Mapping[str, Any]) -> list[Mesh]:
    """Return blades that rise and bend outwards, visible from both sides, the same at each call."""
    at, rng = np.array(piece["at"]), np.random.default_rng(piece["leaves"])
    blades = []
    for i in range(piece["leaves"]):
        angle = 2.4 * i  # golden angle
        out = np.array([np.cos(angle), np.sin(angle), 0.0]) * piece["reach"] * rng.uniform(0.6, 1.0)
        up = np.array([0.0, 0.0, piece["rise"]]) * rng.uniform(0.5, 1.0)
        side = np.array([-np.sin(angle), np.cos(angle), 0.0]) * 0.025
        root, middle, tip = at, at + 0.5 * out + 0.8 * up, at + out + 0.7 * up
        for low, high in ((root, middle), (middle, tip)):
            wide, narrow = (0.5, 1.0) if low is root else (1.0, 0.1)
            corners = [low - wide * side, low + wide * side, high + narrow * side, high - narrow * side]
            blades += [quad(order, _cell(piece["in"]) * 2) for order in (corners, corners[::-1])]
    return blades


def _painted(mesh: Mesh, colour: str) -> Mesh:
    return Mesh(mesh.vertices, mesh.faces, np.tile(_cell(colour), (len(mesh.vertices), 1)))


def _cell(colour: str) -> tuple[float, float]:
    """Return (u, v) of the centre of a colour's square."""
    row, column = divmod(list(_read_furniture()["palette"]).index(colour), _CELLS)
    return (column + 0.5) / _CELLS, (row + 0.5) / _CELLS


@cache
def _read_furniture() -> Mapping[str, Any]:
    return read_yaml("assets/workspaces/furniture.yaml")
