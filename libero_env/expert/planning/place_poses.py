"""Where to put something: poses of a body that make a goal's atom true, found by letting its shape down there."""

from dataclasses import dataclass, replace

import numpy as np

from libero_env.errors import LiberoError
from libero_env.expert.clearance import Voxels, underside, upper_side
from libero_env.expert.shapes import pose_of
from libero_env.geometry import Pose
from libero_env.sim.regions import Box, contains, is_over, region_boxes
from libero_env.sim.state import StateView
from libero_env.tasks.problem import Atom

DOWN = np.array([0.0, 0.0, -1.0])
_YAWS = 12
_GRID = 7  # spots along each side of a region
_LIFT = 0.008  # m, off what carries it when a body is tested for room
_SIDEWAYS = tuple(np.arange(0.02, 0.29, 0.025))  # m, of the way in from a side that must be free
_NEAR = 0.024  # m, between the origins of things that stand on one another
_LEANS = (0.45, 0.8, 1.3)  # rad, of a body that fits nowhere upright
_EDGE, _WITHIN = 40.0, 0.02  # cost of each m that a spot is nearer to the edge of its region than so many m
_CROWDED = 0.04  # share of a body's points that may seem to lie in others, as voxels are coarse
_UNDER = 0.15  # share of a body's columns that may reach into what hangs over them
_UNCARRIED = 2.0  # cost of a lean with nothing under the middle of the body
_ENOUGH = 80  # points of a body that are tested


class PlaceError(LiberoError):
    """A body has no room where the goal wants it."""


@dataclass(frozen=True)
class Place:
    """The body's origin at `pos` (3,), m, turned by `mat` (3, 3); it comes there along `entry` (3,)."""

    pos: np.ndarray
    mat: np.ndarray
    entry: np.ndarray
    cost: float


