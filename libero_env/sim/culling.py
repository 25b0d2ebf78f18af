"""Which geoms a picture cannot show, so that they need not be drawn. Leaving them out changes no bit of it.

A geom is left out if its bounding box is outside the camera's view, and outside what a mirror shows of the scene.
MuJoCo draws at most one mirror (`mjr_render`): the first opaque plane or box of the scene that is reflective, and of a
box only the face z+.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

_MARGIN = 1e-3  # [m] far more than the rounding of positions in single precision
_BOX, _PLANE, _MESH = (int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in ("BOX", "PLANE", "MESH"))
_ROUND = [int(getattr(mujoco.mjtGeom, f"mjGEOM_{n}")) for n in ("SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER")]
_GEOM, _NONE = int(mujoco.mjtObj.mjOBJ_GEOM), mujoco.mjtGeom.mjGEOM_NONE
_OPAQUE = 0.995  # alpha below which MuJoCo draws a geom as a transparent one, which mirrors nothing


class Culling:
    """Finds the geoms of a model that a camera cannot show.

    Args:
        model: Model whose meshes do not change; poses, sizes and materials may.
    """

    def __init__(self, model: mujoco.MjModel):
        self._model = model
        self._is_mesh = model.geom_type == _MESH
        self._can_cull = self._is_mesh | np.isin(model.geom_type, [_BOX, *_ROUND])

    def apply(
        self,
        data: mujoco.MjData,
        camera: int,
        aspect: float,
        geoms: Sequence[mujoco.MjvGeom],
        mirrors: bool = True,
        fovy: float | None = None,
    ) -> list[tuple[mujoco.MjvGeom, int]]:
        """Remove from a scene what the picture of a camera cannot show.

        Args:
            data: State whose kinematics and cameras are up to date.
            camera: Index of a camera.
            aspect: Width of the image over its height.
            geoms: Elements of the scene; those to leave out lose their type.
            mirrors: Whether reflections are drawn.
            fovy: Vertical field of view, [degrees]; by default that of the model.

        Returns:
            Geoms that were left out, with the types that they had.
        """
        normals = self._frustum(data, camera, aspect, fovy)
        if normals is None:
            return []
        elements = [(i, g.objid) for i, g in enumerate(geoms) if g.objtype == _GEOM]
        places, ids = (np.array(column, np.int64) for column in zip(*elements, strict=True))
        boxes = _Boxes(self._model, data, ids, self._is_mesh[ids])
        eye = data.cam_xpos[camera]
        kept = ~self._can_cull[ids] | boxes.inside(eye, normals)
        mirror = next((k for k, i in enumerate(places) if _is_mirror(geoms[i], eye)), None)
        if mirror is not None:
            for i in places[
                mirror + 1 :
            ]:  # otherwise the next one becomes the mirror where this one is left out
                geoms[i].reflectance = 0.0
            if mirrors and kept[mirror]:
                kept |= self._in_mirror(data, eye, normals, boxes, int(ids[mirror]))
        left_out = [(geoms[i], int(geoms[i].type)) for i in places[~kept]]
        for geom, _ in left_out:
            geom.type = _NONE
        return left_out

    def _frustum(
        self, data: mujoco.MjData, camera: int, aspect: float, fovy: float | None
    ) -> np.ndarray | None:
        """Return the inward normals (5, 3) of the planes through the camera that bound its view, None for others."""
        model = self._model
        projection = getattr(model, "cam_projection", getattr(model, "cam_orthographic", None))
        if (projection is not None and projection[camera]) or model.cam_sensorsize[camera].any():
            return None
        y = float(np.tan(np.deg2rad(model.cam_fovy[camera] if fovy is None else fovy) / 2))
        x = y * aspect
        local = np.array([[1, 0, -x], [-1, 0, -x], [0, 1, -y], [0, -1, -y], [0, 0, -1]])
        normals = local / np.linalg.norm(local, axis=1, keepdims=True)
        return normals @ data.cam_xmat[camera].reshape(3, 3).T

    def _in_mirror(
        self, data: mujoco.MjData, eye: np.ndarray, normals: np.ndarray, boxes: "_Boxes", mirror: int
    ) -> np.ndarray:
        """Return which geoms (n,) the reflection in a plane, or in the upper face of a box, can show."""
        size, rotation = self._model.geom_size[mirror], data.geom_xmat[mirror].reshape(3, 3)
        is_box = self._model.geom_type[mirror] == _BOX
        up, centre = rotation[:, 2], data.geom_xpos[mirror] + (size[2] if is_box else 0.0) * rotation[:, 2]
        height = float((eye - centre) @ up)
        if height < -_MARGIN:
            return np.zeros(len(boxes.centres), bool)
        # What is seen in a mirror is what the mirrored eye sees, through the face.
        seen = boxes.inside(eye - 2 * height * up, normals - 2 * np.outer(normals @ up, up))
        seen &= boxes.inside(centre, up[None])
        if is_box and height > _MARGIN:
            signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
            corners = centre + signs * size[:2] @ rotation[:, :2].T - (eye - 2 * height * up)
            edges = np.cross(corners, np.roll(corners, -1, axis=0))
            edges *= np.sign(edges @ corners.mean(axis=0))[:, None]
            edges /= np.linalg.norm(edges, axis=1, keepdims=True)
            seen &= boxes.inside(eye - 2 * height * up, edges)
        return seen


class _Boxes:
    """Bounding boxes of geoms: centres (n, 3) and half axes (n, 3, 3), one in each column, world frame, m."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, ids: np.ndarray, is_mesh: np.ndarray):
        rotations, size = data.geom_xmat[ids].reshape(-1, 3, 3), model.geom_size[ids]
        # A sphere as large as the sum of its sizes holds each round geom.
        whole = np.where(model.geom_type[ids, None] == _BOX, size, size.sum(axis=1, keepdims=True))
        bounds = model.geom_aabb[ids].reshape(-1, 6)
        local = np.where(is_mesh[:, None], bounds[:, :3], 0.0)
        half = np.where(is_mesh[:, None], bounds[:, 3:], whole)
        self.centres = data.geom_xpos[ids] + (rotations @ local[:, :, None])[:, :, 0]
        self.axes = rotations * half[:, None, :]

    def inside(self, apex: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return which boxes (n,) reach inside all planes through `apex` (3,) with inward `normals` (k, 3)."""
        distance = (self.centres - apex) @ normals.T  # (n, k)
        reach = np.abs(np.einsum("kj,nji->nki", normals, self.axes)).sum(axis=2)
        return (distance + reach >= -_MARGIN).all(axis=1)


def _is_mirror(geom: mujoco.MjvGeom, eye: np.ndarray) -> bool:
    if geom.type not in (_PLANE, _BOX) or not geom.reflectance > 0 or geom.rgba[3] < _OPAQUE:
        return False
    return geom.type == _BOX or (eye - geom.pos) @ np.reshape(geom.mat, (3, 3))[:, 2] >= 0
