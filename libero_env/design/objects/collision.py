"""What an object collides with: its convex hull, convex pieces of it, or boxes."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import permutations

import mujoco
import numpy as np

from libero_env.design.objects.mesh_file import Notify, is_closed, signed_volume
from libero_env.errors import LiberoError
from libero_env.geometry import quat_to_mat

METHODS = ("decompose", "hull", "boxes")
INSTALL = "pip install 'libero-lifelong[objects]'"
_CONCAVITY = 0.05  # of CoACD, what a piece may be off its hull
_MAX_PIECES = 24
_CONVEX = 0.95  # share of the hull that is filled by what counts as convex
_CELLS = 16  # of boxes, along the longest side
_MAX_BOXES = 60


@dataclass(frozen=True)
class Pieces:
    """Collision shapes in the object's frame.

    Attributes:
        method: How they were made.
        meshes: Convex, each (n, 3) vertices, metres.
        boxes: (k, 6) centre and half size, metres.
    """

    method: str
    meshes: tuple[np.ndarray, ...] = ()
    boxes: np.ndarray = field(default_factory=lambda: np.zeros((0, 6)))

    def __len__(self) -> int:
        return len(self.meshes) + len(self.boxes)


def collision_pieces(vertices: np.ndarray, faces: np.ndarray, method: str, notify: Notify) -> Pieces:
    """Collision shapes of a mesh.

    Args:
        vertices: (n, 3), metres, joined where they are at one place.
        faces: (f, 3).
        method: `hull`; `decompose`, by CoACD (Wei et al. 2022, Approximate Convex Decomposition for 3D Meshes with
            Collision-Aware Concavity and Tree Search); or `boxes`. A mesh that is convex anyway is its hull.
        notify: Takes a line where something else had to be done.

    Raises:
        LiberoError: There is no such method.
    """
    if method not in METHODS:
        raise LiberoError(f"collision {method!r}: valid are {', '.join(METHODS)}")
    filled = volume_filled(vertices, faces)
    if method == "hull" or (method == "decompose" and filled >= _CONVEX):
        return Pieces("hull", (vertices,))
    if method == "decompose":
        try:
            import coacd
        except ImportError:
            notify(
                f"CoACD is not installed, so that it collides as boxes; finer: {INSTALL}, and add it again"
            )
            return Pieces("boxes", boxes=boxes_of(vertices, faces))
        return Pieces("decompose", _decomposed(coacd, vertices, faces))
    return Pieces("boxes", boxes=boxes_of(vertices, faces))


def volume_filled(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Share of the convex hull that a mesh fills, 0..1; 0 where it is open and has no inside."""
    if not is_closed(faces):
        return 0.0
    return min(abs(signed_volume(vertices, faces)) / hull_mass(vertices, 1.0).volume, 1.0)


@dataclass(frozen=True)
class Mass:
    """Volume (m^3), centre (3,), and the inertia about it in the object's axes (xx, yy, zz, xy, xz, yz), kg m^2."""

    volume: float
    centre: np.ndarray
    inertia: np.ndarray


def hull_mass(vertices: np.ndarray, density: float) -> Mass:
    """Of the convex hull of points (n, 3), filled evenly with so many kg/m^3."""
    return _mass(vertices, None, density, mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)


def solid_mass(vertices: np.ndarray, faces: np.ndarray, density: float) -> Mass:
    """Of a closed mesh, filled evenly with so many kg/m^3."""
    if signed_volume(vertices, faces) < 0:
        faces = faces[:, ::-1]
    return _mass(vertices, faces, density, mujoco.mjtMeshInertia.mjMESH_INERTIA_EXACT)


def _mass(
    vertices: np.ndarray, faces: np.ndarray | None, density: float, kind: mujoco.mjtMeshInertia
) -> Mass:
    scale = 1.0 / np.ptp(vertices, axis=0).max()  # MuJoCo calls very small volumes none
    spec = mujoco.MjSpec()
    mesh = spec.add_mesh(name="mesh", uservert=(vertices * scale).ravel(), inertia=kind)
    if faces is not None:
        mesh.userface = faces.astype(np.int32).ravel()
    body = spec.worldbody.add_body(name="body")
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh", density=1.0)
    body.add_freejoint()
    try:
        model = spec.compile()
    except ValueError as error:
        raise LiberoError(f"the mesh has no inside that could weigh something ({error}); mend it") from error
    index = model.body("body").id
    axes = quat_to_mat(model.body_iquat[index])
    inertia = density / scale**5 * axes @ np.diag(model.body_inertia[index]) @ axes.T
    order = ([0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2])
    return Mass(float(model.body_mass[index] / scale**3), model.body_ipos[index] / scale, inertia[order])


