"""The arm on its two mounts, and as robosuite offers it: `env.robots[0].controller`, `.gripper`, ..."""

from collections.abc import Callable, Mapping
from functools import cached_property
from operator import attrgetter
from typing import Any, ClassVar

import numpy as np

from libero._adapters.controllers import Controller, controller_of
from libero._adapters.lookup import Named, alias_modules
from libero._adapters.observations import quat_xyzw
from libero._adapters.sim import MjModel, MjSim
from libero_env.assets.robot import ARM_JOINTS, GRIP_SITE, OPEN_FINGERS, REST_QPOS, add_panda
from libero_env.envs.checks import checked_actions
from libero_env.errors import LiberoError
from libero_env.mujoco_compat import mujoco
from libero_env.sim.osc import GRIPPER_SPEED

_PART: dict[str, Callable[[Any], Any]] = {
    "bodies": lambda part: part._names("body"),
    "joints": lambda part: part._names("joint"),
    "actuators": lambda part: part._names("actuator"),
    "sites": lambda part: part._names("site"),
    "sensors": lambda part: part._names("sensor"),
    "cameras": lambda part: part._names("camera"),
    "contact_geoms": lambda part: part._geoms(0),
    "visual_geoms": lambda part: part._geoms(1),
}


class ModelPart(Named, names=_PART):
    """A part of the robot: `bodies`, `joints`, `contact_geoms` and so on are names of elements in the scene.

    Args:
        idn: Number of the robot.
        sim: Simulation that it is part of; None for an arm without a scene.
    """

    naming_prefix: ClassVar[str]
    root_body: ClassVar[str]
    important_geoms: Mapping[str, list[str]] = {}
    important_sites: Mapping[str, str] = {}
    important_sensors: Mapping[str, str] = {}
    bottom_offset = top_offset = np.zeros(3)
    horizontal_radius: float = 0
    mount: Any = None

    def __init__(self, idn: int = 0, sim: MjSim | None = None):
        self.idn, self.name = idn, f"{type(self).__name__}{idn}"
        if sim is not None:
            self._model = sim.model

    @cached_property
    def _model(self) -> MjModel:
        spec = mujoco.MjSpec()
        add_panda(spec, (0.0, 0.0, 0.0), detailed=True)
        return MjModel(spec.compile())

    def _names(self, kind: str) -> list[str]:
        return [name for name in getattr(self._model, f"{kind}_names") if name.startswith(self.naming_prefix)]

    def _geoms(self, group: int) -> list[str]:
        names = enumerate(self._model.geom_names)
        return [
            n for i, n in names if n.startswith(self.naming_prefix) and self._model.geom_group[i] == group
        ]

    def set_sites_visibility(self, sim: MjSim, visible: bool) -> None:
        """Show or hide its sites."""
        sim.show_sites(self.sites, visible)


class RethinkMount(ModelPart):
    """The pedestal."""

    naming_prefix, root_body, horizontal_radius = "mount0_", "mount0_base", 0.25
    bottom_offset, top_offset = np.array([0.0, 0.0, -0.922]), np.array([0.0, 0.0, -0.01])


class NullMount(ModelPart):
    """No mount."""

    naming_prefix, root_body = "mount0_", "mount0_base"


class Panda(ModelPart):
    """Properties of the arm.

    Attributes:
        default_mount: Name of the mount; None for the ground.
        horizontal_radius: Radius that is kept free around the arm, m.
        init_qpos: Rest pose, (7,) rad.
        mount: Mount below it.
        grippers: Name of its hand -> gripper.
    """

    default_mount: ClassVar[str | None] = None
    naming_prefix, root_body, eef_name = "robot0_", "robot0_base", "robot0_right_hand"
    dof: ClassVar[int] = len(ARM_JOINTS)
    horizontal_radius = _horizontal_radius = 0.5
    top_offset = np.array([0.0, 0.0, 1.0])

    def __init__(self, idn: int = 0, sim: MjSim | None = None):
        super().__init__(idn, sim)
        self.init_qpos = np.array(REST_QPOS)
        self.mount = (RethinkMount if self.default_mount else NullMount)(idn, sim)
        self.bottom_offset = self.mount.bottom_offset - self.mount.top_offset
        self.grippers = {self.eef_name: PandaGripper(idn, sim)}

    @property
    def models(self) -> list[ModelPart]:
        """Mount and gripper."""
        return [self.mount, *self.grippers.values()]


class MountedPanda(Panda):
    """The arm on a pedestal."""

    default_mount = "RethinkMount"


