"""How to take and put something together: the pair of a hold and a place that leaves the hand room at both."""

from dataclasses import dataclass

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
_GRASPS, _PLACES, _TRIED = 30, 40, 24
_LIFTS = np.array([0.0, 0.02, 0.04, 0.07, 0.10, 0.14, 0.18])  # m, over the place, from which a body is let fall
_BEFORE = 0.06  # m, before a hold, where the hand must have room too
_AZIMUTHS, _TILTS = 8, (0.5, 1.0, 1.45)  # of approaches that are not straight down, rad
CLEAR = 0.30  # m, before a place that is entered from the side


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
    holds = _free_holds(view, voxels, cloud, thing, sideways=spots[0].entry[2] > -0.5)
    pairs = _pairs(voxels, holds, spots[:_PLACES], pose)
    return _reachable(view, shapes, pairs[skip % len(pairs) :])


def _free_holds(view: StateView, voxels: Voxels, cloud: np.ndarray, thing: str, sideways: bool) -> list[Grasp]:
    """Holds from above, and from the side where the place asks for it, those in the way of others last."""
    axis, error, found = finger_axis(view.eef_mat), None, []
    for tilt in [None, *(_tilts() if sideways else ())]:
        try:
            lean = 0.0 if tilt is None else 0.4 * float(np.arccos(tilt[2, 2]))
            own = grasps(cloud, voxels.floor, axis, tilt=tilt, name=thing)
        except GraspError as problem:
            error = error or problem
            continue
        found += [Grasp(g.pos_world, g.mat, g.width, g.cost + lean) for g in _varied(own, _GRASPS if tilt is None else 6)]
    if not found:
        raise error or GraspError(f"{thing} cannot be grasped")
    crowd = np.array([voxels.hits(_hand_at(g.pos_world, g.mat)) for g in found])
    before = np.array([voxels.hits(_hand_at(g.pos_world - _BEFORE * g.mat[:, 2], g.mat)) for g in found])
    total = [
        Grasp(g.pos_world, g.mat, g.width, g.cost + 0.03 * a + 0.03 * b + 0.3 * (a > 0))
        for g, a, b in zip(found, crowd, before, strict=True)
    ]
    return sorted(total, key=lambda g: g.cost)[: 3 * _GRASPS if sideways else _GRASPS]


def _varied(own: list[Grasp], number: int) -> list[Grasp]:
    """The best, each unlike those before it."""
    kept: dict[tuple, Grasp] = {}
    for grasp in own:
        key = (*np.round(grasp.pos_world / 0.015).astype(int), round(grasp.yaw / 0.35))
        kept.setdefault(key, grasp)
        if len(kept) == number:
            break
    return list(kept.values())


def _tilts() -> list[np.ndarray]:
    """Rotations (3, 3) from straight down to approaches that come in from the side."""
    turns = []
    for k in range(_AZIMUTHS):
        c, s = np.cos(2 * np.pi * k / _AZIMUTHS), np.sin(2 * np.pi * k / _AZIMUTHS)
        about = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        for angle in _TILTS:
            c1, s1 = np.cos(angle), np.sin(angle)
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
        hits = np.stack([voxels.hits(hand + [0, 0, lift + 0.006]) for lift in _LIFTS], axis=1)  # (P, L)
        price = 0.03 * hits + 0.3 * (hits > 0) + 4.0 * _LIFTS
        price[~down, 1:] = np.inf
        best = price.argmin(axis=1)
        for i, spot in enumerate(spots):
            outside = 0.0
            if not down[i]:
                back = voxels.hits(hand[i] - 0.08 * spot.entry) + voxels.hits(hand[i] - 0.16 * spot.entry)
                outside = 0.03 * float(back)
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
