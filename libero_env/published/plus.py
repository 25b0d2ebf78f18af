"""Ids of LIBERO-Plus, which say what a variant changes (arXiv 2510.13626; github.com/sylvestf/LIBERO-plus, 4976dc3).

A variant is the name of a task of LIBERO with an ending; `k`, `n`, ... are whole numbers:

    _view_<azimuth>_<elevation>_<distance>_<turn>_<tilt>_initstate_<pose>    camera, or joints of the robot
        ..._noise_<n>                                                       the same with noise on the picture
        _language_<n>_view_...                                              the same with another instruction
    _light_<n>                                                              lights
    _table_<n>                                                              texture of the table, or of the floor
    _tb_<n>                                                                 that, and of the wall
    _add_<n>                                                                further objects
    _level<n>_sample<n>                                                     objects in other places
    _moved_level<n>_sample<n>                                               the goal's objects in other places

What is in the task file of a variant (lights, textures, objects, instruction) its id only numbers.

The poses of the camera and of the arm follow from the numbers. LIBERO-Plus' code rounds positions and quaternions to
four decimals after each of up to five steps, and so does this. All its variants have that, those too whose camera does
not turn. The point that cameras turn about is 0.8 m above the floor in all scenes, those on the floor included.
"""

import re
from dataclasses import dataclass
from functools import cache
from typing import Literal, NamedTuple, get_args

import numpy as np

from libero_env.errors import InvalidInputError, require_known
from libero_env.storage import read_yaml

Kind = Literal["camera", "robot", "noise", "language", "light", "background", "layout"]
KINDS: tuple[Kind, ...] = get_args(Kind)
# Kind -> category in LIBERO-Plus' task_classification.json
CATEGORIES: dict[Kind, str] = {
    "camera": "Camera Viewpoints",
    "robot": "Robot Initial States",
    "noise": "Sensor Noise",
    "language": "Language Instructions",
    "light": "Light Conditions",
    "background": "Background Textures",
    "layout": "Objects Layout",
}
NoiseKind = Literal["motion", "gaussian", "zoom", "fog", "glass"]
NOISES: tuple[NoiseKind, ...] = get_args(NoiseKind)  # in the order of their numbers, ten severities each
SEVERITIES, POSES = 10, 500
_Scenery = Literal["light", "table", "table_and_wall", "added", "moved", "goal_moved"]
# What the task file changes -> ending of the id, and kind.
_SCENERIES: dict[_Scenery, tuple[str, Kind]] = {
    "light": (r"_light_\d{1,4}", "light"),
    "table": (r"_table_\d{1,4}", "background"),
    "table_and_wall": (r"_tb_\d{1,4}", "background"),
    "added": (r"_add_\d{1,4}", "layout"),
    "goal_moved": (r"_moved_level\d{1,4}_sample\d{1,4}", "layout"),
    "moved": (r"_level\d{1,4}_sample\d{1,4}", "layout"),
}
_VIEW = re.compile(
    r"(?P<base>.+?)(?:_language_(?P<language>\d{1,4}))?"
    r"_view_(?P<view>-?\d{1,4}_-?\d{1,4}_\d{1,4}_-?\d{1,4}_-?\d{1,4})"
    r"_initstate_(?P<pose>\d{1,4})(?:_noise_(?P<noise>\d{1,4}))?",
    re.ASCII,
)


@dataclass(frozen=True)
class ViewChange:
    """How the camera `agentview` moves, in the order of the id. Angles are positive where the sense says.

    Attributes:
        azimuth: Rotation of the camera's position and axes about the world's z axis, [degrees].
        elevation: Rotation of both upwards about the y axis through (0, 0, 0.8) m, before the azimuth's, [degrees].
        distance: Factor of the distance from the point (0, 0, 0.8) m.
        turn: Rotation of the camera's axes alone about the world's z axis, [degrees].
        tilt: Rotation of its axes alone about the world's y axis, after that, positive as the elevation, [degrees].
    """

    azimuth: int = 0
    elevation: int = 0
    distance: float = 1.0
    turn: int = 0
    tilt: int = 0


@dataclass(frozen=True)
class Noise:
    """Noise on the pictures of `agentview`.

    Attributes:
        kind: Function of the noise, see `libero_env.perturbations.corruptions`.
        severity: Severity, 1 to 10.
    """

    kind: NoiseKind
    severity: int


