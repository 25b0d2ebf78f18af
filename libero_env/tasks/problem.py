"""The dataclass `Problem`: what a task file says. Its parts, what makes one valid, and the comparison of two.

Every value is checked when it is made, so that whoever has a problem has a valid one. What needs the models of objects
is checked when its scene is built.
"""

import inspect
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, TypeVar

from pydantic import Field

from libero_env.errors import InvalidInputError
from libero_env.parallel import send_to_workers
from libero_env.tasks.cameras import Camera
from libero_env.tasks.values import NAME, Colour, EntityName, Language, Name, Rectangle, Words, YawRange
from libero_env.text import suggest
from libero_env.validation import checked
from libero_env.workspaces import WORKSPACES

MAX_DEPTH = 64  # levels of a goal, and of brackets in a task file
MAX_PARTS = 1000  # regions, init atoms, parts of a goal, rectangles of a region
MAX_CAMERAS = 50  # of a task's own
MAX_ENTITIES = 100  # objects and fixtures of a scene
_MAX_EVALUATIONS = 10_000  # atoms of a goal, counted for each object that its quantifiers stand for

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?", re.IGNORECASE | re.ASCII)
_VARIABLE = re.compile(r"\??\w[\w.-]*")
PLACING = ("On", "In")  # predicates of init atoms that give an entity its place
_TOLERANCE = 1e-9  # largest difference of two equal numbers

Value = TypeVar("Value")


@checked
class Region:
    """A place on or in a fixture, object or workspace.

    Attributes:
        name: Name, unique within the target.
        target: Name of the fixture, object or workspace.
        ranges: Rectangles (x0, y0, x1, y1) in the frame of the target, [m]. A region without any is a site of the
            target's model, such as a drawer or the inside of a basket.
        yaw: Ranges (low, high) of the yaw of what is placed there, [rad].
        rgba: Colour in task files; nothing is drawn.
    """

    name: Name
    target: Name
    ranges: Annotated[tuple[Rectangle, ...], Field(max_length=MAX_PARTS)] = ()
    yaw: tuple[YawRange, ...] = ()
    rgba: Colour = ()

    @property
    def address(self) -> str:
        """Name of the region in atoms, such as `floor_bin_region`."""
        return f"{self.target}_{self.name}"


class Expression:
    """A condition on a state: an atom, or one made of other conditions. As a text it is as in task files."""

    levels: int  # of conditions within each other
    size: int  # number of conditions

    def __post_init__(self) -> None:
        object.__setattr__(self, "levels", 1 + max((child.levels for child in self.children), default=0))
        object.__setattr__(self, "size", 1 + sum(child.size for child in self.children))
        if self.levels > MAX_DEPTH or self.size > MAX_PARTS:
            raise InvalidInputError(
                f"the goal is too large; expected at most {MAX_DEPTH} levels and {MAX_PARTS} parts"
            )

    @property
    def children(self) -> "tuple[Expression, ...]":
        """Conditions that it is made of."""
        return ()

    def map(self, function: "Callable[[Expression], Expression]") -> "Expression":
        """Return the same condition made of what a function returns for each child; an atom is returned as it is."""
        return self

    def fold(self, function: "Callable[[Expression, Iterator[Value]], Value]") -> Value:
        """Return what a function makes of a node and of the values of its children, which are computed when asked for.

        Args:
            function: Function of a node and its children's values, called from the leaves upwards.
        """
        return function(self, (child.fold(function) for child in self.children))

    def atoms(self) -> "tuple[Atom, ...]":
        """Return all atoms, in reading order."""
        return tuple(atom for child in self.children for atom in child.atoms())

    def wanted(self) -> "tuple[Atom, ...]":
        """Return the atoms that are not in a `Never`."""
        return () if isinstance(self, Never) else tuple(a for child in self.children for a in child.wanted())

    def __str__(self) -> str:
        return f"({' '.join((type(self).__name__, *map(str, self.children)))})"


