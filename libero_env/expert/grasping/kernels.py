"""Compiled inner loops of the search for grasps: cross-sections between the fingers, and collisions of the hand.

The dimensions are the gripper's; numba compiles constants of the module in. The direction in which the fingers open is
given as the cosine `c` and sine `s` of its yaw. Coordinates along it are called u, those across it v. Sections are
ground plans (N, 2), [m].
"""

import numpy as np

from libero_env.compilation import compiled
from libero_env.expert.arm import GRIPPER

_FINGER_HALF, _OPENING, _HALF_OPENING = GRIPPER.finger_half_width, GRIPPER.max_opening, GRIPPER.half_opening
_TIP_BELOW, _TIP_THICKNESS, _TAPER = GRIPPER.tip_below, GRIPPER.tip_thickness, GRIPPER.finger_taper
_FINGER_THICKNESS, _HAND_LENGTH = GRIPPER.finger_thickness, GRIPPER.hand_length
_PALM_ABOVE, _PALM_HALF_WIDTH = GRIPPER.palm_above - 0.01, GRIPPER.palm_half_width
_PALM_HALF_LENGTH = GRIPPER.palm_half_length
_OPEN_FINGER_HALF = GRIPPER.finger_half_width + 0.005  # [m] half the width of an open finger, with room
_HAND_MARGIN = 0.002  # [m] around the hand
_PAD_HALF_HEIGHT, _MIN_FACE_HEIGHT = GRIPPER.pad_above, 0.6 * GRIPPER.pad_above
_FACE_TOLERANCE = 0.0025  # [m] by which a face may recede over the height of the pads
_SHIFTS = np.array([0.0, 0.01, -0.01, 0.02, -0.02, 0.03, -0.03, 0.045, -0.045])  # [m] along the pads
_SPARE = 0.006  # [m] between an open finger and the body where the hand is off-centre
_WALL_STEP = 0.012  # [m] between grasps along a wall
_MIN_WALL_OVERLAP = 0.005  # [m] of a wall between the pads
_MAX_WALL_SLOPE = 0.4  # of the faces of a wall against the pads
_MAX_WALL_THICKNESS = 0.045  # [m]
_WALL_FINGER_THICKNESS = 0.021  # [m] of a finger, averaged over the height beside a wall
_CELL = 0.004  # [m] of the ground plan, of which only the highest point matters
_WALL_GAP = 0.012  # [m] between points of different walls
_WALL_MARGIN = 0.008  # [m] around a wall that counts as the wall
_FACE_BIN = 0.006  # [m] of a wall's length that is one point of its face


@compiled
def _extent(values: np.ndarray) -> tuple[float, float]:
    """Return the least and the largest of values (N,), N > 0."""
    low, high = values[0], values[0]
    for value in values:
        low, high = min(low, value), max(high, value)
    return low, high


@compiled
def central_width(section: np.ndarray, c: float, s: float) -> float:
    """Return the width between the fingers in the middle of a cross-section, [m]."""
    v = section[:, 1] * c - section[:, 0] * s
    first, last = _extent(v)
    middle = 0.5 * (first + last)
    low, high = np.inf, -np.inf
    for i in range(len(section)):
        if abs(v[i] - middle) < _FINGER_HALF:
            u = section[i, 0] * c + section[i, 1] * s
            low, high = min(low, u), max(high, u)
    return high - low if high >= low else 0.0


@compiled
def body_grasps(section: np.ndarray, c: float, s: float) -> np.ndarray:
    """Return grasps around the whole of a cross-section.

    Args:
        section: Cross-section at the height of the pads, (N, 2).
        c: Cosine of the yaw.
        s: Sine of the yaw.

    Returns:
        Rows (x, y, width, distance from the middle), (K, 4), [m]; each shift with the body in the middle between the
        fingers and close to either of them.
    """
    u, v = section[:, 0] * c + section[:, 1] * s, section[:, 1] * c - section[:, 0] * s
    low, high = _extent(v)
    rows = np.empty((3 * len(_SHIFTS), 4))
    count = 0
    for shift in _SHIFTS:
        middle = 0.5 * (low + high) + shift
        if shift != 0.0 and not low + 0.008 < middle < high - 0.008:
            continue
        first, last, points = np.inf, -np.inf, 0
        for i in range(len(u)):
            if abs(v[i] - middle) < _FINGER_HALF:
                first, last, points = min(first, u[i]), max(last, u[i]), points + 1
        if points < 2:
            continue
        width = last - first
        room = max(0.5 * (_OPENING - width) - _SPARE, 0.0)
        for offset in (0.0, room, -room):
            centre = 0.5 * (first + last) + offset
            rows[count, 0], rows[count, 1] = centre * c - middle * s, centre * s + middle * c
            rows[count, 2], rows[count, 3] = width, abs(shift) + abs(offset)
            count += 1
    return rows[:count]


