"""How the arm would sit with its hand somewhere: closed forms for the Panda, for many poses at once."""

import numpy as np

# Franka Emika Panda, m: from its data sheet, and the hand down to the grip site.
_SHOULDER = np.array([0.0, 0.0, 0.333])  # over the base
_UPPER, _FOREARM, _ELBOW, _WRIST, _HAND = 0.316, 0.384, 0.0825, 0.088, 0.2104
_REACH = 0.32, 0.64  # m, from the shoulder to the wrist; from 0.20 to 0.70 the elbow is within its limits
_WRIST_MIDDLE = 2.33  # rad, yaw of the fingers straight ahead of the arm with its last joint in the middle
_BENT = (
    2.75  # rad, of joint 6, up to which the wrist bends with ease; at pi joints 5 and 7 turn about one line
)


def posture_cost(pos: np.ndarray, mat: np.ndarray, base: np.ndarray) -> np.ndarray:
    """What poses of the grip site cost the arm: turned wrists, folded and stretched elbows, and wrists bent back.

    Args:
        pos: (N, 3), m, world frame.
        mat: (N, 3, 3).
        base: position of the robot's base, (3,), m.

    Returns:
        (N,), 0 where the arm is at ease; about 1 where a joint is at its limit.
    """
    back = np.maximum(wrist_bend(pos, mat, base) - _BENT, 0.0)
    return 0.12 * wrist_twist(pos, mat, base) ** 2 + 20.0 * reach_violation(pos, mat, base) + 1.5 * back


def wrist_twist(pos: np.ndarray, mat: np.ndarray, base: np.ndarray) -> np.ndarray:
    """How far hands are turned from where the wrist's joints are in the middle, (N,), rad."""
    yaw = _WRIST_MIDDLE + np.arctan2(pos[:, 1] - base[1], pos[:, 0] - base[0])
    c, s = np.cos(yaw), np.sin(yaw)
    trace = c * (mat[:, 0, 0] - mat[:, 1, 1]) + s * (mat[:, 1, 0] + mat[:, 0, 1]) - mat[:, 2, 2]
    return np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))


def reach_violation(pos: np.ndarray, mat: np.ndarray, base: np.ndarray) -> np.ndarray:
    """How far wrists are out of easy reach, too close or too far, (N,), m."""
    distance = np.linalg.norm(_wrist(pos, mat, base), axis=1)
    return np.maximum(0.0, np.maximum(distance - _REACH[1], _REACH[0] - distance))


def wrist_bend(pos: np.ndarray, mat: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Angle of joint 6 with the elbow straight above the line from the shoulder to the wrist, (N,), rad.

    At pi the hand points along the forearm and the wrist is singular; far beyond, at 3.75, is the joint's limit.
    """
    approach = mat[:, :, 2]
    wrist = _wrist(pos, mat, base)
    ahead, level = _unit(wrist * [1.0, 1.0, 0.0]), np.hypot(wrist[:, 0], wrist[:, 1])
    upper, lower, side = np.hypot(_UPPER, _ELBOW), np.hypot(_FOREARM, _ELBOW), np.linalg.norm(wrist, axis=1)
    lift = np.arccos(np.clip((upper**2 + side**2 - lower**2) / (2 * upper * np.maximum(side, 1e-9)), -1, 1))
    elbow = np.arctan2(level, wrist[:, 2]) - lift  # angles from straight up
    forearm = np.arctan2(level - upper * np.sin(elbow), wrist[:, 2] - upper * np.cos(elbow))
    forearm = forearm + np.arctan2(_ELBOW, _FOREARM)
    out = np.sum(approach * ahead, axis=1)
    return np.pi - np.arctan2(
        out * np.cos(forearm) - approach[:, 2] * np.sin(forearm),
        out * np.sin(forearm) + approach[:, 2] * np.cos(forearm),
    )


def _wrist(pos: np.ndarray, mat: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Where the axes of joints 5 and 6 meet, from the shoulder, (N, 3), m; the arm's plane is upright."""
    approach = mat[:, :, 2]
    flange = pos - _HAND * approach - base - _SHOULDER
    ahead = _unit(flange * [1.0, 1.0, 0.0])
    return flange - _WRIST * _unit(ahead - np.sum(ahead * approach, axis=1)[:, None] * approach)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-9)[:, None]