@checked
class Atom(Expression):
    """A predicate applied to names, such as `On butter_1 floor_bin_region`; its predicate is capitalised."""

    predicate: str
    args: Annotated[tuple[str, ...], Field(min_length=1)]

    def atoms(self) -> "tuple[Atom, ...]":
        """Return the atom itself."""
        return (self,)

    wanted = atoms

    def __str__(self) -> str:
        return f"({' '.join((self.predicate, *self.args))})"


@checked
class _Several(Expression):
    """A node with any number of children."""

    parts: tuple[Expression, ...]

    @property
    def children(self) -> tuple[Expression, ...]:
        return self.parts

    def map(self, function: Callable[[Expression], Expression]) -> Expression:
        return type(self)(tuple(map(function, self.parts)))


@checked
class And(_Several):
    """Conjunction: holds if all parts hold."""


@checked
class Or(_Several):
    """Disjunction: holds if any part holds."""


@checked
class Then(_Several):
    """Order: the second part holds, and began to hold after a moment of the episode in which the first did."""

    parts: Annotated[tuple[Expression, ...], Field(min_length=2, max_length=2)]


class _OfOne(Expression):
    """A node with one child."""

    part: Expression

    @property
    def children(self) -> tuple[Expression, ...]:
        return (self.part,)

    def map(self, function: Callable[[Expression], Expression]) -> Expression:
        return replace(self, part=function(self.part))  # type: ignore[type-var]


@checked
class Not(_OfOne):
    """Negation: holds if the part does not."""

    part: Expression


@checked
class Never(_OfOne):
    """Prohibition: holds if the part has held at no moment of the episode."""

    part: Expression


@checked
class Count(_OfOne):
    """Repetition: holds if the part has become true at least so often in the episode; at the start does not count."""

    number: Annotated[int, Field(ge=1, le=999)]
    part: Expression

    def __str__(self) -> str:
        return f"(Count {self.number} {self.part})"


@checked
class ForAll(Expression):
    """Quantifier: holds if the body holds for each object of the categories; variables are (`?name`, category)."""

    variables: tuple[tuple[str, str], ...]
    body: Expression

    @property
    def children(self) -> tuple[Expression, ...]:
        """The body."""
        return (self.body,)

    def map(self, function: Callable[[Expression], Expression]) -> Expression:
        """Return the quantifier with what a function returns for the body."""
        return ForAll(self.variables, function(self.body))

    def __str__(self) -> str:
        variables = " ".join(f"{name} - {category}" for name, category in self.variables)
        return f"(ForAll ({variables}) {self.body})"


