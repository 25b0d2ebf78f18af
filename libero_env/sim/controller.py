"""Controllers of the arm: the meaning of an action, and the goals that a controller keeps between steps.

Semantics and gains are those of robosuite 1.4 (`controllers/config/*.json` there):

| name | action, `control_delta=True` | `control_delta=False` |
|---|---|---|
| `osc_pose` | position (1 is 5 cm), rotation vector (1 is 0.5 rad), gripper | m, rad, gripper |
| `osc_position` | position (1 is 5 cm), gripper; the hand points down | m, gripper |
| `joint_position` | seven joints (1 is 0.05 rad), gripper | rad, gripper |
| `joint_velocity` | seven joints (1 is 0.5 rad/s), gripper | |

Deltas are relative to the pose at the beginning of the step. Poses are those of the grip site in the world frame. The
last number is the gripper's: -1 opens, +1 closes. Values outside the action space are clipped.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from libero_env.compilation import compiled
from libero_env.errors import LiberoError, require_known
from libero_env.sim.osc import (
    GAINS,
    POSITION_SCALE,
    goals_from_deltas,
    goals_from_poses,
    move_gripper,
    osc_torques,
)

JOINT_SCALE = 0.05  # [rad] at full action
VELOCITY_SCALE = 0.5  # [rad/s] at full action
POINTING_DOWN = np.array([0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -1.0])  # rotation matrix
_WORKSPACE_LIMIT = 3.0  # [m] bound of absolute positions along each axis
_JOINT_LOW = (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973)  # [rad] limits of the Panda
_JOINT_HIGH = (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973)  # [rad]

VELOCITY_WINDOW = 5  # substeps over which the derivative is averaged
# errors of the window, their sum, whether a torque saturated, number of substeps
VELOCITY_MEMORY = 7 * VELOCITY_WINDOW + 7 + 2
_JOINT_GAINS = np.array([[50.0] * 7, [2.0 * np.sqrt(50.0)] * 7])
# of the width of the torque range, per rad/s; the second row is not used
_VELOCITY_GAINS = np.full((2, 7), 3.0)
_INTEGRAL, _DERIVATIVE = 0.005, 0.001  # of the proportional gain

SetGoals = Callable[..., None]


@dataclass(frozen=True)
class Controller:
    """A control law together with the meaning of its actions.

    Attributes:
        name: Name in the table above.
        control_delta: Whether actions are relative.
        low: Lower bounds of an action, (action_dim,); its last number is the gripper's.
        high: Upper bounds of an action, (action_dim,).
        goal_sizes: Lengths of the two arrays, goal and memory, that are kept for each simulation.
        kernel: Compiled control law, called in each substep; see `libero_env.sim.osc.osc_torques`.
        set_goals: Function that writes new goals at the first substep; called with (ids, actions, qpos, site_pos,
            site_mat, goal, memory).
        gains: Gains of the kernel on errors and on velocities, (2, 6) or (2, 7).
    """

    name: str
    control_delta: bool
    low: np.ndarray = field(repr=False, compare=False)
    high: np.ndarray = field(repr=False, compare=False)
    goal_sizes: tuple[int, int] = field(repr=False)
    kernel: Callable[..., None] = field(repr=False)
    set_goals: SetGoals = field(repr=False)
    gains: np.ndarray = field(repr=False, compare=False)

    @property
    def action_dim(self) -> int:
        """Length of an action."""
        return len(self.low)

    @property
    def state_size(self) -> int:
        """Length of the vector of `ControllerState.pack`."""
        return sum(self.goal_sizes) + 2


class ControllerState:
    """Goals, memory and gripper commands of the simulations of one model; what a controller keeps between steps.

    Args:
        num: Number of simulations.
        controller: Controller that runs; by default `osc_pose`.

    Attributes:
        goal: Goal of each simulation, (num, ...); position (3,) for OSC, 7 joints otherwise.
        memory: Other state of each simulation, (num, ...); goal orientation (9,) for OSC.
        gripper: Command of the two fingers, (num, 2), in [-1, 1].
    """

    def __init__(self, num: int, controller: Controller | None = None):
        self.controller = controller or get_controller()
        goal_size, memory_size = self.controller.goal_sizes
        self.goal, self.memory = np.zeros((num, goal_size)), np.zeros((num, memory_size))
        self.gripper = np.zeros((num, 2))

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Arrays that the kernel takes, (num, ...) each."""
        return self.goal, self.memory, self.gripper

    def restart(self, ids: np.ndarray, site_pos: np.ndarray, site_mat: np.ndarray) -> None:
        """Hold the current pose, with a neutral gripper command.

        Args:
            ids: Indices of the simulations, (k,).
            site_pos: Position of the grip site, (k, 3), m.
            site_mat: Orientation of the grip site, (k, 9).
        """
        holds_pose = self.controller.goal_sizes == (3, 9)
        self.goal[ids], self.memory[ids] = (site_pos, site_mat) if holds_pose else (0.0, 0.0)
        self.gripper[ids] = 0.0

    def pack(self, i: int) -> np.ndarray:
        """Return the state of simulation i as a vector, (state_size,)."""
        return np.concatenate([array[i] for array in self.arrays])

    def unpack(self, i: int, vector: np.ndarray) -> None:
        """Restore the state of simulation i from a vector of `pack`."""
        parts = np.split(vector, np.cumsum(self.controller.goal_sizes))
        for array, part in zip(self.arrays, parts, strict=True):
            array[i] = part


