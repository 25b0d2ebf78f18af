"""Grasps of handles and knobs, and poses from which the hand pushes a part."""

from collections.abc import Sequence
from itertools import product

import numpy as np

from libero_env.expert.arm.gripper import GRIPPER
from libero_env.expert.arm.posture import posture_cost, reach_violation
from libero_env.expert.arm.servo import downward, finger_axis
from libero_env.expert.grasping import collision_kernels
from libero_env.expert.grasping.grasps import GraspError, choose_grasp
from libero_env.expert.grasping.handle_candidates import MAX_HANDLE_WIDTH, HandleGrasp, find_candidates
from libero_env.expert.grasping.handles import UP, Handle, Part, hinge_rotation, nearby_points
from libero_env.geometry import Pose
from libero_env.sim.state import StateView

_KNOB_LEANS = (0.0, 0.2, -0.2, 0.35, -0.35, 0.5, -0.5)  # [rad] of the hand over a knob
_RETREAT = 0.10  # [m] by which the hand withdraws


def grasp_knob(view: StateView, part: Part, delta: float) -> HandleGrasp:
    """Return the grasp of a knob from above.

    The hand leans along the knob where the wrist would be bent back, close to the arm's base.

    Args:
        view: State of the simulation.
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
        depth = max(hand_collision_depth(obstacles, pose, 0.0, GRIPPER.half_opening) for pose in poses)
        cost[k] += 0.3 * abs(lean) + _depth_cost(depth)
    best = Pose(grasp.pos_world, mat[int(np.argmin(cost))])
    return HandleGrasp(best, best, UP, True)


def grasp_handle(
    view: StateView, part: Part, handle: Handle, delta: float, gripping: bool, failed: Sequence[Pose] = ()
) -> HandleGrasp:
    """Return the best grasp of a handle, or the best pose to push against it.

    The cost counts collisions of the hand, the posture of the arm, and rotation of the hand.

    Args:
        view: State of the simulation.
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


def hand_collision_depth(points: np.ndarray, pose: Pose, inner: float, outer: float) -> float:
    """Return how deep points reach into the hand, [m]; 0 without a collision.

    Args:
        points: Points on obstacles, world frame, (N, 3).
        pose: Pose of the grip site.
        inner: Distance from the middle where the volume of each finger begins, [m].
        outer: Distance from the middle where each finger's thickness begins, [m].
    """
    return collision_kernels.hand_collision_depth(
        points,
        pose.pos,
        np.ascontiguousarray(pose.mat),
        inner,
        outer,
        GRIPPER.tip_below,
        GRIPPER.tip_thickness,
        GRIPPER.finger_taper,
        GRIPPER.finger_half_width,
    )


def table_penetration(surface_height: float, pose: Pose, opened: bool) -> float:
    """Return how deep a hand reaches below 4 mm over the table, [m].

    Args:
        surface_height: Height of the table, [m].
        pose: Pose of the grip site.
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
            depth = max(depth, hand_collision_depth(points, pose, inner, outer))
        return _depth_cost(depth)


def _depth_cost(depth: float) -> float:
    """Return the cost of a collision of this depth, [m]."""
    return 150.0 * depth + 0.8 * (depth > 0.001)