@checked
class Problem:
    """Content of a task file.

    Attributes:
        name: Name of the problem class, such as `LIBERO_Floor_Manipulation`.
        language: Instruction in `:language`.
        goal: Condition of success.
        fixtures: Name -> category, the workspace included, in the order of the file, which is that of the joints.
        objects: Name -> category, in the order of the file, which is that of the joints.
        regions: Places that are declared.
        init: Initial conditions.
        obj_of_interest: Names of the objects that the task is about.
        scene_properties: Kind (`floor`, `wall`, `scene`) -> style.
        domain: Name of the planning domain.
        unknown_sections: Texts of sections that only a reader of one's own knows, such as `(:camera ...)`.
        cameras: Cameras that the scene has besides those of its workspace and of the robot.
        zones: Addresses of regions from which the robot should keep away, see `libero_env.sim.costs`.

    Raises:
        ProblemError: No scene can be built from it.
        InvalidInputError: A field is of another type, or too large.
    """

    name: Name
    language: Language
    goal: Expression
    fixtures: Mapping[EntityName, Name] = field(hash=False)
    objects: Mapping[EntityName, Name] = field(hash=False)
    regions: Annotated[tuple[Region, ...], Field(max_length=MAX_PARTS)] = ()
    init: Annotated[tuple[Atom, ...], Field(max_length=MAX_PARTS)] = ()
    obj_of_interest: tuple[Name, ...] = ()
    scene_properties: Mapping[Name, Words] = field(default_factory=dict, hash=False)
    domain: Words = "robosuite"
    unknown_sections: tuple[str, ...] = ()
    cameras: Annotated[tuple[Camera, ...], Field(max_length=MAX_CAMERAS)] = ()
    zones: Annotated[tuple[Name, ...], Field(max_length=MAX_PARTS)] = ()

    def __post_init__(self) -> None:
        if violations := tuple(_violations(self)):
            raise ProblemError(self, *violations)

    def __eq__(self, other: object) -> bool:
        """Return whether all fields are equal, the order of fixtures and objects included."""
        return isinstance(other, Problem) and self._key() == other._key()

    def _key(self) -> tuple[object, ...]:
        values = (getattr(self, field.name) for field in fields(self))
        return tuple(tuple(value.items()) if isinstance(value, Mapping) else value for value in values)

    @property
    def places(self) -> dict[str, str]:
        """Place of each object and fixture at the start: the address of a region, or a name."""
        return {atom.args[0]: atom.args[1] for atom in self.init if atom.predicate in PLACING}

    def region(self, address: str) -> Region | None:
        """Return the region with an address such as `floor_bin_region`; None where it is not declared."""
        return next((region for region in self.regions if region.address == address), None)

    def kind_of(self, name: str) -> str | None:
        """Return `object`, `fixture`, `workspace` or `region`; None for a name that is not declared."""
        if category := self.fixtures.get(name):
            return "workspace" if category in WORKSPACES else "fixture"
        if name in self.objects:
            return "object"
        return None if self.region(name) is None else "region"


@dataclass(frozen=True)
class Violation:
    """What is wrong with a problem, and where.

    Attributes:
        rule: Name of the rule, such as `region-ranges`.
        what: What is wrong.
        expected: What is valid.
        section: Section of a task file, such as `:regions`.
        part: Name of an object, fixture or region in it, or the number of an atom; None for all of the section.
    """

    rule: str
    what: str
    expected: str
    section: str
    part: str | int | None = None


class ProblemError(InvalidInputError):
    """A problem that no scene can be built from; the message names the task and the first thing that is wrong.

    Attributes:
        problem: The problem, for reports.
        violations: All that is wrong.
    """

    def __init__(self, problem: Problem, *violations: Violation):
        first, language = violations[0], problem.language
        super().__init__(f"task {language!r:.80}, {first.section}: {first.what}; expected {first.expected}")
        self.problem, self.violations = problem, violations

    def __reduce__(self) -> tuple[type, tuple[object, ...]]:
        """Let worker processes send the error: its arguments are not its message."""
        return type(self), (self.problem, *self.violations)


# Kinds of names that the arguments of predicates may have; predicates that are not in `KINDS` take anything.
_ENTITY = frozenset({"object", "fixture"})
_PLACE = _ENTITY | {"region"}
_SOLID = _ENTITY | {"workspace"}
_ANY, _NUMERIC = _PLACE | _SOLID, frozenset({"number"})
KINDS: dict[str, tuple[frozenset[str], ...]] = {
    "In": (_ENTITY, frozenset({"region"})),
    **dict.fromkeys(("On", "Stack"), (_ENTITY, _PLACE)),
    "Up": (_ENTITY,),
    **dict.fromkeys(("Open", "Close", "Turnon", "Turnoff", "Printjointstate"), (_PLACE,)),
    "Incontact": (_SOLID, _SOLID),
}
# name, which no predicate has -> class
OPERATORS: dict[str, Any] = {c.__name__.capitalize(): c for c in (And, Or, Not, ForAll, Then, Never, Count)}
BUILTIN_PREDICATES = frozenset(KINDS) | {"True", "False"}
send_to_workers(__name__, "KINDS")


