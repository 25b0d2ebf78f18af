"""Where the hand takes hold of a handle or a knob, and where it pushes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from libero_env.expert.geometry import Pose, surface_points
from libero_env.expert.grasp import FINGER_HALF_WIDTH, TIP_BELOW, GraspError, choose_grasp
from libero_env.expert.handles import UP, Handle, Part, surroundings
from libero_env.expert.motion import downward, finger_axis
from libero_env.predicates import StateView

TAKES = 0.06  # m, widest handle that is taken between the fingers
OPEN_HALF = 0.04  # m, of an open finger from the middle
TIP = 0.0145  # m, thickness of a finger at its tip
_WIDENS = 0.41  # m of thickness for each m further up
_TILTS = np.radians([90, 75, 65, 55, 45, 35, 25])  # of the approach below the horizontal
_ROLLS = (0.0, 0.8, -0.8)  # rad, of the fingers from across a level bar
_ASIDE = (0.0, 0.012, -0.012, 0.02, -0.02, 0.026, -0.026)  # m, of the open hand from the middle of the bar
_FORTH = (0.0, -0.005)  # m, of the grip site beyond the middle of the bar
_SPARE = 0.002  # m, around the hand
_SHOULDER = np.array([-0.66, 0.0, 0.333])  # m, of the arm, height above its base
_HAND_LENGTH = 0.21  # m, from the flange to the grip site
_REACH = 0.42, 0.74  # m, from the shoulder to the flange, without folding or stretching the arm
_WRIST_MIDDLE = 2.33  # rad, yaw of the fingers straight ahead of the arm with its last joint in the middle


@dataclass(frozen=True)
class Hold:
    """Poses of the grip site to take hold, or to begin to push."""

    ready: Pose  # fingers around the handle and not yet closed, or just in front of it
    held: Pose
    back: np.ndarray  # (3,) unit, where the hand comes from and withdraws to
    grips: bool


def knob_hold(view: StateView, part: Part, delta: float) -> Hold:
    """How to take a knob from above in order to turn it by `delta`, rad.

    Raises:
        GraspError: it is too thick for the fingers.
    """
    cloud = part.pose(view).apply(surface_points(view.scene.model, part.body, 0.004))
    high = cloud[cloud[:, 2] > cloud[:, 2].max() - 0.03]
    around = surroundings(view, part.body, cloud.mean(axis=0), view.scene.things)
    grasp = choose_grasp(high, around, cloud[:, 2].min(), finger_axis(view.eef_mat), "knob")
    mats = [
        downward(grasp.yaw, sign * np.array([np.cos(grasp.yaw), np.sin(grasp.yaw), 0])) for sign in (1, -1)
    ]
    poses = [Pose(grasp.pos_world, mat) for mat in mats]
    best = min(poses, key=lambda pose: strain(pose) ** 2 + strain(part.moved(view, pose, delta)) ** 2)
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
    fixed = surroundings(view, part.body, handle.pos, view.scene.fixtures)
    loose = surroundings(view, part.body, handle.pos, view.scene.objects)
    own = part.pose(view).apply(surface_points(view.scene.model, part.body, 0.012))
    floor, half = view.scene.workspace.surface_height, OPEN_HALF if grips else 0.0
    spans = [(own, (half, half)), (np.concatenate([fixed, loose]), (0.0, half))]
    base, ranked = view.scene.workspace.robot_base_pos[2], []
    for cost, hold in _candidates(handle, grips):
        for pose in (hold.ready, part.moved(view, hold.held, delta)):
            cost += 0.12 * strain(pose) ** 2 + 20.0 * stretch(pose, base)
        turn = 0.5 * (np.sum(view.eef_mat * hold.ready.mat) - 1.0)
        cost += 0.1 * float(np.arccos(np.clip(turn, -1.0, 1.0)))
        ranked.append((cost + sum(0.5 * _alike(hold.ready, pose) for pose in failed), hold))
    best: tuple[float, Hold] | None = None
    for cost, hold in sorted(ranked, key=lambda pair: pair[0]):
        if best is not None and cost >= best[0]:
            break
        ready, worst = hold.ready, np.inf if best is None else best[0]
        moved = [part.moved(view, hold.held, share * delta) for share in (0.5, 1.0)]
        backs = [Pose(ready.pos + back * hold.back, ready.mat) for back in (0.0, 0.03, 0.07)]
        depth = max(under(floor, pose, grips) for pose in (ready, *moved))
        checks = [(points, pose, *span) for pose in backs for points, span in spans]
        for points, pose, *span in checks + [(fixed, pose, 0.0, 0.0) for pose in moved]:
            if cost + _blocked(depth) >= worst:
                break
            depth = max(depth, crowding(points, pose, *span))
        cost += _blocked(depth)
        if best is None or cost < best[0]:
            best = cost, hold
    if best is None:
        raise GraspError(f"no way to take the handle: it is more than {100 * TAKES:.0f} cm thick")
    return best[1]


def _blocked(depth: float) -> float:
    """Cost of a hand that is so deep in something, m."""
    return 150.0 * depth + 0.8 * (depth > 0.001)


def _alike(pose: Pose, other: Pose) -> bool:
    return bool(np.linalg.norm(pose.pos - other.pos) < 0.012 and np.trace(pose.mat.T @ other.mat) > 2.9)


def _candidates(handle: Handle, grips: bool) -> Iterator[tuple[float, Hold]]:
    """(cost, hold) for each approach, what is around not yet considered."""
    upright = abs(handle.along[2]) > 0.7
    for tilt, roll, sign in product(_TILTS, (0.0,) if upright else _ROLLS, (1.0, -1.0)):
        approach = -np.cos(tilt) * handle.out - np.sin(tilt) * UP
        fingers = np.cross(handle.along, -handle.out if upright else approach)
        fingers = sign * (np.cos(roll) * fingers + np.sin(roll) * handle.along)
        mat = np.column_stack([fingers, np.cross(approach, fingers), approach])
        if strain(Pose(handle.pos, mat)) < 0.5 * np.pi + 0.4:
            for cost, hold in (_grips if grips else _pushes)(handle, mat):
                yield cost + 0.3 * abs(roll), hold


def _grips(handle: Handle, mat: np.ndarray) -> Iterator[tuple[float, Hold]]:
    fingers, across, approach = mat.T
    upright = abs(handle.along[2]) > 0.7
    reach = max(handle.half - 0.012, 0.0)
    for shift in (reach, 0.5 * reach, 0.0, -0.5 * reach) if upright else (0.0, 0.3 * reach, -0.3 * reach):
        pos = handle.pos + shift * handle.along
        strip = handle.points[np.abs((handle.points - pos) @ across) < 0.01] @ fingers
        width = float(np.ptp(strip)) if len(strip) else 1.0
        if width > TAKES:
            continue
        backs = {0.0: -approach, 0.02: handle.out}
        for aside, forth, (extra, back) in product(_ASIDE, _FORTH, backs.items()):
            if abs(aside) + 0.5 * width + 0.003 < OPEN_HALF:
                held = Pose(pos + forth * approach, mat)
                ready = Pose(held.pos + aside * fingers, mat)
                yield (
                    0.5 * abs(shift) + 2.0 * abs(aside) + 4.0 * abs(forth) + extra,
                    Hold(ready, held, back, True),
                )


def _pushes(handle: Handle, mat: np.ndarray) -> Iterator[tuple[float, Hold]]:
    """Closed fingers against the bar, or against the front beside it."""
    fingers, across, approach = mat.T
    offset = handle.part - handle.pos
    beside = np.cross(handle.along, handle.out)
    tip = np.array([s * TIP * fingers + t * FINGER_HALF_WIDTH * across + TIP_BELOW * approach
                    for s in (1, -1) for t in (1, -1)])  # fmt: skip
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
        hold = Pose(pos, mat)
        yield (
            0.5 * (abs(shift) + abs(side)) + 0.2 * abs(tilt - np.radians(65)),
            Hold(hold, hold, -approach, False),
        )


def _spread(values: np.ndarray, number: int) -> list[float]:
    """0 and values between the ends of a range, m."""
    return [0.0, *np.linspace(values.min() + 0.02, values.max() - 0.02, number)]


def crowding(points: np.ndarray, pose: Pose, inner: float, outer: float) -> float:
    """How deep points (N, 3) reach into a hand at a pose of its grip site, m; 0 where it is free.

    Its fingers take what is from `inner` to `outer` on both sides, m, and their thickness beyond.
    """
    offset = points - pose.pos
    near = offset[(offset * offset) @ np.ones(3) < 0.17**2]
    x, y, z = (near @ pose.mat).T  # fingers and palm
    x, y = np.abs(x), np.abs(y)
    sides = outer + TIP + _WIDENS * (TIP_BELOW - z) + _SPARE
    finger = np.minimum.reduce(
        [sides - x, x - inner + _SPARE, FINGER_HALF_WIDTH + _SPARE - y, TIP_BELOW + _SPARE - z]
    )
    finger = np.where(z > -0.04, finger, 0.0)
    half = np.clip(0.0175 - 0.22 * (z + 0.031), 0.0, 0.032) + _SPARE  # of the palm, which is thinner in front
    palm = np.minimum.reduce([0.104 + _SPARE - x, half - y, -0.031 + _SPARE - z, z + 0.13])
    x, y, z = (offset[::3] @ pose.mat).T
    wrist = np.minimum.reduce([0.06 - np.abs(x), 0.06 - np.abs(y), -0.12 - z, z + 0.3])
    return float(max(finger.max(initial=0.0), palm.max(initial=0.0), wrist.max(initial=0.0)))


def under(floor: float, pose: Pose, opened: bool) -> float:
    """How deep a hand reaches under a height, m."""
    wide = (OPEN_HALF if opened else 0.0) + TIP
    levels = ((wide, FINGER_HALF_WIDTH, TIP_BELOW), (0.104, 0.018, -0.031), (0.104, 0.032, -0.1))
    corners = [(s * w, t * h, z) for s in (1, -1) for t in (1, -1) for w, h, z in levels]
    return max(0.0, floor + 0.004 - float(pose.apply(np.array(corners))[:, 2].min()))


def strain(pose: Pose) -> float:
    """How far a hand is turned from where the wrist's joints are in the middle, rad."""
    yaw = _WRIST_MIDDLE + np.arctan2(pose.pos[1], pose.pos[0] - _SHOULDER[0])
    c, s = np.cos(yaw), np.sin(yaw)
    trace = np.sum(
        pose.mat * [[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]]
    )  # of the turn from fingers along yaw
    return float(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)))


def stretch(pose: Pose, base_height: float) -> float:
    """How far a hand is out of easy reach, m."""
    offset = pose.pos - _HAND_LENGTH * pose.mat[:, 2] - _SHOULDER - [0.0, 0.0, base_height]
    distance = float(np.linalg.norm(offset))
    return max(0.0, distance - _REACH[1], _REACH[0] - distance)
