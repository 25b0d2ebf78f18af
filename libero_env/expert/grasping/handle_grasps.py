"""Grasps of handles and knobs, and poses from which the hand pushes a part."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from libero_env.expert.arm import GRIPPER, downward, finger_axis, posture_cost, reach_violation, wrist_twist
from libero_env.expert.grasping.grasps import GraspError, choose_grasp
from libero_env.expert.grasping.handles import UP, Handle, Part, hinge_rotation, nearby_points
from libero_env.expert.grasping.kernels import hand_collision_depth
from libero_env.geometry import Pose
from libero_env.sim.state import StateView

MAX_HANDLE_WIDTH = 0.06  # [m]
_TILTS = np.radians([90, 75, 65, 55, 45, 35, 25])  # of the approach below the horizontal
_STEEP = np.radians(60)  # from there on closed fingers need not rotate with the door that they push
_ROLLS = (0.0, 0.8, -0.8)  # [rad] of the fingers, from perpendicular to a horizontal bar
_SHORT_BAR = 0.022  # [m] half the length of a bar that is also grasped by its ends
_FOLLOW_RATIOS = (1.0, 0.5, 0.0)  # shares of a door's rotation that a pushing hand makes too
_OFFSETS = np.array([0.0, 0.012, -0.012, 0.02, -0.02, 0.026, -0.026])  # [m] of the open hand from the bar
_DEPTHS = (0.0, -0.005, -0.0075)  # [m] of the grip site beyond the middle of the bar
_SIDE_LEANS = (0.35, -0.35)  # [rad] of the hand at a vertical bar
_MAX_TWIST = 0.5 * np.pi + 0.4  # [rad] of the wrist
_KNOB_LEANS = (0.0, 0.2, -0.2, 0.35, -0.35, 0.5, -0.5)  # [rad] of the hand over a knob
_RETREAT = 0.10  # [m] by which the hand withdraws


@dataclass(frozen=True)
class HandleGrasp:
    """Poses of the grip site from which the hand moves a part.

    Attributes:
        pregrasp: Pose with the open fingers around the handle, or with closed fingers just in front of the part.
        contact: Pose in which the hand begins to move the part.
        retreat: Direction in which the hand withdraws, and from which it comes, unit vector (3,).
        gripping: Whether the fingers close on the handle; otherwise closed fingers push.
        follow_ratio: Share of the part's rotation that the hand makes too.
    """

    pregrasp: Pose
    contact: Pose
    retreat: np.ndarray
    gripping: bool
    follow_ratio: float = 1.0

    def relative_to(self, frame: Pose) -> "HandleGrasp":
        """Return the same grasp in a frame, such as the part's, instead of the world."""
        pregrasp, contact = frame.to_local(self.pregrasp), frame.to_local(self.contact)
        return HandleGrasp(pregrasp, contact, frame.mat.T @ self.retreat, self.gripping, self.follow_ratio)


# cost, pregrasp, contact, retreat, follow ratio
_Row = tuple[float, np.ndarray, np.ndarray, np.ndarray, float]


@dataclass(frozen=True)
class Candidates:
    """Candidates for a `HandleGrasp`, one per row."""

    cost: np.ndarray  # (N,)
    mat: np.ndarray  # (N, 3, 3)
    pregrasp: np.ndarray  # (N, 3)
    contact: np.ndarray  # (N, 3)
    retreat: np.ndarray  # (N, 3)
    follow_ratio: np.ndarray  # (N,)

    def grasp(self, k: int, gripping: bool) -> HandleGrasp:
        """Return the candidate of a row."""
        pregrasp, contact = Pose(self.pregrasp[k], self.mat[k]), Pose(self.contact[k], self.mat[k])
        return HandleGrasp(pregrasp, contact, self.retreat[k], gripping, float(self.follow_ratio[k]))

    def similar_to(self, pose: Pose) -> np.ndarray:
        """Return which pre-grasps are nearly the same as a pose, (N,) bool."""
        near = np.linalg.norm(self.pregrasp - pose.pos, axis=1) < 0.012
        return near & (np.einsum("ij,nij->n", pose.mat, self.mat) > 2.9)