def declare_predicate(predicate: str, function: Callable[..., bool]) -> tuple[int, ...]:
    """Set the arguments of a predicate from those of its function: numbers where they are annotated so, or of any kind.

    Args:
        predicate: Name of the predicate, capitalised.
        function: Function of a state and of the arguments. One that takes any number of them may have any number.

    Returns:
        Indices of the arguments that are numbers.
    """
    KINDS.pop(predicate, None)
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):  # of some functions in C
        return ()
    plain = all(
        p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) and p.default is p.empty for p in parameters
    )
    numbers = tuple(i for i, p in enumerate(parameters[1:]) if p.annotation in (float, "float"))
    if plain and len(parameters) > 1:
        KINDS[predicate] = tuple(_NUMERIC if i in numbers else _ANY for i in range(len(parameters) - 1))
    return numbers


def _violations(problem: Problem) -> Iterator[Violation]:
    """Yield what is wrong with a problem whose fields have the right types."""
    if (count := len(problem.objects) + len(problem.fixtures)) > MAX_ENTITIES:
        yield Violation("size", f"{count} objects and fixtures", f"at most {MAX_ENTITIES}", ":objects")
        return
    for name in sorted(problem.fixtures.keys() & problem.objects.keys()):
        yield Violation("name", f"{name} is a fixture too", "each name declared once", ":objects", name)
    for camera, count in Counter(camera.name for camera in problem.cameras).items():
        if count > 1:
            yield Violation("name", f"{count} cameras {camera}", "each name once", ":views", camera)
    for kind in problem.scene_properties:
        if kind != kind.casefold():
            yield Violation("name", f"the scene property {kind}", "floor, wall or scene", ":scene_properties")
    for zone in problem.zones:
        if problem.region(zone) is None:
            valid = ", ".join(region.address for region in problem.regions) or "a region that is declared"
            yield Violation("unknown-name", f"the zone {zone} is not a region", f"one of {valid}", ":zones")
    used = {name for atom in (*problem.init, *problem.goal.atoms()) for name in atom.args} | {*problem.zones}
    count_of = Counter(region.address for region in problem.regions)
    for region in problem.regions:
        for rule, what, expected in _region(
            problem, region, region.address in used, count_of[region.address]
        ):
            yield Violation(rule, f"{region.address}{what}", expected, ":regions", region.address)
    for i, atom in enumerate(problem.init):
        for rule, what, expected in _atom(problem, atom):
            yield Violation(rule, f"{atom}{what}", expected, ":init", i)
    yield from _places(problem)
    yield from _goal(problem)


def _region(problem: Problem, region: Region, is_used: bool, count: int) -> Iterator[tuple[str, str, str]]:
    """Check that a region has a name of its own, and is a rectangle on the workspace or a site of something else.

    Yields:
        Rule, what is wrong (after the address of the region), and what is valid.
    """
    if count > 1:
        yield "name", " is declared twice", "each region of a target once"
    elif region.address in problem.objects or region.address in problem.fixtures:
        yield "name", f" is both a region of {region.target} and an object or fixture", "different names"
    if not is_used:
        return
    kind = problem.kind_of(region.target)
    if kind is None or kind == "region":
        entities = ", ".join(sorted({**problem.fixtures, **problem.objects}))
        yield "region-target", f": its target {region.target} is not declared", f"one of {entities}"
    elif kind == "workspace" and not region.ranges:
        yield "region-ranges", " has no extent", "(:ranges ((X0 Y0 X1 Y1))), metres"
    elif kind != "workspace" and region.ranges:
        what = f": ranges are for the workspace only, but {region.target} is {_article(kind)}"
        valid = f"a fixture of {', '.join(WORKSPACES)}, or no :ranges, which is the site of that name"
        yield "region-ranges", what, valid
    if len(region.yaw) > 1:
        yield "region-yaw", f" has {len(region.yaw)} ranges of yaw", "one"
    elif region.yaw and not region.ranges:
        yield "region-yaw", " has a yaw, but no rectangle in which something is turned", "no yaw"


