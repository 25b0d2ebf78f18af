"""Which geoms a picture cannot show, so that they need not be drawn. Leaving them out changes no bit of it.

A geom is left out if its bounding box is outside the camera's view, and outside what a mirror shows of the scene; or
if it is behind the upper face of an opaque box, as the legs of a table are, and no mirror is drawn. MuJoCo draws at
most one mirror (`mjr_render`): the first opaque plane or box of the scene that is reflective, and of a box only the
face z+.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from libero_env.compilation import compiled
from libero_env.mujoco_compat import mujoco

_MARGIN = 1e-3  # [m] far more than the rounding of positions in single precision
_BOX, _PLANE, _MESH, _SPHERE, _CAPSULE, _CYLINDER, _ELLIPSOID = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))
    for name in ("BOX", "PLANE", "MESH", "SPHERE", "CAPSULE", "CYLINDER", "ELLIPSOID")
)
_ROUND = (_SPHERE, _CAPSULE, _CYLINDER, _ELLIPSOID)
_GEOM, _NONE = int(mujoco.mjtObj.mjOBJ_GEOM), mujoco.mjtGeom.mjGEOM_NONE
_OPAQUE = 0.995  # alpha below which MuJoCo draws a geom as a transparent one, which mirrors and hides nothing
_LARGE = 0.1  # [m^2] area of a face that may hide something
_COSTLY = 100  # triangles of a mesh that is worth a look
_SIDES = (-1.0, 1.0)
_SIGNS = np.array([[x, y, z] for x in _SIDES for y in _SIDES for z in _SIDES])  # of the corners of a box
_EDGES = np.array([(a, b) for a in range(8) for b in (a | 1, a | 2, a | 4) if b > a])


class Culling:
    """Finds the geoms of a model that a camera cannot show.

    Args:
        model: Model whose meshes do not change; poses, sizes and materials may.
    """

    def __init__(self, model: mujoco.MjModel):
        self._model = model
        kinds = model.geom_type
        is_mesh, is_round = kinds == _MESH, np.isin(kinds, _ROUND)
        self._can_cull = is_mesh | is_round | (kinds == _BOX)
        faces = model.mesh_facenum[model.geom_dataid] if model.nmesh else np.zeros(model.ngeom)
        self._is_costly = is_round | (is_mesh & (faces >= _COSTLY))
        self._is_flat = ((kinds == _BOX) | (kinds == _PLANE)).tolist()
        self._is_large = ((kinds == _BOX) & (4 * model.geom_size[:, :2].prod(axis=1) > _LARGE)).tolist()
        self._near = float(model.vis.map.znear * model.stat.extent)
        projection = getattr(
            model, "cam_projection", getattr(model, "cam_orthographic", np.zeros(model.ncam))
        )
        self._is_other = ((projection != 0) | model.cam_sensorsize.any(axis=1)).tolist()

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
            aspect: Width of the image over its height.
            geoms: Elements of the scene; those to leave out lose their type.
            mirrors: Whether reflections are drawn.
            fovy: Vertical field of view, [degrees]; by default that of the model.

        Returns:
            Geoms that were left out, with the types that they had.
        """
        view = self._view(data, camera, aspect, fovy)
        if view is None:
            return []
        elements = [(i, g.objid) for i, g in enumerate(geoms) if g.objtype == _GEOM]
        places, ids = (np.array(column, np.int64) for column in zip(*elements, strict=True))
        boxes = self._boxes(data, ids)
        kept = ~self._can_cull[ids] | _reach_inside(boxes, view.eye, view.normals)
        flat = [(k, i) for k, (i, geom) in enumerate(elements) if self._is_flat[geom]]
        mirror = next((k for k, i in flat if _is_mirror(geoms[i], view.eye)), None)
        if mirror is not None:
            for i in places[mirror + 1 :]:  # or the next one becomes the mirror where this one is left out
                geoms[i].reflectance = 0.0
            if mirrors and kept[mirror]:
                kept |= self._in_mirror(data, view, boxes, int(ids[mirror]))
        if mirror is None or not mirrors:
            for k, i in flat:
                if kept[k] and self._is_large[ids[k]] and geoms[i].rgba[3] >= _OPAQUE:
                    self._leave_out_behind(int(ids[k]), data, view, boxes, kept)
        left_out = [(geoms[i], int(geoms[i].type)) for i in places[~kept]]
        for geom, _ in left_out:
            geom.type = _NONE
        return left_out

    def _boxes(self, data: mujoco.MjData, ids: np.ndarray) -> "_Boxes":
        model, boxes = self._model, _Boxes(ids, np.empty((len(ids), 3)), np.empty((len(ids), 3, 3)))
        bounds = model.geom_aabb.reshape(-1, 6)  # of meshes: sizes of others may have changed
        _bound(boxes, model.geom_type, model.geom_size, bounds, data.geom_xpos, data.geom_xmat)
        return boxes

    def _view(self, data: mujoco.MjData, camera: int, aspect: float, fovy: float | None) -> "_View | None":
        """Return what a camera shows, None for cameras of other kinds."""
        if self._is_other[camera]:
            return None
        normals, rays = _frustum(float(self._model.cam_fovy[camera] if fovy is None else fovy), aspect)
        to_world = data.cam_xmat[camera].reshape(3, 3).T
        return _View(data.cam_xpos[camera], normals @ to_world, rays @ to_world)

    def _leave_out_behind(
        self, box: int, data: mujoco.MjData, view: "_View", boxes: "_Boxes", kept: np.ndarray
    ) -> None:
        """Drop from the kept geoms (n,) those that the upper face of a box hides."""
        rotation, size = data.geom_xmat[box], self._model.geom_size[box]
        if rotation[8] < 0.5:  # a wall hides nothing in a room
            return
        centre = data.geom_xpos[box] + size[2] * rotation[2::3] - view.eye
        face = _Face(size, centre, rotation.reshape(3, 3), self._near + _MARGIN)
        _drop_hidden(face, view, boxes, self._is_costly, self._model.geom_type, data.geom_xmat, kept)

    def _in_mirror(self, data: mujoco.MjData, view: "_View", boxes: "_Boxes", mirror: int) -> np.ndarray:
        """Return which geoms (n,) the reflection in a plane, or in the upper face of a box, can show."""
        eye, normals = view.eye, view.normals
        size, rotation = self._model.geom_size[mirror], data.geom_xmat[mirror].reshape(3, 3)
        is_box = self._model.geom_type[mirror] == _BOX
        up, centre = rotation[:, 2], data.geom_xpos[mirror] + (size[2] if is_box else 0.0) * rotation[:, 2]
        height = float((eye - centre) @ up)
        if height < -_MARGIN:
            return np.zeros(len(boxes.centres), bool)
        # What is seen in a mirror is what the mirrored eye sees, through the face.
        seen: np.ndarray = _reach_inside(
            boxes, eye - 2 * height * up, normals - 2 * np.outer(normals @ up, up)
        )
        seen &= _reach_inside(boxes, centre, up[None])
        if is_box and height > _MARGIN:
            signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
            corners = centre + signs * size[:2] @ rotation[:, :2].T - (eye - 2 * height * up)
            edges = np.cross(corners, np.roll(corners, -1, axis=0))
            edges *= np.sign(edges @ corners.mean(axis=0))[:, None]
            edges /= np.linalg.norm(edges, axis=1, keepdims=True)
            seen &= _reach_inside(boxes, eye - 2 * height * up, edges)
        return seen


