"""Parts that a joint moves, their handles, and what is around them; all from the model."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import mujoco
import numpy as np

from libero_env.geometry import Pose, body_points, quat_from_axis_angle, quat_to_mat, surface_points
from libero_env.sim.state import StateView

UP = np.array([0.0, 0.0, 1.0])
KNOB_RADIUS = 0.08  # m, from its axis; what is wider swings like a door
_FINE, _NEAR = 0.11, 0.32  # m, around the handle: looked at closely, and at all
_BEHIND = 0.0055  # m without points: the space behind a handle's bar


@dataclass(frozen=True)
class Part:
    """A body that one joint moves."""

    joint: int
    body: int
    slides: bool

    @classmethod
    def of(cls, model: mujoco.MjModel, joint: int) -> "Part":
        """The part of a joint."""
        slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        return cls(joint, int(model.jnt_bodyid[joint]), bool(slides))

    def value(self, view: StateView) -> float:
        """Position of the joint, m or rad."""
        return float(_field(view, "qpos")[view.scene.model.jnt_qposadr[self.joint]])

    def axis(self, view: StateView) -> tuple[np.ndarray, np.ndarray]:
        """Point on the joint's axis and its direction, world frame, (3,) each."""
        return _field(view, "xanchor")[self.joint].copy(), _field(view, "xaxis")[self.joint].copy()

    def pose(self, view: StateView) -> Pose:
        """Pose of the body."""
        return _body_pose(view, self.body)

    def cloud(self, view: StateView, spacing: float) -> np.ndarray:
        """Points on it and on what hangs on it, world frame, (N, 3)."""
        return self.pose(view).apply(_part_points(view.scene.model, self.body, spacing))

    def moved(self, view: StateView, pose: Pose, delta: float, turn: float | None = None) -> Pose:
        """Where what is fixed to the part comes to when the joint moves by `delta`, m or rad.

        Args:
            view: the state.
            pose: of what is fixed.
            delta: of the joint.
            turn: rad, by which it turns, where that is not `delta`.
        """
        pos, mat = self.moved_all(view, pose.pos[None], pose.mat[None], delta)
        if turn is not None and not self.slides:
            mat = turned(self.axis(view)[1], turn) @ pose.mat[None]
        return Pose(pos[0], mat[0])

    def moved_all(
        self,
        view: StateView,
        pos: np.ndarray,
        mat: np.ndarray,
        delta: float,
        follow: np.ndarray | float = 1.0,
    ) -> tuple[np.ndarray, np.ndarray]:
        """The same of many poses, (N, 3) and (N, 3, 3), of which each turns by its share `follow` (N,) of `delta`."""
        anchor, axis = self.axis(view)
        if self.slides:
            return pos + delta * axis, mat
        angles = np.broadcast_to(np.asarray(follow) * delta, len(mat))
        shares, which = np.unique(angles, return_inverse=True)
        turns = np.stack([turned(axis, float(angle)) for angle in shares])[which]
        return anchor + (pos - anchor) @ turned(axis, delta).T, turns @ mat


@dataclass(frozen=True)
class Handle:
    """The bar that sticks out of a part, or its edge. World frame, m."""

    pos: np.ndarray  # (3,) middle of the bar
    along: np.ndarray  # (3,) unit, its long direction
    out: np.ndarray  # (3,) unit, where it goes when the part opens
    half: float  # m, half its length
    depth: float  # m, of the bar along `out`
    points: np.ndarray  # (N, 3) on it
    part: np.ndarray  # (M, 3) on all of the part