def _atom(
    problem: Problem, atom: Atom, bound: frozenset[str] = frozenset()
) -> Iterator[tuple[str, str, str]]:
    """Check number and kinds of the arguments of an atom; what is yielded is as of `_region`."""
    kinds, count = KINDS.get(atom.predicate), len(atom.args)
    is_own = atom.predicate not in BUILTIN_PREDICATES  # a user's predicate takes numbers and words too
    if kinds is not None and count != len(kinds):
        yield "arity", f" has {_names(count)}", f"{len(kinds)}: {atom.predicate} takes {_names(len(kinds))}"
        return
    for i, name in enumerate(atom.args):
        kind = "object" if name in bound else problem.kind_of(name)
        if kind is None and name == "robot" and atom.predicate == "Incontact":
            continue
        if kinds is not None and kinds[i] == _NUMERIC:
            if not _NUMBER.fullmatch(name):
                yield "kind", f": {name} is not a number", "one such as 0.05 there"
        elif kind is None:
            if is_own and _NUMBER.fullmatch(name):
                continue
            declared = sorted(
                {*problem.fixtures, *problem.objects, *(r.address for r in problem.regions), *bound}
            )
            near = suggest(name, declared)
            if is_own and not near and NAME.fullmatch(name):
                continue  # a word
            valid = f"one of {', '.join(declared)}" if declared else "a declared name"
            yield "unknown-name", f": {name} is not declared{near and '.'}{near}", valid
        elif kinds is not None and kind not in kinds[i]:
            yield (
                "kind",
                f": {name} is {_article(kind)}",
                f"{' or '.join(map(_article, sorted(kinds[i])))} there",
            )
    if kinds is not None and count == 2 and atom.args[0] == atom.args[1]:
        yield "kind", f" is of {atom.args[0]} and itself", "two names"


def _article(kind: str) -> str:
    return f"an {kind}" if kind[0] in "aeiou" else f"a {kind}"


def _names(count: int) -> str:
    return f"{count} name{'s' if count != 1 else ''}"


def _places(problem: Problem) -> Iterator[Violation]:
    """Check that fixtures stand on the workspace, and nothing is placed twice or, by way of others, on itself."""
    placing = [
        (i, atom) for i, atom in enumerate(problem.init) if atom.predicate in PLACING and len(atom.args) == 2
    ]
    counts = Counter(atom.args[0] for _, atom in placing)
    carriers: dict[str, str] = {}
    for i, atom in placing:
        name, place = atom.args
        if name in carriers and (count := counts.pop(name, 1)) > 1:
            what = f"{name} is placed {count} times"
            yield Violation("placed-twice", what, "one atom that places it", ":init", i)
        region = problem.region(place)
        carriers[name] = place if region is None else region.target
        if problem.kind_of(name) == "fixture" and not (atom.predicate == "On" and region and region.ranges):
            what = f"{atom} does not place it: a fixture stands on a rectangle of the workspace"
            yield Violation("kind", what, "such as [0, 0.2] or, in BDDL, a region with :ranges", ":init", i)
    for i, atom in placing:
        seen, name = set[str](), atom.args[0]
        while name in carriers and name not in seen:
            seen.add(name)
            name = carriers[name]
        if name == atom.args[0] and name in seen and atom.args[0] != atom.args[1]:
            what = f"{atom} places it, by way of others, on itself"
            yield Violation("placed-in-a-circle", what, "one of them on the workspace", ":init", i)


