"""The dataclass `Perturbation`, and its text: `camera=0.3,light=0.5`."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from libero_env.errors import InvalidInputError
from libero_env.perturbations.catalog import KINDS, get_kind
from libero_env.perturbations.kind import Kind
from libero_env.text import shown

EXPECTED = "expected KIND=SEVERITY, or several with commas between: camera=0.3,light=0.5"
_MAX_SEED = 2**63 - 1


@dataclass(frozen=True)
class Perturbation:
    """A change of a task or of its episodes.

    Attributes:
        kind: Name of the kind, see `libero_env.perturbations.catalog.KINDS`.
        severity: Severity in [0, 1]; 0 changes nothing, and the kind says what 1 is.
        seed: Seed of what is drawn.

    Raises:
        UnknownNameError: The kind does not exist.
        InvalidInputError: Severity or seed are out of range.
    """

    kind: str
    severity: float
    seed: int = 0

    def __post_init__(self) -> None:
        name = get_kind(self.kind).name
        if isinstance(self.severity, bool) or not isinstance(self.severity, int | float):
            raise InvalidInputError(f"{name}: severity {shown(self.severity)}; expected a number from 0 to 1")
        if not (math.isfinite(self.severity) and 0 <= self.severity <= 1):
            raise InvalidInputError(f"{name}: severity {self.severity:g}; expected a number from 0 to 1")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or not 0 <= self.seed <= _MAX_SEED:
            raise InvalidInputError(f"{name}: seed {shown(self.seed)}; expected a whole number from 0")

    @property
    def definition(self) -> Kind:
        """Kind of the perturbation."""
        return KINDS[self.kind]

    @property
    def amount(self) -> float:
        """Physical amount, in the unit of the kind."""
        return self.definition.amount(self.severity)

    def __str__(self) -> str:
        seed = f"@{self.seed}" if self.seed else ""
        return f"{self.kind}={float(self.severity):g}{seed}"


def parse_perturbations(text: str, seed: int = 0) -> tuple[Perturbation, ...]:
    """Return the perturbations of a text, in the order in which they are applied.

    Args:
        text: `KIND=SEVERITY` with commas between; `camera=0.3@7` has the seed 7.
        seed: Seed of those that name none.

    Raises:
        UnknownNameError: A kind does not exist.
        InvalidInputError: A part has another form, a severity is out of range, or kinds exclude each other.
    """
    found = []
    for part in filter(None, map(str.strip, text.split(","))):
        kind, equals, rest = part.partition("=")
        severity, at, own = rest.partition("@")
        get_kind(kind.strip())
        try:
            values = float(severity), int(own) if at else seed
        except ValueError:
            raise InvalidInputError(f"perturbation {shown(part)}: {EXPECTED}") from None
        if not equals:
            raise InvalidInputError(f"perturbation {shown(part)}: {EXPECTED}")
        found.append(Perturbation(kind.strip(), *values))
    return in_order(found)


def in_order(perturbations: Iterable[Perturbation]) -> tuple[Perturbation, ...]:
    """Return perturbations in the order in which they are applied.

    Raises:
        InvalidInputError: A kind is named twice, or kinds exclude each other.
    """
    names = list(KINDS)
    found = sorted(perturbations, key=lambda one: names.index(one.kind))
    active = [one for one in found if one.severity]
    for first, second in zip(found, found[1:], strict=False):
        if first.kind == second.kind:
            raise InvalidInputError(f"perturbation {first.kind} is named twice: {first} and {second}")
    for one in active:
        rivals = [o.kind for o in active if o is not one and o.definition.layer == one.definition.layer]
        if one.definition.exclusive and rivals:
            raise InvalidInputError(f"perturbation {one.kind} cannot be combined with {', '.join(rivals)}")
    return tuple(found)


def replace_perturbations(
    perturbations: Iterable[Perturbation], others: Iterable[Perturbation]
) -> tuple[Perturbation, ...]:
    """Return perturbations and others, which take the place of those of the same kind.

    Raises:
        InvalidInputError: Kinds exclude each other.
    """
    by_kind = {one.kind: one for one in (*perturbations, *others)}
    return in_order(by_kind.values())


def format_perturbations(perturbations: Iterable[Perturbation]) -> str:
    """Return the text of perturbations, in the order in which they are applied; without those of severity 0."""
    return ",".join(str(one) for one in in_order(perturbations) if one.severity)
