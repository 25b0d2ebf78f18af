"""Keys of `object.yaml` and what each may hold."""

from typing import Annotated, Any, Literal, NotRequired

from pydantic import AfterValidator, BeforeValidator, Field
from typing_extensions import TypedDict

MAX_METRES = 10.0  # of an object
_MAX_ANGLE = 100.0  # [rad], or [m] of a joint that slides


def _number(value: Any) -> Any:
    """Return the value of a text such as `1e-3`, which is no number in YAML."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def _complete(grasp: Any) -> Any:
    if isinstance(grasp, dict) and (key := "reason" if grasp.get("width") is None else "height") not in grasp:
        raise ValueError(f"{key} is missing; expected width and height, or width: null and reason")
    return grasp


def _ordered(values: list[float]) -> list[float]:
    if values[1] < values[0]:
        raise ValueError(f"{values} is no range; expected [low, high] with low <= high")
    return values


Metres = Annotated[float, Field(ge=-MAX_METRES, le=MAX_METRES), BeforeValidator(_number)]
Point = Annotated[list[Metres], Field(min_length=3, max_length=3)]
Length = Annotated[float, Field(ge=0, le=MAX_METRES), BeforeValidator(_number)]
Angle = Annotated[float, Field(ge=-_MAX_ANGLE, le=_MAX_ANGLE), BeforeValidator(_number)]
Amount = Annotated[float, Field(ge=0, le=1e6), BeforeValidator(_number)]
Pair = Annotated[list[Angle], Field(min_length=2, max_length=2)]
Text = Annotated[str, Field(max_length=1000)]


class Collision(TypedDict):
    """How collision geoms were made."""

    method: Text
    pieces: Annotated[int, Field(ge=0)]


class Grasp(TypedDict):
    """The best grasp from above; width null and a reason where there is none."""

    width: Length | None
    height: NotRequired[Metres]
    reason: NotRequired[Text]


class Properties(TypedDict):
    """Content of `object.yaml`: what placement needs, and what the trial of the object found."""

    bottom_offset: Point
    top_offset: Point
    horizontal_radius: Length
    name: NotRequired[Text]
    source: NotRequired[Text]
    mass: NotRequired[Amount]
    watertight: NotRequired[bool]
    collision: NotRequired[Collision]
    size: NotRequired[Annotated[list[Length], Field(min_length=3, max_length=3)]]
    grasp: NotRequired[Annotated[Grasp | None, BeforeValidator(_complete)]]
    stands: NotRequired[bool]
    joint_damping: NotRequired[Amount]
    rotation: NotRequired[dict[Literal["x", "y", "z"], Annotated[Pair, AfterValidator(_ordered)]]]
    rotation_axis: NotRequired[Literal["x", "y", "z"] | None]
    articulation: NotRequired[dict[Literal["open", "close", "turnon", "turnoff"], Pair]]
