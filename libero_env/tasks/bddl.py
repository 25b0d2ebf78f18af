"""Reading and writing of task files: BDDL text <-> frozen `Problem`.

The dialect is the original LIBERO's: `(define (problem NAME) (:domain ...) (:language ...) (:regions ...)
(:fixtures ...) (:objects ...) (:obj_of_interest ...) (:scene_properties ...) (:init ...) (:goal ...))`, with
`;` comments. The original has neither `(:views ...)`, in which each list is the text of a `Camera`, nor `(:zones ...)`,
which names regions. `:requirements` is ignored. Goals may nest and, or, not and forall, and what the original does not
have: then, never and count. Numbers may be arithmetic with `pi`; nothing in a file is ever executed.
"""

import re
import warnings
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from functools import reduce
from itertools import groupby
from pathlib import Path
from typing import Any, NoReturn

from libero_env.errors import BDDLError, InvalidInputError
from libero_env.storage import read_bounded
from libero_env.tasks.cameras import Camera
from libero_env.tasks.expression import OPERATORS, Atom, Expression
from libero_env.tasks.problem import Problem, ProblemError, Region
from libero_env.tasks.sexpr import MAX_CHARACTERS, List, Word, number, parse_tree, show, text_of

_HEADS = (
    ":domain :requirements :language :regions :fixtures :objects :obj_of_interest :scene_properties :views :zones "
    ":init :goal"
)
SECTIONS = tuple(_HEADS.split())
# field of a problem -> section, where its name is another
_SECTIONS_OF = {"name": ":domain", "cameras": ":views"}
_FORMS = {
    "not": "(Not EXPRESSION)",
    "forall": "(ForAll (?x - CATEGORY) EXPRESSION)",
    "then": "(Then EXPRESSION EXPRESSION ...)",
    "never": "(Never EXPRESSION)",
    "count": "(Count NUMBER EXPRESSION)",
}
_PREDICATE = re.compile(r"[A-Za-z][\w-]*", re.ASCII)


def parse(text: str, file: str = "<string>") -> Problem:
    """Return the problem of a BDDL text.

    Args:
        text: Content of a task file.
        file: Name of the file for error messages.

    Raises:
        BDDLError: The text is not of the dialect, declares a name twice, or has an atom with a name that it does not
            declare; or no scene can be built from it. The message is "file:line: what; expected ...".
    """
    reader = Reader(file)
    try:
        problem = reader.problem(parse_tree(text, file))
    except ProblemError as error:
        first = error.violations[0]
        reader.fail(reader.line(first.section, first.part), first.what, first.expected)
    for section in problem.unknown_sections:
        head = section[1:].split(maxsplit=1)[0].rstrip(")")
        warnings.warn(f"{file}: the section {head} is unknown and has no effect", stacklevel=2)
    return problem


def read(path: str | Path) -> Problem:
    """Return the problem of a task file; see `parse`.

    Raises:
        OSError: The file cannot be read.
        BDDLError: As `parse`.
    """
    return parse(read_text(path), str(path))


def read_text(path: str | Path) -> str:
    """Return the text of a task file; errors as of `read`."""
    try:
        content = read_bounded(Path(path), 4 * MAX_CHARACTERS)
    except OSError as error:
        if error.errno is None:  # it is none that may be read
            expected = f"a task file of at most {MAX_CHARACTERS} characters"
            raise BDDLError(str(error), expected, str(path), 1) from None
        raise OSError(error.errno, error.strerror, str(path)) from error
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        what = f"the byte 0x{content[error.start]:02x}"
        raise BDDLError(what, "UTF-8 text", str(path), line) from None


def parse_expression(text: str, file: str = "<string>", line: int = 1) -> Expression:
    """Return the expression of an atom or goal, such as `On plate_1 stove_1` or `(Or (Open a) (Not (On b c)))`.

    Args:
        text: Text of the expression; the brackets of a single atom may be omitted.
        file: Name of the source for error messages.
        line: Line of the source that the text begins on, from 1.

    Raises:
        BDDLError: As in `parse`.
    """
    return Reader(file).expression(_one_list(text, file, line))