def find_candidates(handle: Handle, gripping: bool, hinged: bool, base: np.ndarray) -> Candidates:
    """Return all candidates; collisions are not considered.

    Args:
        handle: Handle, or side of a part that is pushed.
        gripping: Whether the fingers close on the handle; otherwise closed fingers push.
        hinged: Whether the part rotates about a hinge.
        base: Position of the robot's base, (3,), [m].
    """
    rows: list[tuple] = []
    for mat, steep, rotation_cost in _hand_orientations(handle, gripping):
        if wrist_twist(handle.pos[None], mat[None], base)[0] > _MAX_TWIST:
            continue
        if gripping:
            poses = _grip_candidates(handle, mat)
        else:
            poses = _push_candidates(handle, mat, _FOLLOW_RATIOS if hinged and steep else (1.0,))
        rows += [(cost + rotation_cost, mat, *rest) for cost, *rest in poses]
    columns = [np.array(column) for column in zip(*rows, strict=True)] or [np.zeros(0)] * 6
    return Candidates(*columns)


def _hand_orientations(handle: Handle, gripping: bool) -> Iterator[tuple[np.ndarray, bool, float]]:
    """Yield (orientation of the hand (3, 3), whether its approach is steep, cost)."""
    vertical = abs(handle.along[2]) > 0.7
    rolls: tuple[float, ...] = (0.0,) if vertical else _ROLLS
    if gripping and not vertical and handle.half_length < _SHORT_BAR:
        rolls = (*rolls, 0.5 * np.pi)
    for tilt, roll, sign in product(_TILTS, rolls, (1.0, -1.0)):
        approach = -np.cos(tilt) * handle.out - np.sin(tilt) * UP
        fingers = np.cross(handle.along, -handle.out if vertical else approach)
        fingers = sign * (np.cos(roll) * fingers + np.sin(roll) * handle.along)
        mat = np.column_stack([fingers, np.cross(approach, fingers), approach])
        yield mat, tilt > _STEEP, 0.3 * abs(roll)
        if vertical and gripping:
            for lean in _SIDE_LEANS:
                yield hinge_rotation(handle.out, lean) @ mat, tilt > _STEEP, 0.3 * abs(lean)


def _grip_candidates(handle: Handle, mat: np.ndarray) -> Iterator[_Row]:
    """Yield grasps with the bar between the fingers for one orientation of the hand (3, 3)."""
    fingers, across, approach = mat.T
    vertical = abs(handle.along[2]) > 0.7
    by_its_ends = abs(fingers @ handle.along) > 0.9
    reach = 0.0 if by_its_ends else max(handle.half_length - 0.012, 0.0)
    shifts = (reach, 0.5 * reach, 0.0, -0.5 * reach) if vertical else (0.0, 0.3 * reach, -0.3 * reach)
    for shift in dict.fromkeys(shifts):
        pos = handle.pos + shift * handle.along
        strip = handle.points[np.abs((handle.points - pos) @ across) < 0.01] @ fingers
        width = float(np.ptp(strip)) if len(strip) else 1.0
        if width > MAX_HANDLE_WIDTH:
            continue
        offsets = _OFFSETS[np.abs(_OFFSETS) + 0.5 * width + 0.003 < GRIPPER.half_opening]
        retreats = ((0.0, -approach), (0.02, handle.out))
        for offset, depth, (retreat_cost, retreat) in product(offsets, _DEPTHS, retreats):
            contact = pos + depth * approach
            cost = 0.5 * abs(shift) + 2.0 * abs(offset) + 4.0 * abs(depth) + retreat_cost
            yield cost, contact + offset * fingers, contact, retreat, 1.0


def _push_candidates(handle: Handle, mat: np.ndarray, follow_ratios: Sequence[float]) -> Iterator[_Row]:
    """Yield poses of closed fingers against the bar, or against the front beside it, for one orientation (3, 3)."""
    fingers, across, approach = mat.T
    offset = handle.part_points - handle.pos
    beside = np.cross(handle.along, handle.out)
    half_x, half_y = GRIPPER.tip_thickness, GRIPPER.finger_half_width
    signs = product((1, -1), (1, -1))
    tip = np.array(
        [s * half_x * fingers + t * half_y * across + GRIPPER.tip_below * approach for s, t in signs]
    )
    forward = float((-tip @ handle.out).max())
    vertical = abs(handle.along[2]) > 0.7
    tilt = np.arcsin(np.clip(-approach[2], -1, 1))
    sides = _spread(offset @ beside, 5) if vertical else [0.0]
    for shift, side in product(_spread(offset @ handle.along, 7), sides):
        near = (np.abs(offset @ handle.along - shift) < 0.012) & (np.abs(offset @ beside - side) < 0.012)
        if not near.any():
            continue
        front = float((offset[near] @ handle.out).max())
        pos = handle.pos + shift * handle.along + side * beside + (front + forward + 0.004) * handle.out
        cost = 0.5 * (abs(shift) + abs(side)) + 0.2 * abs(tilt - np.radians(65))
        for ratio in follow_ratios:
            yield cost + 0.02 * (1.0 - ratio), pos, pos, -approach, ratio


