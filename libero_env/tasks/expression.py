"""Conditions on a state: goals and their parts."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Annotated, Any, TypeVar

from pydantic import Field

from libero_env.errors import InvalidInputError
from libero_env.validation import checked

MAX_DEPTH = 64  # levels of a goal, and of brackets in a task file
MAX_PARTS = 1000  # regions, init atoms, parts of a goal, rectangles of a region

Value = TypeVar("Value")


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


# name, which no predicate has -> class
OPERATORS: dict[str, Any] = {c.__name__.capitalize(): c for c in (And, Or, Not, ForAll, Then, Never, Count)}
