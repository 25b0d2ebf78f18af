"""How to take and put something together: the pair of a hold and a place that leaves the hand room at both."""

from dataclasses import dataclass, replace

import numpy as np

from libero_env.expert.clearance import Voxels, hand_points
from libero_env.expert.geometry import Pose
from libero_env.expert.grasp import Grasp, GraspError, grasps
from libero_env.expert.motion import finger_axis
from libero_env.expert.place import DOWN, Place, places
from libero_env.expert.shapes import DENSE, Shapes, pose_of
from libero_env.predicates import StateView
from libero_env.problem import Atom

_HAND = hand_points()
_GRASPS, _PLACES, _TRIED = 20, 24, 24
_LIFTS = np.array([0.0, 0.02, 0.04, 0.07, 0.10, 0.14, 0.18])  # m, over the place, from which a body is let fall
_BEFORE = (0.04, 0.08, 0.13)  # m, before a hold, where the hand must have room too
_TILTS = (0.5, 1.0, 1.45)  # rad, of approaches that are not straight down
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
    sides = [pose.mat @ spot.mat.T @ spot.entry for spot in spots[:_PLACES] if spot.entry[2] > -0.5]
    holds = _free_holds(view, voxels, cloud, thing, _tilts(sides))
    pairs = _pairs(voxels, holds, spots[:_PLACES], pose)
    return _reachable(view, shapes, pairs[skip % len(pairs) :])


def takeable(view: StateView, shapes: Shapes, thing: str) -> bool:
    """Whether something of a body fits between the fingers from above."""
    try:
        grasps(shapes.cloud(view, thing), view.scene.workspace.surface_height, finger_axis(view.eef_mat), number=1)
    except GraspError:
        return False
    return True


def _free_holds(
    view: StateView, voxels: Voxels, cloud: np.ndarray, thing: str, tilts: list[np.ndarray]
) -> list[Grasp]:
    """Holds from above and along other approaches, those in the way of others last."""
    axis, error, found = finger_axis(view.eef_mat), None, []
    for tilt in [None, *tilts]:
        try:
            lean = 0.0 if tilt is None else 0.4 * float(np.arccos(tilt[2, 2]))
            number = _GRASPS if tilt is None else 6
            own = grasps(cloud, voxels.floor, axis, tilt=tilt, name=thing, number=number, apart=0.015)
        except GraspError as problem:
            error = error or problem
            continue
        found += [replace(g, cost=g.cost + lean) for g in own]
    if not found:
        raise error or GraspError(f"{thing} cannot be grasped")
    crowd = np.array([voxels.touched(_hand_at(g.pos_world, g.mat)) for g in found])
    before = np.array(
        [sum(voxels.touched(_hand_at(g.pos_world - back * g.mat[:, 2], g.mat)) for back in _BEFORE) for g in found]
    )
    total = [
        replace(g, cost=g.cost + 0.01 * a + 0.01 * b + 0.3 * (a > 0) + 0.2 * (b > 0))
        for g, a, b in zip(found, crowd, before, strict=True)
    ]
    return sorted(total, key=lambda g: g.cost)[: 2 * _GRASPS if tilts else _GRASPS]


def _tilts(sides: list[np.ndarray]) -> list[np.ndarray]:
    """Rotations (3, 3) from straight down to approaches that lean towards horizontal directions, each once."""
    turns, seen = [], set()
    for side in sides:
        angle = float(np.arctan2(side[1], side[0]))
        key = round(angle / (np.pi / 6)) % 12
        if key in seen or len(seen) == _SIDES:
            continue
        seen.add(key)
        c, s = np.cos(angle), np.sin(angle)
        about = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        for tilt in _TILTS:
            c1, s1 = np.cos(tilt), np.sin(tilt)
            lean = np.array([[c1, 0.0, -s1], [0.0, 1.0, 0.0], [s1, 0.0, c1]])  # takes down to (s1, 0, -c1)
            turns.append(about @ lean @ about.T)
    return turns


def _hand_at(pos: np.ndarray, mat: np.ndarray) -> np.ndarray:
    return pos + _HAND @ mat.T


def _pairs(voxels: Voxels, holds: list[Grasp], spots: list[Place], pose: Pose) -> list[Approach]:
    """Holds and places together, the best first; a body is let fall from where the hand has room."""
    found = []
    turns = np.stack([spot.mat @ pose.mat.T for spot in spots])
    down = np.array([spot.entry[2] < -0.5 for spot in spots])
    for grasp in holds:
        mats = turns @ grasp.mat
        origins = np.stack([spot.pos for spot in spots]) + turns @ (grasp.pos_world - pose.pos)
        hand = origins[:, None] + np.einsum("nk,pik->pni", _HAND, mats)
        hits = np.full((len(spots), len(_LIFTS)), 1e6)
        wanting = np.ones(len(spots), bool)
        for k, lift in enumerate(_LIFTS):
            hits[wanting, k] = voxels.touched(hand[wanting] + [0, 0, lift + 0.008])
            wanting &= (hits[:, k] > 0) & down
            if not wanting.any():
                break
        price = 0.01 * hits + 0.3 * (hits > 0) + 4.0 * _LIFTS
        best = price.argmin(axis=1)
        for i, spot in enumerate(spots):
            outside = 0.0
            if not down[i]:
                back = voxels.touched(hand[i] - 0.08 * spot.entry) + voxels.touched(hand[i] - 0.16 * spot.entry)
                outside = 0.01 * float(back)
            cost = grasp.cost + spot.cost + float(price[i, best[i]]) + outside
            found.append(Approach(grasp, spot, pose, float(_LIFTS[best[i]]), cost))
    return sorted(found, key=lambda approach: approach.cost)


def _reachable(view: StateView, shapes: Shapes, pairs: list[Approach]) -> Approach:
    """The first that the arm reaches, or the one it misses least."""
    angles = view.simulations.fields["qpos"][view.index][:7]
    best, seen = None, {}
    for pair in pairs[:_TRIED]:
        grasp, entry = pair.grasp, pair.place.entry
        key = id(grasp)
        if key not in seen:
            above = grasp.pos_world - 0.10 * grasp.mat[:, 2]
            seen[key] = shapes.arm.follow(angles, [(above, grasp.mat), (grasp.pos_world, grasp.mat)])
        after, missed = seen[key]
        clear = 0.08 if entry[2] < DOWN[2] + 0.5 else 0.16
        way = [(pair.hand_pos - clear * entry, pair.hand_mat), (pair.hand_pos, pair.hand_mat)]
        miss = max(missed, shapes.arm.follow(after, way)[1])
        if best is None or miss < best[0]:
            best = miss, pair
        if miss < 1e-4:
            break
    assert best is not None
    return best[1]