@dataclass(frozen=True)
class PlusVariant:
    """What the id of a variant says.

    Attributes:
        name: The id.
        base: Name of the task of LIBERO that is varied.
        file: Stem of the variant's task file.
        view: Move of the camera.
        pose: Number of the arm's pose, 1 to 500; 0 is that of LIBERO.
        noise: Noise on the pictures, or None.
        language: Number of the instruction; None is that of the base task.
        scenery: What else the task file changes: `light`, `table`, `table_and_wall`, `added` objects, objects `moved`,
            the `goal_moved`; None for nothing.
    """

    name: str
    base: str
    file: str
    view: ViewChange = ViewChange()
    pose: int = 0
    noise: Noise | None = None
    language: int | None = None
    scenery: _Scenery | None = None

    @property
    def kind(self) -> Kind:
        """Dimension of LIBERO-Plus that the variant belongs to; of several, the one that is counted there."""
        if self.scenery is not None:
            return _SCENERIES[self.scenery][1]
        if self.noise is not None:
            return "noise"
        if self.language is not None:
            return "language"
        return "robot" if self.pose else "camera"

    @property
    def category(self) -> str:
        """Name of the dimension in LIBERO-Plus' files."""
        return CATEGORIES[self.kind]

    @property
    def has_own_start(self) -> bool:
        """Whether objects are others, or elsewhere, than in the base task: then the initial state is its own."""
        return self.kind == "layout"


def parse_plus_id(name: str) -> PlusVariant:
    """Return what an id of LIBERO-Plus says.

    Args:
        name: Id without an ending for files, such as `turn_on_the_stove_view_0_0_100_0_0_initstate_7`.

    Raises:
        InvalidInputError: It has none of the endings, or a number that their code cannot run.
    """
    if match := _VIEW.fullmatch(name):
        return _seen_otherwise(name, **match.groupdict())
    for scenery, (ending, _) in _SCENERIES.items():
        if match := re.fullmatch(f"(.+?){ending}", name, re.ASCII):
            return PlusVariant(name, match[1], file=name, scenery=scenery)
    raise InvalidInputError(
        f"{name!r:.120} is not an id of LIBERO-Plus; expected a task's name and _view_0_0_100_0_0_initstate_0, "
        "_light_1, _table_1, _tb_1, _add_1, _level1_sample1 or _moved_level1_sample1 with other numbers"
    )


def _seen_otherwise(
    name: str, base: str, language: str | None, view: str, pose: str, noise: str | None
) -> PlusVariant:
    """Return the variant of an id that matches `_VIEW`."""
    azimuth, elevation, percent, turn, tilt = map(int, view.split("_"))
    if int(pose) > POSES:
        raise InvalidInputError(
            f"{name!r:.120}: pose {pose}; LIBERO-Plus has 1 to {POSES}, and 0 for LIBERO's"
        )
    return PlusVariant(
        name,
        base,
        file=base if language is None else f"{base}_language_{language}",
        view=ViewChange(azimuth, elevation, percent / 100, turn, tilt),
        pose=int(pose),
        noise=_noise(name, int(noise or 0)),
        language=None if language is None else int(language),
    )


def _noise(name: str, number: int) -> Noise | None:
    if not number:
        return None
    if number > SEVERITIES * len(NOISES):
        raise InvalidInputError(
            f"{name!r:.120}: noise {number}; LIBERO-Plus has 1 to {SEVERITIES * len(NOISES)}"
        )
    kind, severity = divmod(number - 1, SEVERITIES)
    return Noise(NOISES[kind], severity + 1)


_PIVOT = np.array([0.0, 0.0, 0.8])  # [m]
_DECIMALS = 4
_Y, _Z = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
_POSE_SEED, _POSES_PER_STEP = 42, 100
_STEP = 0.1  # [rad] poses 1 to 100 are one step from rest, 101 to 200 two, ...


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
    cameras = read_yaml("assets/workspaces/original_cameras.yaml")
    require_known("workspace", workspace, cameras)
    start = cameras[workspace]["agentview"]
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
def _all_poses() -> np.ndarray:
    """Return all poses by their number, (501, 7): normal draws, scaled to a distance from the pose of rest."""
    from libero_env.assets.robot import REST_QPOS  # with MuJoCo

    draws = np.random.RandomState(_POSE_SEED).standard_normal((POSES, len(REST_QPOS)))
    steps = 1 + np.arange(POSES) // _POSES_PER_STEP
    offsets = draws / np.linalg.norm(draws, axis=1, keepdims=True) * (_STEP * steps)[:, None]
    return np.vstack([REST_QPOS, np.round(np.array(REST_QPOS) + offsets, 8)])


def _turned(pose: CameraPose, axis: np.ndarray, degrees: float, pivot: np.ndarray) -> CameraPose:
    """Return a pose after a rotation about an axis through a point, rounded."""
    from libero_env.geometry import quat_from_axis_angle, quat_multiply, quat_rotate  # with MuJoCo

    rotation = quat_from_axis_angle(axis, np.deg2rad(degrees))[None]
    quat = pose.quat_wxyz / np.linalg.norm(pose.quat_wxyz)
    pos = quat_rotate(rotation, (pose.pos - pivot)[None])[0] + pivot
    return CameraPose(_rounded(pos), _rounded(quat_multiply(rotation, quat[None])[0]))


def _rounded(values: np.ndarray) -> np.ndarray:
    # Python's rounding: NumPy's multiplies and divides, and differs from it in the last bit
    return np.array([round(value, _DECIMALS) for value in values.tolist()])
