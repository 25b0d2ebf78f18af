"""The dataclass `Problem`, its parts, and the comparison of two problems."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from typing import TypeVar

Value = TypeVar("Value")


@dataclass(frozen=True)
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

    name: str
    target: str
    ranges: tuple[tuple[float, float, float, float], ...] = ()
    yaw: tuple[tuple[float, float], ...] = ()
    rgba: tuple[float, ...] = ()

    @property
    def address(self) -> str:
        """Name of the region in atoms, such as `floor_bin_region`."""
        return f"{self.target}_{self.name}"


class Expression:
    """A condition on a state: an atom, or one made of other conditions. As a text it is as in task files."""

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

    def __str__(self) -> str:
        return f"({' '.join((type(self).__name__, *map(str, self.children)))})"


@dataclass(frozen=True)
class Atom(Expression):
    """A predicate applied to names, such as `On butter_1 floor_bin_region`; its predicate is capitalised."""

    predicate: str
    args: tuple[str, ...]

    def atoms(self) -> "tuple[Atom, ...]":
        """Return the atom itself."""
        return (self,)

    def __str__(self) -> str:
        return f"({' '.join((self.predicate, *self.args))})"


class _Several(Expression):
    """A node with any number of children."""

    parts: tuple[Expression, ...]

    @property
    def children(self) -> tuple[Expression, ...]:
        return self.parts

    def map(self, function: Callable[[Expression], Expression]) -> Expression:
        return type(self)(tuple(map(function, self.parts)))


@dataclass(frozen=True)
class And(_Several):
    """Conjunction: holds if all parts hold."""

    parts: tuple[Expression, ...]


@dataclass(frozen=True)
class Or(_Several):
    """Disjunction: holds if any part holds."""

    parts: tuple[Expression, ...]


@dataclass(frozen=True)
class Not(Expression):
    """Negation: holds if the part does not."""

    part: Expression

    @property
    def children(self) -> tuple[Expression, ...]:
        """The part."""
        return (self.part,)

    def map(self, function: Callable[[Expression], Expression]) -> Expression:
        """Return the negation of what a function returns for the part."""
        return Not(function(self.part))


@dataclass(frozen=True)
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


@dataclass(frozen=True)
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
    """

    name: str
    language: str
    goal: Expression
    fixtures: Mapping[str, str] = field(hash=False)
    objects: Mapping[str, str] = field(hash=False)
    regions: tuple[Region, ...] = ()
    init: tuple[Atom, ...] = ()
    obj_of_interest: tuple[str, ...] = ()
    scene_properties: Mapping[str, str] = field(default_factory=dict, hash=False)
    domain: str = "robosuite"

    def __eq__(self, other: object) -> bool:
        """Return whether all fields are equal, the order of fixtures and objects included."""
        return isinstance(other, Problem) and self._key() == other._key()

    def _key(self) -> tuple[object, ...]:
        values = (getattr(self, field.name) for field in fields(self))
        return tuple(tuple(value.items()) if isinstance(value, Mapping) else value for value in values)

    def region(self, address: str) -> Region | None:
        """Return the region with an address such as `floor_bin_region`; None where it is not declared."""
        return next((region for region in self.regions if region.address == address), None)


def differences(a: Problem, b: Problem, tolerance: float = 1e-9) -> list[str]:
    """Return the differences in meaning of two problems, one line each; empty if they describe the same task.

    The order of fixtures and objects matters (it is the joint order). The order of regions, of init atoms and of the
    parts of a conjunction does not, nor do case and spacing of the language.

    Args:
        a: First problem.
        b: Second problem.
        tolerance: Largest difference of two equal numbers.
    """
    words = lambda p: " ".join(p.language.split()).casefold()  # noqa: E731
    pairs = {
        "name": (a.name.casefold(), b.name.casefold()),
        "language": (words(a), words(b)),
        "fixtures": (list(a.fixtures.items()), list(b.fixtures.items())),
        "objects": (list(a.objects.items()), list(b.objects.items())),
        "obj_of_interest": (set(a.obj_of_interest), set(b.obj_of_interest)),
        "scene_properties": (dict(a.scene_properties), dict(b.scene_properties)),
        "init": (set(a.init), set(b.init)),
        "goal": (a.goal.fold(_meaning), b.goal.fold(_meaning)),
    }
    found = [f"{what}: {x} is not {y}" for what, (x, y) in pairs.items() if x != y]
    regions_a, regions_b = ({region.address: region for region in p.regions} for p in (a, b))
    for address in sorted(regions_a.keys() | regions_b.keys()):
        x, y = regions_a.get(address), regions_b.get(address)
        if x is None or y is None or not _same_region(x, y, tolerance):
            found.append(f"region {address}: {x} is not {y}")
    return found


def same_meaning(a: Problem, b: Problem) -> bool:
    """Return whether two problems describe the same task; see `differences`."""
    return not differences(a, b)


def _meaning(node: Expression, parts: Iterator[object]) -> object:
    """Return a value that is equal for nodes with the same parts in any order."""
    if isinstance(node, Atom):
        return node
    return type(node).__name__, getattr(node, "variables", ()), frozenset(parts)


def _same_region(x: Region, y: Region, tolerance: float) -> bool:
    def close(p, q) -> bool:
        flat_p, flat_q = ([value for row in rows for value in row] for rows in (p, q))
        return len(flat_p) == len(flat_q) and all(
            abs(s - t) <= tolerance for s, t in zip(flat_p, flat_q, strict=True)
        )

    return close(x.ranges, y.ranges) and close(x.yaw, y.yaw) and close([x.rgba], [y.rgba])
