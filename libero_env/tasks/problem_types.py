"""Types and sizes of a problem's parts, which a problem made in Python may have any of."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any

from libero_env.tasks.problem import And, Atom, Expression, ForAll, Not, Or, Problem, Region
from libero_env.tasks.sexpr import MAX_DEPTH

MAX_ENTITIES = 100  # objects and fixtures of a scene
MAX_PARTS = 1000  # regions, init atoms, parts of a goal, rectangles of a region


@dataclass(frozen=True)
class Fault:
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


def type_faults(problem: Problem) -> Iterator[Fault]:
    """Yield the fields and parts of a problem whose types are wrong, or that are too many."""
    found = list(_types(problem))
    yield from found or _sizes(problem)


def _types(problem: Problem) -> Iterator[Fault]:
    """Check the types of fields, which a problem made in Python may have any of."""
    for key in ("name", "language", "domain"):
        if not isinstance(value := getattr(problem, key), str):
            yield Fault("type", f"{key} is {value!r:.80}", "a text", f":{key}")
    for key in ("fixtures", "objects", "scene_properties"):
        value = getattr(problem, key)
        if not isinstance(value, Mapping) or not _are_texts((*value, *value.values())):
            yield Fault("type", f"{key} is {value!r:.80}", "texts by their names", f":{key}")
    if not _are_texts(interest := problem.obj_of_interest):
        yield Fault("type", f"obj_of_interest is {interest!r:.80}", "a tuple of names", ":obj_of_interest")
    for key, kind, is_right in (("regions", Region, _is_region), ("init", Atom, _is_atom)):
        value = getattr(problem, key)
        wrong = [part for part in value if not is_right(part)] if isinstance(value, tuple) else [value]
        for part in wrong:
            yield Fault("type", f"{part!r:.80} in {key}", f"a tuple of {kind.__name__}", f":{key}")
    yield from _goal_types(problem.goal)


def _are_texts(value: Any) -> bool:
    return isinstance(value, tuple) and all(isinstance(word, str) for word in value)


def _is_region(region: Any) -> bool:
    def are_rows(value: Any, width: int) -> bool:
        return isinstance(value, tuple) and all(are_numbers(row) and len(row) == width for row in value)

    def are_numbers(row: Any) -> bool:
        return isinstance(row, tuple) and all(isinstance(x, Real) for x in row)

    return (
        isinstance(region, Region)
        and _are_texts((region.name, region.target))
        and are_rows(region.ranges, 4)
        and are_rows(region.yaw, 2)
        and are_numbers(region.rgba)
    )


def _is_atom(atom: Any) -> bool:
    return (
        isinstance(atom, Atom)
        and isinstance(atom.predicate, str)
        and _are_texts(atom.args)
        and bool(atom.args)
    )


def _goal_types(goal: Expression) -> Iterator[Fault]:
    """Check that a goal is an expression, without recursion: it may be of any depth."""
    waiting: list[tuple[Any, int]] = [(goal, 1)]
    count = 0
    while waiting:
        node, depth = waiting.pop()
        count += 1
        if depth > MAX_DEPTH or count > MAX_PARTS:
            yield Fault(
                "size", "the goal is too large", f"at most {MAX_DEPTH} levels and {MAX_PARTS} parts", ":goal"
            )
            return
        match node:
            case Atom(str(), tuple() as names) if all(isinstance(name, str) for name in names):
                continue
            case And(tuple() as parts) | Or(tuple() as parts):
                waiting += [(part, depth + 1) for part in parts]
            case Not(part):
                waiting.append((part, depth + 1))
            case ForAll(tuple() as variables, body) if all(
                isinstance(pair, tuple) and len(pair) == 2 and all(isinstance(word, str) for word in pair)
                for pair in variables
            ):
                waiting.append((body, depth + 1))
            case _:
                yield Fault("type", f"{node!r:.80} in the goal", "Atom, And, Or, Not or ForAll", ":goal")
                return


def _sizes(problem: Problem) -> Iterator[Fault]:
    if (count := len(problem.objects) + len(problem.fixtures)) > MAX_ENTITIES:
        yield Fault("size", f"{count} objects and fixtures", f"at most {MAX_ENTITIES}", ":objects")
    for section, size in (
        (":regions", len(problem.regions)),
        (":regions", max((len(region.ranges) for region in problem.regions), default=0)),
        (":init", len(problem.init)),
    ):
        if size > MAX_PARTS:
            yield Fault("size", f"{size} entries", f"at most {MAX_PARTS}", section)
