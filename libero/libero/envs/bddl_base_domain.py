"""The environment behind the wrappers: one simulation of a task file, stepped as robosuite steps it."""

import os
import weakref
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from inspect import signature
from typing import Any

import numpy as np

from libero._adapters.arguments import check_arguments, check_horizon, noise_of, substeps_of, with_room
from libero._adapters.controllers import controller_of
from libero._adapters.domain import DomainParts
from libero._adapters.lookup import lookup
from libero._adapters.models import facade_drawing, facade_pack, facade_robot
from libero._adapters.observations import Observer, cameras
from libero._adapters.sim import ClientSimulations, MjSim, Window
from libero.libero.envs import bddl_utils as BDDLUtils
from libero.libero.envs.bddl_utils import task_file
from libero.libero.envs.object_states import BaseObjectState, ObjectState, SiteObjectState
from libero.libero.envs.predicates import eval_predicate_fn
from libero.libero.envs.robots import SingleArm
from libero.libero.envs.scene_objects import TaskModel, scene_fixtures, scene_objects, scene_sites
from libero.libero.utils.utils import postprocess_model_xml
from libero_env.assets.robot import OPEN_FINGERS, ROBOTS
from libero_env.errors import ClosedEnvironmentError, InvalidInputError, LiberoError, require_known
from libero_env.init_states.original_resets import OriginalResets
from libero_env.mujoco_compat import mujoco
from libero_env.sim.predicates import evaluate
from libero_env.sim.scene import build_scene
from libero_env.sim.scene_spec import FAITHFUL, scene_spec
from libero_env.sim.simulation import CLOSED
from libero_env.sim.state import StateView
from libero_env.tasks.rules import BUILTIN_PREDICATES

TASK_MAPPING: dict[str, type["BDDLBaseDomain"]] = {}
CONTROL_FREQ = 20  # Hz
# Arguments in `kwargs` that are attributes of robosuite's environments, and their defaults.
_KEPT: dict[str, Any] = {
    **{"env_configuration": "default", "has_offscreen_renderer": True, "render_collision_mesh": False},
    **{"render_visual_mesh": True, "render_gpu_device_id": -1, "renderer": "mujoco", "renderer_config": None},
    "object_property_initializers": [],
}
_FLOOR_OFFSET = (0.0, 0.0, -0.035)  # the original's origin of regions on the floor, m


class EpisodeOverError(LiberoError, ValueError):
    """`step` was called after the horizon."""


def register_problem(target_class: type["BDDLBaseDomain"]) -> type["BDDLBaseDomain"]:
    """Register a problem class by its name, which task files give after `define (problem`; case does not matter."""
    TASK_MAPPING[target_class.__name__.lower()] = target_class
    return target_class


class BDDLBaseDomain(DomainParts):
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
            `fast`; by default as the environment variable `LIBERO_DRAWING` says, or else `faithful` with the original's
            models and `fast` with the builtin ones; an addition.
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
        drawing: str | None = None,
        robot: str | None = None,
        **kwargs: Any,
    ):
        check_arguments(kwargs, signature(BDDLBaseDomain).parameters)
        check_horizon(horizon)
        self._substeps = substeps_of(control_freq)
        self.robot = robot or facade_robot()
        require_known("robot", self.robot, ROBOTS)
        self.drawing = facade_drawing(drawing)
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
        self._noted = []

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

    def _pre_action(self, action: Any, policy_step: bool = False) -> None:
        """Do nothing; a subclass may change the simulation before each control step."""

    def _post_action(self, action: Any) -> tuple[float, bool, dict[str, Any]]:
        over = self.timestep >= self.horizon and not self.ignore_done
        result: tuple[float, bool, dict[str, Any]] = self.reward(action), over, {}
        self._post_process()
        return result

    def _post_process(self) -> None:
        """Update the states of objects that can be turned on; as in the original, they begin to glow only now."""
        DomainParts.set_visualization(self)
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

    # Properties and helpers ---------------------------------------------------------------------------------

    def is_fixture(self, object_name: str) -> bool:
        """Return whether a fixture has this name."""
        return object_name in self.fixtures_dict

    def get_object(self, object_name: str) -> Any:
        """Return the object, fixture or region of this name; raise an UnknownNameError if there is none."""
        entities = {**self.objects_dict, **self.fixtures_dict, **self.object_sites_dict}
        return lookup(entities, "object, fixture or region", object_name)

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
        for name, value in vars(
            self
        ).items():  # compiled models of hundreds of MB would wait for the garbage collector
            if not isinstance(value, str | int | float | None):
                setattr(self, name, CLOSED)

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
