"""Environments of a task file with robosuite's observations and the four-tuple of old Gym."""

from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import Any

import numpy as np

from libero._adapters.lookup import lookup
from libero.libero.envs import bddl_utils as BDDLUtils
from libero.libero.envs import problems  # noqa: F401 - registers the problem classes
from libero.libero.envs.bddl_base_domain import TASK_MAPPING, BDDLBaseDomain
from libero_env.errors import PlacementError

_RESETS = 5
_NOT_FORWARDED = ("self", "bddl_file_name", "controller", "kwargs")  # all others go to the domain as they are
DEFAULT_CAMERAS = ("agentview", "robot0_eye_in_hand")


class ControlEnv:
    """One simulation of a task file. `step` returns (observation, reward, success, info); there is no `truncated`.

    Args:
        bddl_file_name: Task file; for the tasks of the benchmark its name without a folder is enough.
        controller: Name of the controller, such as `OSC_POSE`, or its configuration.
        camera_names, camera_heights, camera_widths: One value, or one for each camera.
        kwargs: Further arguments of `BDDLBaseDomain`, which also describes the other parameters.

    Raises:
        BDDLError: The file is not a task file.
        UnknownNameError: The problem class, an argument, the controller or a camera does not exist.
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
        arguments = {key: value for key, value in locals().items() if key not in _NOT_FORWARDED}
        info = BDDLUtils.get_problem_info(bddl_file_name)
        self.problem_name, self.domain_name = info["problem_name"], info["domain_name"]
        self.language_instruction = info["language_instruction"]
        self.env: BDDLBaseDomain = lookup(TASK_MAPPING, "problem", self.problem_name)(
            bddl_file_name,
            controller_configs={"type": controller} if isinstance(controller, str) else controller,
            **arguments,
            **kwargs,
        )

    obj_of_interest = property(attrgetter("env.obj_of_interest"), doc="Names of the objects of interest.")
    robots = property(attrgetter("env.robots"), doc="The arm, in a list.")
    sim = property(attrgetter("env.sim"), doc="The simulation.")
    _visualizations = property(attrgetter("env._visualizations"))

    def step(self, action: Any) -> tuple[Mapping[str, np.ndarray], float, bool, dict[str, Any]]:
        """Act for a control period, see `BDDLBaseDomain.step`."""
        return self.env.step(action)

    def reset(self) -> Mapping[str, np.ndarray]:
        """Sample an initial state and observe it; raise a PlacementError if the objects do not fit, five times."""
        for _ in range(_RESETS - 1):
            try:
                return self.env.reset()
            except PlacementError:
                continue
        return self.env.reset()

    def get_observation(self) -> Mapping[str, np.ndarray]:
        """Return the last observation."""
        return self.env._get_observations()

    def check_success(self) -> bool:
        """Return whether the goal holds."""
        return self.env._check_success()

    def get_sim_state(self) -> np.ndarray:
        """Return [time, qpos, qvel]."""
        return self.env.sim.get_state().flatten()

    def set_state(self, mujoco_state: np.ndarray) -> None:
        """Set the state, as `get_sim_state` returns it; see `set_init_state`.

        Between a reset and the first step, the controller takes the arm to be where the reset has left it, as in the
        original, see `libero_env.sim.simulation.Simulations.outdate_controller`.
        """
        self.env.restart(mujoco_state)
        if self.env.cur_time == 0.0:
            self.env.simulations.outdate_controller([0])

    def set_init_state(self, init_state: np.ndarray) -> Mapping[str, np.ndarray]:
        """Set the state, see `BDDLBaseDomain.restart`, and observe it; the horizon counts from the reset."""
        return self.regenerate_obs_from_state(init_state)

    def regenerate_obs_from_state(self, mujoco_state: np.ndarray) -> Mapping[str, np.ndarray]:
        """Set the state and observe it."""
        self.set_state(mujoco_state)
        self._post_process()
        self._update_observables(force=True)
        return self.env._get_observations()

    def reset_from_xml_string(self, xml_string: str) -> None:
        """Build the model again from MJCF, see `BDDLBaseDomain.reset_from_xml_string`."""
        self.env.reset_from_xml_string(xml_string)

    def seed(self, seed: int) -> None:
        """Seed the placements from now on, and nothing else."""
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


class DemoRenderEnv(OffScreenRenderEnv):
    """An environment that renders demonstrations."""

    _get_observations = ControlEnv.get_observation


class SegmentationRenderEnv(OffScreenRenderEnv):
    """An environment that also draws segmentation pictures.

    Attributes:
        segmentation_id_mapping: Index of an instance -> its name, without the parts of the robot.
        instance_to_id: Name -> number in segmentation pictures.
        segmentation_robot_id: Index of the robot.
    """

    def __init__(self, camera_segmentations: Any = "instance", **kwargs: Any):
        super().__init__(camera_segmentations=camera_segmentations, **kwargs)
        names = list(self.env.model.instances_to_ids)
        self.segmentation_robot_id = names.index(self.robots[0].robot_model.name)
        self.segmentation_id_mapping = dict(enumerate(names[: self.segmentation_robot_id]))
        self.instance_to_id = {name: i + 1 for i, name in self.segmentation_id_mapping.items()}

    def get_segmentation_instances(self, segmentation_image: np.ndarray) -> dict[str, np.ndarray]:
        """Return the picture of each instance, and of `robot`, with everything else 0."""
        image, robot = segmentation_image, self.segmentation_robot_id + 1
        pictures = {"robot": np.where(image >= robot, robot, 0)}
        return pictures | {name: np.where(image == i, i, 0) for name, i in self.instance_to_id.items()}

    def get_segmentation_of_interest(self, segmentation_image: np.ndarray) -> np.ndarray:
        """Return a picture with 1 for objects of interest, -1 for the background, and 0 elsewhere."""
        picture = np.where(segmentation_image == 0, -1, 0).astype(segmentation_image.dtype)
        ids = [self.instance_to_id[name] for name in self.obj_of_interest if name in self.instance_to_id]
        picture[np.isin(segmentation_image, ids)] = 1
        return picture
