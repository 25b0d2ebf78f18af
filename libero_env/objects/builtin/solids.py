"""Parts of furniture: panels, bars, turned parts, each with a cell (u0, v0, u1, v1) of the texture. Metres, z up."""

from collections.abc import Mapping, Sequence
from itertools import combinations, product

import numpy as np

from libero_env.mujoco_compat import mujoco
from libero_env.objects.builtin.mesh import CORNERS, Mesh, Ring, loft, merge, path_lengths
from libero_env.objects.builtin.paint import Cell

_FACES = {  # face -> (to the right, upwards), seen from outside
    "x+": ((0, 1, 0), (0, 0, 1)),
    "x-": ((0, -1, 0), (0, 0, 1)),
    "y+": ((-1, 0, 0), (0, 0, 1)),
    "y-": ((1, 0, 0), (0, 0, 1)),
    "z+": ((1, 0, 0), (0, 1, 0)),
    "z-": ((1, 0, 0), (0, -1, 0)),
}


def block(
    low: Sequence[float],
    high: Sequence[float],
    cell: Cell,
    *,
    bevel: float = 0.0,
    faces: Mapping[str, Cell] | None = None,
) -> Mesh:
    """Return a box between two corners; each face shows the whole cell.

    Args:
        low: Corner, (3,) [m].
        high: Opposite corner, (3,) [m].
        cell: Part of the texture.
        bevel: Width of the chamfer along the edges, [m].
        faces: Face (`x+`, `x-`, ... `z-`) -> another part of the texture.
    """
    (bottom, top), cells = np.array([low, high], float), faces or {}
    center, half = 0.5 * (bottom + top), 0.5 * (top - bottom)
    inner = half - bevel
    pieces = []
    for face, (right, up) in _FACES.items():
        middle = np.cross(right, up) * half
        corners = [middle + s * np.multiply(right, inner) + t * np.multiply(up, inner) for s, t in CORNERS]
        pieces.append(_facet(corners, half, face, cells.get(face, cell)))
    for corners in _chamfers(half, inner) if bevel else ():
        # A chamfer continues the texture of the face that is nearest in orientation.
        pieces.append(_facet(corners, half, _face_of(corners, half), cell))
    return merge(pieces).moved(center)


def prism(outline: Sequence[Sequence[float]], low: float, high: float, cell: Cell) -> Mesh:
    """Return the prism from y = low to y = high of a convex outline (x, z), counter-clockwise seen from -y."""
    points = np.array(outline, float)
    near, far = (np.column_stack([points[:, 0], np.full(len(points), y), points[:, 1]]) for y in (low, high))
    corners = np.concatenate([near, far])
    center, half = 0.5 * (corners.min(axis=0) + corners.max(axis=0)), 0.5 * np.ptp(corners, axis=0)
    near, far = near - center, far - center
    pieces = [_facet(near, half, "y-", cell), _facet(far, half, "y+", cell)]
    for one, two in zip(range(len(points)), np.roll(range(len(points)), -1), strict=True):
        side = [near[one], far[one], far[two], near[two]]
        along = np.abs(points[two] - points[one])
        pieces.append(_facet(side, half, "z+" if along[0] > along[1] else "x+", cell))
    return merge(pieces).moved(center)


def turned(
    profile: Sequence[Sequence[float]],
    cell: Cell,
    *,
    base: Sequence[float] = (0.0, 0.0, 0.0),
    axis: Sequence[float] = (0.0, 0.0, 1.0),
    segments: int = 12,
    smooth: bool = False,
) -> Mesh:
    """Return a body of revolution.

    Args:
        profile: Points (height, radius) [m], upwards on the outside; the ends are connected to the axis.
        cell: Part of the texture; its height is the distance along the profile.
        base: Point of height 0, (3,) [m].
        axis: Unit vector of increasing height, (3,).
        segments: Number of corners around the axis.
        smooth: Whether to shade without edges.
    """
    points, way = outline_of(profile)
    rings = [Ring(z, r, r, v, crease=not smooth) for (z, r), v in zip(points, way, strict=True)]
    mesh, quat = loft(rings, segments), np.empty(4)
    mujoco.mju_quatZ2Vec(quat, np.asarray(axis, float))
    mesh = mesh.rotated(quat).moved(base)
    return Mesh(mesh.vertices, mesh.faces, _within(mesh.texcoords, cell))


