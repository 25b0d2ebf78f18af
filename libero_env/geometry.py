"""The shape of bodies as points on their collision geoms; what grasping and avoiding need to know."""

from dataclasses import dataclass

import mujoco
import numpy as np

SPACING = 0.005  # m between points


@dataclass(frozen=True)
class Pose:
    """Where a frame is in the world."""

    pos: np.ndarray  # (3,), m
    mat: np.ndarray  # (3, 3), frame to world

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Points of the frame in the world; (N, 3) -> (N, 3)."""
        return points @ self.mat.T + self.pos

    def invert(self, point_world: np.ndarray) -> np.ndarray:
        """A point of the world in the frame; (3,) -> (3,)."""
        return self.mat.T @ (point_world - self.pos)


def surface_points(model: mujoco.MjModel, body: int, spacing: float = SPACING) -> np.ndarray:
    """Points on the collision geoms of a body and of what hangs on it, in the body's frame; (N, 3), m.

    Bodies below that are moved by joints of their own are taken where the model has them.
    """
    clouds = []
    poses = {body: (np.zeros(3), np.eye(3))}
    for b in range(body, model.nbody):
        if b != body:
            parent = poses.get(int(model.body_parentid[b]))
            if parent is None:
                continue
            local = quat_to_mat(model.body_quat[b])
            poses[b] = (parent[0] + parent[1] @ model.body_pos[b], parent[1] @ local)
        pos, mat = poses[b]
        clouds.append(body_points(model, b, spacing) @ mat.T + pos)
    return np.concatenate(clouds)


def body_points(model: mujoco.MjModel, body: int, spacing: float = SPACING) -> np.ndarray:
    """Points on the collision geoms of one body alone, in its frame; (N, 3), m."""
    clouds = [np.zeros((0, 3))]
    for g in np.flatnonzero(model.geom_bodyid == body):
        if model.geom_contype[g] or model.geom_conaffinity[g]:
            points = _geom_points(model, int(g), spacing)
            clouds.append(points @ quat_to_mat(model.geom_quat[g]).T + model.geom_pos[g])
    return np.concatenate(clouds)


def _geom_points(model: mujoco.MjModel, geom: int, spacing: float) -> np.ndarray:
    kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return _box_points(size, spacing)
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return _mesh_points(model, int(model.geom_dataid[geom]), spacing)
    if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        radii = np.full(3, size[0]) if kind == mujoco.mjtGeom.mjGEOM_SPHERE else size
        return _ball_points(radii, spacing)
    if kind in (mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE):
        side = _tube_points(size[0], size[1], spacing)
        if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
            return side
        ball = _ball_points(np.full(3, size[0]), spacing)
        return np.concatenate([side, ball + np.sign(ball[:, 2:]) * [0, 0, size[1]]])
    return np.zeros((0, 3))  # planes and height fields are not things to grasp


def _steps(half: float, spacing: float) -> np.ndarray:
    return np.linspace(-half, half, max(2, int(np.ceil(2 * half / spacing)) + 1))


def _box_points(half: np.ndarray, spacing: float) -> np.ndarray:
    faces = []
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        u, v = np.meshgrid(_steps(half[a], spacing), _steps(half[b], spacing))
        for sign in (-1.0, 1.0):
            face = np.empty((u.size, 3))
            face[:, a], face[:, b], face[:, axis] = u.ravel(), v.ravel(), sign * half[axis]
            faces.append(face)
    return np.concatenate(faces)


def _tube_points(radius: float, half: float, spacing: float) -> np.ndarray:
    angle = np.arange(0, 2 * np.pi, spacing / radius)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rows = [np.column_stack([radius * ring, np.full(len(ring), z)]) for z in _steps(half, spacing)]
    caps = [
        np.column_stack([r * ring, np.full(len(ring), z)])
        for r in np.arange(0.0, radius, spacing)
        for z in (-half, half)
    ]
    return np.concatenate(rows + caps)


def _ball_points(radii: np.ndarray, spacing: float) -> np.ndarray:
    number = int(np.clip(4 * np.pi * (radii.max() / spacing) ** 2, 50, 2000))
    k = np.arange(number) + 0.5  # a Fibonacci lattice
    z, turn = 1 - 2 * k / number, np.pi * (1 + np.sqrt(5)) * k
    flat = np.sqrt(1 - z**2)
    return np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z]) * radii


def _mesh_points(model: mujoco.MjModel, mesh: int, spacing: float) -> np.ndarray:
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    vertices = model.mesh_vert[start : start + count].astype(float)
    start, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    corners = vertices[model.mesh_face[start : start + count]]  # (F, 3 corners, 3)
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    points = [vertices]
    for triangle, length in zip(corners, edge, strict=True):
        n = min(int(np.ceil(length / spacing)), 20)
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1))
        inside = i + j <= n
        weights = np.stack([i[inside], j[inside], n - i[inside] - j[inside]], axis=1) / max(n, 1)
        points.append(weights @ triangle)
    return np.unique(np.round(np.concatenate(points), 4), axis=0)


def quat_to_mat(quat_wxyz: np.ndarray) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a unit quaternion (4,)."""
    out = np.empty(9)
    mujoco.mju_quat2Mat(out, quat_wxyz)
    return out.reshape(3, 3)


def axis_angle(quat_wxyz: np.ndarray) -> np.ndarray:
    """Rotation vectors (n, 3), rad, of unit quaternions (n, 4); angle in [0, 2 pi) as the original writes it."""
    w = np.clip(quat_wxyz[:, :1], -1.0, 1.0)
    sine = np.sqrt(1.0 - w * w)
    scale = np.where(sine < 1e-9, 0.0, 2.0 * np.arccos(w) / np.maximum(sine, 1e-9))
    return quat_wxyz[:, 1:] * scale


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Quaternion products, wxyz (n, 4); the same bits for every n."""
    aw, ax, ay, az = a.T
    bw, bx, by, bz = b.T
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=1,
    )


def rotated(quat: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) turned by unit quaternions (n, 4), wxyz."""
    pure = np.concatenate([np.zeros((len(vectors), 1)), vectors], axis=1)
    return product(product(quat, pure), quat * (1.0, -1.0, -1.0, -1.0))[:, 1:]
