"""How to take and put something together: the pair of a hold and a place that leaves the hand room at both."""

from dataclasses import dataclass, replace

import numpy as np

from libero_env.expert.clearance import Voxels, hand_points
from libero_env.expert.geometry import Pose
from libero_env.expert.grasp import Grasp, GraspError, crowding, grasps
from libero_env.expert.motion import finger_axis
from libero_env.expert.place import DOWN, Place, places
from libero_env.expert.shapes import DENSE, Shapes, pose_of
from libero_env.predicates import StateView
from libero_env.problem import Atom


def _lean(azimuth: float, tilt: float) -> np.ndarray:
    """Rotation (3, 3) that takes straight down to an approach that leans towards a horizontal direction."""
    c, s, c1, s1 = np.cos(azimuth), np.sin(azimuth), np.cos(tilt), np.sin(tilt)
    about = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return about @ np.array([[c1, 0.0, -s1], [0.0, 1.0, 0.0], [s1, 0.0, c1]]) @ about.T


_HAND = hand_points()
_CROWDED = 1.0  # cost of a hold from which on the hand tries to lean away from what is in its way
_RING = [_lean(2 * np.pi * k / 8, tilt) for tilt in (0.35, 0.6) for k in range(8)]
_GRASPS, _PLACES, _TRIED = 20, 24, 24
_LIFTS = np.array(
    [0.0, 0.02, 0.04, 0.07, 0.10, 0.14, 0.18]
)  # m, over the place, from which a body is let fall
_BEFORE = (0.04, 0.08, 0.13)  # m, before a hold, where the hand must have room too
_TILTS = (0.5, 0.8, 1.1, 1.45)  # rad, of approaches that are not straight down
_NEAR = 0.3  # m, around a body: what is further away is in no hand's way
ASIDE = 0.16  # m, before a place that is entered from a side
_SIDES = 4  # directions of such approaches that are tried


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


def choose_approach(
    view: StateView, shapes: Shapes, atom: Atom, share: tuple[int, int] = (0, 1), skip: int = 0
) -> Approach:
    """The best way to make an (On thing place) or (In thing place) true; the same input gives the same answer.

    Args:
        view: the state.
        shapes: of the scene.
        atom: what shall hold.
        share: see `places`.
        skip: how many ways failed before; the next ones are taken.

    Raises:
        GraspError: nothing of the body fits between the fingers.
        PlaceError: there is no room for it.
    """
    thing = atom.args[0]
    cloud, pose = shapes.cloud(view, thing), pose_of(view, thing)
    floor = view.scene.workspace.surface_height
    voxels = Voxels(shapes.others(view, thing, spacing=DENSE), floor, pose.pos)
    spots = places(view, voxels, cloud, pose, atom, share)
    holds = _free_holds(view, voxels, cloud, thing, _tilts(spots[:_PLACES], pose))
    pairs = _pairs(voxels, holds, spots[:_PLACES], pose)
    return _reachable(view, shapes, pairs[skip % len(pairs) :])


def takeable(view: StateView, shapes: Shapes, thing: str) -> bool:
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


def _free_holds(
    view: StateView, voxels: Voxels, cloud: np.ndarray, thing: str, tilts: list[np.ndarray]
) -> list[Grasp]:
    """Holds from above and along other approaches, those in the way of others last."""
    near = voxels.points[np.linalg.norm(voxels.points - cloud.mean(axis=0), axis=1) < _NEAR]
    axis, error = finger_axis(view.eef_mat), None
    found: list[Grasp] = []
    for tilt in [None, *tilts, *_RING]:
        if tilt is _RING[0] and any(grasp.cost < _CROWDED for grasp in found):
            break  # there is a hold that nothing is in the way of
        try:
            lean = 0.0 if tilt is None else 0.4 * float(np.arccos(tilt[2, 2]))
            number = _GRASPS if tilt is None else 4
            own = grasps(cloud, voxels.floor, axis, tilt=tilt, name=thing, number=number, apart=0.015)
        except GraspError as problem:
            error = error or problem
            continue
        found += [replace(g, cost=g.cost + lean + _crowd_price(voxels, near, g)) for g in own]
    if not found:
        raise error or GraspError(f"{thing} cannot be grasped")
    return sorted(found, key=lambda g: g.cost)


