"""The environment behind the wrappers: one simulation of a task file, stepped as robosuite steps it."""

import os
import warnings
import weakref
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from inspect import signature
from types import MappingProxyType
from typing import Any

import numpy as np

from libero._adapters.arguments import (
    DEFAULT_NOISE,
    check_arguments,
    check_horizon,
    noise_of,
    substeps_of,
    with_room,
)
from libero._adapters.controllers import controller_of
from libero._adapters.lookup import lookup
from libero._adapters.models import facade_pack, facade_robot
from libero._adapters.observations import Observer, RobosuiteMethods, cameras, quat_xyzw
from libero._adapters.sim import ClientSimulations, MjSim, MjSimState, Window
from libero.libero import get_assets_path
from libero.libero.envs import bddl_utils as BDDLUtils
from libero.libero.envs.bddl_utils import task_file
from libero.libero.envs.object_states import BaseObjectState, ObjectState, SiteObjectState
from libero.libero.envs.predicates import eval_predicate_fn
from libero.libero.envs.robots import SingleArm
from libero.libero.envs.scene_objects import TaskModel, scene_fixtures, scene_objects, scene_sites
from libero.libero.utils.utils import postprocess_model_xml
from libero_env.assets.robot import OPEN_FINGERS, REST_QPOS, ROBOTS
from libero_env.demos.stored_model import compile_stored, model_xml, read_fixture_poses, spec_without_textures
from libero_env.envs.checks import checked_numbers
from libero_env.errors import (
    ClosedEnvironmentError,
    DemoError,
    InvalidInputError,
    LiberoError,
    require_known,
)
from libero_env.init_states.original_resets import OriginalResets
from libero_env.init_states.placement import Start, sample_settled
from libero_env.mujoco_compat import mujoco
from libero_env.objects.model import GLOW_GROUP
from libero_env.sim.controller import ControllerState
from libero_env.sim.predicates import evaluate, glowing_sites
from libero_env.sim.scene import DRAWINGS, FAITHFUL, build_scene, scene_spec
from libero_env.sim.simulation import INTEGRATED
from libero_env.sim.state import StateView
from libero_env.tasks.problem import BUILTIN_PREDICATES
from libero_env.timing import SUBSTEPS, TIMESTEP

TASK_MAPPING: dict[str, type["BDDLBaseDomain"]] = {}
CONTROL_FREQ = 20  # Hz
# Arguments in `kwargs` that are attributes of robosuite's environments, and their defaults.
_KEPT: dict[str, Any] = {
    **{"env_configuration": "default", "has_offscreen_renderer": True, "render_collision_mesh": False},
    **{"render_visual_mesh": True, "render_gpu_device_id": -1, "renderer": "mujoco", "renderer_config": None},
    "object_property_initializers": [],
}
_FLOOR_OFFSET = (0.0, 0.0, -0.035)  # the original's origin of regions on the floor, m

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
    "custom_asset_dir": lambda env: get_assets_path(),
    "language_instruction": lambda env: env.problem.language,
    "action_spec": lambda env: env.robots[0].action_limits,
    "action_dim": lambda env: env.robots[0].action_dim,
    "_action_dim": lambda env: env.robots[0].action_dim,
    "_visualizations": lambda env: {"env", "robots", "grippers"},
    "_eef_xpos": lambda env: env.sim.data.site_xpos[env.robots[0].eef_site_id].copy(),
    "_eef_xmat": lambda env: env.sim.data.site_xmat[env.robots[0].eef_site_id].reshape(3, 3).copy(),
    "_eef_xquat": lambda env: quat_xyzw(env._eef_xmat),
}


class EpisodeOverError(LiberoError, ValueError):
    """`step` was called after the horizon."""


def register_problem(target_class: type["BDDLBaseDomain"]) -> type["BDDLBaseDomain"]:
    """Register a problem class by its name, which task files give after `define (problem`; case does not matter."""
    TASK_MAPPING[target_class.__name__.lower()] = target_class
    return target_class