def places(
    view: StateView,
    voxels: Voxels,
    cloud: np.ndarray,
    pose: Pose,
    atom: Atom,
    share: tuple[int, int] = (0, 1),
) -> list[Place]:
    """Poses at which the atom would hold, the best first; upright as the body is now, turned about the vertical.

    Args:
        view: the state.
        voxels: of everything but the body.
        cloud: points on the body, world frame, (N, 3).
        pose: of the body.
        atom: (On thing place) or (In thing place).
        share: which of how many things that go to this place, so that each leaves room for the others.

    Raises:
        PlaceError: it fits nowhere.
    """
    frame = _directions(view, atom.args[1])
    crowded = _CROWDED if not view.is_entity(atom.args[1]) else 3 * _CROWDED
    square = _square(cloud, frame[0])
    upright = [(turn, 0.1 * abs(angle), None) for angle, turn in _turns(_YAWS)]
    found = _found(view, voxels, cloud, pose, atom, share, upright, frame, crowded)
    if not found:
        upright += [(turn, 0.1 * abs(angle), None) for angle, turn in square]
        found = _found(view, voxels, cloud, pose, atom, share, upright[_YAWS:], frame, crowded)
    if not found and not _flat_region(view, atom.args[1]):
        yaws = [*square, *_turns(_YAWS // 2)]
        for angle in _LEANS:
            turns = [(_lean(d, angle) @ turn, 0.1 * abs(a), d) for d in frame for a, turn in yaws]
            found += _found(view, voxels, cloud, pose, atom, share, turns, frame, crowded)
    if not found:
        found = _found(view, voxels, cloud, pose, atom, share, upright, frame, 8 * crowded)
    if not found:
        raise PlaceError(f"({atom.predicate} {' '.join(atom.args)}): there is no room for {atom.args[0]}")
    lowest = min(place.pos[2] for place in found)
    deep = [replace(place, cost=place.cost + 3.0 * (place.pos[2] - lowest)) for place in found]
    return sorted(deep, key=lambda place: place.cost)


Turn = tuple[np.ndarray, float, np.ndarray | None]  # (3, 3) to apply, its cost, the only way in that it suits


def _found(
    view: StateView,
    voxels: Voxels,
    cloud: np.ndarray,
    pose: Pose,
    atom: Atom,
    share: tuple[int, int],
    turns: list[Turn],
    directions: list[np.ndarray],
    crowded: float,
) -> list[Place]:
    """Places of a body turned in these ways, of which at most a share may seem to lie in others."""
    found = []
    step = max(1, len(cloud) // _ENOUGH)
    for turn, price, only in turns:
        body = (cloud - pose.pos) @ turn.T
        for spots, costs, below, holds in _regions(view, atom, body, share):
            heights = voxels.drop(underside(body), spots, below)
            keep = [
                i
                for i, (xy, z) in enumerate(zip(spots, heights, strict=True))
                if holds(np.array([*xy, z + 0.003]))
            ]
            if not keep:
                continue
            origins = np.column_stack([spots, heights])[keep]
            under = voxels.overhead(upper_side(body) + [0, 0, _LIFT], origins, below)
            costs, origins = (costs[keep] + 2.0 * under)[under < _UNDER], origins[under < _UNDER]
            if not len(origins):
                continue
            if only is not None:  # it falls back: its middle should have something under it
                middle = body.mean(axis=0)[None] * [1, 1, 0] + [0, 0, body[:, 2].min()]
                costs = costs + _UNCARRIED * (
                    origins[:, 2] - voxels.drop(middle, origins[:, :2], below) > 0.01
                )
            ways = directions if only is None else [only]
            entries, crowd = _ways_in(voxels, body[::step], origins, ways, crowded)
            for pos, cost, entry, full in zip(origins, costs, entries, crowd, strict=True):
                if entry is not None:
                    aside = 0.5 * (entry[2] > -0.5)
                    found.append(Place(pos, turn @ pose.mat, entry, cost + price + 8.0 * full + aside))
    return found


def _turns(number: int) -> list[tuple[float, np.ndarray]]:
    """Turns about the vertical: (angle, (3, 3))."""
    angles = [2 * np.pi * k / number for k in range(number)]
    angles = [a - 2 * np.pi if a > np.pi else a for a in angles]
    return [(a, _about_vertical(a)) for a in angles]


def _square(cloud: np.ndarray, side: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """Turns about the vertical that put the narrowest way through a body along or across a direction."""
    plan = np.unique(np.round(cloud[:, :2], 3), axis=0)
    yaws = np.pi * np.arange(90) / 90
    widths = np.ptp(plan @ [np.cos(yaws), np.sin(yaws)], axis=0)
    first = np.arctan2(side[1], side[0]) - yaws[widths.argmin()]
    angles = [(first + k * np.pi / 2 + np.pi) % (2 * np.pi) - np.pi for k in range(4)]
    return [(a, _about_vertical(a)) for a in angles]


def _lean(entry: np.ndarray, angle: float) -> np.ndarray:
    """Rotation (3, 3) by which the top of a body leans back, away from where it goes."""
    axis = np.cross(entry, [0.0, 0.0, 1.0])
    x, y, _ = axis
    cross = np.array([[0, 0, y], [0, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _regions(view: StateView, atom: Atom, body: np.ndarray, share: tuple[int, int]):
    """(spots (S, 2), costs (S,), height below which things carry, test of an origin) for each part of a place."""
    target = atom.args[1]
    if view.is_entity(target):
        xy = view.body_pos(target)[:2]
        offsets = np.array([(0, 0), (0.01, 0), (-0.01, 0), (0, 0.01), (0, -0.01)])
        yield (
            xy + offsets,
            8.0 * np.linalg.norm(offsets, axis=1),
            np.inf,
            lambda origin: bool(np.linalg.norm(origin[:2] - xy) < _NEAR),
        )
        return
    test = contains if atom.predicate == "In" else is_over
    for box in region_boxes(view, target):
        centre, mat, size = box
        half = np.abs(mat @ size)
        u, v = (np.linspace(-0.9, 0.9, _GRID) * h for h in half[:2])
        offsets = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        costs = 4.0 * np.linalg.norm(offsets - _wanted(half, share), axis=1)
        costs += _EDGE * np.maximum(_WITHIN - (half[:2] - np.abs(offsets)).min(axis=1), 0.0)
        below = centre[2] + (0.5 * half[2] if atom.predicate == "In" else 0.06)
        if _flat_region(view, target):
            below = view.scene.workspace.surface_height + 0.02
        yield centre[:2] + offsets, costs, below, lambda origin, box=box: test(_smaller(box), origin)


def _wanted(half: np.ndarray, share: tuple[int, int]) -> np.ndarray:
    """Where in a region one of several things should stand: along its longer side, (2,) from the middle."""
    which, number = share
    offset = np.zeros(2)
    if number > 1:
        axis = int(half[1] > half[0])
        offset[axis] = 0.62 * half[axis] * (2 * which / (number - 1) - 1)
    return offset


def _flat_region(view: StateView, address: str) -> bool:
    region = view.scene.problem.region(address)
    return region is not None and bool(region.ranges)


def _smaller(box: Box) -> Box:
    centre, mat, size = box
    half = np.abs(mat @ size)
    return centre, mat, np.where(np.abs(size) > 0.012, np.maximum(size - 0.1 * half.min(), 0.7 * size), size)


def _directions(view: StateView, target: str) -> list[np.ndarray]:
    """The four horizontal directions along the sides of what a place belongs to."""
    owner = view.scene.owner(target)
    x = pose_of(view, owner).mat[:, 0] if owner is not None else np.array([1.0, 0.0, 0.0])
    x = np.array([x[0], x[1], 0.0]) / max(float(np.hypot(x[0], x[1])), 1e-9)
    y = np.array([-x[1], x[0], 0.0])
    return [x, -x, y, -y]


def _ways_in(
    voxels: Voxels, body: np.ndarray, origins: np.ndarray, directions: list[np.ndarray], crowded: float
) -> tuple[list[np.ndarray | None], np.ndarray]:
    """For each origin (S, 3) the direction along which the body comes in, None for none; and the share in walls."""
    standing = origins[:, None] + body[None] + [0, 0, _LIFT]
    crowd = voxels.hits(standing) / len(body)
    entries: list[np.ndarray | None] = [None] * len(origins)
    roofed = voxels.roofed(standing).mean(axis=1)
    for i in np.flatnonzero((crowd < crowded) & (roofed <= np.maximum(crowd, 0.03))):
        entries[i] = DOWN
    for entry in () if any(entry is not None for entry in entries) else directions:
        open_ = [i for i in range(len(origins)) if entries[i] is None and crowd[i] < crowded]
        if not open_:
            break
        free = np.ones(len(open_), bool)
        for length in _SIDEWAYS:
            free &= voxels.hits(standing[open_] - length * entry) <= np.maximum(crowd[open_], 0.03) * len(
                body
            )
        for i, good in zip(open_, free, strict=True):
            if good:
                entries[i] = entry
    return entries, crowd


def _about_vertical(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
