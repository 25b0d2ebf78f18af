"""Parts that a joint moves, their handles, and the points around them, all from the model."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np

from libero_env.geometry import Pose, body_points, quat_from_axis_angle, quat_to_mat, surface_points
from libero_env.mujoco_compat import mujoco
from libero_env.sim.state import StateView

UP = np.array([0.0, 0.0, 1.0])
MAX_KNOB_RADIUS = 0.08  # [m] from the axis; a wider part swings like a door
_FINE_RADIUS, _RADIUS = 0.11, 0.32  # [m] around a handle: with dense points, and at all
_MIN_GAP = 0.0055  # [m] without points behind the bar of a handle

_body_points = lru_cache(maxsize=512)(body_points)
_subtree_points = lru_cache(maxsize=64)(surface_points)


@dataclass(frozen=True)
class Part:
    """A body that one joint moves.

    Attributes:
        slides: Whether the joint is a slide; otherwise it is a hinge.
    """

    joint: int
    body: int
    slides: bool

    @classmethod
    def from_joint(cls, model: mujoco.MjModel, joint: int) -> "Part":
        """Return the part that a joint moves."""
        slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        return cls(joint, int(model.jnt_bodyid[joint]), bool(slides))

    def value(self, view: StateView) -> float:
        """Return the position of the joint, [m] or [rad]."""
        return float(_field(view, "qpos")[view.scene.model.jnt_qposadr[self.joint]])

    def axis(self, view: StateView) -> tuple[np.ndarray, np.ndarray]:
        """Return a point on the joint's axis and its direction, world frame, (3,) each."""
        return _field(view, "xanchor")[self.joint].copy(), _field(view, "xaxis")[self.joint].copy()

    def pose(self, view: StateView) -> Pose:
        """Return the pose of the body."""
        return _body_pose(view, self.body)

    def cloud(self, view: StateView, spacing: float) -> np.ndarray:
        """Return points on the body and its descendants, `spacing` apart, world frame, (N, 3)."""
        return self.pose(view).apply(_subtree_points(view.scene.model, self.body, spacing))

    def pose_after(self, view: StateView, pose: Pose, delta: float, rotation: float | None = None) -> Pose:
        """Return a pose that is fixed to the part after the joint has moved.

        Args:
            pose: Pose now.
            delta: Motion of the joint, [m] or [rad].
            rotation: Angle by which the pose rotates on its path, [rad]; None for that of the part.
        """
        pos, mat = self.poses_after(view, pose.pos[None], pose.mat[None], delta)
        if rotation is not None and not self.slides:
            mat = hinge_rotation(self.axis(view)[1], rotation) @ pose.mat[None]
        return Pose(pos[0], mat[0])

    def poses_after(
        self,
        view: StateView,
        pos: np.ndarray,
        mat: np.ndarray,
        delta: float,
        follow_ratio: np.ndarray | float = 1.0,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return poses that are fixed to the part after the joint has moved.

        Args:
            pos: Positions now, (N, 3).
            mat: Orientations now, (N, 3, 3).
            delta: Motion of the joint, [m] or [rad].
            follow_ratio: Share of the part's rotation that each pose makes, (N,).

        Returns:
            Positions (N, 3) and orientations (N, 3, 3).
        """
        anchor, axis = self.axis(view)
        if self.slides:
            return pos + delta * axis, mat
        angles = np.broadcast_to(np.asarray(follow_ratio) * delta, len(mat))
        distinct, which = np.unique(angles, return_inverse=True)
        rotations = np.stack([hinge_rotation(axis, float(angle)) for angle in distinct])[which]
        return anchor + (pos - anchor) @ hinge_rotation(axis, delta).T, rotations @ mat


@dataclass(frozen=True)
class Handle:
    """The bar that sticks out of a part, or the part's edge; world frame, [m].

    Attributes:
        pos: Middle of the bar, (3,).
        along: Direction of the bar, unit vector (3,).
        out: Direction in which the handle moves when the part opens, unit vector (3,).
        half_length: Half the length of the bar.
        depth: Extent of the bar along `out`.
        points: Points on the bar, (N, 3).
        part_points: Points on the whole part, (M, 3).
    """

    pos: np.ndarray
    along: np.ndarray
    out: np.ndarray
    half_length: float
    depth: float
    points: np.ndarray
    part_points: np.ndarray


def find_handle(view: StateView, part: Part, direction: float) -> Handle:
    """Return what sticks out furthest where the part opens.

    Args:
        part: Part that moves.
        direction: Sign of the joint's motion that opens the part.
    """
    points = part.cloud(view, 0.004)
    out = opening_direction(view, part, direction, points)
    front = points @ out
    tip = points[front > front.max() - 0.003]
    middle = 0.5 * (tip.min(axis=0) + tip.max(axis=0))
    sideways = np.cross(UP, out)
    extents = [np.ptp(tip @ axis) for axis in (sideways, UP)]
    along, across = (sideways, UP) if extents[0] >= extents[1] else (UP, sideways)
    in_bar = np.abs((points - middle) @ across) < 0.5 * min(extents) + 0.012
    core = (np.abs((points - middle) @ along) < 0.006) & in_bar
    depths = np.sort(front.max() - front[core])
    gaps = np.flatnonzero(np.diff(depths) > _MIN_GAP)
    depth = float(depths[gaps[0]]) if len(gaps) else min(float(depths[-1]), 0.02)
    bar = points[(front > front.max() - depth - 0.002) & in_bar]
    middle = middle + out * (front.max() - middle @ out - 0.5 * depth)
    return Handle(middle, along, out, 0.5 * max(extents), depth, bar, points)


def find_inner_side(view: StateView, part: Part, direction: float) -> Handle:
    """Return the side of a door that is pushed to open it further, near its upper edge.

    Args:
        part: Door that is ajar.
        direction: Sign of the joint's motion that opens the door.
    """
    points = part.cloud(view, 0.005)
    anchor, axis = part.axis(view)
    inward = -opening_direction(view, part, direction, points)
    outer = np.cross(inward, axis)
    if outer @ (points.mean(axis=0) - anchor) <= 0:
        outer = np.cross(axis, inward)
    radius = (points - anchor) @ outer
    pos = anchor + 0.6 * radius.max() * outer
    pos = pos + (points[:, 2].max() - 0.03 - pos[2]) * UP
    near = (np.abs((points - pos) @ outer) < 0.015) & (np.abs(points[:, 2] - pos[2]) < 0.015)
    pos = pos + ((points[near] - pos) @ inward).max() * inward
    return Handle(pos, outer, inward, 0.3 * radius.max(), 0.0, points[near], points)


def opening_direction(view: StateView, part: Part, direction: float, points: np.ndarray) -> np.ndarray:
    """Return the direction in which the outer end of a part moves, unit vector (3,).

    Args:
        part: Part that moves.
        direction: Sign of the joint's motion.
        points: Points on the part, world frame, (N, 3).
    """
    anchor, axis = part.axis(view)
    if part.slides:
        return direction * axis
    arms = points - anchor
    arms -= np.outer(arms @ axis, axis)
    radius = np.linalg.norm(arms, axis=1)
    arm = arms[radius > 0.5 * radius.max()].mean(axis=0)
    out = direction * np.cross(axis, arm)
    return out / np.linalg.norm(out)


def is_knob(view: StateView, part: Part) -> bool:
    """Return whether a part is a knob: its axis is vertical and all of it is close to the axis."""
    if part.slides:
        return False
    anchor, axis = part.axis(view)
    arms = part.cloud(view, 0.01) - anchor
    return bool(abs(axis[2]) > 0.9 and np.linalg.norm(np.cross(arms, axis), axis=1).max() < MAX_KNOB_RADIUS)


def nearby_points(
    view: StateView, centre: np.ndarray, names: Iterable[str], excluded_body: int = -1
) -> np.ndarray:
    """Return points on objects and fixtures near `centre` (3,), fewer further away, world frame, (N, 3).

    Args:
        centre: Middle of the space, (3,).
        names: Names of objects and fixtures.
        excluded_body: Index of a body that is left out.
    """
    model, clouds = view.scene.model, [np.zeros((0, 3))]
    bodies = [int(b) for name in names for b in view.scene.bodies[name] if b != excluded_body]
    shells = ((0.009, 0.0, _FINE_RADIUS), (0.02, _FINE_RADIUS, _RADIUS))
    for b, (spacing, low, high) in product(bodies, shells):
        points = _body_pose(view, b).apply(_body_points(model, b, spacing))
        distance = np.linalg.norm(points - centre, axis=1)
        clouds.append(points[(distance >= low) & (distance < high)])
    return np.concatenate(clouds)


def hinge_rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation (3, 3) by an angle, [rad], about a unit axis (3,), computed as MuJoCo does."""
    return quat_to_mat(quat_from_axis_angle(axis, angle))


def _body_pose(view: StateView, body: int) -> Pose:
    return Pose(_field(view, "xpos")[body].copy(), quat_to_mat(_field(view, "xquat")[body]))


def _field(view: StateView, name: str) -> np.ndarray:
    return view.simulations.fields[name][view.index]