def _spread(values: np.ndarray, number: int) -> list[float]:
    """Return 0 and equally spaced values between the ends of a range, 2 cm from them, [m]."""
    return [0.0, *np.linspace(values.min() + 0.02, values.max() - 0.02, number)]


def grasp_knob(view: StateView, part: Part, delta: float) -> HandleGrasp:
    """Return the grasp of a knob from above.

    The hand leans along the knob where the wrist would be bent back, close to the arm's base.

    Args:
        part: Knob.
        delta: Angle by which it is to be turned, [rad].

    Raises:
        GraspError: The knob is too thick for the fingers.
    """
    cloud = part.cloud(view, 0.004)
    upper = cloud[cloud[:, 2] > cloud[:, 2].max() - 0.03]
    obstacles = nearby_points(view, cloud.mean(axis=0), view.scene.entities, part.body)
    grasp = choose_grasp(upper, obstacles, cloud[:, 2].min(), finger_axis(view.eef_mat), "knob")
    fingers = np.array([np.cos(grasp.yaw), np.sin(grasp.yaw), 0.0])
    leans = list(product(_KNOB_LEANS, (1.0, -1.0)))
    mat = np.stack(
        [hinge_rotation(fingers, lean) @ downward(grasp.yaw, sign * fingers) for lean, sign in leans]
    )
    pos = np.tile(grasp.pos_world, (len(mat), 1))
    end_pos, end_mat = part.poses_after(view, grasp.pos_world[None], mat, delta)
    end_pos = np.tile(end_pos, (len(mat), 1))
    base = np.array(view.scene.workspace.robot_base_pos)
    cost = posture_cost(pos, mat, base) + posture_cost(end_pos, end_mat, base)
    for k, (lean, _) in enumerate(leans):
        poses = (Pose(pos[k], mat[k]), Pose(end_pos[k], end_mat[k]))
        depth = max(_depth_in_hand(obstacles, pose, 0.0, GRIPPER.half_opening) for pose in poses)
        cost[k] += 0.3 * abs(lean) + _depth_cost(depth)
    best = Pose(grasp.pos_world, mat[int(np.argmin(cost))])
    return HandleGrasp(best, best, UP, True)


def grasp_handle(
    view: StateView, part: Part, handle: Handle, delta: float, gripping: bool, failed: Sequence[Pose] = ()
) -> HandleGrasp:
    """Return the best grasp of a handle, or the best pose to push against it.

    The cost counts collisions of the hand, the posture of the arm, and rotation of the hand.

    Args:
        part: Part that moves.
        handle: Handle of the part.
        delta: Motion of the joint, [m] or [rad].
        gripping: Whether the handle is taken between the fingers; otherwise it is pushed with closed ones.
        failed: Poses of the grip site that failed before.

    Raises:
        GraspError: The handle is too thick for the fingers.
    """
    base = np.array(view.scene.workspace.robot_base_pos)
    candidates = find_candidates(handle, gripping, not part.slides, base)
    if not len(candidates.cost):
        raise GraspError(
            f"the handle cannot be grasped: it is more than {100 * MAX_HANDLE_WIDTH:.0f} cm thick"
        )
    contact, mat, ratio = candidates.contact, candidates.mat, candidates.follow_ratio
    moved = [part.poses_after(view, contact, mat, share * delta, ratio) for share in (0.5, 1.0)]
    cost = candidates.cost + posture_cost(candidates.pregrasp, mat, base) + posture_cost(*moved[1], base)
    end_pos, end_mat = moved[1]
    cost += 20.0 * reach_violation(end_pos - _RETREAT * end_mat[:, :, 2], end_mat, base)
    cosine = 0.5 * (np.einsum("ij,nij->n", view.eef_mat, mat) - 1.0)
    cost += 0.1 * np.arccos(np.clip(cosine, -1.0, 1.0))
    for pose in failed:
        cost += 0.5 * candidates.similar_to(pose)
    check = _CollisionCheck(view, part, handle, gripping)
    best, least = -1, np.inf
    for k in np.argsort(cost, kind="stable"):
        if cost[k] >= least:
            break
        poses = [Pose(pos[k], mat[k]) for pos, mat in moved]
        collisions = check.cost(candidates.grasp(k, gripping), poses, delta, least - cost[k])
        if cost[k] + collisions < least:
            best, least = int(k), cost[k] + collisions
    return candidates.grasp(best, gripping)


