"""Poses, rotations, and the shape of bodies as points on their collision geoms."""

from dataclasses import dataclass

import numpy as np

from libero_env.mujoco_compat import mujoco

SPACING = 0.005  # [m] between neighbouring points


@dataclass(frozen=True)
class Pose:
    """Position and orientation of a frame in the world.

    Attributes:
        pos: Origin of the frame, (3,), m.
        mat: Rotation matrix, (3, 3), frame to world.
    """

    pos: np.ndarray
    mat: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Transform points (N, 3) from the frame to the world."""
        return points @ self.mat.T + self.pos

    def invert(self, point_world: np.ndarray) -> np.ndarray:
        """Transform a point (3,) from the world to the frame."""
        return self.mat.T @ (point_world - self.pos)

    def to_world(self, pose: "Pose") -> "Pose":
        """Transform a pose from the frame to the world."""
        return Pose(self.mat @ pose.pos + self.pos, self.mat @ pose.mat)

    def to_local(self, pose: "Pose") -> "Pose":
        """Transform a pose from the world to the frame."""
        return Pose(self.invert(pose.pos), self.mat.T @ pose.mat)


def surface_points(model: mujoco.MjModel, body: int, spacing: float = SPACING) -> np.ndarray:
    """Return points on the collision geoms of a body and its descendants.

    Descendants with joints are taken at the reference configuration of the model.

    Args:
        model: Model that has the body.
        spacing: Distance between neighbouring points, m.

    Returns:
        Points in the body's frame, (N, 3), m.
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
    """Return points on the collision geoms of one body, without its descendants, in its frame; (N, 3), m."""
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
    return np.zeros((0, 3))  # planes and height fields cannot be grasped


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
    mat = np.empty(9)
    mujoco.mju_quat2Mat(mat, quat_wxyz)
    return mat.reshape(3, 3)


def mat_to_quat(mat: np.ndarray) -> np.ndarray:
    """Return the unit quaternion (4,), wxyz, of a rotation matrix (3, 3)."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.ravel(mat))
    return quat


def quat_from_axis_angle(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the quaternion (4,), wxyz, of a rotation by `angle`, rad, about a unit axis (3,)."""
    quat = np.empty(4)
    mujoco.mju_axisAngle2Quat(quat, axis, angle)
    return quat


def quat_to_axis_angle(quat_wxyz: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (N, 3), rad, of unit quaternions (N, 4).

    Angles are in [0, 2 pi), as the original LIBERO writes them.
    """
    w = np.clip(quat_wxyz[:, :1], -1.0, 1.0)
    sine = np.sqrt(1.0 - w * w)
    scale = np.where(sine < 1e-9, 0.0, 2.0 * np.arccos(w) / np.maximum(sine, 1e-9))
    return quat_wxyz[:, 1:] * scale


def quat_multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the products of quaternions, (N, 4) each, wxyz; the bits of a row do not depend on N."""
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


def quat_rotate(quat_wxyz: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Rotate vectors (N, 3) by unit quaternions (N, 4)."""
    pure = np.concatenate([np.zeros((len(vectors), 1)), vectors], axis=1)
    return quat_multiply(quat_multiply(quat_wxyz, pure), quat_wxyz * (1.0, -1.0, -1.0, -1.0))[:, 1:]


def rotation_between(mat: np.ndarray, goal_mat: np.ndarray) -> np.ndarray:
    """Return the rotation from one orientation to another as a rotation vector.

    Args:
        mat: Orientation at the start, (3, 3), body to world.
        goal_mat: Orientation at the end, (3, 3), body to world.

    Returns:
        Axis times angle in the world frame, (3,), rad.
    """
    rotation = np.empty(3)
    mujoco.mju_quat2Vel(rotation, mat_to_quat(goal_mat @ mat.T), 1.0)
    return rotation


def rotation_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation (3, 3) by an angle, rad, about a unit axis (3,), by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def rotation_about_z(angle: float) -> np.ndarray:
    """Return the rotation (3, 3) by an angle, rad, about the vertical."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
