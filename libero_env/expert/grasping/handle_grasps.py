"""Where the hand takes hold of a handle or a knob, and where it pushes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numba import njit

from libero_env.expert.arm.gripper import FINGER_HALF_WIDTH, TIP_BELOW
from libero_env.expert.arm.posture import posture_cost, reach_violation, wrist_twist
from libero_env.expert.arm.servo import downward, finger_axis
from libero_env.expert.grasping.grasps import GraspError, choose_grasp
from libero_env.expert.grasping.handles import UP, Handle, Part, surroundings, turned
from libero_env.geometry import Pose
from libero_env.sim.state import StateView

TAKES = 0.06  # m, widest handle that is taken between the fingers
OPEN_HALF = 0.04  # m, of an open finger from the middle
TIP = 0.0145  # m, thickness of a finger at its tip
_WIDENS = 0.41  # m of thickness for each m further up
_TILTS = np.radians([90, 75, 65, 55, 45, 35, 25])  # of the approach below the horizontal
_STEEP = np.radians(60)  # from there on closed fingers need not turn with the door that they push
_ROLLS = (0.0, 0.8, -0.8)  # rad, of the fingers from across a level bar
_SHORT = 0.022  # m, half a bar that is so short that it is taken by its ends too
_FOLLOWS = (1.0, 0.5, 0.0)  # shares of a door's turn that a pushing hand makes too
_ASIDE = np.array(
    [0.0, 0.012, -0.012, 0.02, -0.02, 0.026, -0.026]
)  # m, of the open hand from the middle of the bar
_FORTH = (0.0, -0.005, -0.0075)  # m, of the grip site beyond the middle of the bar
_SIDEWAYS = (0.35, -0.35)  # rad, of the hand at a bar that stands
_CLEAR = 0.10  # m, that a hand withdraws
_SPARE = 0.002  # m, around the hand
_TWISTED = 0.5 * np.pi + 0.4  # rad, of wrist_twist that is too much
_LEANS = (0.0, 0.2, -0.2, 0.35, -0.35, 0.5, -0.5)  # rad, of the hand over a knob


@dataclass(frozen=True)
class Hold:
    """Poses of the grip site to take hold, or to begin to push."""

    ready: Pose  # fingers around the handle and not yet closed, or just in front of it
    held: Pose
    back: np.ndarray  # (3,) unit, where the hand comes from and withdraws to
    grips: bool
    follow: float = 1.0  # share of the part's turn that the hand makes too

    def within(self, frame: Pose) -> "Hold":
        """The same in a frame, such as the part's, instead of the world."""
        ready, held = (
            Pose(frame.invert(pose.pos), frame.mat.T @ pose.mat) for pose in (self.ready, self.held)
        )
        return Hold(ready, held, frame.mat.T @ self.back, self.grips, self.follow)


def knob_hold(view: StateView, part: Part, delta: float) -> Hold:
    """How to take a knob from above in order to turn it by `delta`, rad.

    The hand leans along the knob where the wrist would be bent back, close to the arm's base.

    Raises:
        GraspError: it is too thick for the fingers.
    """
    cloud = part.cloud(view, 0.004)
    high = cloud[cloud[:, 2] > cloud[:, 2].max() - 0.03]
    around = surroundings(view, part.body, cloud.mean(axis=0), view.scene.entities)
    grasp = choose_grasp(high, around, cloud[:, 2].min(), finger_axis(view.eef_mat), "knob")
    fingers = np.array([np.cos(grasp.yaw), np.sin(grasp.yaw), 0.0])
    ways = [
        (lean, turned(fingers, lean) @ downward(grasp.yaw, sign * fingers))
        for lean, sign in product(_LEANS, (1.0, -1.0))
    ]
    mat = np.stack([mat for _, mat in ways])
    pos, end = (
        np.tile(grasp.pos_world, (len(ways), 1)),
        part.moved_all(view, grasp.pos_world[None], mat, delta),
    )
    base = np.array(view.scene.workspace.robot_base_pos)
    cost = posture_cost(pos, mat, base) + posture_cost(np.tile(end[0], (len(ways), 1)), end[1], base)
    for k, (lean, _) in enumerate(ways):
        depths = [crowding(around, Pose(p[k % len(p)], m[k]), 0.0, OPEN_HALF) for p, m in ((pos, mat), end)]
        cost[k] += 0.3 * abs(lean) + _blocked(max(depths))
    best = Pose(grasp.pos_world, mat[int(np.argmin(cost))])
    return Hold(best, best, UP, True)


