"""Small textured triangle meshes: lofts along a vertical axis, and boxes.

All shapes are in the rest frame: z up, the front towards +x, metres. Texture coordinates are (u, v)
with v = 0 at the lower edge of the texture; around a loft, u runs from the back (0) over -y (0.25), the
front (0.5) and +y (0.75) to the back again (1).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from libero_env.geometry import quat_to_mat


@dataclass(frozen=True)
class Mesh:
    """Triangles with one texture coordinate per vertex.

    Attributes:
        vertices: Vertices, (n, 3) [m].
        faces: Vertex indices, (m, 3), counter-clockwise seen from outside.
        texcoords: Texture coordinates, (n, 2).
    """

    vertices: np.ndarray
    faces: np.ndarray
    texcoords: np.ndarray

    def rotated(self, quat: np.ndarray) -> "Mesh":
        """Return the mesh rotated by a quaternion, (4,) wxyz."""
        return Mesh(self.vertices @ quat_to_mat(np.asarray(quat, float)).T, self.faces, self.texcoords)


@dataclass(frozen=True)
class Ring:
    """One section of a loft: a superellipse in a horizontal plane.

    Attributes:
        z: Height, [m].
        depth: Half extent along x, [m].
        width: Half extent along y, [m].
        v: Texture coordinate of the section.
        round: Exponent: 2 is an ellipse, a larger one is closer to a rectangle.
        crease: Whether the surface has a sharp edge here.
    """

    z: float
    depth: float
    width: float
    v: float
    round: float = 2.0
    crease: bool = False


def loft(rings: Sequence[Ring], segments: int, center: tuple[float, float] = (0.0, 0.0)) -> Mesh:
    """Return the surface through sections from bottom to top (or inside to outside); ends of size 0 close it.

    Args:
        rings: Sections in order; the outside is to the right of the path when the axis is on the left.
        segments: Number of vertices of a section.
        center: Position (x, y) of the axis, [m].
    """
    rows: list[np.ndarray] = []
    coords: list[np.ndarray] = []
    quads: list[tuple[int, int]] = []
    for index, ring in enumerate(rings):
        if index:
            quads.append((len(rows) - 1, len(rows)))
        for _ in range(2 if ring.crease and 0 < index < len(rings) - 1 else 1):
            points, texcoords = _section(ring, segments, center)
            rows.append(points)
            coords.append(texcoords)
    faces = np.concatenate([_band(low, high, segments) for low, high in quads])
    vertices = np.concatenate(rows)
    return Mesh(vertices, _without_degenerate(vertices, faces), np.concatenate(coords))


def box(half: Sequence[float], center: Sequence[float], cells: Mapping[str, tuple[float, ...]]) -> Mesh:
    """Return a box whose faces show rectangles of the texture.

    Args:
        half: Half extents (x, y, z), [m].
        center: Centre (x, y, z), [m].
        cells: Face (front, back, left, right, top, bottom) -> (u0, v0, u1, v1); faces are seen from
            outside with z up, top and bottom with the front edge below; right is +y.
    """
    frames = {  # face -> (normal, to the right, upwards)
        "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        "back": ((-1, 0, 0), (0, -1, 0), (0, 0, 1)),
        "right": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
        "left": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
        "top": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
        "bottom": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    }
    quads = []
    for face, (normal, right, up) in frames.items():
        corners = [np.add(normal, np.add(np.multiply(s, right), np.multiply(t, up))) for s, t in _CORNERS]
        quads.append(quad([np.add(center, np.multiply(half, corner)) for corner in corners], cells[face]))
    return merge(quads)


def quad(corners: Sequence[Sequence[float] | np.ndarray], cell: tuple[float, ...]) -> Mesh:
    """Return a quadrilateral, corners counter-clockwise from the lower left, with (u0, v0, u1, v1) of the texture."""
    u0, v0, u1, v1 = cell
    texcoords = np.array([(u0, v0), (u1, v0), (u1, v1), (u0, v1)], float)
    return Mesh(np.array(corners, float), np.array([(0, 1, 2), (0, 2, 3)]), texcoords)


def sweep(
    path: Sequence[Sequence[float]],
    half: Sequence[Sequence[float]],
    across: Sequence[float],
    segments: int,
    cell: tuple[float, ...],
    round: float = 2.0,
) -> Mesh:
    """Return the surface along a path in a plane, for handles and cutlery.

    Args:
        path: Points of the centre line, (n, 3) [m].
        half: Half extents of the section at each point, (n, 2) [m]: along `across`, and in the plane.
        across: Unit normal of the plane, (3,).
        segments: Number of vertices of a section.
        cell: Bounds (u0, v0, u1, v1) in the texture; u runs around, v along the path.
        round: Exponent of the section's superellipse, as in `Ring`.
    """
    points, normal, (u0, v0, u1, v1) = np.asarray(path, float), np.asarray(across, float), cell
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    rows, coords = [], []

    def add(index: int, size: float) -> None:
        ring = Ring(0.0, size * half[index][0], size * half[index][1], 0.0, round)
        section, texcoords = _section(ring, segments, (0.0, 0.0))
        inwards = np.cross(along[index], normal)
        rows.append(points[index] + section[:, :1] * normal + section[:, 1:2] * inwards)
        v = v0 + (v1 - v0) * length[index] / length[-1]
        coords.append(np.column_stack([u0 + (u1 - u0) * texcoords[:, 0], np.full(segments + 1, v)]))

    last = len(points) - 1
    for index, size in [(0, 0.0), (0, 1.0), *((i, 1.0) for i in range(last + 1)), (last, 1.0), (last, 0.0)]:
        add(index, size)
    bands = [(0, 1), *((i, i + 1) for i in range(2, last + 2)), (last + 3, last + 4)]
    faces = np.concatenate([_band(low, high, segments) for low, high in bands])
    vertices = np.concatenate(rows)
    return Mesh(vertices, _without_degenerate(vertices, faces), np.concatenate(coords))


def seamless(mesh: Mesh, segments: int) -> Mesh:
    """Return a loft or sweep whose vertices at the texture's seam are merged, so that shading is continuous there.

    The texture then covers each half, mirrored: u is 0 at the former seam and 1 opposite to it.
    """
    row, column = np.divmod(np.arange(len(mesh.vertices)), segments + 1)
    index = row * segments + column % segments
    kept = column < segments
    texcoords = mesh.texcoords[kept] * 1.0
    texcoords[:, 0] = 1.0 - np.abs(2.0 * texcoords[:, 0] - 1.0)
    return Mesh(mesh.vertices[kept], index[mesh.faces], texcoords)


def faceted(mesh: Mesh) -> Mesh:
    """Return the mesh with flat shading: no two triangles share a vertex."""
    corners = mesh.faces.ravel()
    return Mesh(mesh.vertices[corners], np.arange(len(corners)).reshape(-1, 3), mesh.texcoords[corners])


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """Return all triangles in one mesh."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]),
        np.concatenate([mesh.texcoords for mesh in meshes]),
    )


_CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, 1))


def _section(ring: Ring, segments: int, center: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    # The column of the seam exists twice: u = 0 and u = 1.
    u = np.linspace(0.0, 1.0, segments + 1)
    angle = 2.0 * np.pi * (u - 0.5)
    bend = 2.0 / ring.round
    # Rounded: a fractional power would make the rounding error of sin(pi) visible.
    cosine, sine = np.round(np.cos(angle), 12), np.round(np.sin(angle), 12)
    x = np.sign(cosine) * np.abs(cosine) ** bend * ring.depth + center[0]
    y = np.sign(sine) * np.abs(sine) ** bend * ring.width + center[1]
    return (
        np.column_stack([x, y, np.full_like(u, ring.z)]),
        np.column_stack([u, np.full_like(u, ring.v)]),
    )


def _band(low: int, high: int, segments: int) -> np.ndarray:
    start, column = segments + 1, np.arange(segments)
    a, b = low * start + column, high * start + column
    return np.concatenate([np.column_stack([a, a + 1, b + 1]), np.column_stack([a, b + 1, b])])


def _without_degenerate(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return faces[np.linalg.norm(normal, axis=1) > 1e-12]
