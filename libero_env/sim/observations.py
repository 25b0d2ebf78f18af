"""What a policy may see of a simulation, and the conventions of it.

Names that `observations=` takes, and the entries they give (H W: `camera_size`; in a batch with a leading axis):

| name | entries |
|---|---|
| `rgb` | `<camera>_rgb` (H, W, 3) uint8, first row on top |
| `depth` | `<camera>_depth` (H, W) float32, metres along the optical axis |
| `segmentation_instance`, `_class`, `_element` | `<camera>_segmentation` (H, W) int32; `Observer.labels` says of what |
| `proprioception` | the first four of the following |
| `joint_states` | (7,) rad |
| `gripper_states` | (2,) m |
| `ee_pos` | (3,) m, the grip site |
| `ee_ori` | (3,) rotation vector, rad, of the hand |
| `ee_quat` | (4,) wxyz, of the hand |
| `joint_velocities` | (7,) rad/s |
| `gripper_velocities` | (2,) m/s |
| `objects` | of each object and fixture `<name>_pos` (3,) and `<name>_quat` (4,) wxyz; the same in the hand frame at |
| | the grip site, `<name>_to_ee_pos` and `<name>_to_ee_quat`; where it has joints `<name>_joints` (k,) rad or m |

`<camera>` is the camera's name without `robot0_`. Poses are in the world frame unless said otherwise.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from gymnasium import spaces

from libero_env.errors import LiberoError, UnknownNameError
from libero_env.geometry import quat_multiply, quat_rotate, quat_to_axis_angle
from libero_env.objects.model import ROOT_BODY
from libero_env.sim.predicates import glowing_sites
from libero_env.sim.render import Picture, Renderer
from libero_env.sim.scene import Scene
from libero_env.sim.segmentation import SEGMENTATIONS, Labels, labels
from libero_env.sim.simulation import Simulations
from libero_env.sim.state import StateView

DEFAULT_CAMERAS = ("agentview", "robot0_eye_in_hand")
DEFAULT_OBSERVATIONS = ("rgb", "proprioception")
PROPRIOCEPTION = ("joint_states", "gripper_states", "ee_pos", "ee_ori")
# Entry -> (length, bound): what a policy can be told about the robot; bounds are never reached.
_ROBOT = {
    "joint_states": (7, 2 * np.pi),
    "gripper_states": (2, 1.0),
    "ee_pos": (3, 10.0),
    "ee_ori": (3, 2 * np.pi),
    "ee_quat": (4, 1.0),
    "joint_velocities": (7, 1e3),
    "gripper_velocities": (2, 1e3),
}
_FAR = 1e4  # m, farther than anything falls in an episode
_FRAMES = {"rgb": ((3,), np.uint8), "depth": ((), np.float32), "segmentation": ((), np.int32)}
_BOUNDS = {np.uint8: (0, 255), np.float32: (0.0, 1e4), np.int32: (0, 2**24)}
_PICTURES = ("rgb", "depth", *(f"segmentation_{kind}" for kind in SEGMENTATIONS))
NAMES = (*_PICTURES, "proprioception", *_ROBOT, "objects")


class Observer:
    """Observes the simulations of one scene.

    Args:
        scene, simulations: what is observed.
        views: one for each simulation.
        observations: names of the table above.
        cameras: what is drawn; empty for nothing.
        camera_size: (height, width), pixels.

    Raises:
        UnknownNameError: no such name or camera.
        LiberoError: several kinds of segmentation.
    """

    def __init__(
        self,
        scene: Scene,
        simulations: Simulations,
        views: Sequence[StateView],
        *,
        observations: Sequence[str] = DEFAULT_OBSERVATIONS,
        cameras: Sequence[str] = DEFAULT_CAMERAS,
        camera_size: tuple[int, int] = (128, 128),
    ):
        for name in observations:
            if name not in NAMES:
                raise UnknownNameError("observation", name, NAMES)
        kinds = [kind for kind in SEGMENTATIONS if f"segmentation_{kind}" in observations]
        if len(kinds) > 1:
            raise LiberoError(f"observations: one kind of segmentation at a time, got {', '.join(kinds)}")
        self.scene, self.simulations, self.views = scene, simulations, views
        self.camera_size = (int(camera_size[0]), int(camera_size[1]))
        self.renderer = Renderer(scene.model, *self.camera_size)
        self.segmentation = kinds[0] if kinds else None
        self._kinds = [k for k in ("rgb", "depth") if k in observations] + (["segmentation"] if kinds else [])
        self._cameras = {name: self.renderer.camera_id(name) for name in cameras}
        wanted = {*observations, *(PROPRIOCEPTION if "proprioception" in observations else ())}
        self._robot = [name for name in _ROBOT if name in wanted]
        self._things = _Things(scene) if "objects" in observations else None
        self._hand = scene.model.body("robot0_right_hand").id
        self._known: dict[str, Labels] = {}
        self._data = mujoco.MjData(scene.model)  # kinematics of the simulation being drawn

    def space(self) -> spaces.Dict:
        """The space of one simulation's observations."""
        frames = {
            key: spaces.Box(*_BOUNDS[rows.dtype.type], rows.shape[1:], rows.dtype.type)
            for key, rows in self.empty_frames(1).items()
        }
        robot = {name: box(*_ROBOT[name]) for name in self._robot}
        return spaces.Dict({**frames, **robot, **(self._things.space() if self._things else {})})

    def state(self) -> dict[str, np.ndarray]:
        """All entries but pictures, of all simulations: name -> (num, length) float64."""
        robot = {name: self.robot(name) for name in self._robot}
        return {**robot, **(self._things.observe(self.simulations, self._eef_pose()) if self._things else {})}

    def robot(self, name: str) -> np.ndarray:
        """One entry about the robot, (num, length)."""
        f, nq = self.simulations.fields, self.scene.nq_robot
        match name:
            case "joint_states":
                return f["qpos"][:, :7].copy()
            case "gripper_states":
                return f["qpos"][:, 7:nq].copy()
            case "joint_velocities":
                return f["qvel"][:, :7].copy()
            case "gripper_velocities":
                return f["qvel"][:, 7:nq].copy()
            case "ee_pos":
                return self._eef_pose()[0].copy()
            case "ee_quat":
                return self._eef_pose()[1].copy()
            case "ee_ori":
                return quat_to_axis_angle(self._eef_pose()[1])
        raise UnknownNameError("observation of the robot", name, _ROBOT)

    def empty_frames(self, num: int | None = None) -> dict[str, np.ndarray]:
        """Arrays for `draw`, zero: entry -> (num, height, width, ...); by default one row for each simulation."""
        size = (self.simulations.num if num is None else num, *self.camera_size)
        return {
            entry(camera, kind): np.zeros((*size, *_FRAMES[kind][0]), _FRAMES[kind][1])
            for camera in self._cameras
            for kind in self._kinds
        }

    def draw(self, ids: Sequence[int], frames: dict[str, np.ndarray]) -> None:
        """Draw the cameras for these simulations into rows `ids` of `frames`, which `empty_frames` made."""
        if not frames:
            return
        for i in ids:
            self._draw(
                i,
                [
                    Picture(index, **{kind: frames[entry(camera, kind)][i] for kind in self._kinds})
                    for camera, index in self._cameras.items()
                ],
            )
            if self.segmentation:
                for camera in self._cameras:
                    rows = frames[entry(camera, "segmentation")]
                    rows[i] = self._labels(self.segmentation).of[rows[i]]

    def picture(self, i: int, camera: str, kind: str = "rgb") -> np.ndarray:
        """One picture of simulation i through any camera.

        Args:
            i: which simulation.
            camera: its name in the model.
            kind: `rgb`, `depth`, or `segmentation_instance`, `_class` or `_element`.

        Raises:
            UnknownNameError: no such camera or kind.
        """
        if kind not in _PICTURES:
            raise UnknownNameError("picture", kind, _PICTURES)
        what, _, segmentation = kind.partition("_")
        channels, dtype = _FRAMES[what]
        out = np.empty((*self.camera_size, *channels), dtype)
        self._draw(i, [Picture(self.renderer.camera_id(camera), **{what: out})])
        return self._labels(segmentation).of[out] if segmentation else out

    def labels(self, kind: str | None = None) -> dict[int, str]:
        """What the numbers of a segmentation mean; by default of the one observed."""
        return dict(self._labels(kind or self.segmentation or "instance").names)

    def camera_to_world(self, i: int, camera: str) -> np.ndarray:
        """Pose of a camera in simulation i, (4, 4); camera axes as in OpenCV: x right, y down, z forward."""
        index = self.renderer.camera_id(camera)
        self._pose(i)
        pose = np.eye(4)
        pose[:3, :3] = self._data.cam_xmat[index].reshape(3, 3) * (1.0, -1.0, -1.0)
        pose[:3, 3] = self._data.cam_xpos[index]
        return pose

    def intrinsics(self, camera: str) -> np.ndarray:
        """Camera matrix (3, 3), pixels: camera axes as in OpenCV to columns and rows; (0, 0) is the corner top left."""
        height, width = self.camera_size
        fovy = np.deg2rad(self.scene.model.cam_fovy[self.renderer.camera_id(camera)])
        focal = 0.5 * height / np.tan(0.5 * fovy)
        return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])

    def close(self) -> None:
        """Free the GL context. Idempotent."""
        self.renderer.close()

    def _eef_pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Position of the grip site (num, 3) and orientation of the hand, wxyz (num, 4)."""
        f = self.simulations.fields
        return f["site_xpos"][:, self.simulations.arm.site], f["xquat"][:, self._hand]

    def _labels(self, kind: str) -> Labels:
        if kind not in self._known:
            self._known[kind] = labels(self.scene, kind)
        return self._known[kind]

    def _draw(self, i: int, pictures: list[Picture]) -> None:
        self._pose(i)
        self.renderer.draw(self._data, pictures, glowing_sites(self.views[i]))

    def _pose(self, i: int) -> None:
        data, model = self._data, self.simulations.model
        self.simulations.pose_fixtures(i)
        data.qpos[:] = self.simulations.fields["qpos"][i]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)


class _Things:
    """Poses and joints of objects and fixtures."""

    def __init__(self, scene: Scene):
        model = scene.model
        self._bodies = {
            name: model.body(f"{name}_{ROOT_BODY}").id for name in (*scene.objects, *scene.fixtures)
        }
        joints = {name: [int(model.jnt_qposadr[j]) for j in scene.joints[name]] for name in self._bodies}
        self._joints = {name: addresses for name, addresses in joints.items() if addresses}

    def space(self) -> dict[str, spaces.Box]:
        found: dict[str, spaces.Box] = {}
        for name in self._bodies:
            found |= {f"{name}_pos": box(3, _FAR), f"{name}_quat": box(4, 1.0)}
            found |= {f"{name}_to_ee_pos": box(3, _FAR), f"{name}_to_ee_quat": box(4, 1.0)}
            if name in self._joints:
                found[f"{name}_joints"] = box(len(self._joints[name]), 1e3)
        return found

    def observe(self, simulations: Simulations, eef: tuple[np.ndarray, np.ndarray]) -> dict[str, np.ndarray]:
        f, (eef_pos, eef_quat) = simulations.fields, eef
        back = eef_quat * (1.0, -1.0, -1.0, -1.0)
        found: dict[str, np.ndarray] = {}
        for name, body in self._bodies.items():
            pos, quat = f["xpos"][:, body].copy(), f["xquat"][:, body].copy()
            found |= {f"{name}_pos": pos, f"{name}_quat": quat}
            found[f"{name}_to_ee_pos"] = quat_rotate(back, pos - eef_pos)
            found[f"{name}_to_ee_quat"] = quat_multiply(back, quat)
            if name in self._joints:
                found[f"{name}_joints"] = f["qpos"][:, self._joints[name]]
        return found


def entry(camera: str, kind: str) -> str:
    """Name of a camera's pictures in observations: `robot0_eye_in_hand`, `rgb` -> `eye_in_hand_rgb`."""
    return f"{camera.removeprefix('robot0_')}_{kind}"


def box(length: int, bound: float) -> spaces.Box:
    """Float64 numbers between plus and minus `bound` (and a little, for rounding)."""
    bound *= 1.0 + 1e-6
    return spaces.Box(-bound, bound, (length,), np.float64)
