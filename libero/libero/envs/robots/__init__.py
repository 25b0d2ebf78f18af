"""The arm on its two mounts, and as robosuite offers it: `env.robots[0].controller`, `.gripper`, ..."""

from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from typing import Any, ClassVar

import numpy as np

from libero._adapters.lookup import alias_modules
from libero._adapters.sim import Domain
from libero_env.assets.robot import ARM_JOINTS, FINGER_JOINTS, GRIP_SITE, OPEN_FINGERS, REST_QPOS
from libero_env.envs.checks import checked_actions
from libero_env.errors import LiberoError, UnknownNameError
from libero_env.sim.controller import CONTROLLERS as KINDS
from libero_env.sim.controller import ControllerState, get_controller
from libero_env.sim.osc import POSITION_SCALE, ROTATION_SCALE

_GAIN = 150.0  # [1/s^2] of operational space control; robosuite's controllers/config/osc_pose.json
_SCALES = np.array([POSITION_SCALE] * 3 + [ROTATION_SCALE] * 3)
CONTROLLERS = tuple(name.upper() for name in KINDS)


class Panda:
    """Properties of the arm.

    Attributes:
        default_mount: Name of the mount; None for the ground.
        base_xpos_offset: Workspace -> position of the base, (3,) m; for a table a function of its length.
        horizontal_radius: Radius that is kept free around the arm, m.
    """

    default_mount: ClassVar[str | None] = None
    default_gripper: ClassVar[str] = "PandaGripper"
    default_controller_config: ClassVar[str] = "default_panda"
    arm_type: ClassVar[str] = "single"
    naming_prefix: ClassVar[str] = "robot0_"
    eef_name: ClassVar[str] = "robot0_right_hand"
    grip_site: ClassVar[str] = GRIP_SITE
    joints: ClassVar[tuple[str, ...]] = ARM_JOINTS
    gripper_joints: ClassVar[tuple[str, ...]] = FINGER_JOINTS
    base_xpos_offset: ClassVar[dict[str, Any]] = {}
    dof: ClassVar[int] = len(ARM_JOINTS)
    horizontal_radius: ClassVar[float] = 0.5
    _horizontal_radius: ClassVar[float] = 0.5

    def __init__(self, idn: int = 0):
        self.idn, self.name = idn, f"Panda{idn}"

    init_qpos = property(lambda self: np.array(REST_QPOS), doc="Rest pose, (7,) rad.")
    top_offset = property(lambda self: np.array([0.0, 0.0, 1.0]), doc="Highest point over the base, (3,) m.")


def behind_a_table(x: float, height: float) -> Callable[[float], tuple[float, float, float]]:
    """Return the position of the base behind a table as a function of the length of the table."""
    return lambda table_length: (x - table_length / 2, 0.0, height)


COMMON_OFFSETS = {"bins": (-0.5, -0.1, 0.0), "empty": (-0.6, 0.0, 0.0), "table": behind_a_table(-0.16, 0.0)}


class MountedPanda(Panda):
    """The arm on a pedestal."""

    default_mount = "RethinkMount"
    base_xpos_offset = {
        **COMMON_OFFSETS,
        "kitchen_table": behind_a_table(-0.16, 0.0),
        "study_table": behind_a_table(-0.25, 0.0),
    }


class OnTheGroundPanda(Panda):
    """The arm on the ground."""

    base_xpos_offset = {
        **COMMON_OFFSETS,
        "coffee_table": behind_a_table(-0.16, 0.41),
        "living_room_table": behind_a_table(-0.16, 0.42),
    }


def controller_of(configs: Any) -> dict[str, Any]:
    """Return the configuration of the controller; raise an UnknownNameError if it does not exist.

    Args:
        configs: Configuration, list of one configuration, name of the controller, or None for the default.
    """
    if isinstance(configs, Sequence) and not isinstance(configs, str):
        configs = configs[0] if configs else None
    config = {"type": configs} if isinstance(configs, str) else dict(configs or {})
    config.setdefault("type", "OSC_POSE")
    if config["type"] not in CONTROLLERS:
        raise UnknownNameError("controller", config["type"], CONTROLLERS)
    return config


