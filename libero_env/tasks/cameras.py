"""Cameras that a task, or whoever makes an environment, adds to a scene."""

import math
from collections import Counter
from collections.abc import Iterable
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field

from libero_env.errors import InvalidInputError
from libero_env.tasks.values import EntityName, Metres, Name
from libero_env.validation import checked

_WORLD = "world"
_FOVY = 45.0
_FORM = "NAME,pos=X Y Z,lookat=X Y Z (or quat=W X Y Z),fovy=DEGREES,body=NAME"
_COUNTS = {"pos": 3, "quat": 4, "lookat": 3, "fovy": 1}  # key -> numbers of its value
_Component = Annotated[float, Field(ge=-1e3, le=1e3)]


def _tuple(vector: Any) -> Any:
    return tuple(vector) if isinstance(vector, list | np.ndarray) else vector


_Point = Annotated[tuple[Metres, Metres, Metres], BeforeValidator(_tuple)]
_Quat = Annotated[tuple[_Component, _Component, _Component, _Component], BeforeValidator(_tuple)]


@checked
class Camera:
    """A camera that is added to a scene, in the world or fixed to a body that moves.

    As a text, such as on a command line, it is `top,pos=0.4 0 1.6,lookat=0 0 0.9,fovy=60`.

    Attributes:
        name: Name, also of its observations, such as `<name>_rgb`; no other camera of the scene has it.
        pos: Position in the frame of the body, [m].
        quat: Orientation in the frame of the body, wxyz; the camera looks along its -z, its y is up in the image.
        lookat: Instead of `quat`, the point that it looks at, in the frame of the body, [m]. Up in the image is the z
            of the frame; for a camera that looks along it, its x.
        fovy: Vertical field of view, [degrees].
        body: Body that it is fixed to: an object or fixture, such as `plate_1`, or another body of the scene, such as
            `robot0_right_hand`.

    Raises:
        InvalidInputError: A value is of another kind or outside of its range, or not exactly one of `quat` and `lookat`
            is given.
    """

    name: EntityName
    pos: _Point
    quat: _Quat | None = None
    lookat: _Point | None = None
    fovy: Annotated[float, Field(ge=1, le=170)] = _FOVY
    body: Name = _WORLD

    def __post_init__(self) -> None:
        if (self.quat is None) == (self.lookat is None):
            raise InvalidInputError(f"camera {self.name}: give one of quat and lookat")
        if self.quat is not None and not any(self.quat):
            raise InvalidInputError(f"camera {self.name}: its quat is zero; expected a rotation, wxyz")
        if self.lookat is not None and math.dist(self.lookat, self.pos) < 1e-6:
            raise InvalidInputError(
                f"camera {self.name} looks at the point where it is; expected another lookat"
            )

    @classmethod
    def read(cls, text: str) -> "Camera":
        """Return the camera of a text.

        Raises:
            InvalidInputError: The text is not of this form, or a value is not valid.
        """
        name, *parts = (part.strip() for part in text.split(","))
        values: dict[str, Any] = {"name": name}
        for part in parts:
            key, _, value = (word.strip() for word in part.partition("="))
            numbers = _numbers(value)
            if key in values or (key != "body" and len(numbers) != _COUNTS.get(key, -1)) or not value:
                raise InvalidInputError(f"camera {text!r:.200}: {part!r:.60} is not valid; expected {_FORM}")
            values[key] = value if key == "body" else numbers if len(numbers) > 1 else numbers[0]
        if "pos" not in values:
            raise InvalidInputError(f"camera {text!r:.200}: it has no pos; expected {_FORM}")
        return cls(**values)

    def __str__(self) -> str:
        parts = [self.name]
        for key in ("pos", "quat", "lookat"):
            if (vector := getattr(self, key)) is not None:
                parts.append(f"{key}={' '.join(map(repr, map(float, vector)))}")
        parts += [f"fovy={float(self.fovy)!r}"] * (self.fovy != _FOVY)
        return ",".join([*parts, *[f"body={self.body}"] * (self.body != _WORLD)])

    def axes(self) -> np.ndarray:
        """Return x and y of the image in the frame of the body, (6,); only where it has `lookat`."""
        assert self.lookat is not None
        back = np.subtract(self.pos, self.lookat)
        back /= np.linalg.norm(back)
        right = np.cross((0.0, 0.0, 1.0), back)
        if np.linalg.norm(right) < 1e-6:
            right = np.cross((1.0, 0.0, 0.0), back)
        right /= np.linalg.norm(right)
        return np.concatenate([right, np.cross(back, right)])


def camera_text(camera: Any) -> Any:
    """Return a `Camera`, or the text of one, as its text in one form; the name of a camera of the scene as it is."""
    if isinstance(camera, str) and "," in camera:
        camera = Camera.read(camera)
    return str(camera) if isinstance(camera, Camera) else camera


def camera_name(camera: str) -> str:
    """Return the name of a camera of the scene, or of an added one from its text."""
    return camera.partition(",")[0]


def image_stem(camera: str) -> str:
    """Return what the names of a camera's images begin with: `robot0_eye_in_hand` -> `eye_in_hand`.

    Args:
        camera: Name of the camera, or the text of one that is added.
    """
    return camera_name(camera).removeprefix("robot0_")


def distinct_cameras(cameras: tuple[str, ...]) -> tuple[str, ...]:
    """Return names and texts of cameras, whose images must have different names."""
    for stem, count in Counter(map(image_stem, cameras)).items():
        if count > 1:
            raise ValueError(f"{count} cameras have images {stem}_...; expected each camera once")
    return cameras


def added_cameras(cameras: Iterable[str]) -> tuple[Camera, ...]:
    """Return those of names and texts that are added to the scene."""
    return tuple(Camera.read(camera) for camera in cameras if "," in camera)


def require_own_names(cameras: Iterable[Camera], taken: Iterable[str]) -> None:
    """Check that added cameras have names that no other camera has.

    Raises:
        InvalidInputError: One has the name of another.
    """
    names = {name for camera in taken for name in (camera, image_stem(camera))}
    for camera in cameras:
        if camera.name in names:
            raise InvalidInputError(
                f"camera {camera.name}: the scene has a camera of this name; choose another"
            )
        names.add(camera.name)


def _numbers(text: str) -> tuple[float, ...]:
    """Return the numbers of a text; none where it is of something else."""
    try:
        return tuple(map(float, text.split()))
    except ValueError:
        return ()
