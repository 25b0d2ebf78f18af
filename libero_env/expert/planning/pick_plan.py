"""How to take and put something together: the pair of a hold and a place that leaves the hand room at both."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from libero_env.expert.arm.servo import finger_axis
from libero_env.expert.clearance import Voxels
from libero_env.expert.grasping.costs import HAND, collision_cost, grip_cost
from libero_env.expert.grasping.grasps import Grasp, GraspError, grasps
from libero_env.expert.planning.place_poses import DOWN, Place, places
from libero_env.expert.shapes import DENSE, Shapes, pose_of
from libero_env.geometry import Pose, rotation_between
from libero_env.sim.state import StateView
from libero_env.tasks.problem import Atom


def _lean(azimuth: float, tilt: float) -> np.ndarray:
    """Rotation (3, 3) that takes straight down to an approach that leans towards a horizontal direction."""
    c, s, c1, s1 = np.cos(azimuth), np.sin(azimuth), np.cos(tilt), np.sin(tilt)
    about = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return about @ np.array([[c1, 0.0, -s1], [0.0, 1.0, 0.0], [s1, 0.0, c1]]) @ about.T


_CROWDED = 1.0  # cost of a hold from which on the hand tries to lean away from what is in its way
_RING = [_lean(2 * np.pi * k / 8, tilt) for tilt in (0.25, 0.35, 0.6) for k in range(8)]
_GRASPS, _PLACES, _TRIED = 20, 72, 24
_PAIRS = 1000  # of holds and places, that are looked at
_EACH, _DEPTH = 2, 0.03  # places at most for one turn of the body and so many m of depth
_LEANING = 4  # holds for one approach that leans
_MISSED = 1e-4  # m, by which a pose may be missed that counts as reached
_HOPELESS = 0.03  # m, that a pose is missed by where others turned the same way are missed too
_RAISED = 0.10  # m, over where a body was taken, where the hand has turned as it will put it down
_AGAIN = 0.5  # cost of a hold that failed before, or of a place
_ALIKE, _ALIKE_TURN = 0.02, 0.4  # m and rad, between holds or places that share their fate
_LIFTS = np.array(
    [0.0, 0.02, 0.04, 0.07, 0.10, 0.14, 0.18]
)  # m, over the place, from which a body is let fall
_TILTS = (0.5, 0.8, 1.1, 1.45)  # rad, of approaches that are not straight down
_NEAR = 0.3  # m, around a body: what is further away is in no hand's way
ASIDE = 0.16  # m, before a place that is entered from a side
_WAYS_ROUND = np.ones(3), np.array([-1.0, -1.0, 1.0])  # the hand as it is, and turned by half
_SIDES = 8  # directions of such approaches that are tried


@dataclass(frozen=True)
class Approach:
    """Where to take a body and where to let go of it."""

    grasp: Grasp
    place: Place
    pose: Pose  # of the body now
    lift: float  # m, over the place where it is let go
    cost: float

    @property
    def hand_mat(self) -> np.ndarray:
        """The hand's orientation at the place, (3, 3)."""
        return self.place.mat @ self.pose.mat.T @ self.grasp.mat

    @property
    def hand_pos(self) -> np.ndarray:
        """The grip site at the place, (3,)."""
        turn = self.place.mat @ self.pose.mat.T
        return self.place.pos + [0, 0, self.lift] + turn @ (self.grasp.pos_world - self.pose.pos)


@dataclass(frozen=True)
class Failure:
    """What was tried in vain: a hold, as a pose in the body's frame, and the place if the body got there."""

    hold: Pose | None
    place: Place | None = None

    @classmethod
    def of(cls, way: Approach, placed: bool) -> "Failure":
        """The failure of an approach, before or after the body was let go."""
        back = way.pose.mat.T
        hold = Pose(way.pose.invert(way.grasp.pos_world), back @ way.grasp.mat)
        return cls(hold, way.place if placed else None)


def choose_approach(
    view: StateView,
    shapes: Shapes,
    atom: Atom,
    share: tuple[int, int] = (0, 1),
    failures: Sequence[Failure] = (),
) -> Approach:
    """The best way to make an (On thing place) or (In thing place) true; the same input gives the same answer.

    Args:
        view: the state.
        shapes: of the scene.
        atom: what shall hold.
        share: see `places`.
        failures: what was tried before; something else is preferred.

    Raises:
        GraspError: nothing of the body fits between the fingers.
        PlaceError: there is no room for it.
    """
    thing = atom.args[0]
    cloud, pose = shapes.cloud(view, thing), pose_of(view, thing)
    floor = view.scene.workspace.surface_height
    voxels = Voxels(shapes.others(view, thing, spacing=DENSE), floor, pose.pos)
    spots = _varied(_places_again(places(view, voxels, cloud, pose, atom, share), failures))
    tilts = _tilts(spots, pose)
    holds = _free_holds(view, voxels, cloud, pose, thing, [None, *tilts], failures)
    pairs = _pairs(voxels, holds, spots, pose)
    best, miss = _reachable(view, shapes, pairs)
    if holds[0].cost < _CROWDED and miss <= _MISSED:
        return best
    try:  # lean away from what is in the way, or towards the arm
        leaning = _free_holds(view, voxels, cloud, pose, thing, _RING, failures)
    except GraspError:
        return best
    pairs = sorted([*pairs, *_pairs(voxels, leaning, spots, pose)], key=lambda approach: approach.cost)
    other, short = _reachable(view, shapes, pairs)
    return other if short <= max(miss, _MISSED) else best