def _crowd_price(voxels: Voxels, near: np.ndarray, grasp: Grasp) -> float:
    """What it costs that others are in the hand's way, at the hold and before it."""
    crowd = crowding(near, grasp.pos_world, grasp.mat)
    below = (_hand_at(grasp.pos_world, grasp.mat)[:, 2] < voxels.floor).sum()
    price = 20.0 * crowd + 0.3 * (crowd > 0) + 0.01 * float(below) + 0.3 * (below > 0)
    ways = [crowding(near, grasp.pos_world - back * grasp.mat[:, 2], grasp.mat) for back in _BEFORE]
    return price + 5.0 * max(ways) + 0.1 * (max(ways) > 0)


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


def _hand_at(pos: np.ndarray, mat: np.ndarray) -> np.ndarray:
    return pos + _HAND @ mat.T


def _pairs(voxels: Voxels, holds: list[Grasp], spots: list[Place], pose: Pose) -> list[Approach]:
    """Holds and places together, the best first; a body is let fall from where the hand has room."""
    found = []
    turns = np.stack([spot.mat @ pose.mat.T for spot in spots])
    entries = np.stack([spot.entry for spot in spots])
    down = entries[:, 2] < -0.5
    for grasp in holds:
        mats = turns @ grasp.mat
        origins = np.stack([spot.pos for spot in spots]) + turns @ (grasp.pos_world - pose.pos)
        hits = np.full((len(spots), len(_LIFTS)), 1e6)
        wanting = np.ones(len(spots), bool)
        for k, lift in enumerate(_LIFTS):
            raised = origins[wanting] + [0, 0, lift + 0.008]
            hits[wanting, k] = voxels.touched(_HAND, raised, mats[wanting])
            wanting &= (hits[:, k] > 0) & down
            if not wanting.any():
                break
        price = 0.01 * hits + 0.3 * (hits > 0) + 4.0 * _LIFTS
        best = price.argmin(axis=1)
        befores = origins[:, None] - np.array([0.08, 0.16])[:, None] * entries[:, None]
        for i, spot in enumerate(spots):
            outside = 0.0
            if not down[i]:
                outside = 0.01 * float(voxels.touched(_HAND, befores[i], mats[[i, i]]).sum())
            cost = grasp.cost + spot.cost + float(price[i, best[i]]) + outside
            found.append(Approach(grasp, spot, pose, float(_LIFTS[best[i]]), cost))
    return sorted(found, key=lambda approach: approach.cost)


def _reachable(view: StateView, shapes: Shapes, pairs: list[Approach]) -> Approach:
    """The first that the arm reaches, or the one it misses least."""
    angles = view.simulations.fields["qpos"][view.index][:7]
    best: tuple[float, Approach] | None = None
    seen: dict[tuple[int, int], tuple[np.ndarray, float]] = {}
    tried = 0
    for pair in pairs:
        for side, flip in enumerate((np.ones(3), np.array([-1.0, -1.0, 1.0]))):  # the hand turned by half
            grasp, key = replace(pair.grasp, mat=pair.grasp.mat * flip), (id(pair.grasp), side)
            if key not in seen:
                above = grasp.pos_world - 0.10 * grasp.mat[:, 2]
                seen[key] = shapes.arm.follow(angles, [(above, grasp.mat), (grasp.pos_world, grasp.mat)])
            after, missed = seen[key]
            if best is not None and missed >= best[0]:
                continue
            own, tried = replace(pair, grasp=grasp), tried + 1
            clear = 0.08 if pair.place.entry[2] < -0.5 else ASIDE
            way = [(own.hand_pos - clear * pair.place.entry, own.hand_mat), (own.hand_pos, own.hand_mat)]
            miss = max(missed, shapes.arm.follow(after, way)[1])
            if best is None or miss < best[0]:
                best = miss, own
            if miss < 1e-4:
                return own
        if tried > _TRIED:
            break
    assert best is not None
    return best[1]
