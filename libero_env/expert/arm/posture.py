"""Posture of the arm for a pose of its hand: closed forms for the Panda, vectorised over poses."""

import numpy as np

# Franka Emika Panda, from its data sheet; the hand reaches from the flange to the grip site.
_SHOULDER = np.array([0.0, 0.0, 0.333])  # [m] above the base
_UPPER_ARM, _FOREARM, _ELBOW_OFFSET, _WRIST_OFFSET, _HAND = 0.316, 0.384, 0.0825, 0.088, 0.2104  # [m]
_COMFORTABLE_REACH = 0.32, 0.64  # [m] shoulder to wrist; joint limits of the elbow allow 0.20 to 0.70
_CENTRED_WRIST_YAW = 2.33  # [rad] yaw of the fingers, straight ahead of the arm, at which joint 7 is centred
_COMFORTABLE_BEND = 2.75  # [rad] of joint 6; at pi the axes of joints 5 and 7 coincide


def posture_cost(pos: np.ndarray, mat: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Return the cost of the arm's posture: twisted and bent-back wrists, folded and stretched elbows.

    Args:
        pos: Positions of the grip site in the world frame, (N, 3), [m].
        mat: Orientations of the grip site, (N, 3, 3).
        base: Position of the robot's base, (3,), [m].

    Returns:
        Costs (N,): 0 for a comfortable posture, about 1 where a joint is at its limit.
    """
    bent_back = np.maximum(wrist_bend(pos, mat, base) - _COMFORTABLE_BEND, 0.0)
    return 0.12 * wrist_twist(pos, mat, base) ** 2 + 20.0 * reach_violation(pos, mat, base) + 1.5 * bent_back


def wrist_twist(pos: np.ndarray, mat: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Return the angles between hands and the orientation in which the wrist's joints are centred, (N,), [rad]."""
    yaw = _CENTRED_WRIST_YAW + np.arctan2(pos[:, 1] - base[1], pos[:, 0] - base[0])
    c, s = np.cos(yaw), np.sin(yaw)
    trace = c * (mat[:, 0, 0] - mat[:, 1, 1]) + s * (mat[:, 1, 0] + mat[:, 0, 1]) - mat[:, 2, 2]
    return np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))


def reach_violation(pos: np.ndarray, mat: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Return how far wrists are outside the comfortable reach, too close or too far, (N,), [m]."""
    distance = np.linalg.norm(_wrist(pos, mat, base), axis=1)
    return np.maximum(0.0, np.maximum(distance - _COMFORTABLE_REACH[1], _COMFORTABLE_REACH[0] - distance))


def wrist_bend(pos: np.ndarray, mat: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Return the angle of joint 6 with the elbow straight above the line from shoulder to wrist, (N,), [rad].

    At pi the hand points along the forearm and the wrist is singular; the joint's limit is 3.75.
    """
    approach = mat[:, :, 2]
    wrist = _wrist(pos, mat, base)
    ahead, level = _unit(wrist * [1.0, 1.0, 0.0]), np.hypot(wrist[:, 0], wrist[:, 1])
    upper, lower = np.hypot(_UPPER_ARM, _ELBOW_OFFSET), np.hypot(_FOREARM, _ELBOW_OFFSET)
    distance = np.linalg.norm(wrist, axis=1)
    cosine = (upper**2 + distance**2 - lower**2) / (2 * upper * np.maximum(distance, 1e-9))
    elbow = np.arctan2(level, wrist[:, 2]) - np.arccos(np.clip(cosine, -1, 1))  # angles from straight up
    forearm = np.arctan2(level - upper * np.sin(elbow), wrist[:, 2] - upper * np.cos(elbow))
    forearm = forearm + np.arctan2(_ELBOW_OFFSET, _FOREARM)
    forward = np.sum(approach * ahead, axis=1)
    return np.pi - np.arctan2(
        forward * np.cos(forearm) - approach[:, 2] * np.sin(forearm),
        forward * np.sin(forearm) + approach[:, 2] * np.cos(forearm),
    )


def _wrist(pos: np.ndarray, mat: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Return the intersection of the axes of joints 5 and 6, from the shoulder, (N, 3), [m].

    The plane of the arm is taken to be vertical.
    """
    approach = mat[:, :, 2]
    flange = pos - _HAND * approach - base - _SHOULDER
    ahead = _unit(flange * [1.0, 1.0, 0.0])
    return flange - _WRIST_OFFSET * _unit(ahead - np.sum(ahead * approach, axis=1)[:, None] * approach)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-9)[:, None]