def choose_place(
    view: StateView,
    shapes: Shapes,
    atom: Atom,
    share: tuple[int, int] = (0, 1),
    failures: Sequence[Failure] = (),
) -> Approach:
    """Where to put what the hand holds already, as it holds it; arguments as of `choose_approach`.

    Raises:
        PlaceError: there is no room for it.
    """
    thing = atom.args[0]
    cloud, pose = shapes.cloud(view, thing), pose_of(view, thing)
    voxels = Voxels(shapes.others(view, thing, spacing=DENSE), view.scene.workspace.surface_height, pose.pos)
    spots = _varied(_places_again(places(view, voxels, cloud, pose, atom, share), failures))
    hold = Grasp(view.eef_pos, view.eef_mat, float(np.abs(view.finger_pos).sum()), 0.0)
    return _reachable(view, shapes, _pairs(voxels, [hold], spots, pose), both_ways=False)[0]


def is_graspable(view: StateView, shapes: Shapes, thing: str) -> bool:
    """Whether something of a body fits between the fingers from above."""
    try:
        grasps(
            shapes.cloud(view, thing),
            view.scene.workspace.surface_height,
            finger_axis(view.eef_mat),
            number=1,
        )
    except GraspError:
        return False
    return True


def _places_again(spots: list[Place], failures: Sequence[Failure]) -> list[Place]:
    """Places in order, those like the ones that failed later."""
    if not any(failure.place for failure in failures):
        return spots
    failed = [Pose(f.place.pos, f.place.mat) for f in failures if f.place]
    dearer = [
        replace(s, cost=s.cost + _AGAIN * sum(_alike(Pose(s.pos, s.mat), f) for f in failed)) for s in spots
    ]
    return sorted(dearer, key=lambda spot: spot.cost)


def _varied(spots: list[Place]) -> list[Place]:
    """The best places, few of each turn of the body and each depth that it goes in, so that all are among them."""
    kept: dict[tuple, list[Place]] = {}
    for spot in spots:
        turn, depth = np.round(spot.mat[:2, :2].ravel(), 1), round(float(spot.pos @ spot.entry) / _DEPTH)
        same = kept.setdefault((*turn, *np.round(spot.entry), depth), [])
        if len(same) < _EACH:
            same.append(spot)
    return sorted((spot for same in kept.values() for spot in same), key=lambda spot: spot.cost)[:_PLACES]


def _alike(pose: Pose, other: Pose) -> bool:
    near = np.linalg.norm(pose.pos - other.pos) < _ALIKE
    return bool(near and np.linalg.norm(rotation_between(pose.mat, other.mat)) < _ALIKE_TURN)


def _free_holds(
    view: StateView,
    voxels: Voxels,
    cloud: np.ndarray,
    pose: Pose,
    thing: str,
    tilts: Sequence[np.ndarray | None],
    failures: Sequence[Failure],
) -> list[Grasp]:
    """Holds along some approaches, those in the way of others and those that failed last.

    Raises:
        GraspError: there is none.
    """
    near = voxels.points[np.linalg.norm(voxels.points - cloud.mean(axis=0), axis=1) < _NEAR]
    axis, error = finger_axis(view.eef_mat), None
    found: list[Grasp] = []
    for tilt in tilts:
        try:
            lean = 0.0 if tilt is None else 0.4 * float(np.arccos(tilt[2, 2]))
            number = (_GRASPS if tilt is None else _LEANING) * (1 + len(failures))
            own = grasps(cloud, voxels.floor, axis, tilt=tilt, name=thing, number=number, apart=0.015)
        except GraspError as problem:
            error = error or problem
            continue
        for g in own:
            price = collision_cost(voxels, near, g) + grip_cost(cloud, g) + _failed_price(pose, g, failures)
            found.append(replace(g, cost=g.cost + lean + price))
    if not found:
        raise error or GraspError(f"{thing} cannot be grasped")
    return sorted(found, key=lambda g: g.cost)