def _goal(problem: Problem) -> Iterator[Violation]:
    """Check the atoms of a goal, that no part of it is empty, and how often quantifiers repeat it."""
    categories = Counter(problem.objects.values())
    index = evaluations = 0

    def visit(node: Expression, bound: frozenset[str], times: int) -> Iterator[Violation]:
        nonlocal index, evaluations
        if isinstance(node, Atom):
            for rule, what, expected in _atom(problem, node, bound):
                yield Violation(rule, f"{node}{what}", expected, ":goal", index)
            index, evaluations = index + 1, evaluations + times
        elif not node.children:
            always = "always" if isinstance(node, And) else "never"
            what = f"an empty {type(node).__name__} is {always} true"
            yield Violation("empty-goal", what, "the conditions that must hold", ":goal")
        elif isinstance(node, ForAll):
            for variable, category in node.variables:
                times *= categories[category]
                if not categories[category]:
                    what = f"no object is a {category}: {variable} has no values and the part is always true"
                    yield Violation("empty-goal", what, f"one of {', '.join(sorted(categories))}", ":goal")
                if not _VARIABLE.fullmatch(variable) or problem.kind_of(variable) is not None:
                    what = f"the variable {variable!r:.80}"
                    yield Violation("name", what, "a new name such as ?x", ":goal")
            bound |= {name for name, _ in node.variables}
        for child in node.children:
            yield from visit(child, bound, times)

    yield from visit(problem.goal, frozenset(), 1)
    if evaluations > _MAX_EVALUATIONS:
        what = f"its quantifiers stand for {evaluations} atoms"
        yield Violation("size", what, f"at most {_MAX_EVALUATIONS}", ":goal")


def differences(a: Problem, b: Problem) -> list[str]:
    """Return the differences in meaning of two problems, one line each; empty if they describe the same task.

    The order of fixtures and objects matters (it is the joint order). The order of regions, of init atoms and of the
    parts of a conjunction does not, nor do case and spacing of the language.
    """
    words = lambda p: " ".join(p.language.split()).casefold()  # noqa: E731
    pairs = {
        "name": (a.name.casefold(), b.name.casefold()),
        "language": (words(a), words(b)),
        "fixtures": (list(a.fixtures.items()), list(b.fixtures.items())),
        "objects": (list(a.objects.items()), list(b.objects.items())),
        "obj_of_interest": (set(a.obj_of_interest), set(b.obj_of_interest)),
        "cameras": (set(a.cameras), set(b.cameras)),
        "zones": (set(a.zones), set(b.zones)),
        "scene_properties": (dict(a.scene_properties), dict(b.scene_properties)),
        "init": (set(a.init), set(b.init)),
        "goal": (a.goal.fold(_meaning), b.goal.fold(_meaning)),
    }
    lines = [f"{what}: {x} is not {y}" for what, (x, y) in pairs.items() if x != y]
    regions_a, regions_b = ({region.address: region for region in p.regions} for p in (a, b))
    for address in sorted(regions_a.keys() | regions_b.keys()):
        x, y = regions_a.get(address), regions_b.get(address)
        if x is None or y is None or not _same_region(x, y):
            lines.append(f"region {address}: {x} is not {y}")
    return lines


def same_meaning(a: Problem, b: Problem) -> bool:
    """Return whether two problems describe the same task; see `differences`."""
    return not differences(a, b)


def _meaning(node: Expression, parts: Iterator[object]) -> object:
    """Return a value that is equal for nodes with the same parts in any order."""
    if isinstance(node, Atom):
        return node
    what = (getattr(node, "variables", ()), getattr(node, "number", 1))
    return type(node).__name__, what, (tuple if isinstance(node, Then) else frozenset)(parts)


def _same_region(x: Region, y: Region) -> bool:
    def shape(region: Region) -> tuple[int, int, int]:
        return len(region.ranges), len(region.yaw), len(region.rgba)

    def numbers(region: Region) -> list[float]:
        return [value for row in (*region.ranges, *region.yaw, region.rgba) for value in row]

    pairs = zip(numbers(x), numbers(y), strict=False)
    return shape(x) == shape(y) and all(abs(s - t) <= _TOLERANCE for s, t in pairs)