def handle_hold(
    view: StateView, part: Part, handle: Handle, delta: float, grips: bool, failed: Sequence[Pose] = ()
) -> Hold:
    """How to take a handle, or to push against it, in order to move the joint by `delta`, m or rad.

    Of all approaches it is the one that keeps the hand out of everything, with little turning of the hand.

    Args:
        view: the state.
        part: what moves.
        handle: of the part.
        delta: of the joint, m or rad.
        grips: take the handle between the fingers, or push it with closed ones.
        failed: grip site's poses that did not work before.

    Raises:
        GraspError: the handle is thicker than the fingers take.
    """
    base = np.array(view.scene.workspace.robot_base_pos)
    ways = _candidates(handle, grips, not part.slides, base)
    if not len(ways.cost):
        raise GraspError(f"no way to take the handle: it is more than {100 * TAKES:.0f} cm thick")
    moved = [part.moved_all(view, ways.held, ways.mat, share * delta, ways.follow) for share in (0.5, 1.0)]
    cost = ways.cost + posture_cost(ways.ready, ways.mat, base) + posture_cost(*moved[1], base)
    end, mat = moved[1]
    cost += 20.0 * reach_violation(end - _CLEAR * mat[:, :, 2], mat, base)  # it withdraws from there
    turn = 0.5 * (np.einsum("ij,nij->n", view.eef_mat, ways.mat) - 1.0)
    cost += 0.1 * np.arccos(np.clip(turn, -1.0, 1.0))
    for pose in failed:
        cost += 0.5 * ways.like(pose)
    check = _Check(view, part, handle, grips)
    best, least = -1, np.inf
    for k in np.argsort(cost, kind="stable"):
        if cost[k] >= least:
            break
        poses = [(pos[k], mat[k]) for pos, mat in moved]
        price = check.price(ways.hold(k, grips), poses, delta, least - cost[k])
        if cost[k] + price < least:
            best, least = int(k), cost[k] + price
    return ways.hold(best, grips)


@dataclass(frozen=True)
class _Ways:
    """Candidates, one a row."""

    cost: np.ndarray  # (N,)
    ready: np.ndarray  # (N, 3)
    held: np.ndarray  # (N, 3)
    mat: np.ndarray  # (N, 3, 3)
    back: np.ndarray  # (N, 3)
    follow: np.ndarray  # (N,)

    def hold(self, k: int, grips: bool) -> Hold:
        ready, held = Pose(self.ready[k], self.mat[k]), Pose(self.held[k], self.mat[k])
        return Hold(ready, held, self.back[k], grips, float(self.follow[k]))

    def like(self, pose: Pose) -> np.ndarray:
        """Which are nearly the same as a pose, (N,) bool."""
        near = np.linalg.norm(self.ready - pose.pos, axis=1) < 0.012
        return near & (np.einsum("ij,nij->n", pose.mat, self.mat) > 2.9)


