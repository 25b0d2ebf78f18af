"""Compiled inner loops of the search for grasps: cross-sections of a body between the fingers.

The direction in which the fingers open is given as the cosine `c` and sine `s` of its yaw. Coordinates along it are
called u, those across it v. Sections are ground plans (N, 2), [m].
"""

import numpy as np

from libero_env.parallel import compiled

_WALL_GAP = 0.012  # [m] between points of different walls
_WALL_MARGIN = 0.008  # [m] around a wall that counts as the wall
_FACE_BIN = 0.006  # [m] of a wall's length that is one point of its face


@compiled
def central_width(section: np.ndarray, c: float, s: float, finger_half: float) -> float:
    """Return the width between the fingers in the middle of a cross-section, [m]."""
    v = section[:, 1] * c - section[:, 0] * s
    middle = 0.5 * (v.min() + v.max())
    low, high = np.inf, -np.inf
    for i in range(len(section)):
        if abs(v[i] - middle) < finger_half:
            u = section[i, 0] * c + section[i, 1] * s
            low, high = min(low, u), max(high, u)
    return high - low if high >= low else 0.0


@compiled
def body_grasps(
    section: np.ndarray,
    c: float,
    s: float,
    shifts: np.ndarray,
    finger_half: float,
    opening: float,
    spare: float,
) -> np.ndarray:
    """Return grasps around the whole of a cross-section.

    Args:
        section: Cross-section at the height of the pads, (N, 2).
        c: Cosine of the yaw.
        s: Sine of the yaw.
        shifts: Offsets of the grasp along the pads, (S,), [m].
        finger_half: Half the width of a finger, [m].
        opening: Distance between the open fingers, [m].
        spare: Distance kept between an open finger and the body, [m].

    Returns:
        Rows (x, y, width, distance from the middle), (K, 4), [m]; each shift with the body in the middle between the
        fingers and close to either of them.
    """
    u, v = section[:, 0] * c + section[:, 1] * s, section[:, 1] * c - section[:, 0] * s
    low, high = v.min(), v.max()
    found = np.empty((3 * len(shifts), 4))
    count = 0
    for shift in shifts:
        middle = 0.5 * (low + high) + shift
        if shift != 0.0 and not low + 0.008 < middle < high - 0.008:
            continue
        first, last, points = np.inf, -np.inf, 0
        for i in range(len(u)):
            if abs(v[i] - middle) < finger_half:
                first, last, points = min(first, u[i]), max(last, u[i]), points + 1
        if points < 2:
            continue
        width = last - first
        room = max(0.5 * (opening - width) - spare, 0.0)
        for offset in (0.0, room, -room):
            centre = 0.5 * (first + last) + offset
            found[count] = centre * c - middle * s, centre * s + middle * c, width, abs(shift) + abs(offset)
            count += 1
    return found[:count]


@compiled
def wall_grasps(
    section: np.ndarray,
    column: np.ndarray,
    height: float,
    c: float,
    s: float,
    step: float,
    finger_half: float,
    max_thickness: float,
    min_overlap: float,
    max_slope: float,
    opening: float,
    spare: float,
    finger_thickness: float,
) -> np.ndarray:
    """Return grasps of walls, such as the rim of a bowl, with room for a finger on either side.

    Args:
        section: Cross-section at the height of the pads, (N, 2).
        column: Points that fingers at this height could touch, (M, 3).
        height: Height of the grasp, [m].
        c: Cosine of the yaw.
        s: Sine of the yaw.
        step: Distance between grasps along a wall, [m].
        finger_half: Half the width of a finger, [m].
        max_thickness: Largest thickness of a wall, [m].
        min_overlap: Least height of a wall above the grasp, [m].
        max_slope: Largest slope of a face against a pad.
        opening: Distance between the open fingers, [m].
        spare: Distance kept between an open finger and the wall, [m].
        finger_thickness: Thickness of a finger, [m].

    Returns:
        Rows (x, y, thickness, cost), (K, 4).
    """
    u, v = section[:, 0] * c + section[:, 1] * s, section[:, 1] * c - section[:, 0] * s
    order = np.argsort(u, kind="mergesort")
    u, v = u[order], v[order]
    column_u = column[:, 0] * c + column[:, 1] * s
    column_v = column[:, 1] * c - column[:, 0] * s
    found = np.empty((64, 4))
    count = 0
    for middle in np.arange(v.min() + 0.01, v.max() - 0.009, step):
        strip = np.flatnonzero(np.abs(v - middle) < finger_half)
        if len(strip) < 2:
            continue
        beside = np.flatnonzero(np.abs(column_v - middle) < finger_half + 0.003)
        for start, end in _split_walls(u, strip):
            wall = strip[start:end]
            first, last = u[wall[0]], u[wall[-1]]
            width = last - first
            if width > max_thickness or len(wall) < 2:
                continue
            low, high = first - _WALL_MARGIN, last + _WALL_MARGIN
            overlap = _wall_top(column, column_u, beside, low, high) - height
            if overlap < min_overlap:
                continue
            slope = -1.0
            room = 0.5 * (opening - width) - spare
            for offset in (0.0, 0.5 * room, -0.5 * room, room, -room):
                centre = 0.5 * (first + last) + offset
                if not _has_room(column_u, beside, centre, low, high, 0.5 * opening + finger_thickness):
                    continue
                if slope < 0.0:
                    slope = 0.5 * (_face_slope(v, u, wall, 1.0) + _face_slope(v, u, wall, -1.0))
                if slope > max_slope:
                    break
                cost = 2.0 * width + 40.0 * max(0.012 - overlap, 0.0) + 6.0 * max(overlap - 0.02, 0.0)
                if count == len(found):
                    found = np.concatenate((found, np.empty_like(found)))
                x, y = centre * c - middle * s, centre * s + middle * c
                found[count] = x, y, width, cost + 3.0 * abs(offset) + slope
                count += 1
    return found[:count]


