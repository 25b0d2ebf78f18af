"""Inverse kinematics of the arm, and the limit on actions that keeps its elbow bent."""

from collections.abc import Sequence

import mujoco
import numpy as np

from libero_env.assets.robot import REST_QPOS
from libero_env.geometry import Pose, rotation_between
from libero_env.sim.osc import POSITION_SCALE
from libero_env.sim.state import StateView

_GRIP_SITE = "gripper0_grip_site"
_MAX_STEPS, _STEP_SIZE, _REST_GAIN = 60, 0.5, 0.03
_DAMPING = 1e-3 * np.eye(6)
_MIN_STEP = 1e-3  # [rad] of every joint, below which the search stops
_POS_TOLERANCE, _ROT_TOLERANCE = 0.006, 0.06  # [m], [rad] that count as reached
_JOINT_MARGIN = 0.2  # [rad] from the limits of the joints, which the controller hits on the way
_ELBOW_RANGE = -2.85, -0.9  # [rad] of joint 4: short of folded, short of straight (-0.47), where it locks
_ROLL_JOINTS, _MAX_ROLL = [0, 2, 4], 1.0  # joints that roll the arm; [rad] of roll that is free of cost

_STRAIGHT_ELBOW = -0.467  # [rad] of joint 4
_LIMITED_BEND = 0.6  # [rad] from straight, below which the elbow's extension is limited
_LINK_FACTOR = 0.0892  # [m] a b / (2 (a + b)) for links of lengths a and b
_RESERVE = 0.012  # [m] of the remaining reach that is not used


def limit_elbow_extension(view: StateView, action: np.ndarray) -> np.ndarray:
    """Return an action (7,) without what would straighten the elbow, and with some bending where it is nearly straight.

    The remaining reach of links a and b that are an angle d short of straight is a b d^2 / (2 (a + b)).
    """
    fields, i, model = view.simulations.fields, view.index, view.scene.model
    bend = _STRAIGHT_ELBOW - float(fields["qpos"][i][model.joint("robot0_joint4").qposadr[0]])
    if not 0.0 < bend < _LIMITED_BEND:
        return action
    shoulder, wrist = (fields["xpos"][i][model.body(f"robot0_link{k}").id] for k in (2, 6))
    outward = (wrist - shoulder) / np.linalg.norm(wrist - shoulder)
    remaining = max(_LINK_FACTOR * bend**2 - _RESERVE, -_RESERVE)
    excess = max(float(action[:3] @ outward) * POSITION_SCALE - remaining, 0.0)
    return np.concatenate([np.clip(action[:3] - excess / POSITION_SCALE * outward, -1.0, 1.0), action[3:]])


def joint_angles(view: StateView) -> np.ndarray:
    """Return the seven joint angles of the arm, (7,), [rad]."""
    return view.simulations.fields["qpos"][view.index][:7]


class ArmKinematics:
    """Inverse kinematics that prefers the rest posture, as the controller does.

    Args:
        model: Model of a scene with the robot.
    """

    def __init__(self, model: mujoco.MjModel):
        self._model, self._data = model, mujoco.MjData(model)
        self._site = model.site(_GRIP_SITE).id
        joints = [model.joint(f"robot0_joint{k}") for k in range(1, 8)]
        self._qpos = np.array([joint.qposadr[0] for joint in joints])
        self._dof = np.array([joint.dofadr[0] for joint in joints])
        ranges = np.array([joint.range for joint in joints])
        self._low, self._high = ranges.T + [[_JOINT_MARGIN], [-_JOINT_MARGIN]]
        self._low[3], self._high[3] = _ELBOW_RANGE

    def follow(self, start: np.ndarray, poses: Sequence[Pose]) -> tuple[np.ndarray, float]:
        """Solve for poses of the grip site one after the other, each from the solution before.

        Args:
            start: Joint angles at the start, (7,), [rad].
            poses: Poses of the grip site.

        Returns:
            The last joint angles, and the largest error of the poses: 0 where all are reached.
        """
        angles, largest = start, 0.0
        for pose in poses:
            angles, error = self.solve(angles, pose)
            largest = max(largest, error)
        return angles, largest

    def solve(self, start: np.ndarray, pose: Pose) -> tuple[np.ndarray, float]:
        """Solve for one pose of the grip site.

        Args:
            start: Joint angles at the start, (7,), [rad].
            pose: Pose of the grip site.

        Returns:
            Joint angles (7,), [rad], and the error beyond the tolerances, [m]; 0.1 rad of orientation count as 1 cm.
        """
        model, data, angles = self._model, self._data, start.copy()
        jacobian, rest = np.zeros((6, model.nv)), np.array(REST_QPOS)
        for _ in range(_MAX_STEPS):
            data.qpos[self._qpos] = angles
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            move = pose.pos - data.site_xpos[self._site]
            turn = rotation_between(data.site_xmat[self._site].reshape(3, 3), pose.mat)
            if move @ move < (0.3 * _POS_TOLERANCE) ** 2 and turn @ turn < (0.3 * _ROT_TOLERANCE) ** 2:
                break
            mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], self._site)
            arm_jacobian = jacobian[:, self._dof]
            to_rest = _REST_GAIN * (rest - angles)
            task = np.concatenate([move, turn]) - arm_jacobian @ to_rest
            inner = np.linalg.solve(arm_jacobian @ arm_jacobian.T + _DAMPING, task)
            step = np.minimum(np.maximum(arm_jacobian.T @ inner + to_rest, -0.5), 0.5)
            before, angles = angles, np.minimum(np.maximum(angles + _STEP_SIZE * step, self._low), self._high)
            if np.abs(angles - before).max() < _MIN_STEP:
                break
        error = max(float(np.linalg.norm(move)) - _POS_TOLERANCE, 0.0)
        error = error + 0.1 * max(float(np.linalg.norm(turn)) - _ROT_TOLERANCE, 0.0)
        roll = np.abs(angles - start)[_ROLL_JOINTS].max()
        return angles, float(error + 0.02 * max(roll - _MAX_ROLL, 0.0))
