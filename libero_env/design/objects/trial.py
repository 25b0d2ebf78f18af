"""Test of a new object: whether it stays where it is put down, whether it can be grasped, and a picture of it."""

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from libero_env.design.objects.mesh_file import Notify
from libero_env.errors import LiberoError
from libero_env.expert.arm import GRIPPER
from libero_env.expert.grasping.grasps import Grasp, GraspError, find_grasps
from libero_env.geometry import surface_points
from libero_env.mujoco_compat import log_warnings, make_directional, mujoco, set_damping
from libero_env.objects.model import ROOT_BODY, ObjectModel
from libero_env.sim.render import Renderer, RenderTarget

_PREFIX = "object_"
_BODY = _PREFIX + ROOT_BODY
_SPACING = 0.004  # [m] between the points that widths are measured with
_SECONDS = 1.5  # simulated time in which it must not move
_MAX_TILT, _MAX_SHIFT = 10.0, 0.02  # [deg] and [m] up to which it counts as standing
_MAX_SLANT = 0.006  # [m] of a face, between the two halves of a finger pad
VIEWS = 8  # pictures around the object
_PIXELS = 224  # side of a picture


def try_object(item: ObjectModel, notify: Notify, picture: Path | None = None) -> dict[str, Any]:
    """Put an object down, search for a grasp, and render it from all sides.

    Args:
        item: Object to test; its spec cannot be used afterwards.
        notify: Function that receives a message about each problem for tasks with it.
        picture: PNG file to write; None writes none.

    Returns:
        `mass` [kg], `size` [m] as it rests, the parameters of placement, `stands`, and `grasp`: the width of the
        narrowest grasp [m], or the reason why there is none.

    Raises:
        LiberoError: The model cannot be compiled, or it has no collision geoms.
    """
    model, data, found = _put_down(item)
    if picture is not None:
        turntable(model, data, found["size"], picture)
    found |= {"stands": _stands(model, data, notify), "grasp": _grasp(model, data, item.category, notify)}
    return found


def draw_object(item: ObjectModel, picture: Path) -> Path:
    """Render an object from all sides into a PNG file.

    Args:
        item: Object to render; its spec cannot be used afterwards.
        picture: File to write.

    Returns:
        `picture`.

    Raises:
        LiberoError: The model cannot be compiled, or nothing can be rendered on this machine.
    """
    model, data, found = _put_down(item)
    return turntable(model, data, found["size"], picture)


def turntable(model: mujoco.MjModel, data: mujoco.MjData, size: list[float], picture: Path) -> Path:
    """Write a PNG with two rows of pictures from around the object.

    Args:
        model: Scene of `_scene`.
        data: State to render.
        size: Extents of the object, (3,) [m].
        picture: File to write; its folder is created.

    Returns:
        `picture`.

    Raises:
        RenderError: Nothing can be rendered on this machine.
    """
    frames = np.zeros((VIEWS, _PIXELS, _PIXELS, 3), np.uint8)
    with Renderer(model, _PIXELS, _PIXELS) as renderer:
        reach, centre = float(np.linalg.norm(size)), data.body(_BODY).xpos
        for k, frame in enumerate(frames):
            _aim(model, centre, 1.9 * reach, 2 * np.pi * k / VIEWS)
            mujoco.mj_camlight(model, data)
            renderer.render(data, [RenderTarget(0, frame)])
    rows = np.concatenate(np.split(frames, 2), axis=1)  # (4, 2 H, W, 3)
    picture.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(list(rows), axis=1)).save(picture)
    return picture


def _put_down(item: ObjectModel) -> tuple[mujoco.MjModel, mujoco.MjData, dict[str, Any]]:
    """Return a scene with an object just above a floor as it rests, its mass [kg], size [m], and what placement needs.

    Raises:
        LiberoError: The model cannot be compiled, or it has no collision geoms.
    """
    model = _scene(item)
    body, quat, mat = model.body(_BODY).id, item.rest_quat(), np.zeros(9)
    mujoco.mju_quat2Mat(mat, quat)
    points = surface_points(model, body) @ mat.reshape(3, 3).T
    if not len(points):
        raise LiberoError("it has no collision geoms; give it a geom with contype and conaffinity 1")
    low, high = points.min(axis=0), points.max(axis=0)
    found: dict[str, Any] = {
        "mass": round(float(model.body_subtreemass[body]), 5),
        "size": [round(float(value), 5) for value in high - low],
        "bottom_offset": [0.0, 0.0, round(float(low[2]), 5)],
        "top_offset": [0.0, 0.0, round(float(high[2]), 5)],
        "horizontal_radius": round(float(np.linalg.norm(points[:, :2], axis=1).max()), 5),
    }
    data = mujoco.MjData(model)
    data.qpos[:7] = (0.0, 0.0, 0.001 - found["bottom_offset"][2], *quat)
    mujoco.mj_forward(model, data)
    return model, data, found


