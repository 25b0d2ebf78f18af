"""Compiled inner loops of collision checks: how deep points reach into the hand."""

import numpy as np

from libero_env.parallel import compiled

_HAND_MARGIN = 0.002  # [m] around the hand


@compiled
def open_hand_collision_depth(
    points: np.ndarray,
    pos: np.ndarray,
    mat: np.ndarray,
    tip_below: float,
    tip_thickness: float,
    taper: float,
    max_thickness: float,
    half_opening: float,
    finger_half: float,
    palm_above: float,
    palm_half_width: float,
    palm_half_length: float,
    length: float,
) -> float:
    """Return how deep points reach into the sides of open fingers and of the palm, [m]; 0 without a collision.

    Args:
        points: Points on obstacles, (M, 3).
        pos: Position of the grip site, (3,).
        mat: Orientation of the grip site, (3, 3).
        tip_below: Reach of the fingertips below the grip site, [m].
        tip_thickness: Thickness of a finger at its tip, [m].
        taper: Thickness that a finger gains for each metre above its tip.
        max_thickness: Largest thickness of a finger, [m].
        half_opening: Distance of an open finger from the middle, [m].
        finger_half: Half the width of a finger, [m].
        palm_above: Height of the palm above the grip site, [m].
        palm_half_width: Half the extent of the palm across the fingers' motion, [m].
        palm_half_length: Half the extent of the palm along the fingers' motion, [m].
        length: Extent of hand and wrist above the grip site, [m].
    """
    deepest = 0.0
    for i in range(len(points)):
        x, y, z = points[i, 0] - pos[0], points[i, 1] - pos[1], points[i, 2] - pos[2]
        up = -(x * mat[0, 2] + y * mat[1, 2] + z * mat[2, 2])
        if not -tip_below < up < length:
            continue
        v = abs(x * mat[0, 1] + y * mat[1, 1] + z * mat[2, 1])
        if v >= palm_half_width:
            continue
        u = abs(x * mat[0, 0] + y * mat[1, 0] + z * mat[2, 0])
        if v < finger_half:
            thickness = min(max(tip_thickness + taper * (up + tip_below), tip_thickness), max_thickness)
            deepest = max(deepest, half_opening + thickness + _HAND_MARGIN - u)
        if up > palm_above:
            deepest = max(deepest, palm_half_length - u)
    return deepest


@compiled
def hand_collision_depth(
    points: np.ndarray,
    pos: np.ndarray,
    mat: np.ndarray,
    inner: float,
    outer: float,
    tip_below: float,
    tip_thickness: float,
    taper: float,
    finger_half: float,
) -> float:
    """Return how deep points reach into a hand, measured to its nearest surface, [m]; 0 without a collision.

    Args:
        points: Points on obstacles, (N, 3).
        pos: Position of the grip site, (3,).
        mat: Orientation of the grip site, (3, 3).
        inner: Distance from the middle where the volume of each finger begins, [m].
        outer: Distance from the middle where each finger's thickness begins, [m].
        tip_below: Reach of the fingertips below the grip site, [m].
        tip_thickness: Thickness of a finger at its tip, [m].
        taper: Thickness that a finger gains for each metre above its tip.
        finger_half: Half the width of a finger, [m].
    """
    deepest = 0.0
    for i in range(len(points)):
        a, b, c = points[i, 0] - pos[0], points[i, 1] - pos[1], points[i, 2] - pos[2]
        z = a * mat[0, 2] + b * mat[1, 2] + c * mat[2, 2]
        if z > tip_below + _HAND_MARGIN or z < -0.3:
            continue
        x = abs(a * mat[0, 0] + b * mat[1, 0] + c * mat[2, 0])
        y = abs(a * mat[0, 1] + b * mat[1, 1] + c * mat[2, 1])
        if z > -0.04:  # fingers
            side = outer + tip_thickness + taper * (tip_below - z) + _HAND_MARGIN
            depth = min(
                side - x,
                x - inner + _HAND_MARGIN,
                finger_half + _HAND_MARGIN - y,
                tip_below + _HAND_MARGIN - z,
            )
            deepest = max(deepest, depth)
        if z > -0.13:  # the palm, which is thinner in front
            half = min(max(0.0175 - 0.22 * (z + 0.031), 0.0), 0.032) + _HAND_MARGIN
            deepest = max(
                deepest, min(0.104 + _HAND_MARGIN - x, half - y, -0.031 + _HAND_MARGIN - z, z + 0.13)
            )
        deepest = max(deepest, min(0.06 - x, 0.06 - y, -0.12 - z, z + 0.3))  # the wrist
    return deepest
