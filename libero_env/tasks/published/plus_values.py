"""Poses of the camera and of the arm in LIBERO-Plus, computed from the numbers of an id.

Its code rounds positions and quaternions to four decimals after each of up to five steps, and so does this. All its
variants have that, those too whose camera does not turn. The point that cameras turn about is 0.8 m above the floor in
all scenes, those on the floor included.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from libero_env.assets.robot import REST_QPOS
from libero_env.errors import InvalidInputError, UnknownNameError
from libero_env.geometry import quat_from_axis_angle, quat_multiply, quat_rotate
from libero_env.storage import read_yaml
from libero_env.tasks.published.plus_id import POSES, ViewChange

_PIVOT = np.array([0.0, 0.0, 0.8])  # [m]
_DECIMALS = 4
_Y, _Z = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
_POSE_SEED, _POSES_PER_STEP, _STEP = (
    42,
    100,
    0.1,
)  # [rad] poses 1 to 100 are one step from rest, 101 to 200 two, ...


class CameraPose(NamedTuple):
    """Pose of a camera in the world frame.

    Attributes:
        pos: Position, (3,) [m].
        quat_wxyz: Orientation, (4,), of length 1 up to its rounding; the camera looks along its -z, its y is up.
    """

    pos: np.ndarray
    quat_wxyz: np.ndarray


def camera_pose(workspace: str, view: ViewChange) -> CameraPose:
    """Return the pose of the camera `agentview` in a variant.

    Args:
        workspace: Fixture category of the table or floor, such as `kitchen_table`.
        view: Move of the camera.

    Raises:
        UnknownNameError: The workspace does not exist.
    """
    if workspace not in _cameras():
        raise UnknownNameError("workspace", workspace, _cameras())
    start = _cameras()[workspace]["agentview"]
    pose = CameraPose(np.array(start["pos"]), np.array(start["quat"]))
    if view.elevation:
        pose = _turned(pose, _Y, -view.elevation, _PIVOT)
    pose = _turned(pose, _Z, view.azimuth, np.zeros(3))
    if view.distance != 1.0:
        pose = pose._replace(pos=_rounded(_PIVOT + (pose.pos - _PIVOT) * view.distance))
    for axis, degrees in ((_Z, view.turn), (_Y, -view.tilt)):
        if degrees:
            pose = pose._replace(quat_wxyz=_turned(pose, axis, degrees, _PIVOT).quat_wxyz)
    return pose


def joint_pose(number: int) -> np.ndarray:
    """Return the joint angles that the arm has after a reset in a variant, (7,) [rad].

    Args:
        number: Number of the pose, 1 to 500; 0 is the pose of LIBERO.

    Raises:
        InvalidInputError: There is no such pose.
    """
    if not 0 <= number <= POSES:
        raise InvalidInputError(f"pose {number}; LIBERO-Plus has 1 to {POSES}, and 0 for LIBERO's")
    return _all_poses()[number].copy()


@cache
def _cameras() -> dict[str, Any]:
    return read_yaml("assets/workspaces/original_cameras.yaml")


@cache
def _all_poses() -> np.ndarray:
    """Return all poses by their number, (501, 7): normal draws, scaled to a distance from the pose of rest."""
    draws = np.random.RandomState(_POSE_SEED).standard_normal((POSES, len(REST_QPOS)))
    steps = 1 + np.arange(POSES) // _POSES_PER_STEP
    offsets = draws / np.linalg.norm(draws, axis=1, keepdims=True) * (_STEP * steps)[:, None]
    return np.vstack([REST_QPOS, np.round(np.array(REST_QPOS) + offsets, 8)])


def _turned(pose: CameraPose, axis: np.ndarray, degrees: float, pivot: np.ndarray) -> CameraPose:
    """Return a pose after a rotation about an axis through a point, rounded."""
    rotation = quat_from_axis_angle(axis, np.deg2rad(degrees))[None]
    quat = pose.quat_wxyz / np.linalg.norm(pose.quat_wxyz)
    pos = quat_rotate(rotation, (pose.pos - pivot)[None])[0] + pivot
    return CameraPose(_rounded(pos), _rounded(quat_multiply(rotation, quat[None])[0]))


def _rounded(values: np.ndarray) -> np.ndarray:
    # Python's rounding: NumPy's multiplies and divides, and differs from it in the last bit
    return np.array([round(value, _DECIMALS) for value in values.tolist()])
