"""Candidates for grasping a handle, or for pushing against it, without collisions considered."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from libero_env.expert.arm.gripper import GRIPPER
from libero_env.expert.arm.posture import wrist_twist
from libero_env.expert.grasping.handles import UP, Handle, hinge_rotation
from libero_env.geometry import Pose

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
            found = _grip_candidates(handle, mat)
        else:
            found = _push_candidates(handle, mat, _FOLLOW_RATIOS if hinged and steep else (1.0,))
        rows += [(cost + rotation_cost, mat, *rest) for cost, *rest in found]
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
