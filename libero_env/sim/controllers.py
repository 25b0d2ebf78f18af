"""The arm's controllers by name: what an action means, and what the controller remembers between steps.

Semantics and gains are those of robosuite 1.4 (`controllers/config/*.json` there):

| name | action, `control_delta=True` | `control_delta=False` |
|---|---|---|
| `osc_pose` | position (1 is 5 cm), rotation vector (1 is 0.5 rad), gripper | m, rad, gripper |
| `osc_position` | position (1 is 5 cm), gripper; the hand points down | m, gripper |
| `joint_position` | seven joints (1 is 0.05 rad), gripper | rad, gripper |
| `joint_velocity` | seven joints (1 is 0.5 rad/s), gripper | |

Deltas count from the pose at the beginning of the step; poses are the grip site's in the world frame. The gripper's
number is the last one: -1 opens, +1 closes. Values outside the action space are clipped.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from libero_env.errors import LiberoError, UnknownNameError
from libero_env.sim.osc import POSITION_SCALE, _move_gripper, _rotate, control, set_goals

JOINT_SCALE = 0.05  # rad at full action
VELOCITY_SCALE = 0.5  # rad/s at full action
_KP = 50.0
_KD = 2.0 * np.sqrt(50.0)
_VELOCITY_KP = 3.0  # of the width of the torque range, per rad/s
_INTEGRAL, _DERIVATIVE = 0.005, 0.001  # of the proportional gain
_WINDOW = 5  # substeps over which the derivative is averaged
_POINTING_DOWN = np.array([0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -1.0])
_REACH = 3.0  # m, the box of absolute positions
# Panda's joint limits, rad.
_JOINT_LOW = (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973)
_JOINT_HIGH = (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973)

SetGoals = Callable[..., None]


@dataclass(frozen=True)
class Controller:
    """One way to command the arm.

    Attributes:
        name: see the table above.
        control_delta: whether actions are relative.
        low, high: (action_dim,) bounds of an action; its last number is the gripper's.
        goal_sizes: numbers of the two arrays that a controller remembers for each simulation, beside the gripper's two.
        kernel: one substep, compiled; see `libero_env.sim.osc.control`.
        set_goals: called at the first substep with (ids, actions, qpos, site_pos, site_mat, *arrays).
    """

    name: str
    control_delta: bool
    low: np.ndarray = field(repr=False, compare=False)
    high: np.ndarray = field(repr=False, compare=False)
    goal_sizes: tuple[int, int] = field(repr=False)
    kernel: Callable[..., None] = field(repr=False)
    set_goals: SetGoals = field(repr=False)

    @property
    def action_dim(self) -> int:
        """Length of an action."""
        return len(self.low)

    @property
    def state_size(self) -> int:
        """How many numbers are remembered for each simulation."""
        return sum(self.goal_sizes) + 2


class ControllerState:
    """Goals, memory and gripper commands of n simulations; what control remembers between steps."""

    def __init__(self, num: int, kind: Controller | None = None):
        self.kind = kind or get_controller()
        first, second = self.kind.goal_sizes
        # OSC: goal position (3) and orientation (9); joints: goal (7) and memory. World frame, SI units.
        self.goal, self.memory = np.zeros((num, first)), np.zeros((num, second))
        self.gripper = np.zeros((num, 2))  # command state in [-1, 1]

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What the kernel takes, each (num, ...)."""
        return self.goal, self.memory, self.gripper

    def restart(self, ids: np.ndarray, site_pos: np.ndarray, site_mat: np.ndarray) -> None:
        """Hold the current pose, gripper command neutral; (k,), (k, 3), (k, 9)."""
        holds_pose = self.kind.goal_sizes == (3, 9)
        self.goal[ids], self.memory[ids] = (site_pos, site_mat) if holds_pose else (0.0, 0.0)
        self.gripper[ids] = 0.0

    def set_goals(
        self,
        ids: np.ndarray,
        actions: np.ndarray,
        qpos: np.ndarray,
        site_pos: np.ndarray,
        site_mat: np.ndarray,
    ) -> None:
        """New goals at the first substep; arrays (num, ...)."""
        self.kind.set_goals(ids, actions, qpos, site_pos, site_mat, self.goal, self.memory)

    def pack(self, i: int) -> np.ndarray:
        """The state of simulation i as a vector, (state_size,)."""
        return np.concatenate([array[i] for array in self.arrays])

    def unpack(self, i: int, vector: np.ndarray) -> None:
        """The inverse of `pack`."""
        for array, part in zip(self.arrays, np.split(vector, np.cumsum(self.kind.goal_sizes)), strict=True):
            array[i] = part


def get_controller(name: str = "osc_pose", control_delta: bool = True) -> Controller:
    """A controller by name.

    Raises:
        UnknownNameError: no controller has this name.
        LiberoError: `joint_velocity` without `control_delta`: a velocity is no pose.
    """
    if name not in CONTROLLERS:
        raise UnknownNameError("controller", name, CONTROLLERS)
    if name == "joint_velocity" and not control_delta:
        raise LiberoError("joint_velocity has no absolute mode; leave control_delta=True")
    return CONTROLLERS[name](control_delta)


def _osc_pose(delta: bool) -> Controller:
    pose = np.array([*[_REACH] * 3, *[2 * np.pi] * 3, 1.0])
    high = np.ones(7) if delta else pose
    return Controller(
        "osc_pose", delta, -high, high, (3, 9), control, _pose_step if delta else _pose_goal(pose)
    )


