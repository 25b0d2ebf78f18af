"""The environments that clients make: a task file in, robosuite's observations and the old four-tuple out."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from libero._adapters.envs.sim import MjSim
from libero.libero.envs import bddl_utils as BDDLUtils
from libero.libero.envs import problems  # noqa: F401 - registers the problem classes
from libero.libero.envs.bddl_base_domain import TASK_MAPPING, BDDLBaseDomain
from libero.libero.envs.robots.single_arm import SingleArm
from libero_env.errors import PlacementError, UnknownNameError

_RESETS = 5
DEFAULT_CAMERAS = ("agentview", "robot0_eye_in_hand")


class ControlEnv:
    """One simulation of a task file. `step` returns (observation, reward, success, info); there is no `truncated`.

    Args:
        bddl_file_name: task file; of the benchmark's tasks the name without a folder is enough.
        controller: `OSC_POSE` or `OSC_POSITION`.
        use_camera_obs: whether pictures are drawn.
        camera_names, camera_heights, camera_widths, camera_depths, camera_segmentations: one value, or one per camera.
        has_renderer, render_camera: whether `env.render()` shows a window, and from where; see `Window`.
        horizon: control steps after which `step` raises.
        kwargs: further arguments of `BDDLBaseDomain`.

    Raises:
        BDDLError: it is no task file.
        UnknownNameError: no such problem class, controller or camera.
    """

    def __init__(
        self,
        bddl_file_name: str,
        robots: Any = ("Panda",),
        controller: str = "OSC_POSE",
        gripper_types: Any = "default",
        initialization_noise: Any = None,
        use_camera_obs: bool = True,
        has_renderer: bool = False,
        has_offscreen_renderer: bool = True,
        render_camera: str = "frontview",
        render_collision_mesh: bool = False,
        render_visual_mesh: bool = True,
        render_gpu_device_id: int = -1,
        control_freq: float = 20,
        horizon: int = 1000,
        ignore_done: bool = False,
        hard_reset: bool = True,
        camera_names: str | Sequence[str] = DEFAULT_CAMERAS,
        camera_heights: int | Sequence[int] = 128,
        camera_widths: int | Sequence[int] = 128,
        camera_depths: bool | Sequence[bool] = False,
        camera_segmentations: Any = None,
        renderer: str = "mujoco",
        renderer_config: Any = None,
        **kwargs: Any,
    ):
        info = BDDLUtils.get_problem_info(bddl_file_name)
        self.problem_name, self.domain_name = info["problem_name"], info["domain_name"]
        self.language_instruction = info["language_instruction"]
        if self.problem_name not in TASK_MAPPING:
            raise UnknownNameError("problem", self.problem_name, TASK_MAPPING)
        self.env: BDDLBaseDomain = TASK_MAPPING[self.problem_name](
            bddl_file_name,
            robots=robots,
            controller_configs={"type": controller} if isinstance(controller, str) else controller,
            gripper_types=gripper_types,
            initialization_noise=initialization_noise,
            use_camera_obs=use_camera_obs,
            has_renderer=has_renderer,
            has_offscreen_renderer=has_offscreen_renderer,
            render_camera=render_camera,
            control_freq=control_freq,
            horizon=horizon,
            ignore_done=ignore_done,
            camera_names=camera_names,
            camera_heights=camera_heights,
            camera_widths=camera_widths,
            camera_depths=camera_depths,
            camera_segmentations=camera_segmentations,
            **kwargs,
        )

    @property
    def obj_of_interest(self) -> list[str]:
        """What the task is about."""
        return self.env.obj_of_interest

    @property
    def robots(self) -> list[SingleArm]:
        """The arm, in a list."""
        return self.env.robots

    @property
    def sim(self) -> MjSim:
        """The simulation."""
        return self.env.sim

    @property
    def _visualizations(self) -> set[str]:
        return self.env._visualizations

    def step(self, action: Any) -> tuple[Mapping[str, np.ndarray], float, bool, dict[str, Any]]:
        """Act for 50 ms; see `BDDLBaseDomain.step`."""
        return self.env.step(action)

    def reset(self) -> Mapping[str, np.ndarray]:
        """Place everything anew.

        Raises:
            PlacementError: nothing fits, five times.
        """
        for _ in range(_RESETS - 1):
            try:
                return self.env.reset()
            except PlacementError:
                continue
        return self.env.reset()

    def get_observation(self) -> Mapping[str, np.ndarray]:
        """What was observed last."""
        return self.env._get_observations()

    def check_success(self) -> bool:
        """Whether the goal holds."""
        return self.env._check_success()

    def get_sim_state(self) -> np.ndarray:
        """[time, qpos, qvel]."""
        return self.env.sim.get_state().flatten()

    def set_state(self, mujoco_state: np.ndarray) -> None:
        """Go to a state of `get_sim_state`; see `set_init_state`."""
        self.env.restart(mujoco_state)

    def set_init_state(self, init_state: np.ndarray) -> Mapping[str, np.ndarray]:
        """Go to a state and observe it; the arm holds its pose and the horizon counts from here.

        Args:
            init_state: [time, qpos, qvel], and behind it the poses of the fixtures or nothing.
        """
        self.env.timestep, self.env.done = 0, False
        return self.regenerate_obs_from_state(init_state)

    def regenerate_obs_from_state(self, mujoco_state: np.ndarray) -> Mapping[str, np.ndarray]:
        """Go to a state and observe it."""
        self.set_state(mujoco_state)
        self._post_process()
        self._update_observables(force=True)
        return self.env._get_observations()

    def reset_from_xml_string(self, xml_string: str) -> None:
        """Put the fixtures where a stored model has them; see `BDDLBaseDomain.reset_from_xml_string`."""
        self.env.reset_from_xml_string(xml_string)

    def seed(self, seed: int) -> None:
        """Placements from now on follow from this number; nothing else does."""
        self.env.seed(seed)

    def close(self) -> None:
        """Free the simulation and its GL contexts. Idempotent."""
        self.env.close()

    def _post_process(self) -> None:
        self.env._post_process()

    def _update_observables(self, force: bool = False) -> None:
        self.env._update_observables(force=force)


class OffScreenRenderEnv(ControlEnv):
    """An environment that draws pictures without a window."""

    def __init__(self, **kwargs: Any):
        super().__init__(**{**kwargs, "has_renderer": False, "has_offscreen_renderer": True})


class DemoRenderEnv(ControlEnv):
    """An environment for replaying demonstrations into pictures."""

    def __init__(self, **kwargs: Any):
        defaults = {"render_camera": "frontview"}
        super().__init__(**{**defaults, **kwargs, "has_renderer": False, "has_offscreen_renderer": True})

    def _get_observations(self) -> Mapping[str, np.ndarray]:
        """What was observed last."""
        return self.env._get_observations()


class SegmentationRenderEnv(OffScreenRenderEnv):
    """An environment that also draws which pixel belongs to what.

    Attributes:
        segmentation_id_mapping: index of an instance -> its name, without the parts of the robot.
        instance_to_id: name -> its number in segmentation pictures.
        segmentation_robot_id: index of the robot.
    """

    def __init__(
        self,
        camera_segmentations: Any = "instance",
        camera_heights: int | Sequence[int] = 128,
        camera_widths: int | Sequence[int] = 128,
        **kwargs: Any,
    ):
        super().__init__(
            camera_segmentations=camera_segmentations,
            camera_heights=camera_heights,
            camera_widths=camera_widths,
            **kwargs,
        )
        names = list(self.env.model.instances_to_ids)
        self.segmentation_robot_id = names.index("Panda0")
        self.segmentation_id_mapping = dict(enumerate(names[: self.segmentation_robot_id]))
        self.instance_to_id = {name: i + 1 for i, name in self.segmentation_id_mapping.items()}

    def get_segmentation_instances(self, segmentation_image: np.ndarray) -> dict[str, np.ndarray]:
        """Name of each instance, and `robot` -> the picture with everything else 0."""
        image, robot = segmentation_image, self.segmentation_robot_id + 1
        found = {"robot": np.where(image >= robot, robot, 0)}
        return found | {name: np.where(image == i, i, 0) for name, i in self.instance_to_id.items()}

    def get_segmentation_of_interest(self, segmentation_image: np.ndarray) -> np.ndarray:
        """1 where an object of interest is, -1 in the background, 0 elsewhere."""
        found = np.where(segmentation_image == 0, -1, 0).astype(segmentation_image.dtype)
        ids = [self.instance_to_id[name] for name in self.obj_of_interest if name in self.instance_to_id]
        found[np.isin(segmentation_image, ids)] = 1
        return found

    def segmentation_to_rgb(self, seg_im: np.ndarray, random_colors: bool = False) -> np.ndarray:
        """A colour for each number, (H, W, 3) uint8: well apart from each other, or drawn once from a fixed seed."""
        image = np.asarray(seg_im)
        image = image[..., 0] if image.ndim == 3 else image
        count = int(max(image.max(initial=0), 0)) + 1
        if random_colors:
            colours = np.random.default_rng(0).integers(0, 256, (count, 3))
        else:
            hue = (np.arange(count)[:, None] * 0.618034 + (0.0, 1 / 3, 2 / 3)) % 1.0
            colours = 255 * (0.5 + 0.5 * np.cos(2 * np.pi * hue))
        colours[0] = 0
        return colours.astype(np.uint8)[np.maximum(image, 0)]