def wall_grasps(section: np.ndarray, column: np.ndarray, height: float, c: float, s: float) -> np.ndarray:
    """Return grasps of walls, such as the rim of a bowl, with room for a finger on either side.

    Args:
        section: Cross-section at the height of the pads, (N, 2).
        column: Points that fingers at this height could touch, (M, 3).
        height: Height of the grasp, [m].
        c: Cosine of the yaw.
        s: Sine of the yaw.

    Returns:
        Rows (x, y, thickness, cost), (K, 4).
    """
    u, v = section[:, 0] * c + section[:, 1] * s, section[:, 1] * c - section[:, 0] * s
    order = np.argsort(u, kind="stable")  # NumPy's: numba's takes a second to compile
    return _wall_grasps(u[order], v[order], column, height, c, s)


@compiled
def _wall_grasps(
    u: np.ndarray, v: np.ndarray, column: np.ndarray, height: float, c: float, s: float
) -> np.ndarray:
    """Return grasps of walls; see `wall_grasps`.

    Args:
        u: Coordinates of the section between the fingers, ascending, (N,).
        v: Coordinates across, (N,).
    """
    column_u = column[:, 0] * c + column[:, 1] * s
    column_v = column[:, 1] * c - column[:, 0] * s
    rows = np.empty((64, 4))
    count = 0
    left, right = _extent(v)
    for middle in np.arange(left + 0.01, right - 0.009, _WALL_STEP):
        strip = np.flatnonzero(np.abs(v - middle) < _FINGER_HALF)
        if len(strip) < 2:
            continue
        beside = np.flatnonzero(np.abs(column_v - middle) < _FINGER_HALF + 0.003)
        for start, end in _split_walls(u, strip):
            wall = strip[start:end]
            first, last = u[wall[0]], u[wall[-1]]
            width = last - first
            if width > _MAX_WALL_THICKNESS or len(wall) < 2:
                continue
            low, high = first - _WALL_MARGIN, last + _WALL_MARGIN
            overlap = _wall_top(column, column_u, beside, low, high) - height
            if overlap < _MIN_WALL_OVERLAP:
                continue
            slope = -1.0
            room = 0.5 * (_OPENING - width) - _SPARE
            for offset in (0.0, 0.5 * room, -0.5 * room, room, -room):
                centre = 0.5 * (first + last) + offset
                if not _has_room(
                    column_u, beside, centre, low, high, 0.5 * _OPENING + _WALL_FINGER_THICKNESS
                ):
                    continue
                if slope < 0.0:
                    slope = 0.5 * (_face_slope(v, u, wall, 1.0) + _face_slope(v, u, wall, -1.0))
                if slope > _MAX_WALL_SLOPE:
                    break
                cost = 2.0 * width + 40.0 * max(0.012 - overlap, 0.0) + 6.0 * max(overlap - 0.02, 0.0)
                if count == len(rows):
                    rows = np.concatenate((rows, np.empty_like(rows)))
                rows[count, 0], rows[count, 1] = centre * c - middle * s, centre * s + middle * c
                rows[count, 2], rows[count, 3] = width, cost + 3.0 * abs(offset) + slope
                count += 1
    return rows[:count]


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
    low, high = _extent(along)
    if high - low < 0.008:
        return 0.0
    along, out = along - along.mean(), out - out.mean()
    return abs((along * out).sum()) / (along * along).sum()


@compiled
def highest_per_cell(points: np.ndarray) -> np.ndarray:
    """Return the highest of the points (N, 3) in each cell of the ground plan, (M, 3)."""
    x, y = np.rint(points[:, 0] / _CELL), np.rint(points[:, 1] / _CELL)
    (left, right), (near, far) = _extent(x), _extent(y)
    x, y = x - left, y - near
    rows = int(far - near) + 1
    best = np.full((int(right - left) + 1) * rows, -1)
    for i in range(len(points)):
        k = int(x[i]) * rows + int(y[i])
        if best[k] < 0 or points[i, 2] > points[best[k], 2]:
            best[k] = i
    return points[best[best >= 0]]


