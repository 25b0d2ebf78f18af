"""What stands behind `BDDLBaseDomain`: starts of episodes, observations in time, stored models, robosuite's names."""

import warnings
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from libero._adapters.arguments import DEFAULT_NOISE, noise_of
from libero._adapters.observations import RobosuiteMethods, quat_xyzw
from libero._adapters.sim import MjSimState
from libero_env.assets.robot import REST_QPOS
from libero_env.demos.stored_model import compile_stored, model_xml, read_fixture_poses, spec_without_textures
from libero_env.envs.checks import checked_numbers
from libero_env.errors import DemoError, InvalidInputError, LiberoError
from libero_env.init_states.original_resets import OriginalResets
from libero_env.init_states.placement import Start, sample_settled
from libero_env.mujoco_compat import mujoco
from libero_env.objects.model import GLOW_GROUP
from libero_env.sim.controller import ControllerState
from libero_env.sim.predicates import glowing_sites
from libero_env.sim.scene import Scene
from libero_env.sim.scene_spec import scene_spec
from libero_env.sim.simulation import INTEGRATED
from libero_env.timing import SUBSTEPS, TIMESTEP

_CONFIGURED = ("mount_type", "initialization_noise", "control_freq", "gripper_type")
_NAMES: dict[str, Callable[[Any], Any]] = {
    "camera_heights": lambda env: [camera.height for camera in env.camera_list],
    "camera_widths": lambda env: [camera.width for camera in env.camera_list],
    "camera_depths": lambda env: [camera.depth for camera in env.camera_list],
    "camera_segmentations": lambda env: [list(camera.segmentations) or None for camera in env.camera_list],
    "num_cameras": lambda env: len(env.camera_list),
    "num_robots": lambda env: len(env.robots),
    "robot_names": lambda env: [robot.name for robot in env.robots],
    "robot_configs": lambda env: [  # a hard reset makes the robot of the controller's configuration
        MappingProxyType(
            {name: getattr(env.robots[0], name) for name in _CONFIGURED}
            | {"controller_config": env._controller_configs}
        )
    ],
    "model_timestep": lambda env: env.sim.model.opt.timestep,
    "control_timestep": lambda env: 1.0 / env.control_freq,
    "deterministic_reset": lambda env: False,
    "viewer": lambda env: env.window,
    "viewer_get_obs": lambda env: False,
    "sim_state_initial": lambda env: MjSimState(0.0, env.sim.model.qpos0.copy(), np.zeros(env.sim.model.nv)),
    "language_instruction": lambda env: env.problem.language,
    "action_spec": lambda env: env.robots[0].action_limits,
    "action_dim": lambda env: env.robots[0].action_dim,
    "_action_dim": lambda env: env.robots[0].action_dim,
    "_visualizations": lambda env: {"env", "robots", "grippers"},
    "_eef_xpos": lambda env: env.sim.data.site_xpos[env.robots[0].eef_site_id].copy(),
    "_eef_xmat": lambda env: env.sim.data.site_xmat[env.robots[0].eef_site_id].reshape(3, 3).copy(),
    "_eef_xquat": lambda env: quat_xyzw(env._eef_xmat),
}