def _scene(item: ObjectModel) -> mujoco.MjModel:
    """Return a scene of the object on a floor, with a free joint and a camera."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.impratio, spec.option.cone = 0.002, 20.0, mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.visual.quality.offsamples = 0
    spec.visual.map.znear, spec.visual.headlight.ambient = 0.005, [0.35] * 3
    grey = (0.55, 0.57, 0.6, 1.0)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(10, 10, 1), rgba=grey, group=1)
    light = spec.worldbody.add_light(pos=(0.5, -0.5, 2.0), dir=(-0.2, 0.2, -1.0))
    make_directional(light)
    spec.worldbody.add_camera(name="turntable", fovy=35.0)
    joint = item.spec.body(ROOT_BODY).add_joint(name="joint0", type=mujoco.mjtJoint.mjJNT_FREE)
    set_damping(joint, item.joint_damping)
    spec.attach(item.spec, frame=spec.worldbody.add_frame(), prefix=_PREFIX)
    log_warnings()
    try:
        return spec.compile()
    except ValueError as error:
        raise LiberoError(f"{item.category}: {' '.join(str(error).split())}") from error


def _aim(model: mujoco.MjModel, centre: np.ndarray, distance: float, yaw: float) -> None:
    """Place the camera at a distance from the centre, 30 degrees above it."""
    back = np.array([np.cos(yaw) * np.cos(0.52), np.sin(yaw) * np.cos(0.52), np.sin(0.52)])
    right = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    axes = np.stack([right, np.cross(back, right), back], axis=1)
    model.cam_pos[0] = centre + distance * back
    mujoco.mju_mat2Quat(model.cam_quat[0], axes.ravel())


def _stands(model: mujoco.MjModel, data: mujoco.MjData, notify: Notify) -> bool:
    """Return whether the object stays where it is put down; `data` ends in the state at rest."""
    body = data.body(_BODY)
    before = body.xmat.reshape(3, 3).copy()
    for _ in range(round(_SECONDS / model.opt.timestep)):
        mujoco.mj_step(model, data)
    if data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number or not np.isfinite(data.qpos).all():
        notify("its simulation is unstable; check its masses, inertias and joints")
        mujoco.mj_resetData(model, data)
        mujoco.mj_forward(model, data)
        return False
    tilt = float(np.degrees(np.arccos(np.clip((body.xmat.reshape(3, 3) @ before.T)[2, 2], -1.0, 1.0))))
    slid = float(np.linalg.norm(body.xpos[:2]))
    stands = tilt < _MAX_TILT and slid < _MAX_SHIFT
    if not stands:
        notify(
            f"it does not stay where it is put down: it tilts by {tilt:.0f} degrees and moves by {100 * slid:.0f} cm. "
            "Set the axis that points up (--up), or give it a level bottom (--collision hull)"
        )
    return stands


def _grasp(model: mujoco.MjModel, data: mujoco.MjData, name: str, notify: Notify) -> dict[str, Any]:
    """Return the narrowest grasp from above of the object where it lies now, or the reason why there is none."""
    body = data.body(_BODY)
    cloud = surface_points(model, body.id, _SPACING) @ body.xmat.reshape(3, 3).T + body.xpos
    try:
        found = find_grasps(cloud, 0.0, np.array([0.0, 1.0, 0.0]), name=name, max_count=400, spacing=0.01)
        reason = f"{name}: only its edges fit between the fingers, which would slip off; its faces are too far apart"
    except GraspError as error:
        found, reason = [], str(error)
    square = [hold for hold in found if _is_square(cloud, hold)]
    if square:
        best = min(square, key=lambda hold: (round(float(hold.width), 3), hold.cost))
        return {"width": round(float(best.width), 4), "height": round(float(best.pos_world[2]), 4)}
    notify(
        f"{reason}. It can support or contain other objects; to be picked up, a part of it must be at most "
        f"{100 * GRIPPER.max_grasp_width:.1f} cm wide (--size)"
    )
    return {"width": None, "reason": reason}


def _is_square(cloud: np.ndarray, hold: Grasp) -> bool:
    """Return whether the finger pads touch faces across the closing direction, and not the two sides of an edge."""
    along, across, down = ((cloud - hold.pos_world) @ hold.mat).T
    near = (np.abs(along) < 0.5 * hold.width + _SPACING) & (np.abs(across) < GRIPPER.finger_half_width)
    near &= (down < GRIPPER.pad_below) & (down > -GRIPPER.pad_above)
    for side in (along, -along):
        halves = [side[near & half] for half in (across < 0, across >= 0)]
        if not all(map(len, halves)) or abs(halves[0].max() - halves[1].max()) > _MAX_SLANT:
            return False
    return True
