"""Visual meshes with fewer triangles; each is simplified once per machine and cached."""

import hashlib
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from libero_env.errors import LiberoError
from libero_env.geometry import quat_to_mat
from libero_env.mujoco_compat import mujoco
from libero_env.paths import cache_dir
from libero_env.storage import cached_arrays

_CACHE_VERSION = 3  # in the digests of `lod-*.npz`
_MERGE_CACHE_VERSION = 2  # in the digests of `merge_and_simplify`
_CHUNK = 64  # points whose distances to all others are in memory at once
_PER_SIDE = 40  # samples along the longest side of the mesh

Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class MeshSource(NamedTuple):
    """A mesh file and its pose in the frame of a body.

    Attributes:
        pos: Position, (3,) [m].
        quat: Orientation, (4,) wxyz.
    """

    name: str
    file: str
    pos: tuple[float, ...]
    quat: tuple[float, ...]


def simplify_visuals(spec: mujoco.MjSpec, faces: int) -> None:
    """Simplify the meshes of a model that are visual only, in place.

    Args:
        spec: Model to change.
        faces: Approximate largest number of triangles of a mesh.

    Raises:
        LiberoError: A mesh file cannot be read, or a mesh cannot be simplified that far.
    """
    solid = {g.meshname for g in spec.geoms if g.contype or g.conaffinity}
    for mesh in spec.meshes:
        if mesh.name not in solid and mesh.file:
            arrays = _simplified(mesh.file, tuple(mesh.scale), faces)
            if arrays is not None:
                vertices, triangles, texcoords, face_texcoords = arrays
                mesh.file, mesh.scale = "", (1.0, 1.0, 1.0)
                mesh.uservert, mesh.userface = vertices.ravel(), triangles.ravel()
                if len(texcoords):
                    mesh.usertexcoord, mesh.userfacetexcoord = texcoords.ravel(), face_texcoords.ravel()


@lru_cache(maxsize=256)
def _simplified(file: str, scale: tuple[float, ...], faces: int) -> Arrays | None:
    """Return vertices (n, 3), triangles (f, 3), texture coordinates (t, 2), indices (f, 3); None without faces."""
    try:
        content = Path(file).read_bytes()
    except OSError as error:
        raise LiberoError(f"{file}: {error}; `libero assets download` downloads it") from error
    digest = hashlib.sha256(repr((_CACHE_VERSION, scale, faces)).encode() + content).hexdigest()[:24]
    path = cache_dir() / "meshes" / f"lod-{digest}.npz"

    def make() -> dict[str, np.ndarray]:
        whole = _load(file, scale)
        arrays = whole if len(whole[1]) <= faces else decimate(*whole, faces)
        return {f"a{i}": array for i, array in enumerate(arrays)}

    stored = cached_arrays(path, make, lambda arrays: set(arrays) == {"a0", "a1", "a2", "a3"})
    return (stored["a0"], stored["a1"], stored["a2"], stored["a3"]) if len(stored["a1"]) else None


