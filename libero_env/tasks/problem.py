"""The dataclass `Problem`: what a task file says, and the comparison of two.

Every value is checked when it is made, so that whoever has a problem has a valid one. What needs the models of objects
is checked when its scene is built.
"""

from collections.abc import Iterator, Mapping
from dataclasses import field, fields
from typing import Annotated

from pydantic import Field

from libero_env.errors import InvalidInputError
from libero_env.tasks.cameras import Camera
from libero_env.tasks.expression import MAX_PARTS, Atom, Expression, Then
from libero_env.tasks.rules import PLACING, Violation, violations
from libero_env.tasks.values import Colour, EntityName, Language, Name, Rectangle, Words, YawRange
from libero_env.validation import checked
from libero_env.workspaces import WORKSPACES

MAX_CAMERAS = 50  # of a task's own
_TOLERANCE = 1e-9  # largest difference of two equal numbers


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
        if found := tuple(violations(self)):
            raise ProblemError(self, *found)

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
