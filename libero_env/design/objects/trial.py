"""What an object is like before any task has it: does it stand, can the gripper hold it, what does it look like."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from PIL import Image

from libero_env.design.objects.mesh_file import Notify
from libero_env.errors import LiberoError
from libero_env.expert.arm.gripper import FINGER_HALF_WIDTH, PAD_ABOVE, PAD_BELOW, WIDEST
from libero_env.expert.grasping.grasps import Grasp, GraspError, grasps
from libero_env.geometry import surface_points
from libero_env.mujoco_compat import set_damping
from libero_env.objects.model import ROOT_BODY, ObjectModel
from libero_env.sim.render import Renderer, RenderTarget

_PREFIX = "object_"
_BODY = _PREFIX + ROOT_BODY
_FINE = 0.004  # m between points that widths are measured by
_SECONDS = 1.5  # of standing
_TILTED, _SHIFTED = 10.0, 0.02  # degrees and m that say it fell over or slid away
_ASLANT = 0.006  # m, from one half of a pad to the other
VIEWS = 8
_PIXELS = 224


def try_object(item: ObjectModel, notify: Notify, picture: Path | None = None) -> dict[str, Any]:
    """Put an object down, look for a hold, and draw it from all sides.

    Args:
        item: Fresh; its spec is used up.
        notify: Takes a line about what tasks with it would suffer from.
        picture: PNG to write; None for none.

    Returns:
        `size` (m), placement's figures, `stands`, and `grasp`: the width of the narrowest hold, m, or why none.

    Raises:
        LiberoError: It cannot be compiled, or nothing of it collides.
    """
    model = _stage(item)
    found: dict[str, Any] = {**figures(surface_points(model, model.body(_BODY).id))}
    data = mujoco.MjData(model)
    data.qpos[:3] = (0.0, 0.0, 0.001 - found["bottom_offset"][2])
    mujoco.mj_forward(model, data)
    if picture is not None:
        turntable(model, data, found["size"], picture)
    found |= {"stands": _stands(model, data, notify), "grasp": _grasp(model, data, item.category, notify)}
    return found


def draw_object(item: ObjectModel, picture: Path) -> Path:
    """Draw an object from all sides into a PNG file.

    Raises:
        LiberoError: It cannot be compiled, or no picture can be drawn here.
    """
    model = _stage(item)
    found, data = figures(surface_points(model, model.body(_BODY).id)), mujoco.MjData(model)
    data.qpos[:3] = (0.0, 0.0, 0.001 - found["bottom_offset"][2])
    data.qpos[3:7] = item.rest_quat()
    mujoco.mj_forward(model, data)
    return turntable(model, data, found["size"], picture)


def figures(points: np.ndarray) -> dict[str, Any]:
    """What placement needs to know of points (n, 3) on an object, m.

    Raises:
        LiberoError: There are none.
    """
    if not len(points):
        raise LiberoError("nothing of it collides; give it a geom with contype and conaffinity 1")
    low, high = points.min(axis=0), points.max(axis=0)
    return {
        "size": [round(float(value), 5) for value in high - low],
        "bottom_offset": [0.0, 0.0, round(float(low[2]), 5)],
        "top_offset": [0.0, 0.0, round(float(high[2]), 5)],
        "horizontal_radius": round(float(np.linalg.norm(points[:, :2], axis=1).max()), 5),
    }


def turntable(model: mujoco.MjModel, data: mujoco.MjData, size: list[float], picture: Path) -> Path:
    """Return a sheet of pictures (two rows) from around the origin, as PNG.

    Raises:
        RenderError: No picture can be drawn here.
    """
    frames = np.zeros((VIEWS, _PIXELS, _PIXELS, 3), np.uint8)
    with Renderer(model, _PIXELS, _PIXELS) as renderer:
        reach, middle = float(np.linalg.norm(size)), data.body(_BODY).xpos
        for k, frame in enumerate(frames):
            _aim(model, middle, 1.9 * reach, 2 * np.pi * k / VIEWS)
            mujoco.mj_camlight(model, data)
            renderer.render(data, [RenderTarget(0, frame)])
    rows = np.concatenate(np.split(frames, 2), axis=1)  # (4, 2 H, W, 3)
    picture.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(list(rows), axis=1)).save(picture)
    return picture


def _stage(item: ObjectModel) -> mujoco.MjModel:
    """Return the object on a floor, with a free joint and a camera."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.impratio, spec.option.cone = 0.002, 20.0, mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.visual.quality.offsamples = 0
    spec.visual.map.znear, spec.visual.headlight.ambient = 0.005, [0.35] * 3
    grey = (0.55, 0.57, 0.6, 1.0)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(10, 10, 1), rgba=grey, group=1)
    spec.worldbody.add_light(
        pos=(0.5, -0.5, 2.0), dir=(-0.2, 0.2, -1.0), type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    )
    spec.worldbody.add_camera(name="turntable", fovy=35.0)
    joint = item.spec.body(ROOT_BODY).add_joint(name="joint0", type=mujoco.mjtJoint.mjJNT_FREE)
    set_damping(joint, item.joint_damping)
    spec.attach(item.spec, frame=spec.worldbody.add_frame(), prefix=_PREFIX)
    try:
        return spec.compile()
    except ValueError as error:
        raise LiberoError(f"{item.category}: {error}") from error