def parse_atom(text: str, file: str = "<string>", line: int = 1) -> Atom:
    """Return the atom of a text such as `On plate_1 stove_1`; see `parse_expression`."""
    return Reader(file).atom(_one_list(text, file, line))


def _one_list(text: str, file: str, line: int) -> List:
    return parse_tree(text if text.lstrip().startswith("(") else f"({text})", file, line)


def write(problem: Problem) -> str:
    """Return a problem as BDDL text in the original's layout; `parse(write(problem)) == problem`."""
    optional = {
        ":scene_properties": [f"(:{kind} {style})" for kind, style in problem.scene_properties.items()],
        ":views": [f"({camera})" for camera in problem.cameras],
        ":zones": problem.zones,
    }
    blocks: dict[str, Iterable[str]] = {
        ":regions": map(_region_text, problem.regions),
        ":fixtures": _typed_names(problem.fixtures),
        ":objects": _typed_names(problem.objects),
        ":obj_of_interest": problem.obj_of_interest,
        **{head: content for head, content in optional.items() if content},
        ":init": map(str, problem.init),
        ":goal": [str(problem.goal)],
    }
    lines = [f"(define (problem {problem.name})", f"  (:domain {problem.domain})"]
    lines.append(f"  (:language {problem.language})")
    for head, content in blocks.items():
        lines += [f"  ({head}", *(f"    {line}" for line in content), "  )"]
    return "\n".join([*lines, *(f"  {text}" for text in problem.unknown_sections), ")\n"])


def _typed_names(names: Mapping[str, str]) -> list[str]:
    groups = groupby(names, key=names.__getitem__)
    return [f"{' '.join(group)} - {category}" for category, group in groups]


def _region_text(region: Region) -> str:
    rows = [f"({region.name} (:target {region.target})"]
    for key, tuples in ((":ranges", region.ranges), (":yaw_rotation", region.yaw)):
        if tuples:
            rows.append(f"({key} ({' '.join(map(_numbers, tuples))}))")
    if region.rgba:
        rows.append(f"(:rgba {_numbers(region.rgba)})")
    return " ".join(rows) + ")"


def _numbers(values: tuple[float, ...]) -> str:
    return f"({' '.join(repr(float(value)) for value in values)})"


