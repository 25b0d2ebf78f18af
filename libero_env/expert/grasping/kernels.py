"""The inner loops of the search for holds, compiled: cross-sections of a body between the fingers.

A direction of the fingers is given as (cos, sin) of its yaw. Slabs are ground plans (N, 2), columns points (M, 3).
"""

import numpy as np
from numba import njit

GAP = 0.012  # m between points of a strip that belong to different walls
_LIP = 0.008  # m, of a wall's neighbourhood that counts as the wall
_BIN = 0.006  # m, of a wall's length, for which its face is one point


@njit(cache=True, nogil=True)
def width_in_the_middle(slab: np.ndarray, c: float, s: float, half: float) -> float:
    """Extent along the fingers of the strip, `half` to either side, in the middle of a cross-section; m."""
    v = slab[:, 1] * c - slab[:, 0] * s
    middle = 0.5 * (v.min() + v.max())
    low, high = np.inf, -np.inf
    for i in range(len(slab)):
        if abs(v[i] - middle) < half:
            u = slab[i, 0] * c + slab[i, 1] * s
            low, high = min(low, u), max(high, u)
    return high - low if high >= low else 0.0


@njit(cache=True, nogil=True)
def whole_holds(
    slab: np.ndarray, c: float, s: float, shifts: np.ndarray, half: float, opening: float, spare: float
) -> np.ndarray:
    """Holds around the whole of a cross-section.

    Rows (x, y, width, distance from the middle): along the jaws by each of `shifts`, and within what fingers
    `opening` apart leave free, but `spare`, to either side; (K, 4), m.
    """
    u, v = slab[:, 0] * c + slab[:, 1] * s, slab[:, 1] * c - slab[:, 0] * s
    low, high = v.min(), v.max()
    found = np.empty((3 * len(shifts), 4))
    count = 0
    for shift in shifts:
        middle = 0.5 * (low + high) + shift
        if shift != 0.0 and not low + 0.008 < middle < high - 0.008:
            continue
        first, last, points = np.inf, -np.inf, 0
        for i in range(len(u)):
            if abs(v[i] - middle) < half:
                first, last, points = min(first, u[i]), max(last, u[i]), points + 1
        if points < 2:
            continue
        width = last - first
        side = max(0.5 * (opening - width) - spare, 0.0)
        for aside in (0.0, side, -side):
            along = 0.5 * (first + last) + aside
            found[count] = along * c - middle * s, along * s + middle * c, width, abs(shift) + abs(aside)
            count += 1
    return found[:count]


@njit(cache=True, nogil=True)
def wall_holds(
    slab: np.ndarray, column: np.ndarray, height: float, c: float, s: float, step: float, half: float,
    thickest: float, least: float, steepest: float, opening: float, spare: float, finger: float,
) -> np.ndarray:  # fmt: skip
    """Holds by walls across the fingers with room for both of them; rows (x, y, thickness, badness), (K, 4).

    Args:
        slab: what the pads would touch.
        column: what is beside fingers that reach down to the hold.
        height: of the hold, m.
        c, s: direction of the fingers.
        step: between holds along a wall, m.
        half: width of a finger to either side, m.
        thickest: of a wall, m.
        least: that a wall must reach up over the hold, m.
        steepest: slope of a face against a pad.
        opening: of the fingers, m.
        spare: between an open finger and the wall, m.
        finger: thickness of one, m.
    """
    u, v = slab[:, 0] * c + slab[:, 1] * s, slab[:, 1] * c - slab[:, 0] * s
    order = np.argsort(u, kind="mergesort")
    u, v = u[order], v[order]
    beside_u = column[:, 0] * c + column[:, 1] * s
    beside_v = column[:, 1] * c - column[:, 0] * s
    found = np.empty((64, 4))
    count = 0
    for middle in np.arange(v.min() + 0.01, v.max() - 0.009, step):
        own = np.flatnonzero(np.abs(v - middle) < half)
        if len(own) < 2:
            continue
        here = np.flatnonzero(np.abs(beside_v - middle) < half + 0.003)
        start = 0
        for end in range(1, len(own) + 1):
            if end < len(own) and u[own[end]] - u[own[end - 1]] <= GAP:
                continue
            wall = own[start:end]
            start = end
            first, last = u[wall[0]], u[wall[-1]]
            width = last - first
            if width > thickest or len(wall) < 2:
                continue
            top = -np.inf
            for k in here:
                if first - _LIP < beside_u[k] < last + _LIP:
                    top = max(top, column[k, 2] - height)
            if top < least:
                continue
            slope = -1.0
            side = 0.5 * (opening - width) - spare
            for aside in (0.0, 0.5 * side, -0.5 * side, side, -side):
                center = 0.5 * (first + last) + aside
                if not _room(beside_u, here, center, first - _LIP, last + _LIP, 0.5 * opening + finger):
                    continue
                if slope < 0.0:
                    slope = 0.5 * (_slope(v, u, wall, 1.0) + _slope(v, u, wall, -1.0))
                if slope > steepest:
                    break
                badness = 2.0 * width + 40.0 * max(0.012 - top, 0.0) + 6.0 * max(top - 0.02, 0.0)
                if count == len(found):
                    found = np.concatenate((found, np.empty_like(found)))
                found[count] = (
                    center * c - middle * s,
                    center * s + middle * c,
                    width,
                    badness + 3.0 * abs(aside) + slope,
                )
                count += 1
    return found[:count]


