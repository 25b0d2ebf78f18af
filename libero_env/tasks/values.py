"""Values that names, places and numbers in task files may have, as types that `libero_env.validation` checks."""

import re
from typing import Annotated, Any

from pydantic import AfterValidator, Field

MAX_NAME = 100  # characters of a name
NAME = re.compile(rf"\w[\w.-]{{0,{MAX_NAME - 1}}}")
_NAME_RULE = f"letters, digits, _ . and -, at most {MAX_NAME} characters"
_UNWRITABLE = re.compile("[();\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
_RESERVED = ("robot", "world", "ee")  # the robot in contacts, MuJoCo's root, the hand in observations
_RESERVED_PREFIXES = ("robot0", "gripper0", "mount0")


def _check_name(text: str) -> str:
    if not NAME.fullmatch(text):
        raise ValueError(f"the name {text!r:.60} is not valid; expected {_NAME_RULE}")
    return text


def _check_entity(name: str) -> str:
    if name in _RESERVED or name.startswith(_RESERVED_PREFIXES):
        raise ValueError(
            f"the name {name} is one of the robot or of MuJoCo; expected another, such as plate_1"
        )
    return name


def _check_writable(text: str) -> str:
    if _UNWRITABLE.search(text):
        raise ValueError(f"{text!r:.60} cannot be written; expected one line without ( ) and ;")
    return " ".join(text.split())  # as a reader of BDDL has them


def check_corners(rectangle: Any) -> Any:
    """Return a rectangle (x0, y0, x1, y1), whose corners must be in order."""
    x0, y0, x1, y1 = rectangle
    if x1 < x0 or y1 < y0:
        raise ValueError(
            f"{rectangle} has swapped corners; expected (X0 Y0 X1 Y1) with X0 <= X1 and Y0 <= Y1"
        )
    return rectangle


def check_order(limits: Any) -> Any:
    """Return a range (low, high), which must be in order."""
    low, high = limits
    if high < low:
        raise ValueError(f"{limits} is not a range; expected (LOW HIGH) with LOW <= HIGH")
    return limits


def _check_colour(rgba: tuple[float, ...]) -> tuple[float, ...]:
    if len(rgba) not in (0, 4):
        raise ValueError(f"{rgba} is not a colour; expected 4 numbers")
    return rgba


Name = Annotated[str, AfterValidator(_check_name)]
EntityName = Annotated[Name, AfterValidator(_check_entity)]
Words = Annotated[str, Field(max_length=MAX_NAME), AfterValidator(_check_writable)]
Language = Annotated[str, Field(max_length=1000), AfterValidator(_check_writable)]
Metres = Annotated[float, Field(ge=-10, le=10)]  # in the frame of the workspace
Radians = Annotated[float, Field(ge=-100, le=100)]
Rectangle = Annotated[tuple[Metres, Metres, Metres, Metres], AfterValidator(check_corners)]
YawRange = Annotated[tuple[Radians, Radians], AfterValidator(check_order)]
Colour = Annotated[tuple[float, ...], AfterValidator(_check_colour)]  # none, or red, green, blue, opacity
