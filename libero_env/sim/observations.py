"""Observations of a simulation, and their conventions.

Names that `observations=` takes, and the entries they give (H W: `camera_size`; in a batch with a leading axis):

| name | entries |
|---|---|
| `rgb` | `<camera>_rgb` (H, W, 3) uint8, first row on top |
| `depth` | `<camera>_depth` (H, W) float32, metres along the optical axis |
| `segmentation_instance`, `_class`, `_element` | `<camera>_segmentation` (H, W) int32; see `Observer.labels` |
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
from dataclasses import dataclass

import numpy as np
from gymnasium import spaces

from libero_env.errors import LiberoError, require_known
from libero_env.geometry import quat_multiply, quat_rotate, quat_to_axis_angle
from libero_env.mujoco_compat import mujoco
from libero_env.objects.model import ROOT_BODY
from libero_env.sim.appearance import Appearance, SceneAppearance
from libero_env.sim.predicates import glowing_sites
from libero_env.sim.render import Renderer, RenderTarget
from libero_env.sim.scene import Scene
from libero_env.sim.scene_spec import FAITHFUL
from libero_env.sim.simulation import Indices, Simulations
from libero_env.sim.state import StateView
from libero_env.tasks.cameras import camera_name, image_stem

SEGMENTATIONS = ("instance", "class", "element")
ARENA, ARM, GRIPPER = "arena", "robot", "gripper"
DEFAULT_CAMERAS = ("agentview", "robot0_eye_in_hand")
DEFAULT_OBSERVATIONS = ("rgb", "proprioception")
PROPRIOCEPTION = ("joint_states", "gripper_states", "ee_pos", "ee_ori")
_ROBOT = {  # entry about the robot -> bound, which is never reached
    "joint_states": 2 * np.pi,
    "gripper_states": 1.0,
    "ee_pos": 10.0,
    "ee_ori": 2 * np.pi,
    "ee_quat": 1.0,
    "joint_velocities": 1e3,
    "gripper_velocities": 1e3,
}
_OBJECTS = {"pos": 1e4, "quat": 1.0, "joints": 1e3}  # the same of entries about objects, by their last word
_IMAGES = {"rgb": ((3,), np.uint8), "depth": ((), np.float32), "segmentation": ((), np.int32)}
_BOUNDS = {np.uint8: (0, 255), np.float32: (0.0, 1e4), np.int32: (0, 2**24)}
IMAGES = ("rgb", "depth", *(f"segmentation_{kind}" for kind in SEGMENTATIONS))
NAMES = (*IMAGES, "proprioception", *_ROBOT, "objects")


def is_of_joints(name: str) -> bool:
    """Return whether an entry is of joints, and not of poses, which the simulation computes from them."""
    return name.startswith(("joint_", "gripper_")) if name in _ROBOT else name.endswith("_joints")


@dataclass(frozen=True)
class Labels:
    """Labels of rendered elements, and the names of the labels.

    Attributes:
        of_element: Label of each number that `libero_env.sim.render` writes, (1 + ngeom + nsite,) int32.
        names: Name of each label.
    """

    of_element: np.ndarray
    names: dict[int, str]


class Observer:
    """Observer of the simulations of one scene.

    Args:
        scene: Scene that is simulated.
        simulations: Simulations to observe.
        observations: Names of the table above.
        cameras: Cameras to render, empty for none: names, or texts of cameras that were added to the scene.
        camera_size: Height and width of the images, pixels.

    Attributes:
        views: State view of each simulation.

    Raises:
        UnknownNameError: An observation or a camera does not exist.
        LiberoError: Several kinds of segmentation are given.
    """

    def __init__(
        self,
        scene: Scene,
        simulations: Simulations,
        *,
        observations: Sequence[str] = DEFAULT_OBSERVATIONS,
        cameras: Sequence[str] = DEFAULT_CAMERAS,
        camera_size: tuple[int, int] = (128, 128),
    ):
        for name in observations:
            require_known("observation", name, NAMES)
        kinds = [kind for kind in SEGMENTATIONS if f"segmentation_{kind}" in observations]
        if len(kinds) > 1:
            raise LiberoError(f"observations: one kind of segmentation at a time, got {', '.join(kinds)}")
        self.scene, self.simulations = scene, simulations
        self.views = [StateView(scene, simulations, i) for i in range(simulations.num)]
        self.camera_size = (int(camera_size[0]), int(camera_size[1]))
        self.renderer = Renderer(scene.model, *self.camera_size, faithful=scene.drawing == FAITHFUL)
        self.segmentation = kinds[0] if kinds else None
        self._kinds = [k for k in ("rgb", "depth") if k in observations] + (["segmentation"] if kinds else [])
        self._cameras = {name: self.renderer.camera_id(name) for name in map(camera_name, cameras)}
        selected = {*observations, *(PROPRIOCEPTION if "proprioception" in observations else ())}
        self._robot = [name for name in _ROBOT if name in selected]
        self._entities = tuple(scene.entities) if "objects" in observations else ()
        self._hand = scene.model.body("robot0_right_hand").id
        self._labels_of: dict[str, Labels] = {}
        self._appearances: dict[int, SceneAppearance] = {}
        self._data = mujoco.MjData(scene.model)  # kinematics of the simulation that is rendered

    def set_appearance(self, i: int, appearance: Appearance) -> None:
        """Draw simulation i otherwise than its model says, until this is called again.

        Raises:
            UnknownNameError: The appearance names a camera, a light, a material or an object that does not exist.
        """
        if appearance == Appearance():
            self._appearances.pop(i, None)
        else:
            self._appearances[i] = SceneAppearance(appearance, self.scene)

    def space(self) -> spaces.Dict:
        """Return the observation space of one simulation."""
        images = {
            key: spaces.Box(*_BOUNDS[rows.dtype.type], rows.shape[1:], rows.dtype.type)
            for key, rows in self.empty_images(1).items()
        }
        vectors = {}
        for name, rows in self.state().items():
            bound = _ROBOT[name] if name in self._robot else _OBJECTS[name.rpartition("_")[2]]
            bound *= 1.0 + 1e-6  # for rounding
            vectors[name] = spaces.Box(-bound, bound, rows.shape[1:], np.float64)
        return spaces.Dict({**images, **vectors})

    def state(self) -> dict[str, np.ndarray]:
        """Return all entries except images, of all simulations: name -> (num, length) float64."""
        fields, nq, model = self.simulations.fields, self.scene.nq_robot, self.scene.model
        qpos, qvel = fields["qpos"], fields["qvel"]
        ee_pos, ee_quat = fields["site_xpos"][:, self.simulations.arm.site], fields["xquat"][:, self._hand]
        robot = {
            "joint_states": qpos[:, :7],
            "gripper_states": qpos[:, 7:nq],
            "ee_pos": ee_pos,
            "ee_ori": quat_to_axis_angle(ee_quat),
            "ee_quat": ee_quat,
            "joint_velocities": qvel[:, :7],
            "gripper_velocities": qvel[:, 7:nq],
        }
        entries = {name: robot[name].copy() for name in self._robot}
        world_to_ee = ee_quat * (1.0, -1.0, -1.0, -1.0)
        for name in self._entities:
            body = model.body(f"{name}_{ROOT_BODY}").id
            pos, quat = fields["xpos"][:, body].copy(), fields["xquat"][:, body].copy()
            entries |= {f"{name}_pos": pos, f"{name}_quat": quat}
            entries[f"{name}_to_ee_pos"] = quat_rotate(world_to_ee, pos - ee_pos)
            entries[f"{name}_to_ee_quat"] = quat_multiply(world_to_ee, quat)
            if joints := self.scene.joints[name]:
                entries[f"{name}_joints"] = qpos[:, model.jnt_qposadr[list(joints)]]
        return entries

    def empty_images(self, num: int | None = None) -> dict[str, np.ndarray]:
        """Return zero arrays for `render_cameras`: entry -> (num, height, width, ...).

        Args:
            num: Number of rows; by default one for each simulation.
        """
        size = (self.simulations.num if num is None else num, *self.camera_size)
        return {
            image_name(camera, kind): np.zeros((*size, *_IMAGES[kind][0]), _IMAGES[kind][1])
            for camera in self._cameras
            for kind in self._kinds
        }

    def render_cameras(self, ids: Indices, images: dict[str, np.ndarray]) -> None:
        """Render the observed images of simulations.

        Args:
            images: Arrays of `empty_images`, whose rows `ids` are overwritten.
        """
        if not images:
            return
        for i in ids:
            self._render(
                i,
                [
                    RenderTarget(index, **{kind: images[image_name(camera, kind)][i] for kind in self._kinds})
                    for camera, index in self._cameras.items()
                ],
            )
            if self.segmentation:
                for camera in self._cameras:
                    rows = images[image_name(camera, "segmentation")]
                    rows[i] = self._labels(self.segmentation).of_element[rows[i]]

    def render(self, i: int, camera: str, kind: str = "rgb") -> np.ndarray:
        """Render one image of simulation i, from any camera of the model.

        Args:
            i: Index of the simulation.
            kind: `rgb`, `depth`, or `segmentation_instance`, `_class` or `_element`.

        Returns:
            The image, (height, width, 3) uint8, (height, width) float32 or (height, width) int32.

        Raises:
            UnknownNameError: The camera or the kind does not exist.
        """
        require_known("image", kind, IMAGES)
        base, _, segmentation = kind.partition("_")
        channels, dtype = _IMAGES[base]
        out = np.empty((*self.camera_size, *channels), dtype)
        self._render(i, [RenderTarget(self.renderer.camera_id(camera), **{base: out})])
        return self._labels(segmentation).of_element[out] if segmentation else out

    def labels(self, kind: str | None = None) -> dict[int, str]:
        """Return the meaning of each number of a segmentation; by default of the observed one."""
        return dict(self._labels(kind or self.segmentation or "instance").names)

    def camera_to_world(self, i: int, camera: str) -> np.ndarray:
        """Return the pose of a camera in simulation i, (4, 4); axes as in OpenCV: x right, y down, z forward."""
        index = self.renderer.camera_id(camera)
        self._update_kinematics(i)
        pose = np.eye(4)
        pose[:3, :3] = self._data.cam_xmat[index].reshape(3, 3) * (1.0, -1.0, -1.0)
        pose[:3, 3] = self._data.cam_xpos[index]
        return pose

    def intrinsics(self, camera: str, i: int = 0) -> np.ndarray:
        """Return the camera matrix (3, 3) of simulation i, pixels.

        It maps the camera frame, axes as in OpenCV, to columns and rows; (0, 0) is the top left corner of the image.
        """
        (height, width), index = self.camera_size, self.renderer.camera_id(camera)
        own = self._appearances[i].fovy(index) if i in self._appearances else None
        fovy = np.deg2rad(self.scene.model.cam_fovy[index] if own is None else own)
        focal = 0.5 * height / np.tan(0.5 * fovy)
        return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])

    def close(self) -> None:
        """Free the OpenGL context."""
        self.renderer.close()

    def _labels(self, kind: str) -> Labels:
        if kind not in self._labels_of:
            self._labels_of[kind] = segmentation_labels(self.scene, kind)
        return self._labels_of[kind]

    def _render(self, i: int, targets: list[RenderTarget]) -> None:
        self._update_kinematics(i)
        self.renderer.render(self._data, targets, glowing_sites(self.views[i]), self._appearances.get(i))

    def _update_kinematics(self, i: int) -> None:
        data, model = self._data, self.simulations.model
        self.simulations.pose_fixtures(i)
        data.qpos[:] = self.simulations.fields["qpos"][i]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        if (appearance := self._appearances.get(i)) is not None:
            appearance.place_cameras(data)


def segmentation_labels(scene: Scene, kind: str) -> Labels:
    """Return the labels of a kind of segmentation.

    `instance`: 0 is the arena and everything without a name of its own, 1 the robot with its mount, 2 the gripper, then
    objects and fixtures in the order of the task file. `class`: the same, with one number for each category.
    `element`: 1 + index of the geom, or 1 + number of geoms + index of the site; 0 for the background.

    Args:
        scene: Scene that is rendered.
        kind: `instance`, `class` or `element`.

    Raises:
        UnknownNameError: The kind does not exist.
    """
    model = scene.model
    if kind == "element":
        geoms = {1 + i: model.geom(i).name or f"geom{i}" for i in range(model.ngeom)}
        sites = {1 + model.ngeom + i: model.site(i).name or f"site{i}" for i in range(model.nsite)}
        return Labels(
            np.arange(1 + model.ngeom + model.nsite, dtype=np.int32), {0: "nothing", **geoms, **sites}
        )
    require_known("segmentation", kind, SEGMENTATIONS)
    entities = {name: name if kind == "instance" else item.category for name, item in scene.entities.items()}
    names = dict(enumerate(dict.fromkeys((ARENA, ARM, GRIPPER, *entities.values()))))
    numbers = {name: number for number, name in names.items()}
    of_body = np.zeros(model.nbody, np.int32)
    for body in range(model.nbody):
        name = model.body(body).name
        if name.startswith(("robot0_", "mount0_")):
            of_body[body] = numbers[ARM]
        elif name.startswith("gripper0_"):
            of_body[body] = numbers[GRIPPER]
    for name, label in entities.items():
        of_body[scene.bodies[name]] = numbers[label]
    of_element = np.concatenate([[0], of_body[model.geom_bodyid], of_body[model.site_bodyid]])
    return Labels(of_element.astype(np.int32), names)


def image_name(camera: str, kind: str) -> str:
    """Return the name of a camera's images in observations: `robot0_eye_in_hand`, `rgb` -> `eye_in_hand_rgb`.

    Args:
        camera: Name of the camera, or the text of one that is added.
    """
    return f"{image_stem(camera)}_{kind}"
