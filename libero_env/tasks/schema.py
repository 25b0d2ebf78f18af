"""A task's YAML file: where a definition stands, its keys and what they may hold, as `validation` checks it.

Values are checked after parameters are filled in. What comes back is in one form: goals and init atoms are expressions,
numbers are numbers (`pi/2` is 1.57), a single object is a list of one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import pi
from pathlib import Path
from typing import Annotated, Any, Required

from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag
from typing_extensions import TypedDict

from libero_env.errors import BDDLError, InvalidInputError
from libero_env.storage import read_yaml_file
from libero_env.tasks.bddl import parse_atom, parse_expression
from libero_env.tasks.expression import MAX_PARTS, Expression
from libero_env.tasks.rules import MAX_ENTITIES
from libero_env.tasks.sexpr import number
from libero_env.tasks.task import MAX_NAME_BYTES, check_name
from libero_env.tasks.values import Language, Name, Words, check_corners, check_order
from libero_env.validation import Key, LineOf, validate

MAX_FILES = 20  # each of which is the scene of the one before


@dataclass(frozen=True)
class Source:
    """Where a definition stands.

    Attributes:
        name: File, or another name for messages.
        folder: Folder that the file of a scene is relative to.
        root: Folder that it must lie in; None for any, in a call from Python.
        files: Files that led here, each the scene of the one before.
        line_of: Function that returns the line of a path of keys; None where there are no lines.
        places: Atom, object, region, camera or zone of its task -> `file:line` that it comes from.
    """

    name: str
    folder: Path = field(default_factory=Path)
    root: Path | None = None
    files: tuple[Path, ...] = ()
    line_of: LineOf | None = None
    places: dict[str, str] = field(default_factory=dict, compare=False)

    def at(self, *path: Key) -> str:
        """Return `file:line` of a path of keys; the name where there are no lines."""
        return f"{self.name}:{self.line_of(path) or 1}" if self.line_of else self.name

    def shared_with(self, own: Sequence[Key], index: int) -> LineOf | None:
        """Return the lines of one of the tasks of the file: its own keys are below `tasks`, the others are shared."""
        if (line_of := self.line_of) is None:
            return None
        return lambda path: line_of(("tasks", index, *path) if not path or path[0] in own else path)


def read_definition(path: Path, source: Source | None = None) -> tuple[dict[str, Any], Source]:
    """Return the content of a task's or scene's YAML file, and where it stands.

    Args:
        source: Definition that names the file as its scene; None for none.

    Raises:
        InvalidInputError: The file is missing, is not valid YAML, has no keys, or is its own scene.
    """
    files = source.files if source else ()
    resolved = path.resolve()
    if source and (resolved in files or len(files) >= MAX_FILES):
        names = " -> ".join(file.name for file in (*files, resolved)[-4:])
        raise InvalidInputError(f"{source.at('scene')}: scenes include each other without end: {names}")
    content = read_yaml_file(path)
    if not isinstance(content.data, dict):
        raise InvalidInputError(f"{content.at()}: expected keys such as scene, objects, place and goal")
    if wrong := [key for key in content.data if not isinstance(key, str)]:
        raise InvalidInputError(f"{content.at()}: the key {wrong[0]!r:.60} is not a text")
    root = source.root if source and source.root else path.parent
    return content.data, Source(str(path), path.parent, root, (*files, resolved), content.line_of)


def scene_file(name: str, source: Source) -> Path:
    """Return the file of a scene that a definition names.

    Raises:
        InvalidInputError: The file is missing, or is not in the folder of the task's file.
    """
    path, at = source.folder / name, source.at("scene")
    if not name.isprintable() or len(name.encode()) > MAX_NAME_BYTES:
        raise InvalidInputError(f"{at}: its scene {name!r:.80} is not the name of a file")
    if source.root is not None and not path.resolve().is_relative_to(source.root.resolve()):
        raise InvalidInputError(
            f"{at}: its scene {name} is not in the folder of the task's file, {source.root}; put a copy there, and "
            "give its name"
        )
    if not path.is_file():
        raise InvalidInputError(f"{at}: its scene {path} is missing")
    return path


def _instruction(text: Any) -> Any:
    if isinstance(text, str) and not (text := text.strip()):
        raise ValueError("the instruction is empty; expected a sentence")
    return text


def _number(value: Any) -> Any:
    """Return the value of a text such as `pi/2`, and anything else as it is."""
    if not isinstance(value, str):
        return value
    try:
        return number(value)
    except ValueError:
        raise ValueError(
            f"{value!r:.60} is not a finite number; expected one such as 0.25 or -pi/4"
        ) from None


def _few_turns(angle: float) -> float:
    if abs(angle) > 4 * pi:
        raise ValueError(f"{angle:g} rad is more than two turns; expected radians: 90 degrees are pi/2")
    return angle


def _pair(value: Any) -> Any:
    """Return a number as a pair of itself."""
    return value if isinstance(value, list) else [value, value]


def _listed(value: Any) -> Any:
    return value if isinstance(value, list) else [value]


def _words(atom: Any) -> Any:
    """Return the words of an atom as one text."""
    if isinstance(atom, list) and atom and all(type(word) in (str, int, float) for word in atom):
        return " ".join(map(str, atom))
    return atom


def _parsed(parse: Callable[[str, str], Expression], text: str) -> Expression:
    try:
        return parse(text, "")
    except BDDLError as error:
        raise ValueError(f"{text!r:.60} is not an atom or expression: {error}") from None


def _goal(goal: Any) -> Any:
    """Return a goal as a list; a list of single words is one atom, since no atom is a single word."""
    is_one = isinstance(goal, list) and not any(isinstance(w, str) and " " in w.strip() for w in goal)
    return _listed(_words(goal) if is_one else goal)


def _sites(value: Any) -> Any:
    """Return regions `[a, b]` as `{a: {}, b: {}}`."""
    is_names = isinstance(value, list) and all(isinstance(name, str) for name in value)
    return {name: {} for name in value} if is_names else value


def _form(value: Any) -> str | None:
    return "text" if isinstance(value, str) else "fields" if isinstance(value, dict) else None


_TWO, _THREE, _FOUR = (Field(min_length=n, max_length=n) for n in (2, 3, 4))
_Number = Annotated[float, BeforeValidator(_number)]
_Metres = Annotated[float, Field(ge=-10, le=10), BeforeValidator(_number)]
_Point = Annotated[list[_Metres], _THREE]
_Half = Annotated[float, Field(ge=0, le=10), BeforeValidator(_number)]
_Radians = Annotated[float, AfterValidator(_few_turns), BeforeValidator(_number)]
_Row = Annotated[list[_Metres], _FOUR, AfterValidator(check_corners)]
_Atom = Annotated[str, AfterValidator(partial(_parsed, parse_atom)), BeforeValidator(_words)]
_Part = Annotated[str, AfterValidator(partial(_parsed, parse_expression)), BeforeValidator(_words)]
_Atoms = Annotated[list[_Atom], Field(max_length=MAX_PARTS), BeforeValidator(_listed)]
_Category = Annotated[
    Annotated[Name, Tag("text")]
    | Annotated[dict[Name, Annotated[int, Field(ge=0, le=MAX_ENTITIES)]], Tag("fields")],
    Discriminator(
        _form, custom_error_type="category", custom_error_message="expected a category, or {category: number}"
    ),
]
_Categories = Annotated[list[_Category], Field(max_length=MAX_ENTITIES), BeforeValidator(_listed)]


class Rectangle(TypedDict, total=False):
    """A place on the workspace, or part of one that a scene gives."""

    at: Annotated[list[_Metres], _TWO]
    half: Annotated[list[_Half], _TWO, BeforeValidator(_pair)]
    ranges: Annotated[list[_Row], Field(max_length=MAX_PARTS)]
    yaw: Annotated[list[_Radians], _TWO, AfterValidator(check_order), BeforeValidator(_pair)]
    rgba: Annotated[list[_Number], _FOUR]


def _support(text: str) -> tuple[str, str]:
    """Return predicate and support of a place such as `plate_1` or `In basket_1_contain_region`."""
    *predicate, support = text.strip("() ").split() or [""]
    if [word.capitalize() for word in predicate] not in ([], ["On"], ["In"]) or {*support} & {*"()"}:
        raise ValueError(
            f"{text!r:.60} is not a place; expected such as plate_1, or In basket_1_contain_region"
        )
    return (predicate or ["On"])[0].capitalize(), support


def _placed(place: Any) -> Any:
    if isinstance(place, dict) and not ("at" in place or place.get("ranges")):
        raise ValueError("it has neither at nor ranges; expected [x, y] or {at: [x, y], half: h}")
    return place


_Place = Annotated[
    Annotated[str, AfterValidator(_support), Tag("text")]
    | Annotated[Rectangle, AfterValidator(_placed), Tag("fields")],
    Discriminator(
        _form,
        custom_error_type="place",
        custom_error_message="expected [x, y], {at: [x, y], half: h}, or the name of what it is on",
    ),
    BeforeValidator(lambda value: {"at": value} if isinstance(value, list) else value),
]


class View(TypedDict, total=False):
    """A camera; see `libero_env.tasks.cameras.Camera`."""

    pos: Required[_Point]
    quat: Annotated[list[_Number], _FOUR]
    lookat: _Point
    fovy: _Number
    body: Name


class Definition(TypedDict, total=False):
    """Keys of a task, without `scene` and `with`."""

    furniture: _Categories
    objects: _Categories
    place: Annotated[dict[Name, _Place], Field(max_length=MAX_ENTITIES)]
    goal: Annotated[list[_Part], Field(max_length=MAX_PARTS), BeforeValidator(_goal)]
    name: Annotated[str, AfterValidator(partial(check_name, what="name"))]
    problem: Name
    language: Annotated[Language, BeforeValidator(_instruction)]
    fixtures: dict[Name, Name]
    regions: dict[Name, Annotated[dict[Name, Rectangle | None], BeforeValidator(_sites)]]
    init: _Atoms
    init_also: _Atoms
    cameras: dict[Name, View]
    zones: Annotated[list[Name], Field(max_length=MAX_PARTS), BeforeValidator(_listed)]
    obj_of_interest: Annotated[list[Name], Field(max_length=MAX_PARTS)]
    scene_properties: dict[Name, Words]


KEYS = ("scene", "with", *Definition.__annotations__)


def check_definition(definition: Any, source: Source) -> Definition:
    """Return a definition, in which parameters are filled in, in one form; keys that are null are left out.

    Raises:
        InvalidInputError: A key does not exist, or a value is not valid; the message has file and line.
    """
    values = {key: value for key, value in definition.items() if value is not None}
    return validate(Definition, values, source=source.name, line_of=source.line_of)