class DomainParts(RobosuiteMethods, names=_NAMES):
    """Methods of `BDDLBaseDomain`, which sets the attributes."""

    scene: Scene
    _noted: list[np.ndarray]
    _clock: float
    _is_sampled: bool
    _moment: int

    # Starts of episodes -------------------------------------------------------------------------------------

    def seed(self, seed: int | None) -> None:
        """Seed the placements from now on; fixtures stand where the original's resets with this seed have them."""
        self.rng = np.random.default_rng(seed)
        self._resets = None if seed is None else OriginalResets(self.scene, seed)

    def _arm_start(self, sampled: np.ndarray) -> np.ndarray:
        """Return the joints of the arm at a reset, (7,) rad; those of a placement have robosuite's default noise."""
        robot = self.robots[0]
        noise, joints = noise_of(robot.initialization_noise), np.array(robot.init_qpos, np.float64)
        if noise == DEFAULT_NOISE:
            return sampled + (joints - REST_QPOS)
        if noise["type"] == "gaussian":
            return joints + noise["magnitude"] * self.rng.standard_normal(7)
        return joints + noise["magnitude"] * self.rng.uniform(-1.0, 1.0, 7)

    def _sample(self) -> Start:
        """Return a settled initial state, where objects are in their places; the arm holds its pose."""
        controller, self.simulations.controller_state = self.simulations.controller_state, ControllerState(1)
        self.simulations.ends_current, self.simulations.substeps = True, SUBSTEPS
        try:
            fixtures = None if self._resets is None else self._resets.reset()
            return sample_settled(self.scene, self.simulations, 0, self.rng, fixtures, only_places=True)
        finally:
            self.simulations.controller_state, self.simulations.ends_current = controller, False
            self.simulations.substeps = self._substeps

    def restart(self, state: np.ndarray) -> None:
        """Start from [time, qpos, qvel], with or without the poses of the fixtures after it; the arm holds its pose.

        Raises:
            LiberoError: The state has another length, or numbers that no physics has; nothing has changed.
        """
        self._check_open()
        nq, nv = self.scene.model.nq, self.scene.model.nv
        short = 1 + nq + nv
        whole = short + 7 * len(self.scene.fixtures)
        state = checked_numbers(state, f"a state of {self.bddl_file_name}", ("any",)).ravel()
        if state.size not in (short, whole) or (np.abs(state) > mujoco.mjMAXVAL).any():
            raise InvalidInputError(
                f"a state of {self.bddl_file_name} is {short} numbers, or {whole} with the poses of the fixtures, up "
                f"to {mujoco.mjMAXVAL:g}; got {state.size}. Is it a state of another task?"
            )
        self.simulations.fixtures[0] = self.simulations.read_fixtures()
        fixtures = state[short:].reshape(1, -1, 7) if state.size == whole else None
        qpos, qvel = state[None, 1 : 1 + nq], state[None, 1 + nq : short]
        self.simulations.reset([0], qpos, qvel, float(state[0]), fixtures)
        self._noted = []

    # Observations in time -----------------------------------------------------------------------------------

    def _update_observables(self, force: bool = False) -> None:
        """Advance robosuite's sampling clock by a physics step, and observe at the first step of each control period.

        Observing by force advances the clock, too (robosuite 1.4.0, `utils/observables.py`): observations of `step`
        are of as many physics steps before its end as there were calls with `force` after that of `reset`.
        """
        self._clock += TIMESTEP
        if force or not self._is_sampled:
            self._observations, self._is_sampled = self._observe(), True
        period = 1.0 / self.control_freq
        if self._clock >= period:
            self._clock, self._is_sampled = self._clock % period, False

    def _get_observations(self, force_update: bool = False) -> "OrderedDict[str, np.ndarray]":
        """Return the last observation."""
        if force_update:
            self._update_observables(force=True)
        return OrderedDict(self._observations)

    def observation_spec(self) -> "OrderedDict[str, np.ndarray]":
        """Return the last observation, as robosuite does."""
        return self._get_observations()

    def get_robot_state_vector(self, obs: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return fingers, grip position and hand orientation of an observation, (9,)."""
        return np.concatenate([obs[f"robot0_{key}"] for key in ("gripper_qpos", "eef_pos", "eef_quat")])

    def _watch(self, moment: int, _: np.ndarray) -> None:
        if moment == INTEGRATED:
            self._update_observables()
            self._moment += 1
            if self._moment in (1, self._substeps - 1):
                self._noted.append(self._arm())

    def _arm(self) -> np.ndarray:
        """Return positions, velocities and torques of the arm's joints, (3, 7)."""
        data = self.sim.data._data
        return np.stack([data.qpos[:7], data.qvel[:7], data.ctrl[:7]])

    @property
    def arm_seen(self) -> np.ndarray:
        """What the controller saw last, see `_arm`: of a step, the state before its last substep."""
        return self._noted[-1] if self._noted else self._arm()

    def visualize(self, vis_settings: Mapping[str, bool]) -> None:
        """Show or hide sites of objects and fixtures (`env`), of the arm (`robots`) and of the gripper (`grippers`)."""
        for item in self.model.mujoco_objects:
            item.set_sites_visibility(self.sim, vis_settings["env"])
        self.robots[0].visualize(vis_settings)

    def set_visualization(self) -> None:
        """Show the sites that glow while their object is on."""
        model, on = self.sim.model, list(glowing_sites(self.view))
        sites = np.flatnonzero(model.site_group == GLOW_GROUP)
        model.site_rgba[sites, 3] = np.where(np.isin(sites, on), 1.0, -1.0) * abs(model.site_rgba[sites, 3])

    # Stored models ------------------------------------------------------------------------------------------

    def get_xml(self) -> str:
        """Return the scene as MJCF without textures, with the present poses of the fixtures."""
        poses = dict(zip(self.scene.fixtures, self.simulations.read_fixtures(), strict=True))
        spec = (
            mujoco.MjSpec.from_string(self._xml)
            if self._xml
            else spec_without_textures(self.problem, self.scene.pack, self.drawing, self.robot)
        )
        return model_xml(spec, poses)

    def reset_from_xml_string(self, xml_string: str) -> None:
        """Build the model again from MJCF, edited or not; the arm is at rest and objects are where the text has them.

        Of a text whose files are missing, such as one of the original without its models, only the poses of the
        fixtures are taken, with a warning.

        Raises:
            DemoError: The text is not MJCF.
            LiberoError: The text is a model of another task.
        """
        poses = read_fixture_poses(xml_string, self.scene)
        try:
            self._build(xml_string)
        except DemoError as error:
            warnings.warn(f"{error}; only the poses of the fixtures are taken from it", stacklevel=2)
            for name, pose in poses.items():
                self.sim.model.body_pos[self.obj_body_id[name]] = pose[:3]
                self.sim.model.body_quat[self.obj_body_id[name]] = pose[3:]
        self.sim.reset()
        self.sim.data.qpos[: len(REST_QPOS)] = REST_QPOS
        self.sim.forward()
        present = self.view.eef_pos[None], self.view.eef_mat.reshape(1, 9)
        self.simulations.controller_state.restart(np.zeros(1, np.int64), *present)
        self._restart_clock()
        self._update_observables(force=True)

    def _build(self, xml_string: str) -> None:
        spec = scene_spec(self.problem, self.scene.pack, drawing=self.drawing, robot=self.robot)
        model = compile_stored(xml_string, spec)
        self._check_names(model)
        self.sim.free()
        self.scene, self._xml = replace(self.scene, model=model), xml_string
        self._simulate(model)
        self._setup_references()

    def set_xml_processor(self, processor: Callable[[str], str] | None) -> None:
        """Let a function change the scene, as MJCF, at each reset; None for none."""
        self._xml_processor = processor

    def _check_names(self, model: mujoco.MjModel) -> None:
        """Raise a LiberoError unless a model has the joints and sites of the task, in their order."""
        for kind, count in (("joint", "njnt"), ("site", "nsite")):
            expected, present = (
                [getattr(m, kind)(i).name for i in range(getattr(m, count))]
                for m in (self.scene.model, model)
            )
            missing = [name for name in expected if name and name not in present]
            if missing or (kind == "joint" and expected != present):
                named = missing[0] if missing else "the joints in their order"
                raise LiberoError(
                    f"the model lacks {kind} {named!r} of {self.bddl_file_name}: is it of another task?"
                )