class Reader:
    """Conversion of one file into a `Problem`.

    Attributes:
        file: Name of the file for error messages.
        sections: Line of each section.
        entities: Name of an object or fixture -> line.
        regions: Address of a region -> line.
        init: Line of each init atom.
        goal: Line of each atom of the goal, in reading order.
        unknown: Sections that are kept as texts, for readers of their own.
    """

    def __init__(self, file: str):
        self.file = file
        self.sections: dict[str, int] = {}
        self.entities: dict[str, int] = {}
        self.regions: dict[str, int] = {}
        self.init: list[int] = []
        self.goal: list[int] = []
        self.unknown: list[str] = []

    def line(self, section: str, part: int | str | None = None) -> int:
        """Return the line of a part of a section; see `libero_env.tasks.rules.Violation`."""
        lines: Any = dict(enumerate({":init": self.init, ":goal": self.goal}.get(section, ())))
        if isinstance(part, str):
            lines = {**self.regions, **self.entities}
        return lines.get(part, self.sections.get(section, 1))

    def fail(self, line: int, what: str, expected: str) -> NoReturn:
        """Raise the error of a line in this file."""
        raise BDDLError(what, expected, self.file, line)

    def refuse(self, line: int, error: InvalidInputError) -> NoReturn:
        """Raise the error of a value on a line in this file."""
        what, _, expected = str(error).removeprefix("Problem: ").partition("; expected ")
        raise BDDLError(what, expected, self.file, line) from None

    def problem(self, root: List) -> Problem:
        """Return the problem of the tree of a text.

        Raises:
            BDDLError: As in `parse`.
            ProblemError: No scene can be built from it.
        """
        if root.head != "define" or len(root.items) < 2:
            self.fail(root.line, "not a problem", "(define (problem NAME) ...)")
        title, *rest = root.items[1:]
        if not isinstance(title, List) or title.head != "problem" or len(title.items) != 2:
            self.fail(title.line, "no problem name", "(problem NAME)")
        sections: dict[str, List] = {}
        for part in rest:
            section = part if isinstance(part, List) else List((), part.line)
            head, line = section.head, section.line
            if head not in SECTIONS:
                if not head.startswith(":") or get_close_matches(head, SECTIONS, cutoff=0.66):
                    self.fail(
                        line, f"unknown section {head or show(part)!r}", f"one of {', '.join(SECTIONS)}"
                    )
                self.unknown.append(text_of(part))
                continue
            if head in sections:
                self.fail(line, f"a second {head}", f"one (the first is on line {self.sections[head]})")
            sections[head], self.sections[head] = section, line
        for needed in (":language", ":fixtures", ":objects", ":init", ":goal"):
            if needed not in sections:
                expected = f"all of {', '.join(SECTIONS)} but the optional ones"
                self.fail(root.line, f"no ({needed} ...) section", expected)
        if (count := len(sections[":goal"].items) - 1) != 1:
            self.fail(self.sections[":goal"], f"{count} goals", "one, such as (And (On plate_1 stove_1))")
        fields = self.fields({key: section.items[1:] for key, section in sections.items()})
        try:
            return Problem(name=self.word(title.items[1]), **fields)
        except ProblemError:
            raise
        except InvalidInputError as error:  # of one field
            field, place, *_ = (*error.path, None, None)
            self.refuse(self.line(_SECTIONS_OF.get(str(field), f":{field}"), place), error)

    def fields(self, items: Mapping[str, tuple[Word | List, ...]]) -> dict[str, Any]:
        """Return the fields of the problem that the sections of a file have."""
        init = tuple(map(self.atom, items[":init"]))
        self.init, self.goal = self.goal, []
        properties = [self.scene_property(node) for node in items.get(":scene_properties", ())]
        if len(properties) > len(dict(properties)):
            self.fail(self.sections[":scene_properties"], "two properties of one kind", "each once")
        return {
            "domain": " ".join(map(self.word, items.get(":domain", ()))) or "robosuite",
            "language": " ".join(map(self.word, items[":language"])),
            "regions": tuple(map(self.region, items.get(":regions", ()))),
            "fixtures": self.names(items[":fixtures"]),
            "objects": self.names(items[":objects"]),
            "obj_of_interest": tuple(map(self.word, items.get(":obj_of_interest", ()))),
            "scene_properties": dict(properties),
            "cameras": tuple(map(self.camera, items.get(":views", ()))),
            "zones": tuple(map(self.word, items.get(":zones", ()))),
            "init": init,
            "unknown_sections": tuple(self.unknown),
            "goal": self.expression(items[":goal"][0]),
        }

    def word(self, node: Word | List) -> str:
        """Return the text of a word, in which brackets are an error."""
        if isinstance(node, List):
            self.fail(node.line, f"a list {show(node)}", "a word")
        return node.text

    def names(self, words: Iterable[Word | List]) -> dict[str, str]:
        """Return {a_1: a, a_2: a, b_1: b} for `a_1 a_2 - a  b_1 - b`."""
        categories: dict[str, str] = {}
        waiting: list[tuple[str, int]] = []
        items = iter(words)
        for item in items:
            if (word := self.word(item)) != "-":
                waiting.append((word, item.line))
                continue
            category = next(items, None)
            if not waiting or category is None:
                self.fail(
                    item.line, "a - without names before it or a category after it", "NAME NAME - CATEGORY"
                )
            for name, line in waiting:
                if name in categories:
                    self.fail(line, f"{name} is declared twice", "each name declared once")
                categories[name], self.entities[name] = self.word(category), line
            waiting = []
        if waiting:
            name, line = waiting[0]
            self.fail(line, f"{name} has no category", "NAME NAME - CATEGORY")
        return categories

    def region(self, node: Word | List) -> Region:
        """Return the region of one entry of `:regions`."""
        if not isinstance(node, List) or len(node.items) < 2:
            self.fail(node.line, f"not a region: {show(node)}", "(NAME (:target NAME) ...)")
        fields: dict[str, Any] = {}
        seen: set[str] = set()
        for part in node.items[1:]:
            head = part.head if isinstance(part, List) and len(part.items) == 2 else ""
            value = part.items[1] if isinstance(part, List) and head else part
            if head in seen:
                self.fail(part.line, f"a second {head} in a region", "one")
            seen.add(head)
            if head == ":target":
                fields["target"] = self.word(value)
            elif head in (":ranges", ":yaw_rotation"):
                width, key = (4, "ranges") if head == ":ranges" else (2, "yaw")
                if not isinstance(value, List):
                    self.fail(value.line, f"{head} {value.text}", "a list of lists of numbers")
                fields[key] = tuple(self.numbers(row, width, head) for row in value.items)
            elif head == ":rgba":
                fields["rgba"] = self.numbers(value, 4, head)
            else:
                valid = "(:target X), (:ranges (...)), (:yaw_rotation (...)) or (:rgba (...))"
                self.fail(part.line, f"{show(part)} in a region", valid)
        if "target" not in fields:
            self.fail(node.line, f"region {show(node.items[0])} has no target", "(:target NAME)")
        try:
            region = Region(name=self.word(node.items[0]), **fields)
        except InvalidInputError as error:
            self.refuse(node.line, error)
        self.regions[region.address] = node.line
        return region

    def numbers(self, node: Word | List, count: int, head: str) -> tuple[float, ...]:
        """Return the `count` numbers of a list."""
        if not isinstance(node, List) or len(node.items) != count:
            self.fail(node.line, f"{show(node)} in {head}", f"a list of {count} numbers")
        return tuple(self.number(item) for item in node.items)

    def number(self, node: Word | List) -> float:
        """Return the value of a word that is a number."""
        try:
            return number(self.word(node))
        except ValueError:
            self.fail(node.line, f"{show(node)} is not a number", "a finite number such as 0.25 or -pi/4")

    def scene_property(self, node: Word | List) -> tuple[str, str]:
        """Return kind and style of an entry of `:scene_properties`."""
        if not isinstance(node, List) or not node.head.startswith(":"):
            self.fail(node.line, f"not a scene property: {show(node)}", "(:floor STYLE) or (:wall STYLE)")
        return node.head[1:], " ".join(map(self.word, node.items[1:]))

    def camera(self, node: Word | List) -> Camera:
        """Return the camera of an entry of `:views`."""
        words = map(self.word, node.items if isinstance(node, List) else [node])
        try:
            return Camera.read(" ".join(words))
        except InvalidInputError as error:
            self.refuse(node.line, error)

    def atom(self, node: Word | List) -> Atom:
        """Return the atom of a list."""
        if not isinstance(node, List) or len(node.items) < 2:
            self.fail(node.line, f"not an atom: {show(node)}", "(PREDICATE NAME ...)")
        predicate, *args = map(self.word, node.items)
        if not _PREDICATE.fullmatch(predicate):
            self.fail(node.line, f"{predicate} is not a predicate", "letters, such as On, In, Open or Turnon")
        self.goal.append(node.line)
        return Atom(predicate.capitalize(), tuple(args))

    def expression(self, node: Word | List) -> Expression:
        """Return the expression of a list."""
        parts = node.items[1:] if isinstance(node, List) else ()
        head = node.head if isinstance(node, List) else ""
        make: Any = OPERATORS.get(head.capitalize())
        if head in ("and", "or"):
            return make(tuple(map(self.expression, parts)))
        if head in ("not", "never") and len(parts) == 1:
            return make(self.expression(parts[0]))
        if head == "then" and len(parts) > 1:
            return reduce(lambda before, after: make((before, after)), map(self.expression, parts))
        if head == "count" and len(parts) == 2:
            return make(self.times(parts[0]), self.expression(parts[1]))
        if head == "forall" and len(parts) == 2 and isinstance(parts[0], List):
            variables = Reader(self.file).names(parts[0].items)
            return make(tuple(variables.items()), self.expression(parts[1]))
        if head in _FORMS:
            self.fail(node.line, show(node), _FORMS[head])
        return self.atom(node)

    def times(self, node: Word | List) -> int:
        """Return the number of a Count."""
        word = self.word(node)
        if not re.fullmatch("[1-9][0-9]{0,2}", word):
            self.fail(node.line, f"{show(node)} in a Count", "a whole number from 1 to 999")
        return int(word)
