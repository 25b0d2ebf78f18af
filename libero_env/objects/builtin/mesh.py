"""Small textured triangle meshes: lofts along a vertical axis, sweeps, boxes, and what is made of them.

All shapes are in the rest frame: z up, the front towards +x, metres. Texture coordinates are (u, v)
with v = 0 at the lower edge of the texture; around a loft, u runs from the back (0) over -y (0.25), the
front (0.5) and +y (0.75) to the back again (1).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from libero_env.geometry import quat_to_mat
from libero_env.mujoco_compat import mujoco
from libero_env.objects.builtin.paint import Cell

CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, 1))
SPARE = (0.0, 0.94, 1.0, 0.99)  # part of a vessel's texture that only its handle shows
_CREASE = np.radians(50.0)  # angle from which an edge of a vessel's profile is sharp


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

    def rotated(self, quat: Sequence[float] | np.ndarray) -> "Mesh":
        """Return the mesh rotated by a quaternion, (4,) wxyz."""
        return Mesh(self.vertices @ quat_to_mat(np.asarray(quat, float)).T, self.faces, self.texcoords)

    def add_to(self, spec: mujoco.MjSpec, name: str) -> mujoco.MjsMesh:
        """Add the mesh to a spec, with the inertia of a shell, and return it there."""
        added = spec.add_mesh(name=name, uservert=self.vertices.ravel(), userface=self.faces.ravel())
        added.usertexcoord, added.inertia = self.texcoords.ravel(), mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        return added

    def moved(self, offset: Sequence[float] | np.ndarray) -> "Mesh":
        """Return the mesh moved by an offset, (3,) [m]."""
        return Mesh(self.vertices + np.asarray(offset), self.faces, self.texcoords)


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


def loft(rings: Sequence[Ring], segments: int, center: Sequence[float] = (0.0, 0.0)) -> Mesh:
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


def box(half: Sequence[float], center: Sequence[float], cells: Mapping[str, Cell] | Cell) -> Mesh:
    """Return a box whose faces show rectangles of the texture, or all the same one.

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
        corners = [np.add(normal, np.add(np.multiply(s, right), np.multiply(t, up))) for s, t in CORNERS]
        cell = cells[face] if isinstance(cells, Mapping) else cells
        quads.append(quad([np.add(center, np.multiply(half, corner)) for corner in corners], cell))
    return merge(quads)


def quad(corners: Sequence[Sequence[float] | np.ndarray], cell: Cell) -> Mesh:
    """Return a quadrilateral, corners counter-clockwise from the lower left, with (u0, v0, u1, v1) of the texture."""
    u0, v0, u1, v1 = cell
    texcoords = np.array([(u0, v0), (u1, v0), (u1, v1), (u0, v1)], float)
    return Mesh(np.array(corners, float), np.array([(0, 1, 2), (0, 2, 3)]), texcoords)


def sweep(
    *points: Sequence[float], cell: Cell = SPARE, segments: int = 8, round: float = 2.0, x: float = 0.0
) -> Mesh:
    """Return the surface along a path in a plane of constant x, for handles and cutlery.

    Args:
        points: Points of the centre line with half extents of the section, (n, 4) [m]: y, z, along x, in the plane.
        cell: Bounds (u0, v0, u1, v1) in the texture; u runs around, v along the path.
        segments: Number of vertices of a section.
        round: Exponent of the section's superellipse, as in `Ring`.
        x: Position of the plane, [m].
    """
    path, half = np.array([(x, y, z) for y, z, _, _ in points], float), [point[2:] for point in points]
    normal, (u0, v0, u1, v1) = np.array([1.0, 0.0, 0.0]), cell
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    length = path_lengths(path)
    rows, coords = [], []
    last = len(path) - 1
    for index, size in [(0, 0.0), (0, 1.0), *((i, 1.0) for i in range(last + 1)), (last, 1.0), (last, 0.0)]:
        ring = Ring(0.0, size * half[index][0], size * half[index][1], 0.0, round)
        section, texcoords = _section(ring, segments, (0.0, 0.0))
        inwards = np.cross(along[index], normal)
        rows.append(path[index] + section[:, :1] * normal + section[:, 1:2] * inwards)
        v = v0 + (v1 - v0) * length[index] / length[-1]
        coords.append(np.column_stack([u0 + (u1 - u0) * texcoords[:, 0], np.full(segments + 1, v)]))
    bands = [(0, 1), *((i, i + 1) for i in range(2, last + 2)), (last + 3, last + 4)]
    faces = np.concatenate([_band(low, high, segments) for low, high in bands])
    vertices = np.concatenate(rows)
    return Mesh(vertices, _without_degenerate(vertices, faces), np.concatenate(coords))


def vessel(
    outside: Sequence[Sequence[float]],
    inside: Sequence[Sequence[float]],
    *,
    segments: int = 28,
    center: Sequence[float] = (0.0, 0.0),
) -> Mesh:
    """Return the surface of a vessel with a wall: a bowl, a cup, a pan.

    In the texture, v is the share of the length of the profile: the outside from the centre of the foot (0)
    to the rim (0.44), the inside from the rim (0.46) to the centre of the floor (0.90). u is 0 at the
    back and 1 at the front, so that both sides show the same.

    Args:
        outside: Profile of the outside, points (radius, height) from the axis at the bottom to the rim, [m].
        inside: Profile of the inside, from the rim to the axis on the floor.
        segments: Number of vertices around the axis.
        center: Position (x, y) of the axis, [m].
    """
    points, out, back = np.array([*outside, *inside], float), path_lengths(outside), path_lengths(inside)
    v = np.concatenate([0.44 * out / out[-1], 0.46 + (0.90 - 0.46) * back / back[-1]])
    steps = np.diff(points, axis=0)
    turn = np.abs(np.diff(np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))))
    creases = [False, *(turn > _CREASE), False]
    rings = [Ring(z, r, r, at, crease=edge) for (r, z), at, edge in zip(points, v, creases, strict=True)]
    return _seamless(loft(rings, segments, center), segments)