def _osc_position(delta: bool) -> Controller:
    high = np.array([*[1.0 if delta else _REACH] * 3, 1.0])

    def goals(ids, actions, qpos, site_pos, site_mat, goal, memory):
        move = np.clip(actions[ids, :3], -high[:3], high[:3])
        goal[ids] = site_pos[ids] + POSITION_SCALE * move if delta else move
        memory[ids] = _POINTING_DOWN

    return Controller("osc_position", delta, -high, high, (3, 9), control, goals)


def _joint_position(delta: bool) -> Controller:
    low = -np.ones(8) if delta else np.array([*_JOINT_LOW, -1.0])
    high = np.ones(8) if delta else np.array([*_JOINT_HIGH, 1.0])

    def goals(ids, actions, qpos, site_pos, site_mat, goal, memory):
        move = np.clip(actions[ids, :7], low[:7], high[:7])
        goal[ids] = qpos[ids, :7] + JOINT_SCALE * move if delta else move

    return Controller("joint_position", delta, low, high, (7, 0), joint_position, goals)


def _joint_velocity(delta: bool) -> Controller:
    def goals(ids, actions, qpos, site_pos, site_mat, goal, memory):
        goal[ids] = VELOCITY_SCALE * np.clip(actions[ids, :7], -1.0, 1.0)

    size = 7 * _WINDOW + 7 + 2  # errors of the last substeps, their sum, saturated, substeps so far
    return Controller("joint_velocity", delta, -np.ones(8), np.ones(8), (7, size), joint_velocity, goals)


CONTROLLERS: dict[str, Callable[[bool], Controller]] = {
    "osc_pose": _osc_pose,
    "osc_position": _osc_position,
    "joint_position": _joint_position,
    "joint_velocity": _joint_velocity,
}


def _pose_step(ids, actions, qpos, site_pos, site_mat, goal, memory):
    set_goals(ids, actions, site_pos, site_mat, goal, memory)


def _pose_goal(high: np.ndarray) -> SetGoals:
    def goals(ids, actions, qpos, site_pos, site_mat, goal, memory):
        _set_pose(ids, np.clip(actions[:, :6], -high[:6], high[:6]), goal, memory)

    return goals


@njit(cache=True, nogil=True)
def _set_pose(ids, poses, goal_pos, goal_mat):
    """Goals from positions and rotation vectors, (n, 6) -> (n, 3), (n, 9) in place."""
    identity = np.eye(3).ravel()
    for k in range(ids.shape[0]):
        i = ids[k]
        goal_pos[i] = poses[i, :3]
        if (poses[i, 3:] != 0.0).any():
            _rotate(poses[i, 3:], identity, goal_mat[i])
        else:
            goal_mat[i] = identity


@njit(cache=True, nogil=True)
def joint_position(
    ids, actions, qpos, qvel, xanchor, xaxis, site_pos, site_mat, mass, bias, goal, memory, gripper, ctrl,
    mass_address, torque_limit, finger_range, rest,
):  # fmt: skip
    """One substep: tau = M (kp (goal - q) - kd qd) + bias. Arguments as in `libero_env.sim.osc.control`."""
    pull = np.empty(7)
    for k in range(ids.shape[0]):
        i = ids[k]
        for j in range(7):
            pull[j] = _KP * (goal[i, j] - qpos[i, j]) - _KD * qvel[i, j]
        for j in range(7):
            tau = bias[i, j]
            for c in range(7):
                tau += mass[i, mass_address[j, c]] * pull[c]
            ctrl[i, j] = min(max(tau, -torque_limit[j]), torque_limit[j])
        _move_gripper(actions[i, 7], gripper[i], ctrl[i], finger_range)


@njit(cache=True, nogil=True)
def joint_velocity(
    ids, actions, qpos, qvel, xanchor, xaxis, site_pos, site_mat, mass, bias, goal, memory, gripper, ctrl,
    mass_address, torque_limit, finger_range, rest,
):  # fmt: skip
    """One substep of a PID loop on joint velocities, plus bias; the integral stands still while a torque saturates.

    The mean of the last differences of the error is its change over the window. Arguments as in
    `libero_env.sim.osc.control`; memory (n, 44): errors of the window, oldest first, their sum, saturated, substeps.
    """
    total, flag, count = 7 * _WINDOW, 7 * _WINDOW + 7, 7 * _WINDOW + 8
    for k in range(ids.shape[0]):
        i = ids[k]
        memory[i, count] = min(memory[i, count] + 1.0, float(_WINDOW))
        saturated = False
        for j in range(7):
            error = goal[i, j] - qvel[i, j]
            change = (error - memory[i, j]) / memory[i, count]
            for w in range(_WINDOW - 1):
                memory[i, 7 * w + j] = memory[i, 7 * w + 7 + j]
            memory[i, 7 * (_WINDOW - 1) + j] = error
            if memory[i, flag] == 0.0:
                memory[i, total + j] += error
            gain = _VELOCITY_KP * 2.0 * torque_limit[j]
            tau = bias[i, j] + gain * (error + _INTEGRAL * memory[i, total + j] + _DERIVATIVE * change)
            ctrl[i, j] = min(max(tau, -torque_limit[j]), torque_limit[j])
            saturated = saturated or ctrl[i, j] != tau
        memory[i, flag] = 1.0 if saturated else 0.0
        _move_gripper(actions[i, 7], gripper[i], ctrl[i], finger_range)
