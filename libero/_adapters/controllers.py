"""Controllers of the arm with the configurations and attributes of robosuite 1.4.0 (`controllers/*.py` there)."""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from libero._adapters.lookup import Named
from libero_env.assets.robot import GRIP_SITE
from libero_env.errors import InvalidInputError, LiberoError, require_known
from libero_env.mujoco_compat import MASS_FIELD
from libero_env.sim.controller import POINTING_DOWN, ControllerState, get_controller
from libero_env.sim.osc import goals_from_poses, rotate
from libero_env.storage import parse_yaml
from libero_env.text import shown

# robosuite's controllers/config/*.json; m, rad, rad/s and N m
DEFAULTS: dict[str, dict[str, Any]] = parse_yaml(
    Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8")
)
_PANDA = {"type": "JOINT_VELOCITY", "kp": 0.03}  # default_panda.json
_POSES = {"orientation_limits": None, "uncouple_pos_ori": True}
# Keys that have one value here; the others of robosuite are obeyed, or have no effect with these values.
_FIXED: dict[str, Any] = {"impedance_mode": "fixed", "interpolation": None, **_POSES}
_SET_BY_ROBOT = "robot_name sim eef_name eef_rot_offset joint_indexes actuator_range policy_freq ndim".split()  # noqa: SIM905
_LIMITS = ("position_limits", "qpos_limits", "velocity_limits")


def controller_of(configs: Any) -> dict[str, Any]:
    """Return the whole configuration of a controller, with robosuite's values for keys that are left out.

    Args:
        configs: Configuration, list of one configuration, name of the controller, or None for robosuite's default.

    Raises:
        UnknownNameError: There is no such controller, or a key is not one of its configuration.
        LiberoError: A value is not supported.
    """
    if isinstance(configs, Sequence) and not isinstance(configs, str):
        configs = configs[0] if configs else None
    configs = _PANDA if configs is None else configs
    given = configs if isinstance(configs, Mapping) else {"type": configs}
    config = {key: value for key, value in given.items() if key not in _SET_BY_ROBOT}
    kind = config.setdefault("type", "OSC_POSE")
    require_known("controller", kind, DEFAULTS)
    if "use_delta" in config:  # as the attribute is called
        config["control_delta"] = config.pop("use_delta")
    valid = ["type", "control_delta", *DEFAULTS[kind]]
    for key, value in config.items():
        require_known(f"key of the controller {kind}", key, valid)
        if key in _FIXED and value != _FIXED[key]:
            raise LiberoError(
                f"controller {kind}, {key}={shown(value)}: not supported; leave {_FIXED[key]!r}"
            )
    return deepcopy({"type": kind, **DEFAULTS[kind], **config})


def _jacobian(controller: Any) -> np.ndarray:
    """Return the Jacobian of the grip site, (6, 7): hinge j moves it by axis x (site - anchor)."""
    data = controller._env.sim.data
    axes = data.xaxis[:7]
    return np.concatenate([np.cross(axes, controller.ee_pos - data.xanchor[:7]), axes], axis=1).T


_INDICES = list(np.arange(7, dtype=np.int32))
_NAMES: dict[str, Callable[[Any], Any]] = {  # m, rad, N m
    "J_full": _jacobian,
    "J_pos": lambda c: c.J_full[:3],
    "J_ori": lambda c: c.J_full[3:],
    "ee_pos": lambda c: c._env.view.eef_pos,
    "ee_ori_mat": lambda c: c._env.view.eef_mat,
    "ee_pos_vel": lambda c: c.J_pos @ c.joint_vel,
    "ee_ori_vel": lambda c: c.J_ori @ c.joint_vel,
    "joint_pos": lambda c: c._env.arm_seen[0],
    "joint_vel": lambda c: c._env.arm_seen[1],
    "mass_matrix": lambda c: c._env.simulations.fields[MASS_FIELD][0][c._env.simulations.arm.mass_address],
    "torque_compensation": lambda c: c._env.sim.data.qfrc_bias[:7].copy(),
    "goal_pos": lambda c: c._state.goal[0],
    "goal_ori": lambda c: c._state.memory[0].reshape(3, 3),
    "actuator_min": lambda c: -c.actuator_max,
    "control_limits": lambda c: (c.input_min, c.input_max),
    "actuator_limits": lambda c: (c.actuator_min, c.actuator_max),
    "action_scale": lambda c: abs(c.output_max - c.output_min) / abs(c.input_max - c.input_min),
    "action_input_transform": lambda c: (c.input_max + c.input_min) / 2.0,
    "action_output_transform": lambda c: (c.output_max + c.output_min) / 2.0,
    "sim": lambda c: c._env.sim,
    **dict.fromkeys(("orientation_limits", "interpolator_pos", "interpolator_ori"), lambda c: None),
    "impedance_mode": lambda c: "fixed",
    "uncoupling": lambda c: True,
}


