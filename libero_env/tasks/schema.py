"""Keys of a task's YAML file and what each may hold: types with bounds, as `libero_env.validation` checks them.

Values are checked after parameters are filled in. What comes back is in one form: atoms are texts such as `On a b`,
numbers are numbers (`pi/2` is 1.57), a single object is a list of one.
"""

from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag
from typing_extensions import TypedDict

from libero_env.errors import LiberoError
from libero_env.tasks.checks import (
    LANGUAGE_RULE,
    MAX_LANGUAGE,
    MAX_METRES,
    MAX_NAME,
    MAX_RADIANS,
    NAME,
    NAME_RULE,
    UNWRITABLE,
)
from libero_env.tasks.problem_types import MAX_ENTITIES, MAX_PARTS
from libero_env.tasks.sexpr import number, parse_tree
from libero_env.tasks.source import Source
from libero_env.tasks.task import check_name
from libero_env.validation import validate


def _name(text: str) -> str:
    if not NAME.fullmatch(text):
        raise ValueError(f"{text!r:.60} is no valid name; expected {NAME_RULE}")
    return text


def _task_name(text: str) -> str:
    try:
        return check_name(text, "name")
    except LiberoError as error:
        raise ValueError(str(error)) from None


def _language(text: str) -> str:
    text = text.strip()
    if not text or UNWRITABLE.search(text) or len(text) > MAX_LANGUAGE:
        raise ValueError(f"{text!r:.60} is no valid instruction; expected {LANGUAGE_RULE}")
    return text


def _single_blanks(text: str) -> str:
    return " ".join(text.split())


def _number(value: Any) -> Any:
    """Return the value of a text such as `pi/2`, and anything else as it is."""
    if not isinstance(value, str):
        return value
    try:
        return number(value)
    except ValueError:
        raise ValueError(f"{value!r:.60} is no finite number; expected one such as 0.25 or -pi/4") from None


def _row(row: list[float]) -> list[float]:
    if row[2] < row[0] or row[3] < row[1]:
        raise ValueError(f"{row} has swapped corners; expected [x0, y0, x1, y1] with x0 <= x1 and y0 <= y1")
    return row


def _pair(value: Any) -> Any:
    """Return a number as a pair of itself."""
    return value if isinstance(value, list) else [value, value]


def _ordered(angles: list[float]) -> list[float]:
    if angles[1] < angles[0]:
        raise ValueError(f"{angles} is no range; expected [low, high] with low <= high")
    return angles


def _words(atom: Any) -> Any:
    """Return the words of an atom as one text."""
    if isinstance(atom, list) and atom and all(isinstance(word, str) for word in atom):
        return " ".join(atom)
    return atom


def _atom(text: str) -> str:
    text = text.strip()
    try:
        tree = parse_tree(text if text.startswith("(") else f"({text})", "")
    except LiberoError as error:
        raise ValueError(f"{text!r:.60} is no atom or expression: {str(error).partition(': ')[2]}") from None
    if not tree.items:
        raise ValueError("it is empty; expected an atom such as On plate_1 stove_1")
    return text


def _goal(goal: Any) -> Any:
    """Return a goal as a list; a list of single words is one atom, since no atom is a single word."""
    if (
        isinstance(goal, list)
        and goal
        and all(isinstance(word, str) and " " not in word.strip() for word in goal)
    ):
        return [" ".join(goal)]
    return goal if isinstance(goal, list) else [goal]


def _listed(value: Any) -> Any:
    return value if isinstance(value, list) else [value]


def _sites(value: Any) -> Any:
    """Return regions `[a, b]` as `{a: {}, b: {}}`."""
    return {name: {} for name in value} if isinstance(value, list) and _are_texts(value) else value


def _are_texts(values: Sequence[Any]) -> bool:
    return all(isinstance(value, str) for value in values)


def _form(value: Any) -> str | None:
    return "text" if isinstance(value, str) else "fields" if isinstance(value, dict) else None


