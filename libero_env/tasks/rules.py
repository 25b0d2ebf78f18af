"""What makes a problem valid, as far as the models of its objects are not asked, and the arguments of predicates."""

import inspect
import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from libero_env.doors import doors, enter
from libero_env.parallel import send_to_workers
from libero_env.tasks.expression import And, Atom, Expression, ForAll
from libero_env.tasks.values import NAME
from libero_env.text import suggest
from libero_env.workspaces import WORKSPACES

MAX_ENTITIES = 100  # objects and fixtures of a scene
_MAX_EVALUATIONS = 10_000  # atoms of a goal, counted for each object that its quantifiers stand for

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?", re.IGNORECASE | re.ASCII)
_VARIABLE = re.compile(r"\??\w[\w.-]*")
PLACING = ("On", "In")  # predicates of init atoms that give an entity its place
Problem = Any  # `libero_env.tasks.problem.Problem`, which asks for `violations`


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


CONSTANTS = ("True", "False")  # predicates that say nothing of a state
# Predicates that exist, with the kinds of names that their arguments may have; None where they take any.
_ENTITY = frozenset({"object", "fixture"})
_PLACE = _ENTITY | {"region"}
_SOLID = _ENTITY | {"workspace"}
_ANY, _NUMERIC = _PLACE | _SOLID, frozenset({"number"})
KINDS: dict[str, tuple[frozenset[str], ...] | None] = {
    "In": (_ENTITY, frozenset({"region"})),
    **dict.fromkeys(("On", "Stack"), (_ENTITY, _PLACE)),
    "Up": (_ENTITY,),
    **dict.fromkeys(("Open", "Close", "Turnon", "Turnoff", "Printjointstate"), (_PLACE,)),
    "Incontact": (_SOLID, _SOLID),
    **dict.fromkeys(CONSTANTS),
}
BUILTIN_PREDICATES = frozenset(KINDS)
send_to_workers(__name__, "KINDS")


def declare_predicate(predicate: str, function: Callable[..., bool]) -> tuple[int, ...]:
    """Set the arguments of a predicate from those of its function: numbers where they are annotated so, or of any kind.

    Args:
        predicate: Name of the predicate, capitalised.
        function: Function of a state and of the arguments. One that takes any number of them may have any number.

    Returns:
        Indices of the arguments that are numbers.
    """
    KINDS[predicate] = None
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


def violations(problem: Problem) -> Iterator[Violation]:
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


def _region(problem: Problem, region: Any, is_used: bool, count: int) -> Iterator[tuple[str, str, str]]:
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
    if atom.predicate not in KINDS and atom.predicate in doors("predicates"):
        declare_predicate(atom.predicate, enter("predicates", atom.predicate))
    if atom.predicate not in KINDS:
        known = sorted(KINDS.keys() - {*CONSTANTS})
        near = suggest(atom.predicate, known)
        what = f": {atom.predicate} is not a predicate{near and '.'}{near}"
        yield (
            "unknown-predicate",
            what,
            f"one of {', '.join(known)}, or your own (register_predicate, --import MODULE)",
        )
        return
    kinds, count = KINDS[atom.predicate], len(atom.args)
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
            if node.predicate in CONSTANTS:
                always = "always" if node.predicate == "True" else "never"
                yield Violation("constant", f"{node} {always} holds", "a condition", ":goal", index)
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