def bottle(
    body: Sequence[Sequence[float]], cap: Sequence[Sequence[float]], *, center: Sequence[float] = (0.0, 0.0)
) -> Mesh:
    """Return a bottle: sections (height, half depth, half width) of its body and of its cap, [m]."""
    bottom, shoulder, top = body[0][0], body[-1][0], cap[-1][0]
    rings = [Ring(bottom, 0.0, 0.0, 0.0), Ring(bottom, body[0][1], body[0][2], 0.01, round=2.4, crease=True)]
    for height, depth, width in body[1:]:
        v = (0.80 - 0.01) * (height - bottom) / (shoulder - bottom)
        rings.append(Ring(height, depth, width, v, round=2.4))
    for height, depth, width in cap:
        v = 0.80 + 0.01 + 0.13 * (height - shoulder) / (top - shoulder)
        rings.append(Ring(height, depth, width, v, crease=True))
    rings.append(Ring(top, 0.0, 0.0, 0.96))
    return loft(rings, segments=16, center=center)


def tin(bottom: float, top: float, radius: float) -> Mesh:
    """Return a tin with rims; heights and radius in metres."""
    profile = [  # height, radius, v, sharp edge
        (bottom + 0.001, 0.0, 0.00, False),
        (bottom, radius - 0.001, 0.02, True),
        (bottom + 0.001, radius + 0.0008, 0.04, False),
        (bottom + 0.004, radius, 0.10, True),
        (top - 0.004, radius, 0.80, True),
        (top - 0.001, radius + 0.0010, 0.84, False),
        (top, radius, 0.88, True),
        (top - 0.0025, radius - 0.0030, 0.91, True),
        (top - 0.0020, 0.0, 0.98, False),
    ]
    return loft([Ring(z, r, r, v, crease=crease) for z, r, v, crease in profile], segments=18)


def packet(
    half: Sequence[float], center: Sequence[float] = (0.0, 0.0, 0.0), *, upright: bool = False
) -> Mesh:
    """Return a packet that lies or, `upright`, stands; its large faces show the left half of the picture."""
    faces, sides, ends = ("front", "back"), ("left", "right"), ("top", "bottom")
    large = (0.0, 0.0, 0.5, 1.0)
    if upright:
        cells = {**dict.fromkeys(faces, large), **dict.fromkeys(sides, (0.5, 0.0, 0.7, 1.0))}
        cells |= {"top": (0.7, 0.8, 1.0, 1.0), "bottom": (0.7, 0.0, 1.0, 0.2)}
    else:
        cells = {**dict.fromkeys(ends, large), **dict.fromkeys(sides, (0.5, 0.8, 1.0, 1.0))}
        cells |= dict.fromkeys(faces, (0.5, 0.5, 1.0, 0.75))
    return box(half, center, cells)


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


def path_lengths(points: Sequence[Sequence[float]] | np.ndarray) -> np.ndarray:
    """Return the length of a path up to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def _seamless(mesh: Mesh, segments: int) -> Mesh:
    """Return a loft whose vertices at the texture's seam are merged, so that shading is continuous there.

    The texture then covers each half, mirrored: u is 0 at the former seam and 1 opposite to it.
    """
    row, column = np.divmod(np.arange(len(mesh.vertices)), segments + 1)
    index = row * segments + column % segments
    inner = column < segments
    texcoords = mesh.texcoords[inner] * 1.0
    texcoords[:, 0] = 1.0 - np.abs(2.0 * texcoords[:, 0] - 1.0)
    return Mesh(mesh.vertices[inner], index[mesh.faces], texcoords)


def _section(ring: Ring, segments: int, center: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    # The column of the seam exists twice: u = 0 and u = 1.
    u = np.linspace(0.0, 1.0, segments + 1)
    angle = 2.0 * np.pi * (u - 0.5)
    bend = 2.0 / ring.round
    # Rounded: a fractional power would make the rounding error of sin(pi) visible.
    cosine, sine = np.round(np.cos(angle), 12), np.round(np.sin(angle), 12)
    x = np.sign(cosine) * np.abs(cosine) ** bend * ring.depth + center[0]
    y = np.sign(sine) * np.abs(sine) ** bend * ring.width + center[1]
    return (np.column_stack([x, y, np.full_like(u, ring.z)]), np.column_stack([u, np.full_like(u, ring.v)]))


def _band(low: int, high: int, segments: int) -> np.ndarray:
    start, column = segments + 1, np.arange(segments)
    a, b = low * start + column, high * start + column
    return np.concatenate([np.column_stack([a, a + 1, b + 1]), np.column_stack([a, b + 1, b])])


def _without_degenerate(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return faces[np.linalg.norm(normal, axis=1) > 1e-12]
