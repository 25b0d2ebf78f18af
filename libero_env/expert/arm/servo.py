"""From where the gripper is to where it should be: one action of the environment."""

import numpy as np

from libero_env.geometry import rotation_between
from libero_env.sim.osc import POSITION_SCALE, ROTATION_SCALE

OPEN, CLOSE = -1.0, 1.0
DAMPING = 0.12  # s, of motion that is taken into account ahead of time
TURN_GAIN = 2.5


def action_toward(
    pos: np.ndarray,
    mat: np.ndarray,
    goal_pos: np.ndarray,
    goal_mat: np.ndarray,
    *,
    velocity: np.ndarray,
    gripper: float,
    gain: float = 1.6,
    speed: float = 1.0,
    lateral: float = 1.0,
) -> np.ndarray:
    """Damped proportional action towards a pose of the grip site.

    Damping and the stiffer rotation are there because the controller treats position and orientation as decoupled,
    which this arm is not: a hand that brakes tilts, and comes back slowly. With them 30 cm to within
    2.5 mm take 36 steps instead of 59.

    Args:
        pos: position of the grip site, world frame, (3,), m.
        mat: its orientation, site to world, (3, 3).
        goal_pos: where it should be, (3,), m.
        goal_mat: and how turned, (3, 3).
        velocity: of the grip site now, (3,), m/s.
        gripper: 7th entry of the action.
        gain: action per error, in units of the largest step.
        speed: largest action of the translation; the horizontal part is scaled as one, so that paths are straight.
        lateral: factor on the horizontal part, in [0, 1].

    Returns:
        Action (7,) in [-1, 1].
    """
    action = np.zeros(7)
    move = gain * (goal_pos - pos - DAMPING * velocity) / POSITION_SCALE
    action[:2] = lateral * move[:2] * min(1.0, speed / max(np.abs(move[:2]).max(), 1e-9))
    action[2] = np.clip(move[2], -speed, speed)
    turn = TURN_GAIN * rotation_between(mat, goal_mat) / ROTATION_SCALE
    action[3:6] = turn * min(1.0, 0.6 / max(np.linalg.norm(turn), 1e-9))
    action[6] = gripper
    return action


def finger_axis(mat: np.ndarray) -> np.ndarray:
    """Direction in which the fingers open, (3,), of a grip site's orientation (3, 3)."""
    return mat[:, 0]


def downward(yaw: float, finger_axis: np.ndarray) -> np.ndarray:
    """Gripper pointing down with its fingers opening along `yaw`, on the side that needs less turning; (3, 3)."""
    x = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    if x @ finger_axis < 0:
        x = -x
    z = np.array([0.0, 0.0, -1.0])
    return np.column_stack([x, np.cross(z, x), z])