def get_controller(name: str = "osc_pose", control_delta: bool = True) -> Controller:
    """Return a controller by name.

    Args:
        name: Name in the table of this module.
        control_delta: Whether actions are relative.

    Raises:
        UnknownNameError: No controller has this name.
        LiberoError: `joint_velocity` is asked for without `control_delta`.
    """
    require_known("controller", name, CONTROLLERS)
    if name == "joint_velocity" and not control_delta:
        raise LiberoError("joint_velocity has no absolute mode; leave control_delta=True")
    return CONTROLLERS[name](control_delta)


def _osc_pose(delta: bool) -> Controller:
    high = np.ones(7) if delta else np.array([*[_WORKSPACE_LIMIT] * 3, *[2 * np.pi] * 3, 1.0])

    def absolute_goals(ids, actions, qpos, site_pos, site_mat, goal, memory):
        goals_from_poses(ids, np.clip(actions[:, :6], -high[:6], high[:6]), goal, memory)

    set_goals = goals_from_deltas if delta else absolute_goals
    return Controller("osc_pose", delta, -high, high, (3, 9), osc_torques, set_goals, GAINS)


def _osc_position(delta: bool) -> Controller:
    high = np.array([*[1.0 if delta else _WORKSPACE_LIMIT] * 3, 1.0])

    def set_goals(ids, actions, qpos, site_pos, site_mat, goal, memory):
        move = np.clip(actions[ids, :3], -high[:3], high[:3])
        goal[ids] = site_pos[ids] + POSITION_SCALE * move if delta else move
        memory[ids] = POINTING_DOWN

    return Controller("osc_position", delta, -high, high, (3, 9), osc_torques, set_goals, GAINS)


def _joint_position(delta: bool) -> Controller:
    low = -np.ones(8) if delta else np.array([*_JOINT_LOW, -1.0])
    high = np.ones(8) if delta else np.array([*_JOINT_HIGH, 1.0])

    def set_goals(ids, actions, qpos, site_pos, site_mat, goal, memory):
        move = np.clip(actions[ids, :7], low[:7], high[:7])
        goal[ids] = qpos[ids, :7] + JOINT_SCALE * move if delta else move

    law = joint_position_torques
    return Controller("joint_position", delta, low, high, (7, 0), law, set_goals, _JOINT_GAINS)


def _joint_velocity(delta: bool) -> Controller:
    def set_goals(ids, actions, qpos, site_pos, site_mat, goal, memory):
        goal[ids] = VELOCITY_SCALE * np.clip(actions[ids, :7], -1.0, 1.0)

    sizes, law, high = (7, VELOCITY_MEMORY), joint_velocity_torques, np.ones(8)
    return Controller("joint_velocity", delta, -high, high, sizes, law, set_goals, _VELOCITY_GAINS)


CONTROLLERS: dict[str, Callable[[bool], Controller]] = {
    "osc_pose": _osc_pose,
    "osc_position": _osc_position,
    "joint_position": _joint_position,
    "joint_velocity": _joint_velocity,
}


@compiled
def joint_position_torques(
    ids, actions, qpos, qvel, xanchor, xaxis, site_pos, site_mat, mass, bias, goal, memory, gripper, ctrl,
    mass_address, torque_limit, finger_range, rest, gains,
):  # fmt: skip
    """Compute one substep of control of joint positions: tau = M (kp (goal - q) - kd qd) + bias.

    Arguments as in `libero_env.sim.osc.osc_torques`; goal (n, 7), rad.
    """
    pull = np.empty(7)
    for k in range(ids.shape[0]):
        i = ids[k]
        for j in range(7):
            pull[j] = gains[0, j] * (goal[i, j] - qpos[i, j]) - gains[1, j] * qvel[i, j]
        for j in range(7):
            tau = bias[i, j]
            for c in range(7):
                tau += mass[i, mass_address[j, c]] * pull[c]
            ctrl[i, j] = min(max(tau, -torque_limit[j]), torque_limit[j])
        move_gripper(actions[i, 7], gripper[i], ctrl[i], finger_range)


@compiled
def joint_velocity_torques(
    ids, actions, qpos, qvel, xanchor, xaxis, site_pos, site_mat, mass, bias, goal, memory, gripper, ctrl,
    mass_address, torque_limit, finger_range, rest, gains,
):  # fmt: skip
    """Compute one substep of a PID loop on joint velocities, plus bias.

    The integral is not updated while a torque saturates. The derivative is the change of the error over the window,
    divided by the number of substeps in it.

    Arguments as in `libero_env.sim.osc.osc_torques`; goal (n, 7), rad/s; memory (n, 44): errors of the window, oldest
    first, their sum, whether a torque saturated, number of substeps.
    """
    total, flag, count = 7 * VELOCITY_WINDOW, 7 * VELOCITY_WINDOW + 7, 7 * VELOCITY_WINDOW + 8
    for k in range(ids.shape[0]):
        i = ids[k]
        memory[i, count] = min(memory[i, count] + 1.0, float(VELOCITY_WINDOW))
        saturated = False
        for j in range(7):
            error = goal[i, j] - qvel[i, j]
            change = (error - memory[i, j]) / memory[i, count]
            for w in range(VELOCITY_WINDOW - 1):
                memory[i, 7 * w + j] = memory[i, 7 * w + 7 + j]
            memory[i, 7 * (VELOCITY_WINDOW - 1) + j] = error
            if memory[i, flag] == 0.0:
                memory[i, total + j] += error
            gain = gains[0, j] * 2.0 * torque_limit[j]
            tau = bias[i, j] + gain * (error + _INTEGRAL * memory[i, total + j] + _DERIVATIVE * change)
            ctrl[i, j] = min(max(tau, -torque_limit[j]), torque_limit[j])
            saturated = saturated or ctrl[i, j] != tau
        memory[i, flag] = 1.0 if saturated else 0.0
        move_gripper(actions[i, 7], gripper[i], ctrl[i], finger_range)