class Controller:
    """Goals of the arm.

    Attributes:
        name: Name of the controller, such as `OSC_POSE`.
        goal_pos, goal_ori: Goal of the grip site under operational space control, (3,) m and (3, 3).
    """

    def __init__(self, env: Domain, config: Mapping[str, Any]):
        self._env, self.name = env, config["type"]
        delta = bool(config.get("control_delta", config.get("use_delta", True)))
        env.simulations.controller_state = ControllerState(1, get_controller(self.name.lower(), delta))

    _state = property(attrgetter("_env.simulations.controller_state"))
    goal_pos = property(lambda self: self._state.goal[0])
    goal_ori = property(lambda self: self._state.memory[0].reshape(3, 3))
    ee_pos = property(attrgetter("_env.view.eef_pos"), doc="Position of the grip site, (3,) m.")
    ee_ori_mat = property(attrgetter("_env.view.eef_mat"), doc="Orientation of the grip site, (3, 3).")
    joint_pos = property(lambda self: self._env.sim.data.qpos[:7].copy(), doc="Joint positions, (7,) rad.")

    @property
    def use_delta(self) -> bool:
        """Whether actions are relative to the present pose; may be set at any time."""
        return self._state.controller.control_delta

    @use_delta.setter
    def use_delta(self, value: bool) -> None:
        self._state.controller = get_controller(self.name.lower(), bool(value))

    kp = property(lambda self: np.full(6, _GAIN), doc="Gains on pose errors, (6,) 1/s^2.")
    kd = property(lambda self: np.full(6, 2 * np.sqrt(_GAIN)), doc="Gains on velocities, (6,).")
    input_max = property(lambda self: np.ones(self.control_dim), doc="Largest action, without the gripper.")
    input_min = property(lambda self: -np.ones(self.control_dim), doc="Smallest action, without the gripper.")
    output_max = property(
        lambda self: _SCALES[: self.control_dim], doc="Motion of the largest action, m and rad."
    )
    output_min = property(lambda self: -_SCALES[: self.control_dim], doc="Motion of the smallest action.")

    @property
    def control_dim(self) -> int:
        """Length of an action without the gripper."""
        return self._state.controller.action_dim - 1

    def update(self, force: bool = False) -> None:
        """Measure the arm, if forced; otherwise do nothing: kinematics are read when they are needed."""
        if force:
            self._env.simulations.update_controller([0])

    def update_base_pose(self, base_pos: Any = None, base_ori: Any = None) -> None:
        """Do nothing: goals are in the world frame."""

    def reset_goal(self) -> None:
        """Set the goal to the present pose; the command of the gripper stays."""
        gripper = self._state.gripper[0].copy()
        self._state.restart(np.zeros(1, np.int64), self.ee_pos[None], self.ee_ori_mat.reshape(1, 9))
        self._state.gripper[0] = gripper


class Gripper:
    """The two fingers."""

    dof = 1
    init_qpos = np.array(OPEN_FINGERS)
    naming_prefix = "gripper0_"
    important_sites: Mapping[str, str] = {
        "grip_site": GRIP_SITE,
        "grip_cylinder": "gripper0_grip_site_cylinder",
    }
    important_geoms: Mapping[str, list[str]] = {
        name: [f"gripper0_finger{finger}{part}_collision" for part in parts]
        for name, finger, parts in (
            ("left_finger", 1, ("", "_pad")),
            ("right_finger", 2, ("", "_pad")),
            ("left_fingerpad", 1, ("_pad",)),
            ("right_fingerpad", 2, ("_pad",)),
        )
    }

    def __init__(self, env: Domain):
        self._env = env

    @property
    def contact_geoms(self) -> list[str]:
        """Names of the collision geoms."""
        model = self._env.sim.model
        names = enumerate(model.geom_names)
        return [name for i, name in names if name.startswith(self.naming_prefix) and model.geom_group[i] == 0]

    @property
    def current_action(self) -> np.ndarray:
        """Command of the two fingers in [-1, 1], (2,)."""
        return self._env.simulations.controller_state.gripper[0]

    @current_action.setter
    def current_action(self, value: Any) -> None:
        self._env.simulations.controller_state.gripper[0] = value


class SingleArm:
    """The arm with controller and gripper."""

    def __init__(self, env: Domain, config: Mapping[str, Any], robots: Any = ("Panda",)):
        names = [robots] if isinstance(robots, str) else list(robots)
        if len(names) != 1 or not str(names[0]).endswith("Panda"):
            raise LiberoError(f"robots={names}: the benchmark has one arm; pass ['Panda']")
        self._env, self.sim = env, env.sim
        self.robot_model = (OnTheGroundPanda if env.scene.workspace.mount is None else MountedPanda)()
        self.controller, self.gripper = Controller(env, config), Gripper(env)
        self.controller_config = dict(config)
        self.name, self.idn, self.dof = "Panda", 0, 8
        self.init_qpos = self.robot_model.init_qpos
        self.joint_indexes = self._ref_joint_pos_indexes = self._ref_joint_vel_indexes = list(range(7))
        self._ref_gripper_joint_pos_indexes = self._ref_gripper_joint_vel_indexes = [7, 8]
        self.eef_site_id = env.sim.model.site_name2id(self.robot_model.grip_site)

    action_dim = property(lambda self: self.controller.control_dim + 1, doc="Length of an action.")
    _joint_positions = property(lambda self: self.sim.data.qpos[:7].copy())
    _joint_velocities = property(lambda self: self.sim.data.qvel[:7].copy())
    _hand_pos = property(lambda self: self.sim.data.get_body_xpos(self.robot_model.eef_name).copy())
    _hand_orn = property(lambda self: self.sim.data.get_body_xmat(self.robot_model.eef_name).copy())
    _hand_quat = property(lambda self: np.roll(self.sim.data.get_body_xquat(self.robot_model.eef_name), -1))

    @property
    def action_limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest action."""
        controller = self._env.simulations.controller_state.controller
        return controller.low.copy(), controller.high.copy()

    @property
    def base_pos(self) -> np.ndarray:
        """Position of the base, (3,) m."""
        return self.sim.data.get_body_xpos("robot0_base").copy()

    def set_robot_joint_positions(self, jpos: Any) -> None:
        """Set the joint positions, (7,) rad."""
        self.sim.data.qpos[:7] = jpos
        self.sim.forward()

    def command(self, action: Any) -> np.ndarray:
        """Return an action, see `checked_actions`; of seven numbers for `OSC_POSITION` the rotation is left out."""
        action = np.asarray(action)
        if self.action_dim == 4 and action.shape == (7,):
            action = action[[0, 1, 2, 6]]
        return checked_actions(action, (self.action_dim,))


ROBOT_CLASS_MAPPING = dict.fromkeys(("Panda", "MountedPanda", "OnTheGroundPanda"), SingleArm)

alias_modules(__name__, "mounted_panda on_the_ground_panda")