def _aim(model: mujoco.MjModel, middle: np.ndarray, distance: float, yaw: float) -> None:
    """Put the camera so far from the middle, 30 degrees above it."""
    back = np.array([np.cos(yaw) * np.cos(0.52), np.sin(yaw) * np.cos(0.52), np.sin(0.52)])
    right = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    axes = np.stack([right, np.cross(back, right), back], axis=1)
    model.cam_pos[0] = middle + distance * back
    mujoco.mju_mat2Quat(model.cam_quat[0], axes.ravel())


def _stands(model: mujoco.MjModel, data: mujoco.MjData, notify: Notify) -> bool:
    """Return whether it stays as it is put down; the state is left where it came to rest."""
    for _ in range(round(_SECONDS / model.opt.timestep)):
        mujoco.mj_step(model, data)
    body = data.body(_BODY)
    tilt = float(np.degrees(np.arccos(np.clip(body.xmat.reshape(3, 3)[2, 2], -1.0, 1.0))))
    slid = float(np.linalg.norm(body.xpos[:2]))
    stands = tilt < _TILTED and slid < _SHIFTED
    if not stands:
        notify(
            f"it does not stay as it is put down: it tilts by {tilt:.0f} degrees and moves by {100 * slid:.0f} cm. "
            "Say which axis is up (--up), or give it a level bottom (--collision hull)"
        )
    return stands


def _grasp(model: mujoco.MjModel, data: mujoco.MjData, name: str, notify: Notify) -> dict[str, Any]:
    """Return the narrowest grasp from above of the object where it lies now, or the reason why there is none."""
    body = data.body(_BODY)
    cloud = surface_points(model, body.id, _FINE) @ body.xmat.reshape(3, 3).T + body.xpos
    try:
        found = grasps(cloud, 0.0, np.array([0.0, 1.0, 0.0]), name=name, number=400, apart=0.01)
        reason = (
            f"{name}: only its edges fit between the fingers, which slip off; its faces are too far apart"
        )
    except GraspError as error:
        found, reason = [], str(error)
    square = [hold for hold in found if _is_square(cloud, hold)]
    if square:
        best = min(square, key=lambda hold: (round(float(hold.width), 3), hold.cost))
        return {"width": round(float(best.width), 4), "height": round(float(best.pos_world[2]), 4)}
    notify(
        f"{reason}. It can carry or hold other things; to be picked up, a part of it must be at most "
        f"{100 * WIDEST:.1f} cm wide (--size)"
    )
    return {"width": None, "reason": reason}


def _is_square(cloud: np.ndarray, hold: Grasp) -> bool:
    """Return whether the pads meet faces that stand across the way they close, and not the two sides of an edge."""
    along, across, down = ((cloud - hold.pos_world) @ hold.mat).T
    near = (np.abs(along) < 0.5 * hold.width + _FINE) & (np.abs(across) < FINGER_HALF_WIDTH)
    near &= (down < PAD_BELOW) & (down > -PAD_ABOVE)
    for side in (along, -along):
        halves = [side[near & half] for half in (across < 0, across >= 0)]
        if not all(map(len, halves)) or abs(halves[0].max() - halves[1].max()) > _ASLANT:
            return False
    return True