class BDDLBaseDomain(RobosuiteMethods, names=_NAMES):
    """One simulation of a task file.

    Attributes:
        sim: Simulation with robosuite's interface.
        scene, view: Compiled task and the state that predicates see, both of `libero_env`.
        parsed_problem: Task file as dictionaries.
        objects_dict, fixtures_dict, object_sites_dict, object_states_dict: Objects, fixtures, regions and states by
            name.
        robots: List of the one arm.
        done: Whether the horizon is reached.

    Args:
        controller_configs: Controller, `{"type": "OSC_POSE"}`, with gains, scales and limits of robosuite;
            `control_delta` or `use_delta` for absolute actions.
        initialization_noise: Noise of the arm's joints at a reset: `default`, None for none, or
            `{"magnitude": 0.02, "type": "gaussian"}`, rad, also of type `uniform`.
        reward_scale: Reward of success.
        has_renderer, render_camera: Whether `render` shows a window, and the camera it shows.
        horizon: Control steps after which `step` raises, unless `ignore_done`.
        placement_initializer: Object whose `sample()` returns name -> (pos, quat wxyz, object); by default the regions
            of the task file are sampled.
        drawing: How images are drawn: `faithful`, to the bit of the original's with its models and MuJoCo 3.3.2, or
            `fast`; an addition.
        robot: Model of the arm, `libero` (that of robosuite 1.4.0) or `robosuite-1.4.1`; by default the key `robot` of
            the configuration file, or else `libero`; an addition.
        hard_reset: Whether a reset undoes all changes of model, controller and robot, as robosuite's does.
        scene_xml, scene_properties: Room, see `libero._adapters.arguments.with_room`.
        kwargs: Other arguments of the original's classes, see `libero._adapters.arguments`; values that would change
            something there are refused.

    Raises:
        BDDLError: The file is not a task file.
        UnknownNameError: An argument, controller, camera, style or robot does not exist.
        InvalidInputError: A value is not valid, or not supported.
    """

    def __init__(
        self,
        bddl_file_name: str,
        robots: Any = ("Panda",),
        controller_configs: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None,
        initialization_noise: Any = "default",
        use_camera_obs: bool = True,
        use_object_obs: bool = True,
        reward_scale: float | None = 1.0,
        reward_shaping: bool = False,
        placement_initializer: Any = None,
        has_renderer: bool = False,
        render_camera: str = "frontview",
        control_freq: float = CONTROL_FREQ,
        horizon: int = 1000,
        ignore_done: bool = False,
        camera_names: str | Sequence[str] = "agentview",
        camera_heights: int | Sequence[int] = 256,
        camera_widths: int | Sequence[int] = 256,
        camera_depths: bool | Sequence[bool] = False,
        camera_segmentations: Any = None,
        hard_reset: bool = True,
        scene_xml: str | None = None,
        scene_properties: Mapping[str, str] | None = None,
        drawing: str = FAITHFUL,
        robot: str | None = None,
        **kwargs: Any,
    ):
        check_arguments(kwargs, signature(BDDLBaseDomain).parameters)
        check_horizon(horizon)
        self._substeps = substeps_of(control_freq)
        require_known("drawing", drawing, DRAWINGS)
        self.robot = robot or facade_robot()
        require_known("robot", self.robot, ROBOTS)
        self.drawing = drawing
        self.bddl_file_name, self.control_freq = task_file(bddl_file_name), control_freq
        self.problem = with_room(BDDLUtils.read_problem(bddl_file_name), scene_xml, scene_properties)
        self.parsed_problem = BDDLUtils.robosuite_parse_problem(bddl_file_name)
        self.obj_of_interest = self.parsed_problem["obj_of_interest"]
        self.conditioned_initial_place_dict: dict[str, Any] = {}
        self.use_object_obs, self.use_camera_obs = use_object_obs, use_camera_obs
        self.reward_scale, self.reward_shaping = reward_scale, reward_shaping
        self.horizon, self.ignore_done, self.render_camera = horizon, ignore_done, render_camera
        self.window, self.has_renderer = Window(render_camera) if has_renderer else None, has_renderer
        vars(self).update(deepcopy(_KEPT) | {key: value for key, value in kwargs.items() if key in _KEPT})
        self._xml_processor: Callable[[str], str] | None = None
        self.initialization_noise, self.hard_reset = noise_of(initialization_noise), hard_reset
        self.placement_initializer = placement_initializer
        sizes = camera_heights, camera_widths
        self.camera_list = cameras(camera_names, *sizes, camera_depths, camera_segmentations)
        self.camera_names = [camera.name for camera in self.camera_list]
        self.rng = np.random.default_rng(np.random.randint(2**31))  # noqa: NPY002 - until `seed`, that of scripts
        self._resets: OriginalResets | None = None
        self._restart_clock()
        self._is_sampled = self._closed = False
        self._observations: OrderedDict[str, np.ndarray] = OrderedDict()
        self._observables: OrderedDict[str, Any] = OrderedDict()
        self._controller_configs, self._robots, self._xml = controller_of(controller_configs), robots, ""
        self._load_model()
        self._setup_references()

    # Hooks of subclasses ------------------------------------------------------------------------------------

    def _load_fixtures_in_arena(self, mujoco_arena: Any) -> None:
        """Change the scene before it is compiled; its fixtures are in place."""

    def _load_objects_in_arena(self, mujoco_arena: Any) -> None:
        """Change the scene before it is compiled; its objects are in place."""

    def _load_sites_in_arena(self, mujoco_arena: Any) -> None:
        """Change the scene before it is compiled; its regions are in place."""

    def _setup_camera(self, mujoco_arena: Any) -> None:
        """Change the cameras of the scene before it is compiled, with `mujoco_arena.set_camera`."""

    def _add_placement_initializer(self) -> None:
        """Set `placement_initializer`, if at all; called once, before the first reset."""

    def _load_model(self) -> None:
        pack = facade_pack()
        self.scene = build_scene(self.problem, pack, drawing=self.drawing, robot=self.robot)
        self._setup_workspace()
        hooks = ("_load_fixtures_in_arena", "_load_objects_in_arena", "_load_sites_in_arena", "_setup_camera")
        if any(getattr(type(self), hook) is not getattr(BDDLBaseDomain, hook) for hook in hooks):
            from libero.libero.envs.arenas import Arena

            arena = Arena(scene_spec(self.problem, pack, drawing=self.drawing, robot=self.robot))
            self.objects_dict: dict[str, Any] = {}
            self.fixtures_dict: dict[str, Any] = {}
            self.object_sites_dict: dict[str, Any] = {}
            for hook in hooks:
                getattr(self, hook)(arena)
            for name in {**self.objects_dict, **self.fixtures_dict}:
                lookup(self.scene.entities, "object or fixture of the task file", name)
            self.scene = replace(self.scene, model=arena.spec.compile())
        self._simulate(self.scene.model)

    def _simulate(self, model: mujoco.MjModel) -> None:
        self.simulations = ClientSimulations(model, 1, self.scene.fixture_bodies.tolist())
        self.simulations.ends_current = False
        self.simulations.substeps = self._substeps
        self.sim = MjSim(self.simulations, model, self.get_xml, faithful=self.drawing == FAITHFUL)
        self.view = StateView(self.scene, self.simulations, 0)
        self.simulations.domain = weakref.ref(self)

    def _setup_references(self) -> None:
        scene = self.scene
        self.objects_dict, self.fixtures_dict = scene_objects(scene), scene_fixtures(scene)
        self.object_sites_dict = scene_sites(scene)
        self.objects, self.fixtures = list(self.objects_dict.values()), list(self.fixtures_dict.values())
        self.obj_body_id = {n: self.sim.model.body_name2id(f"{n}_main") for n in scene.entities}
        self.object_states_dict: dict[str, BaseObjectState] = {
            name: ObjectState(self, name, is_fixture=name in scene.fixtures) for name in scene.entities
        }
        for name, site in self.object_sites_dict.items():
            self.object_states_dict[name] = SiteObjectState(self, name, site.parent_name)
        states = self.object_states_dict.values()
        self.tracking_object_states_change = [s for s in states if getattr(s, "has_turnon_affordance", 0)]
        self.visualization_sites_list = [state.object_name for state in self.tracking_object_states_change]
        self.robots = [SingleArm(self, self._controller_configs, self._robots)]
        parts = [*self.objects, *self.fixtures]
        self.model = TaskModel(scene, self.sim.model._model, self.get_xml, parts, self.robots[0].robot_model)
        self.visualize(dict.fromkeys(self._visualizations, False))
        drawn = self.camera_list if self.use_camera_obs else ()
        # robosuite shrinks sites to nothing
        self.sim.draws_sites = not any(camera.segmentations for camera in drawn)
        observed = list(scene.objects) if self.use_object_obs else []
        self.observer = Observer(self.sim, observed, drawn, self.model.segments)
        self._observables = self._observables or self._setup_observables()
        self._add_placement_initializer()

    def _setup_workspace(self) -> None:
        """Set what the original's problem classes say of table or floor, such as `kitchen_table_full_size`."""
        workspace = self.scene.workspace
        thickness = workspace.parameters["table_thickness"]
        self.workspace_name, self.workspace_offset = self.scene.workspace_name, workspace.offset
        self.z_offset = 0.01 - thickness
        if workspace.name == "floor":
            self.workspace_offset, self.z_offset = _FLOOR_OFFSET, self.z_offset - _FLOOR_OFFSET[2]
        else:
            length_width = (0.7, 1.6) if workspace.mount is None else (1.0, 1.2)
            setattr(self, f"{workspace.name}_full_size", (*length_width, thickness))
        setattr(self, f"{workspace.name}_offset", self.workspace_offset)

    # Episodes -----------------------------------------------------------------------------------------------

    def seed(self, seed: int | None) -> None:
        """Seed the placements from now on; fixtures stand where the original's resets with this seed have them."""
        self.rng = np.random.default_rng(seed)
        self._resets = None if seed is None else OriginalResets(self.scene, seed)

    def reset(self) -> "OrderedDict[str, np.ndarray]":
        """Sample an initial state and observe it; raise a PlacementError if the objects do not fit."""
        self._check_open()
        if self.hard_reset:
            self._restore()
        self._reset_internal()
        self._restart_clock()
        self.visualize(dict.fromkeys(self._visualizations, False))
        return self._get_observations(force_update=True)

    def _restore(self) -> None:
        """Undo all changes of model, controller and robot."""
        if self._xml:
            self.sim.free()
            self._xml = ""
            self._load_model()
            self._setup_references()
        else:
            self.sim.restore_model()
            self.robots[0] = SingleArm(self, self._controller_configs, self._robots)
        if self._xml_processor is not None:
            self._build(self._xml_processor(self.get_xml()))

    def _restart_clock(self) -> None:
        self.timestep, self.cur_time, self.done, self._clock = 0, 0.0, False, 0.0
        self._noted: list[np.ndarray] = []

    def _reset_internal(self) -> None:
        """Set the state to a sampled initial state; a subclass may change it afterwards."""
        start = self._sample()
        qpos = start.qpos.copy()
        qpos[:7], qpos[7:9] = self._arm_start(start.qpos[:7]), OPEN_FINGERS
        if self.placement_initializer is not None:
            for name, (pos, quat, *_) in self.placement_initializer.sample().items():
                joint = self.scene.pose_address(name)
                qpos[joint : joint + 7] = [*pos, *quat]
        self.restart(np.concatenate([[0.0], qpos, np.zeros(self.scene.model.nv), start.fixtures.ravel()]))
        self.simulations.set_rest(qpos[:7].copy())
        self.robots[0].reset()

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

    def step(self, action: Any) -> "tuple[OrderedDict[str, np.ndarray], float, bool, dict[str, Any]]":
        """Act for a control period; return observation, reward, success, and a dictionary with `success`.

        Of when the observation is, see `_update_observables`. Poses and contacts in `sim.data`, which success is judged
        by, are of 2 ms before the end until `sim.forward`, as in the original.

        Raises:
            EpisodeOverError: The horizon is reached.
            ActionError: The action has the wrong shape or is not finite; nothing has moved.
        """
        self._check_open()
        if self.done:
            raise EpisodeOverError(
                f"the horizon of {self.horizon} steps is reached: call reset(), or set horizon or ignore_done"
            )
        self._pre_action(action, policy_step=True)
        command = self.robots[0].command(action)
        self.timestep += 1
        mujoco.mj_step1(self.sim.model._model, self.sim.data._data)  # what clients wrote since
        self._noted, self._moment = [], 0
        self.simulations.step([0], command[None], watch=self._watch)
        self.robots[0].recent_torques.push(self._noted[0][2])
        self.cur_time += 1.0 / self.control_freq
        reward, self.done, info = self._post_action(action)
        success = self._check_success()
        return self._get_observations(), reward, success, {"success": success, **info}

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

    def _pre_action(self, action: Any, policy_step: bool = False) -> None:
        """Do nothing; a subclass may change the simulation before each control step."""

    def _post_action(self, action: Any) -> tuple[float, bool, dict[str, Any]]:
        over = self.timestep >= self.horizon and not self.ignore_done
        result: tuple[float, bool, dict[str, Any]] = self.reward(action), over, {}
        self._post_process()
        return result

    def _post_process(self) -> None:
        """Update the states of objects that can be turned on; as in the original, they begin to glow only now."""
        BDDLBaseDomain.set_visualization(self)
        for state in self.tracking_object_states_change:
            state.update_state()

    def reward(self, action: Any = None) -> float:
        """Return `reward_scale` on success, otherwise 0."""
        return float(self._check_success()) * (1.0 if self.reward_scale is None else self.reward_scale)

    def _check_success(self) -> bool:
        """Return whether the goal holds."""
        return all(map(self._eval_predicate, self.parsed_problem["goal_state"]))

    def _eval_predicate(self, state: Sequence[Any]) -> bool:
        """Return whether an atom holds, `["on", "a_1", "b_1"]`, or a nested goal; case does not matter."""
        if state[0].lower() in ("and", "or", "not", "forall"):
            return evaluate(BDDLUtils.as_expression(list(state)), self.view)
        entities = self.object_states_dict
        is_own = state[0].capitalize() not in BUILTIN_PREDICATES  # whose arguments may be numbers and words
        kind, names = "object, fixture or region", state[1:]
        states = [n if is_own and n not in entities else lookup(entities, kind, n) for n in names]
        return bool(eval_predicate_fn(state[0], *states))

    # Observations -------------------------------------------------------------------------------------------

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

    # Properties and helpers ---------------------------------------------------------------------------------

    def is_fixture(self, object_name: str) -> bool:
        """Return whether a fixture has this name."""
        return object_name in self.fixtures_dict

    def get_object(self, object_name: str) -> Any:
        """Return the object, fixture or region of this name; raise an UnknownNameError if there is none."""
        entities = {**self.objects_dict, **self.fixtures_dict, **self.object_sites_dict}
        return lookup(entities, "object, fixture or region", object_name)

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

    def edit_model_xml(self, xml_str: str) -> str:
        """Return a stored model with the paths of this machine."""
        return postprocess_model_xml(xml_str)

    def clear_objects(self, object_names: str | Sequence[str]) -> None:
        """Move objects out of sight."""
        for name in [object_names] if isinstance(object_names, str) else object_names:
            self.sim.data.set_joint_qpos(f"{name}_joint0", (10, 10, 10, 1, 0, 0, 0))

    def close(self) -> None:
        """Free the simulation, its GL contexts and its window. Idempotent."""
        if self._closed:
            return
        if self.window is not None:
            self.window.close()
        self.sim.free()
        self._closed = True

    def _check_open(self) -> None:
        if self._closed:
            raise ClosedEnvironmentError(f"this environment of {self.bddl_file_name} is closed; make another")

    def __getstate__(self) -> dict[str, Any]:
        raise InvalidInputError(
            "an environment cannot be copied or pickled: it holds a compiled simulation; make another"
        )

    def render(self) -> None:
        """Show the present state in a window, with `has_renderer` and a screen."""
        self._check_open()
        if self.window is not None:
            self.window.show(self.sim.model._model, self.sim.data._data)


DIR_PATH = os.path.dirname(os.path.realpath(__file__))