Name = Annotated[str, AfterValidator(_name)]
Number = Annotated[float, BeforeValidator(_number)]
Metres = Annotated[float, Field(ge=-MAX_METRES, le=MAX_METRES), BeforeValidator(_number)]
Half = Annotated[float, Field(ge=0, le=MAX_METRES), BeforeValidator(_number)]
Radians = Annotated[float, Field(ge=-MAX_RADIANS, le=MAX_RADIANS), BeforeValidator(_number)]
_TWO, _FOUR = (Field(min_length=n, max_length=n) for n in (2, 4))
Row = Annotated[list[Metres], _FOUR, AfterValidator(_row)]
Atom = Annotated[str, AfterValidator(_atom), BeforeValidator(_words)]
Atoms = Annotated[list[Atom], Field(max_length=MAX_PARTS), BeforeValidator(_listed)]
Count = Annotated[int, Field(ge=0, le=MAX_ENTITIES)]
Category = Annotated[
    Annotated[Name, Tag("text")] | Annotated[dict[Name, Count], Tag("fields")],
    Discriminator(
        _form, custom_error_type="category", custom_error_message="a category, or {category: number}"
    ),
]
Categories = Annotated[list[Category], Field(max_length=MAX_ENTITIES), BeforeValidator(_listed)]


class Rectangle(TypedDict, total=False):
    """A place on the workspace, or part of one that a scene gives."""

    at: Annotated[list[Metres], _TWO]
    half: Annotated[list[Half], _TWO, BeforeValidator(_pair)]
    ranges: Annotated[list[Row], Field(max_length=MAX_PARTS)]
    yaw: Annotated[list[Radians], _TWO, AfterValidator(_ordered), BeforeValidator(_pair)]
    rgba: Annotated[list[Number], _FOUR]


def _support(text: str) -> str:
    if len(text.strip("() ").split()) not in (1, 2):
        raise ValueError(f"{text!r:.60} is no place; expected such as plate_1, or In basket_1_contain_region")
    return text


def _at(value: Any) -> Any:
    return {"at": value} if isinstance(value, list) else value


def _placed(place: Any) -> Any:
    if isinstance(place, dict) and not ("at" in place or place.get("ranges")):
        raise ValueError("it has neither at nor ranges; expected [x, y] or {at: [x, y], half: h}")
    return place


Place = Annotated[
    Annotated[Atom, AfterValidator(_support), Tag("text")]
    | Annotated[Rectangle, AfterValidator(_placed), Tag("fields")],
    Discriminator(
        _form,
        custom_error_type="place",
        custom_error_message="[x, y], {at: [x, y], half: h}, or the name of what it is on",
    ),
    BeforeValidator(_at),
]
Regions = dict[Name, Annotated[dict[Name, Rectangle | None], BeforeValidator(_sites)]]


class Definition(TypedDict, total=False):
    """Keys of a task, without `scene` and `with`."""

    furniture: Categories
    objects: Categories
    place: Annotated[dict[Name, Place], Field(max_length=MAX_ENTITIES)]
    goal: Annotated[list[Atom], Field(max_length=MAX_PARTS), BeforeValidator(_goal)]
    name: Annotated[str, AfterValidator(_task_name)]
    problem: Name
    language: Annotated[str, AfterValidator(_language)]
    fixtures: dict[Name, Name]
    regions: Regions
    init: Atoms
    init_also: Atoms
    obj_of_interest: Annotated[list[Name], Field(max_length=MAX_PARTS)]
    scene_properties: dict[Name, Annotated[str, Field(max_length=MAX_NAME), AfterValidator(_single_blanks)]]


def check_definition(definition: Any, source: Source) -> dict[str, Any]:
    """Return a definition, in which parameters are filled in, in one form; keys that are null are left out.

    Raises:
        InvalidInputError: A key does not exist, or a value is not valid; the message has file and line.
    """
    given = {key: value for key, value in definition.items() if value is not None}
    return validate(Definition, given, source=source.name, line_of=source.line_of)