@compiled
def _split_walls(u: np.ndarray, strip: np.ndarray) -> list[tuple[int, int]]:
    """Return (start, end) of the parts of a sorted strip that are separated by gaps."""
    parts, start = [], 0
    for end in range(1, len(strip) + 1):
        if end == len(strip) or u[strip[end]] - u[strip[end - 1]] > _WALL_GAP:
            parts.append((start, end))
            start = end
    return parts


@compiled
def _wall_top(column: np.ndarray, u: np.ndarray, beside: np.ndarray, low: float, high: float) -> float:
    """Return the height of the highest point of a column with u in (low, high), [m]."""
    top = -np.inf
    for k in beside:
        if low < u[k] < high:
            top = max(top, column[k, 2])
    return top


@compiled
def _has_room(
    u: np.ndarray, beside: np.ndarray, centre: float, low: float, high: float, reach: float
) -> bool:
    """Return whether all points within reach of open fingers around `centre` are in [low, high]."""
    for k in beside:  # noqa: SIM110 (numba has no generators)
        if abs(u[k] - centre) < reach and not low < u[k] < high:
            return False
    return True


@compiled
def _face_slope(v: np.ndarray, u: np.ndarray, wall: np.ndarray, sign: float) -> float:
    """Return the slope, against a pad, of the face of a wall at its smallest sign * u; 0 where they are parallel."""
    first = np.inf
    last = -np.inf
    for i in wall:
        first, last = min(first, np.rint(v[i] / _FACE_BIN)), max(last, np.rint(v[i] / _FACE_BIN))
    face = np.full(int(last - first) + 1, -1)
    for i in wall:
        k = int(np.rint(v[i] / _FACE_BIN) - first)
        if face[k] < 0 or sign * u[i] < sign * u[face[k]]:
            face[k] = i
    face = face[face >= 0]
    if len(face) < 2:
        return 0.0
    along, out = v[face], sign * u[face]
    if along.max() - along.min() < 0.008:
        return 0.0
    along, out = along - along.mean(), out - out.mean()
    return abs((along * out).sum()) / (along * along).sum()


@compiled
def highest_per_cell(points: np.ndarray, cell: float) -> np.ndarray:
    """Return the highest of the points (N, 3) in each cell of the ground plan, (M, 3)."""
    x, y = np.rint(points[:, 0] / cell), np.rint(points[:, 1] / cell)
    x, y = x - x.min(), y - y.min()
    rows = int(y.max()) + 1
    best = np.full((int(x.max()) + 1) * rows, -1)
    for i in range(len(points)):
        k = int(x[i]) * rows + int(y[i])
        if best[k] < 0 or points[i, 2] > points[best[k], 2]:
            best[k] = i
    return points[best[best >= 0]]


@compiled
def pads_meet_upright_faces(
    points: np.ndarray,
    pos: np.ndarray,
    c: float,
    s: float,
    finger_half: float,
    pad_half_height: float,
    opening: float,
    tolerance: float,
    min_height: float,
) -> bool:
    """Return whether both pads meet a face that stands along the approach, and not a slanted one.

    Args:
        points: Points on a body, (N, 3), [m].
        pos: Middle of the pads, (3,).
        c: Cosine of the yaw.
        s: Sine of the yaw.
        finger_half: Half the width of a finger, [m].
        pad_half_height: Height above and below the middle that is looked at, [m].
        opening: Distance between the open fingers, [m].
        tolerance: Distance from the first contact that still counts as the face, [m].
        min_height: Least height of the face above the middle, [m].
    """
    us, zs = np.empty(len(points)), np.empty(len(points))
    count = 0
    for i in range(len(points)):
        z = points[i, 2] - pos[2]
        if abs(z) >= pad_half_height:
            continue
        x, y = points[i, 0] - pos[0], points[i, 1] - pos[1]
        u = x * c + y * s
        if abs(y * c - x * s) < finger_half and abs(u) < 0.5 * opening:
            us[count], zs[count] = u, z
            count += 1
    if count == 0:
        return False
    us, zs = us[:count], zs[:count]
    first, last = us.min(), us.max()
    low_side, high_side = -np.inf, -np.inf
    for i in range(count):
        if us[i] - first < tolerance:
            low_side = max(low_side, zs[i])
        if last - us[i] < tolerance:
            high_side = max(high_side, zs[i])
    return low_side > min_height and high_side > min_height