def _depth_in_hand(points: np.ndarray, pose: Pose, inner: float, outer: float) -> float:
    return hand_collision_depth(points, pose.pos, np.ascontiguousarray(pose.mat), inner, outer)


def table_penetration(surface_height: float, pose: Pose, opened: bool) -> float:
    """Return how deep a hand reaches below 4 mm over the table, [m].

    Args:
        surface_height: Height of the table, [m].
        opened: Whether the fingers are open.
    """
    outer = (GRIPPER.half_opening if opened else 0.0) + GRIPPER.tip_thickness
    lowest = np.inf
    corners = (
        (outer, GRIPPER.finger_half_width, GRIPPER.tip_below),
        (0.104, 0.018, -0.031),
        (0.104, 0.032, -0.1),
    )
    for x, y, z in corners:
        row = pose.mat[2]
        lowest = min(lowest, pose.pos[2] - x * abs(row[0]) - y * abs(row[1]) + z * row[2])
    return max(0.0, surface_height + 0.004 - float(lowest))


class _CollisionCheck:
    """Collisions of the hand on its way to a handle and while it moves the part."""

    def __init__(self, view: StateView, part: Part, handle: Handle, gripping: bool):
        self._view, self._part, self._out, self._gripping = view, part, handle.out, gripping
        self._fixtures = nearby_points(view, handle.pos, view.scene.fixtures, part.body)
        objects = nearby_points(view, handle.pos, view.scene.objects, part.body)
        self._others = np.concatenate([self._fixtures, objects])
        self._part_points = part.cloud(view, 0.012)

    def cost(self, grasp: HandleGrasp, moved: list[Pose], delta: float, limit: float) -> float:
        """Return the cost of collisions at the pre-grasp, before it, and at the poses to which the part moves.

        Args:
            grasp: Candidate, world frame.
            moved: Poses of the grip site while it moves the part.
            delta: Motion of the joint, [m] or [rad].
            limit: Cost at which the check stops early, as another candidate is better.
        """
        opening = GRIPPER.half_opening if self._gripping else 0.0
        surface_height = self._view.scene.workspace.surface_height
        depth = max(table_penetration(surface_height, p, self._gripping) for p in (grasp.pregrasp, *moved))
        pos, mat = grasp.pregrasp.pos, grasp.pregrasp.mat
        approach = [Pose(pos + distance * grasp.retreat, mat) for distance in (0.0, 0.03, 0.07)]
        part, others = self._part_points, self._others
        checks = [(points, p, x, opening) for p in approach for points, x in ((part, opening), (others, 0.0))]
        checks += [(self._fixtures, pose, 0.0, 0.0) for pose in moved]
        if grasp.follow_ratio < 1.0:  # the door rotates under the hand
            lag = (grasp.follow_ratio - 1.0) * delta
            out = Pose(grasp.contact.pos + 0.01 * self._out, grasp.contact.mat)
            rotated = [
                self._part.pose_after(self._view, out, 0.0, rotation=share * lag) for share in (0.5, 1.0)
            ]
            checks += [(part, pose, 0.0, 0.0) for pose in rotated]
        for points, pose, inner, outer in checks:
            if _depth_cost(depth) >= limit:
                break
            depth = max(depth, _depth_in_hand(points, pose, inner, outer))
        return _depth_cost(depth)


def _depth_cost(depth: float) -> float:
    """Return the cost of a collision of this depth, [m]."""
    return 150.0 * depth + 0.8 * (depth > 0.001)