def find_handle(view: StateView, part: Part, way: float) -> Handle:
    """What sticks out furthest where the part opens.

    Args:
        view: the state.
        part: what moves.
        way: sign of the joint's motion that opens.
    """
    points = part.cloud(view, 0.004)
    out = opening_direction(view, part, way, points)
    front = points @ out
    slab = points[front > front.max() - 0.003]
    middle = 0.5 * (slab.min(axis=0) + slab.max(axis=0))
    sideways = np.cross(UP, out)
    spans = [np.ptp(slab @ axis) for axis in (sideways, UP)]
    along, across = (sideways, UP) if spans[0] >= spans[1] else (UP, sideways)
    core = np.abs((points - middle) @ along) < 0.006
    core &= np.abs((points - middle) @ across) < 0.5 * min(spans) + 0.012
    depths = np.sort(front.max() - front[core])
    gaps = np.flatnonzero(np.diff(depths) > _BEHIND)
    depth = float(depths[gaps[0]]) if len(gaps) else min(float(depths[-1]), 0.02)
    mask = (front > front.max() - depth - 0.002) & (
        np.abs((points - middle) @ across) < 0.5 * min(spans) + 0.012
    )
    middle = middle + out * (front.max() - middle @ out - 0.5 * depth)
    return Handle(middle, along, out, 0.5 * max(spans), depth, points[mask], points)


def inner_side(view: StateView, part: Part, way: float) -> Handle:
    """The side of a door that is pushed to open it further, near its upper edge."""
    points = part.cloud(view, 0.005)
    anchor, axis = part.axis(view)
    inward = -opening_direction(view, part, way, points)
    outer = (
        np.cross(inward, axis)
        if np.cross(inward, axis) @ (points.mean(axis=0) - anchor) > 0
        else np.cross(axis, inward)
    )
    radius = (points - anchor) @ outer
    at = anchor + 0.6 * radius.max() * outer
    at = at + (points[:, 2].max() - 0.03 - at[2]) * UP
    near = (np.abs((points - at) @ outer) < 0.015) & (np.abs(points[:, 2] - at[2]) < 0.015)
    at = at + ((points[near] - at) @ inward).max() * inward
    return Handle(at, outer, inward, 0.3 * radius.max(), 0.0, points[near], points)


def opening_direction(view: StateView, part: Part, way: float, points: np.ndarray) -> np.ndarray:
    """Where the outer end of a part goes when its joint moves in the direction `way`, (3,) unit."""
    anchor, axis = part.axis(view)
    if part.slides:
        return way * axis
    arms = points - anchor
    arms -= np.outer(arms @ axis, axis)
    reach = np.linalg.norm(arms, axis=1)
    arm = arms[reach > 0.5 * reach.max()].mean(axis=0)
    out = way * np.cross(axis, arm)
    return out / np.linalg.norm(out)


def is_knob(view: StateView, part: Part) -> bool:
    """Whether a part turns about itself under the hand: its axis is upright and all of it is close to that."""
    if part.slides:
        return False
    anchor, axis = part.axis(view)
    arms = part.cloud(view, 0.01) - anchor
    return bool(abs(axis[2]) > 0.9 and np.linalg.norm(np.cross(arms, axis), axis=1).max() < KNOB_RADIUS)


def surroundings(view: StateView, body: int, centre: np.ndarray, names: Iterable[str]) -> np.ndarray:
    """Points near `centre` on objects and fixtures but one body of them, world frame, (N, 3); fewer further away."""
    model, clouds = view.scene.model, [np.zeros((0, 3))]
    bodies = [int(b) for name in names for b in view.scene.bodies[name] if b != body]
    for b, (spacing, low, high) in product(bodies, ((0.009, 0.0, _FINE), (0.02, _FINE, _NEAR))):
        points = _body_pose(view, b).apply(_own_points(model, b, spacing))
        distance = np.linalg.norm(points - centre, axis=1)
        clouds.append(points[(distance >= low) & (distance < high)])
    return np.concatenate(clouds)


@lru_cache(maxsize=512)
def _own_points(model: mujoco.MjModel, body: int, spacing: float) -> np.ndarray:
    return body_points(model, body, spacing)


@lru_cache(maxsize=64)
def _part_points(model: mujoco.MjModel, body: int, spacing: float) -> np.ndarray:
    return surface_points(model, body, spacing)


def _body_pose(view: StateView, body: int) -> Pose:
    return Pose(_field(view, "xpos")[body].copy(), quat_to_mat(_field(view, "xquat")[body]))


def _field(view: StateView, name: str) -> np.ndarray:
    return view.simulations.fields[name][view.index]


def turned(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation (3, 3) by an angle, rad, about a unit axis (3,)."""
    return quat_to_mat(quat_from_axis_angle(axis, angle))
