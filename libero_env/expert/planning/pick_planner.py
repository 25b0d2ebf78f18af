"""Plan a pick and a place together: a grasp and a place pose that the arm reaches and that leave the hand room."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from libero_env.expert.arm import finger_axis
from libero_env.expert.grasping.grasps import HAND, Grasp, GraspError, collision_cost, find_grasps, grip_cost
from libero_env.expert.planning.pick_plan import FLIPS, SEARCH, FailedAttempt, PickPlan, first_reachable
from libero_env.expert.planning.place_poses import DOWN, Placement, PlacePose, find_place_poses
from libero_env.expert.shapes import Shapes
from libero_env.geometry import Pose, rotation_about_z
from libero_env.sim.state import StateView
from libero_env.tasks.expression import Atom

_DROP_HEIGHTS = np.array([0.0, 0.02, 0.04, 0.07, 0.10, 0.14, 0.18])  # [m] above the place
_FEW_HITS = 30  # of a hand's points: one that hits more does not fit into a place entered from a side
_TILTS = (0.5, 0.8, 1.1, 1.45)  # [rad] of approaches that suit places entered from a side


def plan_pick(
    view: StateView,
    shapes: Shapes,
    atom: Atom,
    slot: tuple[int, int] = (0, 1),
    failures: Sequence[FailedAttempt] = (),
) -> PickPlan:
    """Return the best plan to make an atom true; the result is deterministic.

    Args:
        atom: (On object place), (In object region) or (Stack object place).
        slot: (k, n): the object is number k of n that go to this place.
        failures: Attempts that failed before; others are preferred.

    Raises:
        GraspError: No part of the object fits between the fingers.
        PlaceError: There is no room for the object.
    """
    placement = Placement.from_view(view, shapes, atom, slot)
    places = _candidate_places(placement, failures)
    tilts = _entry_tilts(places, placement.object_pose)
    near = places[0].pos
    grasps = _candidate_grasps(placement, [None, *tilts], failures, near)
    pairs = _rank_pairs(placement, grasps, places)
    best, error = first_reachable(view, shapes, pairs)
    if grasps[0].cost < SEARCH.collision_limit and error <= SEARCH.reach_tolerance:
        return best
    try:  # tilt the hand away from obstacles, or towards the arm
        number = SEARCH.tilted_grasps if failures else SEARCH.crowded_grasps
        tilted = _candidate_grasps(placement, _ALL_TILTS, failures, near, number)
    except GraspError:
        return best
    pairs = sorted([*pairs, *_rank_pairs(placement, tilted, places)], key=lambda plan: plan.cost)
    other, other_error = first_reachable(view, shapes, pairs)
    return other if other_error <= max(error, SEARCH.reach_tolerance) else best


def plan_place(
    view: StateView,
    shapes: Shapes,
    atom: Atom,
    slot: tuple[int, int] = (0, 1),
    failures: Sequence[FailedAttempt] = (),
) -> PickPlan:
    """Return where to place the object that is in the hand, as the hand holds it now; arguments as of `plan_pick`.

    Raises:
        PlaceError: There is no room for the object.
    """
    placement = Placement.from_view(view, shapes, atom, slot)
    places = _candidate_places(placement, failures)
    held = Grasp(view.eef_pos, view.eef_mat, float(np.abs(view.finger_pos).sum()), 0.0)
    return first_reachable(view, shapes, _rank_pairs(placement, [held], places), held=True)[0]


def is_graspable(view: StateView, shapes: Shapes, name: str) -> bool:
    """Return whether some part of an object fits between the fingers from above."""
    surface_height = view.scene.workspace.surface_height
    try:
        find_grasps(shapes.cloud(view, name), surface_height, finger_axis(view.eef_mat), max_count=1)
    except GraspError:
        return False
    return True


def _candidate_places(placement: Placement, failures: Sequence[FailedAttempt]) -> list[PlacePose]:
    """Return the best places, some of each orientation of the object and each depth; failed ones cost more."""
    failed = [failure.place.pose for failure in failures if failure.place]
    places = []
    for place in find_place_poses(placement):
        repeats = sum(SEARCH.is_same(place.pose, other) for other in failed)
        places.append(replace(place, cost=place.cost + SEARCH.retry_cost * repeats))
    groups: dict[tuple, list[PlacePose]] = {}
    for place in sorted(places, key=lambda place: place.cost):
        orientation = np.round(place.mat[:2, :2].ravel(), 1)
        depth = round(float(place.pos @ place.entry) / SEARCH.depth_step)
        group = groups.setdefault((*orientation, *np.round(place.entry), depth), [])
        if len(group) < SEARCH.places_per_group:
            group.append(place)
    varied = [place for group in groups.values() for place in group]
    return sorted(varied, key=lambda place: place.cost)[: SEARCH.places]


def _candidate_grasps(
    placement: Placement,
    tilts: Sequence[np.ndarray | None],
    failures: Sequence[FailedAttempt],
    near: np.ndarray,
    tilted_grasps: int = SEARCH.tilted_grasps,
) -> list[Grasp]:
    """Return grasps for some approaches, best first; collisions, a poor grip and failed attempts cost.

    Args:
        placement: Object and scene.
        tilts: Rotations (3, 3) from straight down to an approach; None for straight down.
        failures: Attempts that failed before.
        near: Position (3,) to which the side of a symmetric object that is grasped is the near one, so that all
            demonstrations choose the same.
        tilted_grasps: Number of grasps for one tilted approach, for each attempt so far and the next one.

    Raises:
        GraspError: There is no grasp.
    """
    view, voxels, cloud, name = placement.view, placement.voxels, placement.cloud, placement.atom.args[0]
    middle = cloud.mean(axis=0)
    distance = np.linalg.norm(voxels.points - middle, axis=1)
    obstacles = voxels.points[distance < SEARCH.obstacle_radius]
    axis, error = finger_axis(view.eef_mat), None
    towards = (near - middle) * [1, 1, 0]
    towards /= max(float(np.linalg.norm(towards)), 1e-9)
    candidates: list[Grasp] = []
    for tilt in tilts:
        tilt_cost = 0.0 if tilt is None else 0.4 * float(np.arccos(tilt[2, 2]))
        number = (SEARCH.top_grasps if tilt is None else tilted_grasps) * (1 + len(failures))
        try:
            grasps = find_grasps(
                cloud,
                voxels.surface_height,
                axis,
                tilt=tilt,
                name=name,
                max_count=number,
                spacing=SEARCH.grasp_spacing,
            )
        except GraspError as problem:
            error = error or problem
            continue
        for grasp in grasps:
            extra = collision_cost(voxels, obstacles, grasp) + grip_cost(cloud, grasp)
            extra = extra + _retry_cost(placement.object_pose, grasp, failures)
            extra = extra + SEARCH.side_cost * float((middle - grasp.pos_world) @ towards)
            candidates.append(replace(grasp, cost=grasp.cost + tilt_cost + extra))
    if not candidates:
        raise error or GraspError(f"{name} cannot be grasped")
    return sorted(candidates, key=lambda grasp: grasp.cost)


def _retry_cost(object_pose: Pose, grasp: Grasp, failures: Sequence[FailedAttempt]) -> float:
    """Return the cost of similar grasps that failed; a grasp rotated by half a turn is the same."""
    local = object_pose.to_local(Pose(grasp.pos_world, grasp.mat))
    poses = [Pose(local.pos, local.mat * flip) for flip in FLIPS]
    failed = [f.grasp for f in failures if f.grasp is not None]
    return SEARCH.retry_cost * sum(any(SEARCH.is_same(pose, grasp) for pose in poses) for grasp in failed)


def _tilt(azimuth: float, angle: float) -> np.ndarray:
    """Return the rotation (3, 3) from straight down to an approach that leans towards a horizontal direction."""
    about, c, s = rotation_about_z(azimuth), np.cos(angle), np.sin(angle)
    return about @ np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]]) @ about.T


_ALL_TILTS = [_tilt(2 * np.pi * k / 8, angle) for angle in (0.25, 0.35, 0.6) for k in range(8)]


def _entry_tilts(places: list[PlacePose], object_pose: Pose) -> list[np.ndarray]:
    """Return rotations (3, 3) from straight down to approaches that suit places entered from a side or leaning."""
    tilts: list[np.ndarray] = []
    seen: set[int] = set()
    for place in places:
        to_now = object_pose.mat @ place.mat.T
        entry = to_now @ (DOWN if place.from_above else place.entry)
        horizontal, azimuth = float(np.hypot(entry[0], entry[1])), np.arctan2(entry[1], entry[0])
        direction = round(azimuth / (np.pi / 6)) % 12
        if horizontal < 0.3 or direction in seen or len(seen) == SEARCH.entry_directions:
            continue
        seen.add(direction)
        tilts += [_tilt(float(azimuth), angle) for angle in _TILTS]
    return tilts


def _rank_pairs(placement: Placement, grasps: list[Grasp], places: list[PlacePose]) -> list[PickPlan]:
    """Return the best pairs of a grasp and a place, in order, each with the height at which the hand has room."""
    object_pose, voxels = placement.object_pose, placement.voxels
    rotations = np.stack([place.mat @ object_pose.mat.T for place in places])
    positions, entries = np.stack([p.pos for p in places]), np.stack([p.entry for p in places])
    from_side = np.flatnonzero(entries[:, 2] > -0.5)
    cost = np.array([[grasp.cost + place.cost for place in places] for grasp in grasps])
    heights = np.zeros(cost.shape, int)
    for g, grasp in enumerate(grasps):
        mats = rotations @ grasp.mat
        origins = positions + rotations @ (grasp.pos_world - object_pose.pos)
        hits = np.full((len(places), len(_DROP_HEIGHTS)), 1e6)
        colliding = np.ones(len(places), bool)
        for k, height in enumerate(_DROP_HEIGHTS):
            raised = origins[colliding] + [0, 0, height + 0.008]
            hits[colliding, k] = voxels.count_hand_collisions(HAND, raised, mats[colliding])
            colliding &= hits[:, k] > 0
            colliding[from_side] = False
            if not colliding.any():
                break
        hits[from_side] += 10 * np.maximum(hits[from_side] - _FEW_HITS, 0)
        height_cost = 0.01 * hits + 0.3 * (hits > 0) + 4.0 * _DROP_HEIGHTS
        heights[g] = height_cost.argmin(axis=1)
        cost[g] += height_cost.min(axis=1)
        for distance in (0.08, 0.16):
            before = origins[from_side] - distance * entries[from_side]
            cost[g, from_side] += 0.01 * voxels.count_hand_collisions(HAND, before, mats[from_side])
    best = np.argsort(cost, axis=None, kind="stable")[: SEARCH.pairs]
    return [
        PickPlan(grasps[g], places[p], object_pose, float(_DROP_HEIGHTS[heights[g, p]]), float(cost[g, p]))
        for g, p in zip(*np.unravel_index(best, cost.shape), strict=True)
    ]
