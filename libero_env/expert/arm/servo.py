"""From the pose of the gripper and its target pose to an action of the environment."""

import numpy as np

from libero_env.geometry import rotation_between
from libero_env.sim.osc import POSITION_SCALE, ROTATION_SCALE

OPEN, CLOSE = -1.0, 1.0  # gripper entry of an action
DAMPING_TIME = 0.12  # [s] of motion that is anticipated
ROTATION_GAIN = 2.5  # action per full-scale rotation error
MAX_ROTATION = 0.6  # largest norm of the rotation part of an action


def action_toward(
    pos: np.ndarray,
    mat: np.ndarray,
    target_pos: np.ndarray,
    target_mat: np.ndarray,
    *,
    velocity: np.ndarray,
    gripper: float,
    gain: float = 1.6,
    speed: float = 1.0,
    lateral_scale: float = 1.0,
) -> np.ndarray:
    """Return a damped proportional action towards a pose of the grip site.

    Damping and the higher gain of the rotation compensate for the controller, which decouples position and
    orientation although the arm couples them: a hand that brakes tilts and recovers slowly. With both, 30 cm to within
    2.5 mm take 36 steps instead of 59.

    Args:
        pos: Position of the grip site in the world frame, (3,), [m].
        mat: Orientation of the grip site, site to world (3, 3).
        target_pos: Target position of the grip site, (3,), [m].
        target_mat: Target orientation of the grip site, (3, 3).
        velocity: Velocity of the grip site, (3,), [m/s].
        gripper: Seventh entry of the action: `OPEN`, `CLOSE` or 0 to keep the fingers where they are.
        gain: Action per full-scale position error.
        speed: Largest translation; both horizontal entries are scaled together, so that paths are straight.
        lateral_scale: Factor on the horizontal part, in [0, 1].

    Returns:
        Action (7,) in [-1, 1].
    """
    action = np.zeros(7)
    move = gain * (target_pos - pos - DAMPING_TIME * velocity) / POSITION_SCALE
    action[:2] = lateral_scale * move[:2] * min(1.0, speed / max(np.abs(move[:2]).max(), 1e-9))
    action[2] = np.clip(move[2], -speed, speed)
    turn = ROTATION_GAIN * rotation_between(mat, target_mat) / ROTATION_SCALE
    action[3:6] = turn * min(1.0, MAX_ROTATION / max(float(np.linalg.norm(turn)), 1e-9))
    action[6] = gripper
    return action


def lateral_ramp(height: float, target_height: float, tolerance: float, band: float) -> float:
    """Return the factor on horizontal motion, in [0, 1], of a hand that has to rise first.

    Args:
        height: Height of the grip site, [m].
        target_height: Height to which it rises, [m].
        tolerance: Missing height up to which the hand moves at full speed, [m].
        band: Missing height beyond the tolerance over which the speed falls to zero, [m].
    """
    return float(np.clip(1.0 - (target_height - height - tolerance) / band, 0.0, 1.0))


def finger_axis(mat: np.ndarray) -> np.ndarray:
    """Return the direction in which the fingers open, (3,), for an orientation of the grip site (3, 3)."""
    return mat[:, 0]


def downward(yaw: float, finger_axis: np.ndarray) -> np.ndarray:
    """Return the orientation (3, 3) of a gripper that points down with its fingers opening along `yaw`, [rad].

    Of the two that are half a turn apart, it is the one closer to `finger_axis` (3,), where the fingers open now.
    """
    x = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    if x @ finger_axis < 0:
        x = -x
    z = np.array([0.0, 0.0, -1.0])
    return np.column_stack([x, np.cross(z, x), z])
