"""Kinds that change how a scene is drawn: the agent's camera and the lights."""

import mujoco
import numpy as np

from libero_env.geometry import quat_multiply, quat_to_mat, rotation_about
from libero_env.perturbations.drawing import direction, sign
from libero_env.perturbations.kind import Kind
from libero_env.sim.look import HEADLIGHT, CameraView, Lamp, Look
from libero_env.sim.scene import Scene

CAMERA = "agentview"  # the camera that does not move with the robot
_DISTANCE = 1.2  # factor of the distance, or its inverse, at the full angle
_FULL_ANGLE = 30.0  # [degrees]
_LAMP_ANGLE = 60.0  # [degrees] by which lights turn at the full ratio
_FULL_RATIO = 3.0


def orbit(scene: Scene, axis_angle: float, degrees: float, factor: float, camera: str = CAMERA) -> CameraView:
    """Return the view of a camera that was moved on a sphere about the point of the workspace that it looks at.

    Args:
        scene: Scene with the camera.
        axis_angle: Direction of the movement in the image: 0 moves the camera to its right, pi / 2 upwards, [rad].
        degrees: Angle between the rays from the point to the camera before and after.
        factor: Ratio of the distances from the point after and before.
        camera: Name of the camera.
    """
    model = scene.model
    index = model.camera(camera).id
    pos, quat = model.cam_pos[index], model.cam_quat[index]
    mat = quat_to_mat(quat)
    pivot = pivot_of(scene, camera)
    across = -np.sin(axis_angle) * mat[:, 0] + np.cos(axis_angle) * mat[:, 1]  # axis of the movement
    turn = rotation_about(across, np.deg2rad(degrees))
    turn_quat = np.zeros(4)
    mujoco.mju_mat2Quat(turn_quat, turn.ravel())
    moved = pivot + factor * turn @ (pos - pivot)
    turned = quat_multiply(turn_quat[None], quat[None])[0]
    return CameraView(pos=tuple(moved.tolist()), quat=tuple(turned.tolist()))


def pivot_of(scene: Scene, camera: str = CAMERA) -> np.ndarray:
    """Return the point (3,) where the axis of a camera meets the surface that objects stand on, [m]."""
    model = scene.model
    index = model.camera(camera).id
    forward = -quat_to_mat(model.cam_quat[index])[:, 2]
    reach = (scene.workspace.surface_height - model.cam_pos[index][2]) / forward[2]
    return model.cam_pos[index] + reach * forward


def _camera(degrees: float, rng: np.random.Generator, scene: Scene) -> Look:
    towards, factor = rng.uniform(0, 2 * np.pi), _DISTANCE ** (sign(rng) * degrees / _FULL_ANGLE)
    return Look(cameras={CAMERA: orbit(scene, towards, degrees, factor)})


def _fov(degrees: float, rng: np.random.Generator, scene: Scene) -> Look:
    fovy = float(scene.model.cam_fovy[scene.model.camera(CAMERA).id]) + sign(rng) * degrees
    return Look(cameras={CAMERA: CameraView(fovy=fovy)})


def _light(ratio: float, rng: np.random.Generator, scene: Scene) -> Look:
    model, factor = scene.model, ratio ** sign(rng)
    share = np.log(ratio) / np.log(_FULL_RATIO)
    axis = direction(rng, 3) * (1.0, 1.0, 0.0)
    turn = rotation_about(axis / np.linalg.norm(axis), np.deg2rad(_LAMP_ANGLE * share))
    head = model.vis.headlight
    lamps = {HEADLIGHT: _scaled(head.ambient, head.diffuse, head.specular, factor)}
    for i in range(model.nlight):
        lamp = _scaled(model.light_ambient[i], model.light_diffuse[i], model.light_specular[i], factor)
        turned = tuple((turn @ model.light_dir[i]).tolist())
        lamps[model.light(i).name] = Lamp(None, turned, lamp.ambient, lamp.diffuse, lamp.specular)
    return Look(lights=lamps)


def _scaled(ambient: np.ndarray, diffuse: np.ndarray, specular: np.ndarray, factor: float) -> Lamp:
    colours = [tuple((factor * np.asarray(c, float)).tolist()) for c in (ambient, diffuse, specular)]
    return Lamp(ambient=colours[0], diffuse=colours[1], specular=colours[2])


KINDS = (
    Kind(
        "camera",
        "look",
        "degrees",
        _FULL_ANGLE,
        "the agent's camera moves about the point of the workspace that it looks at, and up to 1.2 times nearer or "
        "farther",
        _camera,
    ),
    Kind("fov", "look", "degrees", 20.0, "the agent's camera has a wider or narrower field of view", _fov),
    Kind(
        "light",
        "look",
        "lux ratio",
        _FULL_RATIO,
        "all lights are brighter or darker by this factor, and turned by up to 60 degrees",
        _light,
        scale="ratio",
    ),
)