def _failed_price(pose: Pose, grasp: Grasp, failures: Sequence[Failure]) -> float:
    """What it costs that holds like this one failed; either finger may be on either side."""
    hold = Pose(pose.invert(grasp.pos_world), pose.mat.T @ grasp.mat)
    turned = Pose(hold.pos, hold.mat * [-1.0, -1.0, 1.0])
    return _AGAIN * sum(
        f.hold is not None and (_alike(hold, f.hold) or _alike(turned, f.hold)) for f in failures
    )


def _tilts(spots: list[Place], pose: Pose) -> list[np.ndarray]:
    """Rotations (3, 3) from straight down to approaches that suit places entered from a side or with a lean."""
    turns: list[np.ndarray] = []
    seen: set[tuple] = set()
    for spot in spots:
        back = pose.mat @ spot.mat.T
        side = back @ (spot.entry if spot.entry[2] > -0.5 else DOWN)
        flat = float(np.hypot(side[0], side[1]))
        key = round(np.arctan2(side[1], side[0]) / (np.pi / 6)) % 12
        if flat < 0.3 or key in seen or len(seen) == _SIDES:
            continue
        seen.add(key)
        turns += [_lean(float(np.arctan2(side[1], side[0])), tilt) for tilt in _TILTS]
    return turns


def _pairs(voxels: Voxels, holds: list[Grasp], spots: list[Place], pose: Pose) -> list[Approach]:
    """The best holds and places together, in order; a body is let fall from where the hand has room."""
    turns = np.stack([spot.mat @ pose.mat.T for spot in spots])
    at, entries = np.stack([spot.pos for spot in spots]), np.stack([spot.entry for spot in spots])
    aside = np.flatnonzero(entries[:, 2] > -0.5)
    cost = np.array([[grasp.cost + spot.cost for spot in spots] for grasp in holds])
    lifts = np.zeros(cost.shape, int)
    for h, grasp in enumerate(holds):
        mats, origins = turns @ grasp.mat, at + turns @ (grasp.pos_world - pose.pos)
        hits = np.full((len(spots), len(_LIFTS)), 1e6)
        wanting = np.ones(len(spots), bool)
        for k, lift in enumerate(_LIFTS):
            raised = origins[wanting] + [0, 0, lift + 0.008]
            hits[wanting, k] = voxels.touched(HAND, raised, mats[wanting])
            wanting &= hits[:, k] > 0
            wanting[aside] = False
            if not wanting.any():
                break
        price = 0.01 * hits + 0.3 * (hits > 0) + 4.0 * _LIFTS
        lifts[h] = price.argmin(axis=1)
        cost[h] += price.min(axis=1)
        for back in (0.08, 0.16):
            before = origins[aside] - back * entries[aside]
            cost[h, aside] += 0.01 * voxels.touched(HAND, before, mats[aside])
    best = np.argsort(cost, axis=None, kind="stable")[:_PAIRS]
    return [
        Approach(holds[h], spots[s], pose, float(_LIFTS[lifts[h, s]]), float(cost[h, s]))
        for h, s in zip(*np.unravel_index(best, cost.shape), strict=True)
    ]


def _reachable(
    view: StateView, shapes: Shapes, pairs: list[Approach], both_ways: bool = True
) -> tuple[Approach, float]:
    """The first that the arm reaches, or the one it misses least; and by how much it does, as `Arm.follow`."""
    angles = view.simulations.fields["qpos"][view.index][:7]
    best: tuple[float, Approach] | None = None
    seen: dict[tuple[int, int], tuple[np.ndarray, float]] = {}
    hopeless: set[tuple] = set()
    tried = 0
    for pair in pairs:
        for side, flip in enumerate(_WAYS_ROUND[: 1 + both_ways]):
            grasp, key = replace(pair.grasp, mat=pair.grasp.mat * flip), (id(pair.grasp), side)
            if key not in seen:
                above = grasp.pos_world - 0.10 * grasp.mat[:, 2]
                seen[key] = shapes.arm.follow(angles, [(above, grasp.mat), (grasp.pos_world, grasp.mat)])
            after, missed = seen[key]
            if best is not None and missed >= best[0]:
                continue
            turned = (*key, *np.round(pair.place.mat.ravel(), 1), *np.round(pair.place.entry))
            if turned in hopeless:
                continue
            own, tried = replace(pair, grasp=grasp), tried + 1
            clear = 0.08 if pair.place.entry[2] < -0.5 else ASIDE
            way = [
                (grasp.pos_world + [0.0, 0.0, _RAISED], own.hand_mat),
                (own.hand_pos - clear * pair.place.entry, own.hand_mat),
                (own.hand_pos, own.hand_mat),
            ]
            miss = max(missed, shapes.arm.follow(after, way)[1])
            if miss > _HOPELESS:
                hopeless.add(turned)
            if best is None or miss < best[0]:
                best = miss, own
            if miss < _MISSED:
                return own, miss
        if tried > _TRIED:
            break
    assert best is not None
    return best[1], best[0]
