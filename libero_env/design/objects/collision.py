"""Collision geometry of a mesh: its convex hull, a convex decomposition, or boxes."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import permutations
from typing import TYPE_CHECKING

import numpy as np

from libero_env.assets.simplify import decimate
from libero_env.design.objects.mesh_file import Notify
from libero_env.errors import install_command

if TYPE_CHECKING:
    from trimesh import Trimesh

INSTALL = install_command("objects")
_CONCAVITY = 0.05  # CoACD's threshold: deviation of a piece from its hull
_MAX_PIECES = 24
_MAX_FACES = 100_000  # that CoACD takes apart within minutes
_CONVEX = 0.95  # share of its hull that a convex mesh fills
_CELLS = 16  # grid cells along the longest side, from which boxes are made
_MAX_BOXES = 60


@dataclass(frozen=True)
class Pieces:
    """Collision geometry in the frame of the object.

    Attributes:
        method: Method that was used, `hull`, `decompose` or `boxes`.
        meshes: Vertices (n, 3) [m] of each convex mesh.
        boxes: Centre and half size of each box, (k, 6) [m].
    """

    method: str
    meshes: tuple[np.ndarray, ...] = ()
    boxes: np.ndarray = field(default_factory=lambda: np.zeros((0, 6)))

    def __len__(self) -> int:
        return len(self.meshes) + len(self.boxes)


def collision_pieces(mesh: "Trimesh", method: str, notify: Notify) -> Pieces:
    """Return the collision geometry of a mesh.

    Args:
        mesh: Mesh without duplicate vertices, [m].
        method: `hull`, `boxes`, or `decompose`, which uses CoACD (Wei et al. 2022, Approximate Convex Decomposition for
            3D Meshes with Collision-Aware Concavity and Tree Search). A convex mesh is replaced by its hull.
        notify: Function that receives a message where another method had to be used.
    """
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if method == "hull" or (method == "decompose" and volume_filled(mesh) >= _CONVEX):
        return Pieces("hull", (vertices,))
    if method == "decompose":
        try:
            import coacd
        except ImportError:
            notify(
                f"CoACD is not installed: boxes are used for collisions; for a finer shape: {INSTALL}, and add it again"
            )
            return Pieces("boxes", boxes=boxes_of(mesh))
        if len(faces) > _MAX_FACES:
            notify(f"its {len(faces)} triangles are simplified to {_MAX_FACES} for the decomposition")
            empty = np.zeros((0, 2)), np.zeros((0, 3), np.int64)
            scale = np.ptp(vertices, axis=0).max()
            found, faces, *_ = decimate(vertices / scale, faces, *empty, _MAX_FACES)
            vertices = found * scale
        return Pieces("decompose", _decomposed(coacd, vertices, faces))
    return Pieces("boxes", boxes=boxes_of(mesh))


def is_closed(mesh: "Trimesh") -> bool:
    """Return whether every edge belongs to two triangles of consistent orientation."""
    return bool(mesh.is_watertight and mesh.is_winding_consistent)


def volume_filled(mesh: "Trimesh") -> float:
    """Return the share of its convex hull that a mesh fills, in [0, 1]; 0 for an open mesh."""
    return min(abs(mesh.volume) / mesh.convex_hull.volume, 1.0) if is_closed(mesh) else 0.0


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


def boxes_of(mesh: "Trimesh") -> np.ndarray:
    """Return boxes that cover a mesh, made of the cells of a grid: centre and half size, (k, 6) [m].

    Walls that are thinner than a cell become as thick as one; an open mesh has walls only.
    """
    from trimesh import Trimesh

    low, extent = mesh.bounds[0], mesh.extents
    cells = _CELLS
    while True:
        count = np.maximum(np.round(extent / extent.max() * cells), 1).astype(int)
        # in cells, slightly towards the centre: a point on the border belongs to the inner cell
        points = ((mesh.vertices - low) / extent - 0.5) * (1 - 1e-6) * count + (count - 1) / 2
        grid = Trimesh(points, mesh.faces, process=False).voxelized(1.0)
        grid = grid.fill() if is_closed(mesh) else grid
        filled = np.zeros(count, bool)
        filled[tuple(np.round(grid.points).astype(int).T)] = True
        found = list(_merge_cells(filled))
        if len(found) <= _MAX_BOXES or cells <= 6:
            break
        cells -= 2
    step = extent / count
    return np.array([[*(low + step * (a + b) / 2), *(step * (b - a) / 2)] for a, b in found])


def _merge_cells(filled: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield boxes (first cell, one after the last cell) that cover the cells which are True.

    Each is the largest that starts at the first cell that is not covered yet.
    """
    left = filled.copy()
    while left.any():
        seed = np.array(np.unravel_index(int(left.argmax()), left.shape))
        low, high = _largest_box(left, seed)
        left[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = False
        yield low, high


def _largest_box(left: np.ndarray, seed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
