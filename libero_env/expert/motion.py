"""From where the gripper is to where it should be: one action of the environment."""

import mujoco
import numpy as np

from libero_env.control import POSITION_SCALE, ROTATION_SCALE

OPEN, CLOSE = -1.0, 1.0


def action_toward(
    pos: np.ndarray, mat: np.ndarray, goal_pos: np.ndarray, goal_mat: np.ndarray, *,
    gripper: float, gain: float = 1.5, speed: float = 1.0, lateral: float = 1.0,
) -> np.ndarray:  # fmt: skip
    """Proportional action towards a pose of the grip site.

    Args:
        pos: position of the grip site, world frame, (3,), m.
        mat: its orientation, site to world, (3, 3).
        goal_pos: where it should be, (3,), m.
        goal_mat: and how turned, (3, 3).
        gripper: 7th entry of the action.
        gain: action per error, in units of the largest step.
        speed: largest action of the translation; horizontally it limits the length, so that paths are straight.
        lateral: factor on the horizontal part, in [0, 1].

    Returns:
        Action (7,) in [-1, 1].
    """
    action = np.zeros(7)
    move = gain * (goal_pos - pos) / POSITION_SCALE
    length = np.hypot(move[0], move[1])
    action[:2] = lateral * move[:2] * min(1.0, speed / max(length, 1e-9))
    action[2] = np.clip(move[2], -speed, speed)
    turn = gain * rotation_between(mat, goal_mat) / ROTATION_SCALE
    action[3:6] = turn * min(1.0, 0.6 / max(np.linalg.norm(turn), 1e-9))
    action[6] = gripper
    return action


def rotation_between(mat: np.ndarray, goal_mat: np.ndarray) -> np.ndarray:
    """The rotation that takes one orientation to the other, axis times angle in the world frame, (3,), rad."""
    quat, out = np.zeros(4), np.zeros(3)
    mujoco.mju_mat2Quat(quat, (goal_mat @ mat.T).ravel())
    mujoco.mju_quat2Vel(out, quat, 1.0)
    return out


def downward(yaw: float, finger_axis: np.ndarray) -> np.ndarray:
    """Gripper pointing down with its fingers opening along `yaw`, on the side that needs less turning; (3, 3)."""
    y = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    if y @ finger_axis < 0:
        y = -y
    z = np.array([0.0, 0.0, -1.0])
    return np.column_stack([np.cross(y, z), y, z])