@njit(cache=True, nogil=True)
def _room(u: np.ndarray, here: np.ndarray, center: float, low: float, high: float, reach: float) -> bool:
    """Whether open fingers around `center` meet nothing, and hold between them only what is in [low, high]."""
    for k in here:  # noqa: SIM110 (numba has no generators)
        if abs(u[k] - center) < reach and not low < u[k] < high:
            return False
    return True


@njit(cache=True, nogil=True)
def _slope(v: np.ndarray, u: np.ndarray, wall: np.ndarray, sign: float) -> float:
    """How much the face of a wall at its smallest sign * u leans against a pad, 0 where the pad meets it squarely."""
    first = np.inf
    last = -np.inf
    for i in wall:
        first, last = min(first, np.rint(v[i] / _BIN)), max(last, np.rint(v[i] / _BIN))
    face = np.full(int(last - first) + 1, -1)
    for i in wall:
        k = int(np.rint(v[i] / _BIN) - first)
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


@njit(cache=True, nogil=True)
def depth_in_hand(
    points: np.ndarray, pos: np.ndarray, mat: np.ndarray, tip_below: float, tip: float, widens: float,
    thickest: float, half_opening: float, finger_half: float, palm_above: float, palm_half: float,
    palm_reach: float, length: float,
) -> float:  # fmt: skip
    """How deep points (M, 3) reach into open fingers and the palm of a hand, m; 0 where the way is free.

    Fingers are `tip` thick at their ends, `tip_below` under the grip site, and `widens` more for each m further up.
    """
    deepest = 0.0
    for i in range(len(points)):
        x, y, z = points[i, 0] - pos[0], points[i, 1] - pos[1], points[i, 2] - pos[2]
        up = -(x * mat[0, 2] + y * mat[1, 2] + z * mat[2, 2])
        if not -tip_below < up < length:
            continue
        v = abs(x * mat[0, 1] + y * mat[1, 1] + z * mat[2, 1])
        if v >= palm_half:
            continue
        u = abs(x * mat[0, 0] + y * mat[1, 0] + z * mat[2, 0])
        if v < finger_half:
            thick = min(max(tip + widens * (up + tip_below), tip), thickest)
            deepest = max(deepest, half_opening + thick + 0.002 - u)
        if up > palm_above:
            deepest = max(deepest, palm_reach - u)
    return deepest


@njit(cache=True, nogil=True)
def highest_in_cells(points: np.ndarray, cell: float) -> np.ndarray:
    """The highest of the points (N, 3) in each cell of the ground plan, (M, 3)."""
    x, y = np.rint(points[:, 0] / cell), np.rint(points[:, 1] / cell)
    x, y = x - x.min(), y - y.min()
    rows = int(y.max()) + 1
    best = np.full((int(x.max()) + 1) * rows, -1)
    for i in range(len(points)):
        k = int(x[i]) * rows + int(y[i])
        if best[k] < 0 or points[i, 2] > points[best[k], 2]:
            best[k] = i
    return points[best[best >= 0]]


@njit(cache=True, nogil=True)
def faces_reach_up(
    points: np.ndarray, pos: np.ndarray, c: float, s: float, half: float, high: float, opening: float,
    slant: float, least: float,
) -> bool:  # fmt: skip
    """Whether on both sides what pads at `pos` touch first, within `slant`, reaches higher than `least` over it, m.

    Args:
        points: of a body, (N, 3).
        pos: middle of the pads, (3,).
        c, s: direction of the fingers.
        half, high: of the pads to either side, m.
        opening: of the fingers, m.
        slant: m, that a face may give way over the pads.
        least: m.
    """
    us, zs = np.empty(len(points)), np.empty(len(points))
    count = 0
    for i in range(len(points)):
        z = points[i, 2] - pos[2]
        if abs(z) >= high:
            continue
        x, y = points[i, 0] - pos[0], points[i, 1] - pos[1]
        u = x * c + y * s
        if abs(y * c - x * s) < half and abs(u) < 0.5 * opening:
            us[count], zs[count] = u, z
            count += 1
    if count == 0:
        return False
    us, zs = us[:count], zs[:count]
    first, last = us.min(), us.max()
    low_side, high_side = -np.inf, -np.inf
    for i in range(count):
        if us[i] - first < slant:
            low_side = max(low_side, zs[i])
        if last - us[i] < slant:
            high_side = max(high_side, zs[i])
    return low_side > least and high_side > least