class _Check:
    """What holds cost because of what the hand would be in."""

    def __init__(self, view: StateView, part: Part, handle: Handle, grips: bool):
        self._floor, self._grips = view.scene.workspace.surface_height, grips
        self._fixed = surroundings(view, part.body, handle.pos, view.scene.fixtures)
        loose = surroundings(view, part.body, handle.pos, view.scene.objects)
        self._others = np.concatenate([self._fixed, loose])
        self._own = part.cloud(view, 0.012)
        self._part, self._view, self._out = part, view, handle.out

    def price(
        self, hold: Hold, moved: list[tuple[np.ndarray, np.ndarray]], delta: float, enough: float
    ) -> float:
        """Cost of how deep the hand is in something at the hold, before it and on its way; `enough` or more early."""
        half = OPEN_HALF if self._grips else 0.0
        ends = [Pose(pos, mat) for pos, mat in moved]
        depth = max(under(self._floor, pose, self._grips) for pose in (hold.ready, *ends))
        backs = [Pose(hold.ready.pos + back * hold.back, hold.ready.mat) for back in (0.0, 0.03, 0.07)]
        checks = [(pts, p, i, half) for p in backs for pts, i in ((self._own, half), (self._others, 0.0))]
        checks += [(self._fixed, pose, 0.0, 0.0) for pose in ends]
        if hold.follow < 1.0:  # the door turns under the hand
            lag, out = (hold.follow - 1.0) * delta, Pose(hold.held.pos + 0.01 * self._out, hold.held.mat)
            askew = [self._part.moved(self._view, out, 0.0, turn=share * lag) for share in (0.5, 1.0)]
            checks += [(self._own, pose, 0.0, 0.0) for pose in askew]
        for points, pose, inner, outer in checks:
            if _blocked(depth) >= enough:
                break
            depth = max(depth, crowding(points, pose, inner, outer))
        return _blocked(depth)


def _blocked(depth: float) -> float:
    """Cost of a hand that is so deep in something, m."""
    return 150.0 * depth + 0.8 * (depth > 0.001)


def _candidates(handle: Handle, grips: bool, swings: bool, base: np.ndarray) -> _Ways:
    """All approaches, what is around not yet considered."""
    rows: list[tuple] = []
    for mat, steep, extra in _orientations(handle, grips):
        if wrist_twist(handle.pos[None], mat[None], base)[0] > _TWISTED:
            continue
        if grips:
            found = _grips(handle, mat)
        else:
            found = _pushes(handle, mat, _FOLLOWS if swings and steep else (1.0,))
        rows += [(cost + extra, ready, held, mat, back, follow) for cost, ready, held, back, follow in found]
    columns = [np.array(column) for column in zip(*rows, strict=True)] or [np.zeros(0)] * 6
    return _Ways(*columns)


def _orientations(handle: Handle, grips: bool) -> Iterator[tuple[np.ndarray, bool, float]]:
    """(orientation of the hand (3, 3), whether it is steep, cost)."""
    upright = abs(handle.along[2]) > 0.7
    rolls = (0.0,) if upright else _ROLLS
    if grips and not upright and handle.half < _SHORT:
        rolls = (*rolls, 0.5 * np.pi)
    for tilt, roll, sign in product(_TILTS, rolls, (1.0, -1.0)):
        approach = -np.cos(tilt) * handle.out - np.sin(tilt) * UP
        fingers = np.cross(handle.along, -handle.out if upright else approach)
        fingers = sign * (np.cos(roll) * fingers + np.sin(roll) * handle.along)
        mat = np.column_stack([fingers, np.cross(approach, fingers), approach])
        yield mat, tilt > _STEEP, 0.3 * abs(roll)
        if upright and grips:  # across a bar that stands the hand may lean sideways
            for lean in _SIDEWAYS:
                yield turned(handle.out, lean) @ mat, tilt > _STEEP, 0.3 * abs(lean)


def _grips(handle: Handle, mat: np.ndarray) -> Iterator[tuple]:
    """(cost, ready, held, back, follow) of ways to have the bar between the fingers."""
    fingers, across, approach = mat.T
    upright = abs(handle.along[2]) > 0.7
    ends = abs(fingers @ handle.along) > 0.9  # it is taken by its ends
    reach = 0.0 if ends else max(handle.half - 0.012, 0.0)
    shifts = (reach, 0.5 * reach, 0.0, -0.5 * reach) if upright else (0.0, 0.3 * reach, -0.3 * reach)
    for shift in dict.fromkeys(shifts):
        pos = handle.pos + shift * handle.along
        strip = handle.points[np.abs((handle.points - pos) @ across) < 0.01] @ fingers
        width = float(np.ptp(strip)) if len(strip) else 1.0
        if width > TAKES:
            continue
        asides = _ASIDE[np.abs(_ASIDE) + 0.5 * width + 0.003 < OPEN_HALF]
        for aside, forth, (extra, back) in product(asides, _FORTH, ((0.0, -approach), (0.02, handle.out))):
            held = pos + forth * approach
            cost = 0.5 * abs(shift) + 2.0 * abs(aside) + 4.0 * abs(forth) + extra
            yield cost, held + aside * fingers, held, back, 1.0