class OnTheGroundPanda(Panda):
    """The arm on the ground."""


class PandaGripper(ModelPart):
    """The two fingers.

    Attributes:
        current_action: Command of the two fingers in [-1, 1], (2,).
    """

    dof, speed = 1, GRIPPER_SPEED
    init_qpos = np.array(OPEN_FINGERS)
    naming_prefix, root_body = "gripper0_", "gripper0_right_gripper"
    important_sites = {
        "grip_site": GRIP_SITE,
        "grip_cylinder": "gripper0_grip_site_cylinder",
        **{name: f"gripper0_{name}" for name in ("ee", "ee_x", "ee_y", "ee_z")},
    }
    important_sensors = {name: f"gripper0_{name}" for name in ("force_ee", "torque_ee")}
    important_geoms = {
        name: [f"gripper0_finger{finger}{part}_collision" for part in parts]
        for name, finger, parts in (
            ("left_finger", 1, ("", "_pad")),
            ("right_finger", 2, ("", "_pad")),
            ("left_fingerpad", 1, ("_pad",)),
            ("right_fingerpad", 2, ("_pad",)),
        )
    }
    _env: Any

    @property
    def current_action(self) -> np.ndarray:
        """Command of the two fingers in [-1, 1], (2,)."""
        return self._env.simulations.controller_state.gripper[0]

    @current_action.setter
    def current_action(self, value: Any) -> None:
        self._env.simulations.controller_state.gripper[0] = value

    def format_action(self, action: Any) -> np.ndarray:
        """Move the command of the fingers by one substep of an action, (1,), and return it, (2,)."""
        moved = self.current_action + np.array([-1.0, 1.0]) * self.speed * np.sign(action)
        self.current_action = np.clip(moved, -1.0, 1.0)
        return self.current_action


class Recent:
    """Present and last value of what is noted at the beginning of each step; zeros before."""

    def __init__(self, dim: int):
        self.dim, self.last, self.current = dim, np.zeros(dim), np.zeros(dim)

    def push(self, value: Any) -> None:
        """Note a value."""
        self.last, self.current = self.current, np.array(value, np.float64)

    delta = property(lambda self: self.current - self.last, doc="Change from the last to the present value.")
    average = property(lambda self: (self.current + self.last) / 2, doc="Mean of both.")


_ROBOT: dict[str, Callable[[Any], Any]] = {
    "action_dim": lambda robot: robot.controller.control_dim + 1,
    "base_pos": lambda robot: robot.sim.data.get_body_xpos("robot0_base").copy(),
    "base_ori": lambda robot: quat_xyzw(robot.sim.data.get_body_xmat("robot0_base")),
    "ee_force": lambda robot: robot.get_sensor_measurement("gripper0_force_ee"),
    "ee_torque": lambda robot: robot.get_sensor_measurement("gripper0_torque_ee"),
    "robot_joints": lambda robot: robot.robot_model.joints,
    "torque_limits": lambda robot: tuple(robot.sim.model.actuator_ctrlrange[:7].T.copy()),
    "torques": lambda robot: robot.sim.data.ctrl[:7].copy() if robot._env.timestep else None,
    "_joint_positions": lambda robot: robot.sim.data.qpos[:7].copy(),
    "_joint_velocities": lambda robot: robot.sim.data.qvel[:7].copy(),
    "_hand_pose": lambda robot: robot.pose_in_base_from_name(robot.robot_model.eef_name),
    "_hand_pos": lambda robot: robot._hand_pose[:3, 3],
    "_hand_orn": lambda robot: robot._hand_pose[:3, :3],
    "_hand_quat": lambda robot: quat_xyzw(robot._hand_orn),
    "_hand_total_velocity": lambda robot: np.concatenate([robot._hand_vel, robot._hand_ang_vel]),
    "_hand_vel": lambda robot: robot.sim.data.get_body_xvelp(robot.robot_model.eef_name),
    "_hand_ang_vel": lambda robot: robot.sim.data.get_body_xvelr(robot.robot_model.eef_name),
}