class _View(NamedTuple):
    """What a camera shows: all that is inside of planes through its eye.

    Attributes:
        eye: Where they meet, (3,), m.
        normals: Inward normals of the four planes at the sides, and the direction of the view, (5, 3).
        rays: Directions of the edges in which the first four meet, (4, 3).
    """

    eye: np.ndarray
    normals: np.ndarray
    rays: np.ndarray


class _Boxes(NamedTuple):
    """Bounding boxes of geoms in the world frame, m.

    Attributes:
        ids: Indices of the geoms, (n,).
        centres: Their centres, (n, 3).
        axes: Their half axes, one in each column, (n, 3, 3).
    """

    ids: np.ndarray
    centres: np.ndarray
    axes: np.ndarray


class _Face(NamedTuple):
    """The upper face of a box.

    Attributes:
        size: Half edges of the box, (3,).
        centre: Centre of the face from the eye, (3,).
        rotation: Axes of the box, in columns, (3, 3).
        near: Least distance along the view at which something is drawn.
    """

    size: np.ndarray
    centre: np.ndarray
    rotation: np.ndarray
    near: float


@lru_cache(maxsize=64)
def _frustum(fovy: float, aspect: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the normals (5, 3) and rays (4, 3) of a `_View` in the frame of its camera."""
    y = float(np.tan(np.deg2rad(fovy) / 2))
    x = y * aspect
    local = np.array([[1, 0, -x], [-1, 0, -x], [0, 1, -y], [0, -1, -y], [0, 0, -1]])
    rays = np.array([[x, y, -1], [x, -y, -1], [-x, y, -1], [-x, -y, -1]])
    return local / np.linalg.norm(local, axis=1, keepdims=True), rays


@compiled
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def _bound(boxes, kinds, sizes, bounds, positions, rotations):
    """Write the bounding boxes of geoms."""
    ids, centres, axes = boxes
    half = np.empty(3)
    for n in range(len(ids)):
        g = ids[n]
        kind = kinds[g]
        for r in range(3):
            half[r], centres[n, r] = sizes[g, 0 if kind == _SPHERE else r], positions[g, r]
        if kind in (_CYLINDER, _CAPSULE):
            half[1] = sizes[g, 0]
            half[2] = sizes[g, 1] + (sizes[g, 0] if kind == _CAPSULE else 0.0)
        elif kind == _MESH:
            for r in range(3):
                half[r] = bounds[g, 3 + r]
                centres[n, r] += _dot(rotations[g, 3 * r : 3 * r + 3], bounds[g])
        for r in range(3):
            for c in range(3):
                axes[n, r, c] = rotations[g, 3 * r + c] * half[c]


@compiled
def _reach_inside(boxes, apex, normals):
    """Return which boxes (n,) reach inside all planes through a point (3,) with inward normals (k, 3)."""
    _, centres, axes = boxes
    inside = np.ones(len(centres), np.bool_)
    for n in range(len(centres)):
        for k in range(len(normals)):
            reach = _dot(centres[n], normals[k]) - _dot(apex, normals[k])
            for c in range(3):
                reach += abs(_dot(axes[n, :, c], normals[k]))
            if reach < -_MARGIN:
                inside[n] = False
                break
    return inside


@compiled
def _is_hidden(point, face, forward):
    """Return whether the face of a box is on the way from the eye to a point, which is relative to the eye."""
    size, centre, rotation, near = face
    down = _dot(point, rotation[:, 2])
    if down >= 0.0:
        return False
    share = _dot(centre, rotation[:, 2]) / down
    if share * _dot(point, forward) < near:
        return False
    for c in range(2):
        if abs(share * _dot(point, rotation[:, c]) - _dot(centre, rotation[:, c])) > size[c] - _MARGIN:
            return False
    return True


@compiled
def _is_behind(centre, axes, normals, face):
    """Return whether the face of a box hides all that is seen of a bounding box, whose centre is relative to the eye.

    What is behind the face is convex. So a box is behind it if its corners are, or those of its part on the inner side
    of one of the four planes that bound the view.
    """
    corners, depths, hidden = np.empty((8, 3)), np.empty((8, 4)), np.empty(8, np.bool_)
    for k in range(8):
        for r in range(3):
            corners[k, r] = centre[r] + _dot(_SIGNS[k], axes[r])
        hidden[k] = _is_hidden(corners[k], face, normals[4])
        for j in range(4):
            depths[k, j] = _MARGIN + _dot(corners[k], normals[j])
    if hidden.all():
        return True
    point = np.empty(3)
    for j in range(4):
        behind = True
        for k in range(8):
            behind = behind and (hidden[k] or depths[k, j] < 0.0)
        for e in range(len(_EDGES)):
            a, b = _EDGES[e, 0], _EDGES[e, 1]
            if behind and (depths[a, j] < 0.0) != (depths[b, j] < 0.0):
                share = depths[a, j] / (depths[a, j] - depths[b, j])
                for r in range(3):
                    point[r] = corners[a, r] + share * (corners[b, r] - corners[a, r])
                behind = _is_hidden(point, face, normals[4])
        if behind:
            return True
    return False


@compiled
def _drop_hidden(face, view, boxes, costly, kinds, rotations, kept):
    """Drop from the kept geoms (n,) those that the upper face of a box hides, as far as they are worth a look.

    Args:
        face: The face.
        view: What the camera shows.
        boxes: Bounding boxes of the geoms.
        costly: Which geoms of the model are worth a look.
        kinds: Types of the geoms of the model.
        rotations: Their orientations, (ngeom, 9).
        kept: Whether each geom is drawn, (n,); changed.
    """
    (ids, centres, axes), (eye, normals, rays) = boxes, view
    up = face.rotation[:, 2].copy()
    level = _dot(face.centre, up)  # of the face over the eye
    if level > -_MARGIN:
        return
    fills_view = True
    for k in range(4):
        fills_view = fills_view and _is_hidden(rays[k], face, normals[4])
    for n in range(len(ids)):
        g = ids[n]
        if not kept[n] or not (fills_view or costly[g]):
            continue
        centre = centres[n] - eye
        top = _dot(centre, up)
        if kinds[g] == _PLANE:  # infinite
            top += 0.0 if abs(_dot(rotations[g, 2::3], up)) > 1.0 - 1e-9 else np.inf
        else:
            for c in range(3):
                top += abs(_dot(axes[n, :, c], up))
        if top < level - _MARGIN:
            kept[n] = not (fills_view or _is_behind(centre, axes[n], normals, face))


def _is_mirror(geom: mujoco.MjvGeom, eye: np.ndarray) -> bool:
    if geom.type not in (_PLANE, _BOX) or not geom.reflectance > 0 or geom.rgba[3] < _OPAQUE:
        return False
    return geom.type == _BOX or (eye - geom.pos) @ np.reshape(geom.mat, (3, 3))[:, 2] >= 0