def _decomposed(coacd, vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, ...]:
    coacd.set_log_level("error")
    scale = 1.0 / np.ptp(vertices, axis=0).max()
    parts = coacd.run_coacd(
        coacd.Mesh(vertices * scale, faces.astype(np.int32)),
        threshold=_CONCAVITY,
        max_convex_hull=_MAX_PIECES,
        max_ch_vertex=64,
        decimate=True,
        seed=0,
    )
    return tuple(np.asarray(points) / scale for points, _ in parts)


def boxes_of(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Boxes that cover a mesh: cells of a grid, joined as far as they can be; (k, 6) centre, half size, m.

    Walls that are thinner than a cell are as thick as one; a mesh that is open has walls only.
    """
    low, extent = vertices.min(axis=0), np.ptp(vertices, axis=0)
    cells = _CELLS
    while True:
        count = np.maximum(np.round(extent / extent.max() * cells), 1).astype(int)
        filled = _walls(vertices, faces, low, extent, count)
        if is_closed(faces):
            filled |= _inside(vertices, faces, low, extent, count)
        found = list(_joined(filled))
        if len(found) <= _MAX_BOXES or cells <= 6:
            break
        cells -= 2
    step = extent / count
    return np.array([[*(low + step * (a + b) / 2), *(step * (b - a) / 2)] for a, b in found])


def _walls(vertices, faces, low, extent, count) -> np.ndarray:
    """Cells that the surface goes through, by points on it a third of a cell apart."""
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.clip(np.ceil(3 * longest / (extent / count).min()), 1, 64).astype(int)
    filled = np.zeros(count, bool)
    for n in np.unique(steps):
        grid = np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]) / n
        points = (grid @ corners[steps == n]).reshape(-1, 3)
        # towards the middle by a little: a point on the border belongs to the cell that it closes
        inward = low + extent / 2 + (points - low - extent / 2) * (1 - 1e-6)
        cell = np.clip(((inward - low) / extent * count).astype(int), 0, count - 1)
        filled[tuple(cell.T)] = True
    return filled


def _inside(vertices, faces, low, extent, count) -> np.ndarray:
    """Cells whose middle is inside a closed mesh: an odd number of surfaces lies below."""
    step = extent / count
    x, y, z = (low[k] + step[k] * (np.arange(count[k]) + 0.5013) for k in range(3))  # not through vertices
    below = np.zeros(count, int)
    for a, b, c in vertices[faces]:
        (ux, uy), (vx, vy) = b[:2] - a[:2], c[:2] - a[:2]
        area = ux * vy - uy * vx
        if abs(area) < 1e-18:
            continue
        dx, dy = (x - a[0])[:, None], (y - a[1])[None]
        s, t = (dx * vy - dy * vx) / area, (dy * ux - dx * uy) / area
        i, j = np.nonzero((s >= 0) & (t >= 0) & (s + t < 1))
        height = a[2] + s[i, j] * (b[2] - a[2]) + t[i, j] * (c[2] - a[2])
        below[i, j] += z[None] > height[:, None]
    return below % 2 == 1


def _joined(filled: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Boxes (first cell, one after the last) that cover the cells which are True; each the largest that begins at the
    first cell not yet covered."""
    left = filled.copy()
    while left.any():
        seed = np.array(np.unravel_index(int(left.argmax()), left.shape))
        low, high = _grown(left, seed)
        left[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = False
        yield low, high


def _grown(left: np.ndarray, seed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest of the boxes that grow from a cell along the axes, in each order of them."""
    best: tuple[np.ndarray, np.ndarray] | None = None
    for order in permutations(range(3)):
        low, high = seed.copy(), seed + 1
        for axis in order:
            while high[axis] < left.shape[axis]:
                face = [slice(a, b) for a, b in zip(low, high, strict=True)]
                face[axis] = slice(high[axis], high[axis] + 1)
                if not left[tuple(face)].all():
                    break
                high[axis] += 1
        if best is None or np.prod(high - low) > np.prod(best[1] - best[0]):
            best = low, high
    assert best is not None
    return best