@lru_cache(maxsize=8)
def merge_and_simplify(
    stem: str, name: str, groups: tuple[tuple[MeshSource, ...], ...], faces: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Merge the meshes of each group into one and simplify it.

    Args:
        stem: Beginning of the name of the cache file.
        name: Name of the model; it distinguishes models whose meshes have the same names.
        faces: Approximate largest number of triangles of a merged mesh.

    Returns:
        Vertices (n, 3) [m] and triangles (f, 3) of each group.
    """
    parts = [(source.name, *source.pos, *source.quat) for sources in groups for source in sources]
    digest = hashlib.sha256(repr((_MERGE_CACHE_VERSION, faces, name, parts)).encode()).hexdigest()[:16]
    path = cache_dir() / "meshes" / f"{stem}-{digest}.npz"

    def make() -> dict[str, np.ndarray]:
        meshes = [_merge(sources, faces) for sources in groups]
        return {key: array for i, (v, f) in enumerate(meshes) for key, array in ((f"v{i}", v), (f"f{i}", f))}

    names = {f"{kind}{i}" for i in range(len(groups)) for kind in "vf"}
    stored = cached_arrays(path, make, lambda arrays: set(arrays) == names)
    return [(stored[f"v{i}"], stored[f"f{i}"]) for i in range(len(groups))]


def _merge(sources: tuple[MeshSource, ...], faces: int) -> tuple[np.ndarray, np.ndarray]:
    import trimesh  # only needed the first time on a machine

    parts = []
    for source in sources:
        mesh = trimesh.load(source.file, force="mesh", process=True, skip_materials=True)
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = quat_to_mat(np.asarray(source.quat)), source.pos
        parts.append(mesh.apply_transform(pose))
    whole = trimesh.util.concatenate(parts)
    if len(whole.faces) > faces:
        whole = whole.simplify_quadric_decimation(face_count=faces)
    whole.update_faces(whole.nondegenerate_faces())
    whole.remove_unreferenced_vertices()
    return np.asarray(whole.vertices, np.float64), np.asarray(whole.faces, np.int32)


def _load(file: str, scale: tuple[float, ...]) -> Arrays:
    """Return a mesh as MuJoCo reads it, in the frame of the file."""
    spec = mujoco.MjSpec()
    shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    spec.add_mesh(name="mesh", file=file, scale=scale, inertia=shell)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh")
    model = spec.compile()
    rotation = quat_to_mat(model.mesh_quat[0])
    vertices = model.mesh_vert.astype(np.float64) @ rotation.T + model.mesh_pos[0]
    textured = model.mesh_texcoordadr[0] >= 0
    texcoords = model.mesh_texcoord.astype(np.float64) if textured else np.zeros((0, 2))
    indices = model.mesh_facetexcoord if textured else np.zeros((0, 3))
    return vertices, model.mesh_face.astype(np.int32), texcoords, indices.astype(np.int32)


def decimate(
    vertices: np.ndarray, triangles: np.ndarray, texcoords: np.ndarray, indices: np.ndarray, faces: int
) -> Arrays:
    """Simplify a mesh by quadric error; corners take the texture coordinate of the nearest point of the old surface.

    A patch is a piece of the surface that the texture covers without a seam. A new triangle belongs to the patch that
    is nearest to its centre and faces the same way, so that none stretches across a seam.

    Args:
        vertices: Vertices, (n, 3) [m].
        triangles: Vertex indices, (f, 3).
        texcoords: Texture coordinates, (t, 2); (0, 2) for a mesh without.
        indices: Indices into `texcoords` of each corner, (f, 3).
        faces: Desired number of triangles.

    Returns:
        The same four arrays of the simplified mesh.
    """
    import fast_simplification  # only needed the first time on a machine

    points, where = np.unique(vertices.round(7), axis=0, return_inverse=True)
    merged = where.reshape(-1)[triangles]
    new_points, new = fast_simplification.simplify(points, merged.astype(np.int32), target_count=faces, agg=5)
    new_points, new = np.asarray(new_points, np.float64), np.asarray(new, np.int32)
    new = new[(new != np.roll(new, 1, axis=1)).all(axis=1)]
    if not len(new):
        raise LiberoError(
            f"a mesh of {len(triangles)} triangles cannot be simplified to {faces}; allow more triangles"
        )
    if not len(texcoords):
        return new_points, new, texcoords, np.zeros((0, 3), np.int32)
    samples, texcoord, owner = _samples(points, merged, texcoords[indices])
    patch = _patches(merged, texcoords[indices])[owner]
    face_patch = patch[nearest(_facing(points, new_points[new].mean(axis=1), new_points, new), samples)]
    result = np.zeros((len(new), 3, 2))
    for one in np.unique(face_patch):
        chosen, there = np.flatnonzero(face_patch == one), np.flatnonzero(patch == one)
        for k in range(3):
            corners = _facing(points, new_points[new[chosen, k]], new_points, new[chosen])
            result[chosen, k] = texcoord[there[nearest(corners, samples[there])]]
    distinct, compact = np.unique(result.reshape(-1, 2), axis=0, return_inverse=True)
    return new_points, new, distinct, compact.reshape(-1, 3).astype(np.int32)


def nearest(points: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Return the index (n,) of the nearest of `among` (m, d) for each of `points` (n, d)."""
    half = 0.5 * (among**2).sum(axis=1)
    parts = [points[i : i + _CHUNK] for i in range(0, len(points), _CHUNK)]
    return np.concatenate([np.argmin(half - part @ among.T, axis=1) for part in parts])


def _samples(
    points: np.ndarray, triangles: np.ndarray, texcoords: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sample a surface; return the descriptors of `_facing` (s, 6), texture coordinates (s, 2), triangles (s,)."""
    corners = points[triangles]  # (f, 3, 3)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.clip(np.ceil(_PER_SIDE * longest / _extent(points)), 1, _PER_SIDE).astype(int)
    parts = []
    for n in np.unique(steps):
        grid = np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]) / n
        weights = np.vstack([grid, [[1 / 3, 1 / 3, 1 / 3]]])  # (w, 3)
        chosen = np.repeat(np.flatnonzero(steps == n), len(weights))
        spread = np.tile(weights, (len(chosen) // len(weights), 1))[:, :, None]
        where, texcoord = ((spread * array[chosen]).sum(axis=1) for array in (corners, texcoords))
        parts.append((_facing(points, where, points, triangles[chosen]), texcoord, chosen))
    samples, coordinates, owner = map(np.concatenate, zip(*parts, strict=True))
    return samples, coordinates, owner


def _facing(whole: np.ndarray, where: np.ndarray, points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return descriptors (f, 6): points on triangles, and the normals scaled to a tenth of the size of the mesh."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    return np.hstack([where, 0.1 * _extent(whole) * normals])


def _extent(points: np.ndarray) -> float:
    return float(np.ptp(points, axis=0).max())


def _patches(triangles: np.ndarray, texcoords: np.ndarray) -> np.ndarray:
    """Return the label (f,) of the texture patch of each triangle (f, 3), from the corners' texcoords (f, 3, 2).

    Two triangles are on one patch if they share a vertex that has the same texture coordinate in both.
    """
    from scipy.sparse import coo_array  # only needed the first time on a machine
    from scipy.sparse.csgraph import connected_components

    corners = np.concatenate([triangles.reshape(-1, 1), texcoords.reshape(-1, 2).round(6)], axis=1)
    shared = np.unique(corners, axis=0, return_inverse=True)[1].reshape(-1, 3)
    starts, ends, number = np.repeat(shared[:, 0], 2), shared[:, 1:].reshape(-1), shared.max() + 1
    edges = coo_array((np.ones(len(starts)), (starts, ends)), shape=(number, number))
    return connected_components(edges, directed=False)[1][shared[:, 0]]