class Controller(Named, names=_NAMES):
    """Goals, gains and limits of the arm. They may be set, and count from the next step to the next reset.

    What it has measured is of the last substep, as in robosuite.

    Attributes:
        name: Name of the controller, such as `OSC_POSE`.
        control_dim: Length of an action without the gripper.
        input_min, input_max, output_min, output_max: Ranges of an action, and what they mean, (control_dim,).
        actuator_max: Largest torques of the joints at the last reset, (7,), N m.
        position_limits, velocity_limits: Bounds of goals, (2, n): m, rad or rad/s; None for none.
    """

    eef_name, joint_dim = GRIP_SITE, 7
    joint_index, qpos_index, qvel_index = list(range(7)), _INDICES, _INDICES

    def __init__(self, env: Any, config: Mapping[str, Any]):
        self._env, self.name = env, config["type"]
        self._take_torque_limits()
        self.actuator_max = env.simulations.arm.torque_limit.copy()
        self.use_delta = bool(config.get("control_delta", True))
        self.control_dim = self._law.action_dim - 1
        for name in ("kp", "damping_ratio"):
            for end, value in zip(("min", "max"), config.get(f"{name}_limits", ()), strict=False):
                setattr(self, f"{name}_{end}", self._numbers({name: value}, name, self._law.gains.shape[1]))
        for key in ("input_max", "input_min", "output_max", "output_min"):
            setattr(self, key, self._numbers(config, key, self.control_dim))
        self.position_limits = self.velocity_limits = None
        for key in _LIMITS:
            if config.get(key) is not None:
                setattr(self, key.replace("qpos", "position"), self._bounds(config, key))
        law = replace(self._law, set_goals=self._set_goals, gains=self._gains(config))
        env.simulations.controller_state = ControllerState(1, law)
        self.reset_goal()

    def _take_torque_limits(self) -> None:
        """Clip torques at what the model allows now; it does so itself where that is less on one side."""
        simulations = self._env.simulations
        np.abs(simulations.model.actuator_ctrlrange[:7]).max(axis=1, out=simulations.arm.torque_limit)

    def _gains(self, config: Mapping[str, Any]) -> np.ndarray:
        gains = self._law.gains.copy()
        if "kp" in config:
            gains[0] = self._numbers(config, "kp", gains.shape[1])
        if "damping_ratio" in config:
            gains[1] = 2 * np.sqrt(gains[0]) * self._numbers(config, "damping_ratio", gains.shape[1])
        if self.name == "JOINT_VELOCITY" and np.ndim(config["kp"]):  # a list is not of the torque range
            gains[0] /= 2 * self.actuator_max
        return gains

    def _numbers(self, config: Mapping[str, Any], key: str, count: int) -> np.ndarray:
        try:
            values = np.asarray(config[key], np.float64)
            if values.ndim <= 1 and np.isfinite(values).all() and (key != "kp" or (values >= 0).all()):
                return np.array(np.broadcast_to(values, (count,)))
        except (TypeError, ValueError):
            pass
        raise self._invalid(config, key, f"a number, or {count} numbers")

    def _bounds(self, config: Mapping[str, Any], key: str) -> np.ndarray:
        n = 3 if self.name.startswith("OSC") else 7
        try:
            low, high = config[key]
            bounds = np.stack([np.broadcast_to(np.asarray(end, np.float64), (n,)) for end in (low, high)])
            if not np.isnan(bounds).any():
                return bounds
        except (TypeError, ValueError):
            pass
        raise self._invalid(config, key, f"two rows of {n} numbers, lowest and highest")

    def _invalid(self, config: Mapping[str, Any], key: str, expected: str) -> InvalidInputError:
        return InvalidInputError(f"controller {self.name}: {key}={shown(config[key])}; expected {expected}")

    # The meaning of an action -------------------------------------------------------------------------------

    def scale_action(self, action: Any) -> np.ndarray:
        """Return what an action without the gripper means, from the ranges of input and output."""
        clipped = np.clip(action, self.input_min, self.input_max)
        return (clipped - self.action_input_transform) * self.action_scale + self.action_output_transform

    def _set_goals(self, ids, actions, qpos, site_pos, site_mat, goal, memory):
        """See `libero_env.sim.controller.Controller`."""
        if self.name != "JOINT_VELOCITY":  # robosuite's clips at those of the last reset
            self._take_torque_limits()
        move, limits = actions[0, : self.control_dim], self.position_limits
        absolute = np.clip(move, self._law.low[:-1], self._law.high[:-1])
        wanted = self.scale_action(move) if self.use_delta else absolute
        if self.name == "OSC_POSE" and not self.use_delta:
            goals_from_poses(ids, wanted[None], goal, memory)
        elif self.name == "OSC_POSE" and wanted[3:].any():
            rotate(wanted[3:], site_mat[0], memory[0])
        elif self.name == "OSC_POSITION":
            memory[0] = POINTING_DOWN
        start = 0.0
        if self.name == "JOINT_VELOCITY":
            limits = self.velocity_limits
        elif self.use_delta:
            start = site_pos[0] if self.name.startswith("OSC") else qpos[0, :7]
        goal[0] = start + wanted[: goal.shape[1]]
        if limits is not None:
            goal[0] = np.clip(goal[0], *limits)

    @property
    def use_delta(self) -> bool:
        """Whether actions are relative to the present pose; may be set at any time."""
        return self._law.control_delta

    @use_delta.setter
    def use_delta(self, value: bool) -> None:
        self._law = get_controller(self.name.lower(), bool(value))

    # State --------------------------------------------------------------------------------------------------

    _state = property(attrgetter("_env.simulations.controller_state"))

    @property
    def kp(self) -> np.ndarray:
        """Gains on errors, (6,) of poses or (7,) of joints."""
        kp = self._state.controller.gains[0]
        return kp * 2 * self.actuator_max if self.name == "JOINT_VELOCITY" else kp

    @kp.setter
    def kp(self, value: Any) -> None:
        self._set_gains(0, value)

    @property
    def kd(self) -> np.ndarray:
        """Gains on velocities, (6,) or (7,)."""
        return 0.001 * self.kp if self.name == "JOINT_VELOCITY" else self._state.controller.gains[1]

    @kd.setter
    def kd(self, value: Any) -> None:
        self._set_gains(1, value)

    @property
    def initial_joint(self) -> np.ndarray:
        """Joints towards which operational space control pulls, (7,) rad."""
        return self._env.simulations.rest

    @initial_joint.setter
    def initial_joint(self, value: Any) -> None:
        self._env.simulations.rest = self._numbers({"initial_joint": value}, "initial_joint", 7)

    def _set_gains(self, row: int, value: Any) -> None:
        if self.name == "JOINT_VELOCITY":
            raise InvalidInputError(f"controller {self.name}: its gains are those of the configuration")
        gains = self._state.controller.gains
        gains[row] = self._numbers({"value": value}, "value", gains.shape[1])

    def update(self, force: bool = False) -> None:
        """Measure the arm, if forced; otherwise do nothing: kinematics are read when they are needed."""
        if force:
            self._env.simulations.update_controller([0])

    def reset_goal(self) -> None:
        """Set the goal to the present pose; the command of the gripper stays."""
        gripper = self._state.gripper[0].copy()
        self._state.restart(np.zeros(1, np.int64), self.ee_pos[None], self.ee_ori_mat.reshape(1, 9))
        self._state.gripper[0] = gripper