def _pushes(handle: Handle, mat: np.ndarray, follows: Sequence[float]) -> Iterator[tuple]:
    """(cost, ready, held, back, follow) of closed fingers against the bar, or against the front beside it."""
    fingers, across, approach = mat.T
    offset = handle.part - handle.pos
    beside = np.cross(handle.along, handle.out)
    tip = np.array(
        [
            s * TIP * fingers + t * FINGER_HALF_WIDTH * across + TIP_BELOW * approach
            for s in (1, -1)
            for t in (1, -1)
        ]
    )
    forward = float((-tip @ handle.out).max())
    upright = abs(handle.along[2]) > 0.7
    tilt = np.arcsin(np.clip(-approach[2], -1, 1))
    sides = _spread(offset @ beside, 5) if upright else [0.0]
    for shift, side in product(_spread(offset @ handle.along, 7), sides):
        near = (np.abs(offset @ handle.along - shift) < 0.012) & (np.abs(offset @ beside - side) < 0.012)
        if not near.any():
            continue
        front = float((offset[near] @ handle.out).max())
        pos = handle.pos + shift * handle.along + side * beside + (front + forward + 0.004) * handle.out
        cost = 0.5 * (abs(shift) + abs(side)) + 0.2 * abs(tilt - np.radians(65))
        for follow in follows:
            yield cost + 0.02 * (1.0 - follow), pos, pos, -approach, follow


def _spread(values: np.ndarray, number: int) -> list[float]:
    """0 and values between the ends of a range, m."""
    return [0.0, *np.linspace(values.min() + 0.02, values.max() - 0.02, number)]


def crowding(points: np.ndarray, pose: Pose, inner: float, outer: float) -> float:
    """How deep points (N, 3) reach into a hand at a pose of its grip site, m; 0 where it is free.

    Its fingers take what is from `inner` to `outer` on both sides, m, and their thickness beyond.
    """
    return _depth(points, pose.pos, np.ascontiguousarray(pose.mat), inner, outer)


@njit(cache=True, nogil=True)
def _depth(points: np.ndarray, pos: np.ndarray, mat: np.ndarray, inner: float, outer: float) -> float:
    deepest = 0.0
    for i in range(len(points)):
        a, b, c = points[i, 0] - pos[0], points[i, 1] - pos[1], points[i, 2] - pos[2]
        z = a * mat[0, 2] + b * mat[1, 2] + c * mat[2, 2]
        if z > TIP_BELOW + _SPARE or z < -0.3:
            continue
        x = abs(a * mat[0, 0] + b * mat[1, 0] + c * mat[2, 0])
        y = abs(a * mat[0, 1] + b * mat[1, 1] + c * mat[2, 1])
        if z > -0.04:  # fingers
            side = outer + TIP + _WIDENS * (TIP_BELOW - z) + _SPARE
            depth = min(side - x, x - inner + _SPARE, FINGER_HALF_WIDTH + _SPARE - y, TIP_BELOW + _SPARE - z)
            deepest = max(deepest, depth)
        if z > -0.13:  # the palm, which is thinner in front
            half = min(max(0.0175 - 0.22 * (z + 0.031), 0.0), 0.032) + _SPARE
            deepest = max(deepest, min(0.104 + _SPARE - x, half - y, -0.031 + _SPARE - z, z + 0.13))
        deepest = max(deepest, min(0.06 - x, 0.06 - y, -0.12 - z, z + 0.3))  # the wrist
    return deepest


def under(floor: float, pose: Pose, opened: bool) -> float:
    """How deep a hand reaches under a height, m."""
    wide = (OPEN_HALF if opened else 0.0) + TIP
    lowest = np.inf
    for w, h, z in ((wide, FINGER_HALF_WIDTH, TIP_BELOW), (0.104, 0.018, -0.031), (0.104, 0.032, -0.1)):
        row = pose.mat[2]
        lowest = min(lowest, pose.pos[2] - w * abs(row[0]) - h * abs(row[1]) + z * row[2])
    return max(0.0, floor + 0.004 - float(lowest))