def arch(length: float, height: float, thickness: float, half_width: float, cell: Cell) -> Mesh:
    """Return a bent board along y, of half length `length`, whose ends are on the floor."""
    y = np.linspace(-length, length, 9)
    top = height - (height - thickness) * np.abs(y / length) ** 1.5
    pieces = []
    for i in range(len(y) - 1):
        low = [(y[i], top[i] - thickness), (y[i + 1], top[i + 1] - thickness)]
        pieces.append(prism([*low, (y[i + 1], top[i + 1]), (y[i], top[i])], -half_width, half_width, cell))
    quarter = np.sqrt(0.5) * np.array([1.0, 0.0, 0.0, 1.0])  # the outline's x becomes y
    return merge(pieces).rotated(quarter)


def outline_of(profile: Sequence[Sequence[float]]) -> tuple[np.ndarray, np.ndarray]:
    """Return a profile closed at the axis, (n, 2), and the share of its length at each point, (n,) in [0, 1]."""
    points = np.array([(profile[0][0], 0.0), *profile, (profile[-1][0], 0.0)])
    way = path_lengths(points)
    return points, way / way[-1]


def bar(
    start: Sequence[float], end: Sequence[float], radius: float, cell: Cell, *, segments: int = 10, tip=None
) -> Mesh:
    """Return a round bar between two points, (3,) [m]; `tip` is the chamfer of its ends, by default radius / 5."""
    way = np.subtract(end, start)
    length = float(np.linalg.norm(way))
    tip = 0.2 * radius if tip is None else tip
    profile = [(0, radius - tip), (tip, radius), (length - tip, radius), (length, radius - tip)]
    return turned(profile, cell, base=start, axis=(way / length).tolist(), segments=segments)


def capsule(
    start: Sequence[float], end: Sequence[float], radius: float, cell: Cell, *, segments: int = 12
) -> Mesh:
    """Return a bar with hemispherical ends, whose centres are `start` and `end`, (3,) [m]."""
    way = np.subtract(end, start)
    length = float(np.linalg.norm(way))
    turns = np.radians((-65, -40, 0))
    dome = [(radius * np.sin(angle), radius * np.cos(angle)) for angle in turns]
    profile = [(-radius, 0), *dome, *((length - z, r) for z, r in reversed(dome)), (length + radius, 0)]
    return turned(profile, cell, base=start, axis=(way / length).tolist(), segments=segments, smooth=True)


def _chamfers(half: np.ndarray, inner: np.ndarray) -> list[list[np.ndarray]]:
    """Return the chamfers of the twelve edges and eight corners of a box around the origin."""
    outer, cuts = np.diag(half - inner), []
    for one, two in combinations(range(3), 2):
        third = 3 - one - two
        for s, t in CORNERS:
            sign = np.ones(3)
            sign[one], sign[two] = s, t
            back = sign.copy()
            sign[third], back[third] = 1.0, -1.0
            a, b = outer[one], outer[two]
            cuts.append([sign * (inner + a), back * (inner + a), back * (inner + b), sign * (inner + b)])
    for signs in product((-1.0, 1.0), repeat=3):
        cuts.append([np.array(signs) * (inner + step) for step in outer])
    return cuts


def _face_of(corners: Sequence[np.ndarray], half: np.ndarray) -> str:
    share = np.mean(corners, axis=0) / half
    axis = int(np.argmax(np.abs(share)))
    return "xyz"[axis] + ("+" if share[axis] > 0 else "-")


def _facet(corners: Sequence[np.ndarray], half: np.ndarray, face: str, cell: Cell) -> Mesh:
    """Return a convex polygon of a body around the origin, facing outwards, with the texture of a face of its box."""
    points = np.array(corners, float)
    (ax, ay, az), (bx, by, bz) = points[1] - points[0], points[2] - points[0]
    # ten times as fast as np.cross
    normal = np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
    if normal @ points.mean(axis=0) < 0:
        points = points[::-1]
    share = 0.5 + 0.5 * points @ np.transpose(_FACES[face]) / (np.abs(_FACES[face]) @ half)
    fan = np.array([(0, i, i + 1) for i in range(1, len(points) - 1)])
    return Mesh(points, fan, _within(share, cell))


def _within(share: np.ndarray, cell: Cell) -> np.ndarray:
    u0, v0, u1, v1 = cell
    return (u0, v0) + share * (u1 - u0, v1 - v0)