class SingleArm(Named, names=_ROBOT):
    """The arm with controller and gripper.

    Attributes:
        recent_qpos, recent_torques, recent_actions: Joints, (7,) rad, torques, (7,) N m, and action at the beginning of
            the last step and of the one before it.
    """

    idn, dof, has_gripper, gripper_type, mount_type = 0, 8, True, "default", "default"

    def __init__(self, env: Any, config: Any, robots: Any = ("Panda",)):
        names = [robots] if isinstance(robots, str) else list(robots)
        if len(names) != 1 or not str(names[0]).endswith("Panda"):
            raise LiberoError(f"robots={names}: the benchmark has one arm; pass ['Panda']")
        self._env, self.sim, self.control_freq = env, env.sim, env.control_freq
        kind = OnTheGroundPanda if env.scene.workspace.mount is None else MountedPanda
        self.robot_model, self.name = kind(sim=env.sim), kind.__name__
        (self.gripper,) = self.robot_model.grippers.values()
        self.gripper._env = env
        self.controller_config = controller_of(config)
        self.init_qpos = self.robot_model.init_qpos
        self.initialization_noise = dict(env.initialization_noise)
        self._ref_joint_indexes = self.joint_indexes = self._ref_joint_actuator_indexes = list(range(7))
        self._ref_joint_gripper_actuator_indexes = [7, 8]
        self._ref_joint_pos_indexes = self._ref_joint_vel_indexes = list(np.arange(7, dtype=np.int32))
        self._ref_gripper_joint_pos_indexes = list(np.arange(7, 9, dtype=np.int32))
        self._ref_gripper_joint_vel_indexes = self._ref_gripper_joint_pos_indexes
        sites = self.gripper.important_sites
        self.eef_site_id, self.eef_cylinder_id = (
            env.sim.model.site_name2id(sites[name]) for name in ("grip_site", "grip_cylinder")
        )
        self.reset()

    @property
    def action_limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest action."""
        low, high = self.controller.control_limits
        return np.append(low, -1.0), np.append(high, 1.0)

    def reset(self) -> None:
        """Make the controller anew, from `controller_config`; it takes the present rest pose for its own."""
        self.controller = Controller(self._env, controller_of(self.controller_config))
        self.recent_qpos, self.recent_torques = Recent(7), Recent(7)
        self.recent_actions = Recent(self.action_dim)

    def set_robot_joint_positions(self, jpos: Any) -> None:
        """Set the joint positions, (7,) rad."""
        self.sim.data.qpos[:7] = jpos
        self.sim.forward()

    def get_sensor_measurement(self, sensor_name: str) -> np.ndarray:
        """Return the numbers of a sensor."""
        model, index = self.sim.model, self.sim.model.sensor_name2id(sensor_name)
        start = model.sensor_adr[index]
        return self.sim.data.sensordata[start : start + model.sensor_dim[index]].copy()

    def pose_in_base_from_name(self, name: str) -> np.ndarray:
        """Return the pose of a body in the frame of the base, (4, 4)."""
        data, base = self.sim.data, self.robot_model.root_body
        turn, pose = data.get_body_xmat(base).T, np.eye(4)
        pose[:3, :3] = turn @ data.get_body_xmat(name)
        pose[:3, 3] = turn @ (data.get_body_xpos(name) - data.get_body_xpos(base))
        return pose

    def check_q_limits(self) -> bool:
        """Return whether a joint is less than 0.1 rad from a limit."""
        low, high = self.sim.model.jnt_range[:7].T
        return bool(((self._joint_positions <= low + 0.1) | (self._joint_positions >= high - 0.1)).any())

    def grip_action(self, gripper: PandaGripper, gripper_action: Any) -> None:
        """Move the fingers' controls by one substep of an action, (1,); `step` sets them anew."""
        low, high = self.sim.model.actuator_ctrlrange[7:9].T
        command = gripper.format_action(gripper_action)
        self.sim.data.ctrl[7:9] = (high + low) / 2 + (high - low) / 2 * command

    def visualize(self, vis_settings: Mapping[str, bool]) -> None:
        """Show or hide the sites of the arm (`robots`) and of the gripper (`grippers`)."""
        self.robot_model.set_sites_visibility(self.sim, vis_settings["robots"])
        self.gripper.set_sites_visibility(self.sim, vis_settings["grippers"])

    def command(self, action: Any) -> np.ndarray:
        """Return an action, see `checked_actions`, and note it with the joints.

        Of seven numbers for `OSC_POSITION` the rotation is left out.
        """
        action = np.asarray(action)
        if self.action_dim == 4 and action.shape == (7,):
            action = action[[0, 1, 2, 6]]
        action = checked_actions(action, (self.action_dim,))
        self.recent_qpos.push(self._joint_positions)
        self.recent_actions.push(action)
        return action


ROBOT_CLASS_MAPPING = dict.fromkeys(("Panda", "MountedPanda", "OnTheGroundPanda"), SingleArm)

alias_modules(__name__, "mounted_panda on_the_ground_panda")