@compiled
def pads_meet_upright_faces(points: np.ndarray, pos: np.ndarray, c: float, s: float) -> bool:
    """Return whether both pads meet a face that stands along the approach, and not a slanted one.

    Args:
        points: Points on a body, (N, 3), [m].
        pos: Middle of the pads, (3,).
        c: Cosine of the yaw.
        s: Sine of the yaw.
    """
    us, zs = np.empty(len(points)), np.empty(len(points))
    count = 0
    for i in range(len(points)):
        z = points[i, 2] - pos[2]
        if abs(z) >= _PAD_HALF_HEIGHT:
            continue
        x, y = points[i, 0] - pos[0], points[i, 1] - pos[1]
        u = x * c + y * s
        if abs(y * c - x * s) < _FINGER_HALF and abs(u) < 0.5 * _OPENING:
            us[count], zs[count] = u, z
            count += 1
    if count == 0:
        return False
    us, zs = us[:count], zs[:count]
    first, last = _extent(us)
    low_side, high_side = -np.inf, -np.inf
    for i in range(count):
        if us[i] - first < _FACE_TOLERANCE:
            low_side = max(low_side, zs[i])
        if last - us[i] < _FACE_TOLERANCE:
            high_side = max(high_side, zs[i])
    return low_side > _MIN_FACE_HEIGHT and high_side > _MIN_FACE_HEIGHT


@compiled
def open_hand_collision_depth(points: np.ndarray, pos: np.ndarray, mat: np.ndarray) -> float:
    """Return how deep points reach into the sides of open fingers and of the palm, [m]; 0 without a collision.

    Args:
        points: Points on obstacles, (M, 3).
        pos: Position of the grip site, (3,).
        mat: Orientation of the grip site, (3, 3).
    """
    deepest = 0.0
    for i in range(len(points)):
        x, y, z = points[i, 0] - pos[0], points[i, 1] - pos[1], points[i, 2] - pos[2]
        up = -(x * mat[0, 2] + y * mat[1, 2] + z * mat[2, 2])
        if not -_TIP_BELOW < up < _HAND_LENGTH:
            continue
        v = abs(x * mat[0, 1] + y * mat[1, 1] + z * mat[2, 1])
        if v >= _PALM_HALF_WIDTH:
            continue
        u = abs(x * mat[0, 0] + y * mat[1, 0] + z * mat[2, 0])
        if v < _OPEN_FINGER_HALF:
            thickness = min(
                max(_TIP_THICKNESS + _TAPER * (up + _TIP_BELOW), _TIP_THICKNESS), _FINGER_THICKNESS
            )
            deepest = max(deepest, _HALF_OPENING + thickness + _HAND_MARGIN - u)
        if up > _PALM_ABOVE:
            deepest = max(deepest, _PALM_HALF_LENGTH - u)
    return deepest


@compiled
def hand_collision_depth(
    points: np.ndarray, pos: np.ndarray, mat: np.ndarray, inner: float, outer: float
) -> float:
    """Return how deep points reach into a hand, measured to its nearest surface, [m]; 0 without a collision.

    Args:
        points: Points on obstacles, (N, 3).
        pos: Position of the grip site, (3,).
        mat: Orientation of the grip site, (3, 3).
        inner: Distance from the middle where the volume of each finger begins, [m].
        outer: Distance from the middle where each finger's thickness begins, [m].
    """
    deepest = 0.0
    for i in range(len(points)):
        a, b, c = points[i, 0] - pos[0], points[i, 1] - pos[1], points[i, 2] - pos[2]
        z = a * mat[0, 2] + b * mat[1, 2] + c * mat[2, 2]
        if z > _TIP_BELOW + _HAND_MARGIN or z < -0.3:
            continue
        x = abs(a * mat[0, 0] + b * mat[1, 0] + c * mat[2, 0])
        y = abs(a * mat[0, 1] + b * mat[1, 1] + c * mat[2, 1])
        if z > -0.04:  # fingers
            side = outer + _TIP_THICKNESS + _TAPER * (_TIP_BELOW - z) + _HAND_MARGIN
            depth = min(
                side - x,
                x - inner + _HAND_MARGIN,
                _FINGER_HALF + _HAND_MARGIN - y,
                _TIP_BELOW + _HAND_MARGIN - z,
            )
            deepest = max(deepest, depth)
        if z > -0.13:  # the palm, which is thinner in front
            half = min(max(0.0175 - 0.22 * (z + 0.031), 0.0), 0.032) + _HAND_MARGIN
            deepest = max(
                deepest, min(0.104 + _HAND_MARGIN - x, half - y, -0.031 + _HAND_MARGIN - z, z + 0.13)
            )
        deepest = max(deepest, min(0.06 - x, 0.06 - y, -0.12 - z, z + 0.3))  # the wrist
    return deepest
