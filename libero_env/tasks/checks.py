"""Checks of a problem: everything that can be known without the models of its objects.

Parsers of task files run them and name the line; a scene is built from nothing that they refuse, whoever made it.
"""

import math
import re
from collections import Counter
from collections.abc import Iterator, Sized

from libero_env.errors import InvalidInputError
from libero_env.tasks.problem import And, Atom, Expression, ForAll, Not, Or, Problem, Region
from libero_env.tasks.problem_types import Fault, type_faults
from libero_env.tasks.signatures import KINDS

MAX_METRES = 10.0  # [m] coordinates of regions, in the frame of the workspace
MAX_RADIANS = 100.0  # [rad] yaw of regions
MAX_EVALUATIONS = 10_000  # atoms of a goal, counted for each object that its quantifiers stand for
MAX_NAME = 100  # characters of a name
MAX_LANGUAGE = 1000  # characters of an instruction

NAME = re.compile(rf"\w[\w.-]{{0,{MAX_NAME - 1}}}")
NAME_RULE = f"letters, digits, _ . and -, at most {MAX_NAME} characters"
UNWRITABLE = re.compile("[();\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
LANGUAGE_RULE = f"one line without ( ) and ;, at most {MAX_LANGUAGE} characters"
_RESERVED = ("robot", "world", "ee")  # the robot in contacts, MuJoCo's root, the hand in observations
_RESERVED_PREFIXES = ("robot0", "gripper0", "mount0")
_VARIABLE = re.compile(r"\??\w[\w.-]*")
_PLACING = ("On", "In")


class ProblemError(InvalidInputError):
    """A problem that no scene can be built from.

    Attributes:
        fault: What is wrong.
        language: Instruction of the problem, by which the message names it.
    """

    def __init__(self, fault: Fault, language: str):
        super().__init__(f"task {language!r:.80}, {fault.section}: {fault.what}; expected {fault.expected}")
        self.fault, self.language = fault, language

    def __reduce__(self) -> tuple[type, tuple[Fault, str]]:
        """Let worker processes send the error: its arguments are not its message."""
        return type(self), (self.fault, self.language)


def faults(problem: Problem) -> Iterator[Fault]:
    """Yield what is wrong with a problem. Where types or sizes are wrong, nothing else is looked at."""
    if found := list(type_faults(problem)):
        yield from found
        return
    yield from _texts(problem)
    yield from _names(problem)
    for region in problem.regions:
        yield from _numbers(region)
    used = {name for atom in (*problem.init, *problem.goal.atoms()) for name in atom.args}
    for region in problem.regions:
        if region.address in used:
            yield from _target(problem, region)
    for i, atom in enumerate(problem.init):
        yield from _atom(problem, atom, frozenset(), ":init", i)
    yield from _places(problem)
    yield from _goal(problem)


def check_problem(problem: Problem) -> None:
    """Check a problem, such as one that was made in Python.

    Raises:
        ProblemError: The problem is not valid; the message names the task and the part.
    """
    for fault in faults(problem):
        raise ProblemError(fault, problem.language)


def kind_of(problem: Problem, name: str) -> str:
    """Return `object`, `fixture`, `workspace` or `region`; a variable of a quantifier is an object."""
    # not with the module: `libero --help` need not wait for MuJoCo
    from libero_env.assets.arena import WORKSPACES

    if category := problem.fixtures.get(name):
        return "workspace" if category in WORKSPACES else "fixture"
    return "region" if name not in problem.objects and problem.region(name) is not None else "object"


def article(kind: str) -> str:
    """Return a word with its article."""
    return f"an {kind}" if kind[0] in "aeiou" else f"a {kind}"


def _texts(problem: Problem) -> Iterator[Fault]:
    """Check that texts can be written to a task file and read again."""
    if UNWRITABLE.search(problem.language) or len(problem.language) > MAX_LANGUAGE:
        yield Fault("text", f"the language {problem.language!r:.80}", LANGUAGE_RULE, ":language")
    for section, text in (
        (":domain", problem.domain),
        *((":scene_properties", v) for v in problem.scene_properties.values()),
    ):
        if UNWRITABLE.search(text) or len(text) > MAX_NAME:
            yield Fault(
                "text", f"{text!r:.80}", f"words without ( ) and ;, at most {MAX_NAME} characters", section
            )


def _names(problem: Problem) -> Iterator[Fault]:
    """Check that names can be written, are not those of the robot, and stand for one thing each."""
    if not NAME.fullmatch(problem.name):
        yield Fault("name", f"the name {problem.name!r:.80} of the problem", NAME_RULE, ":domain")
    for section, names in ((":fixtures", problem.fixtures), (":objects", problem.objects)):
        for name, category in names.items():
            if not NAME.fullmatch(name) or not NAME.fullmatch(category):
                yield Fault("name", f"the name {name!r:.80} - {category!r:.80}", NAME_RULE, section, name)
            elif name in _RESERVED or name.startswith(_RESERVED_PREFIXES):
                what = f"the name {name} is the robot's or MuJoCo's own"
                yield Fault("name", what, f"another name, such as {category}_1", section, name)
    for name in sorted(problem.fixtures.keys() & problem.objects.keys()):
        yield Fault("name", f"{name} is a fixture too", "each name declared once", ":objects", name)
    for kind in problem.scene_properties:
        if not NAME.fullmatch(kind) or kind != kind.casefold():
            yield Fault(
                "name", f"the scene property {kind!r:.80}", "floor, wall or scene", ":scene_properties"
            )
    for name in problem.obj_of_interest:
        if not NAME.fullmatch(name):
            yield Fault("name", f"the name {name!r:.80}", NAME_RULE, ":obj_of_interest")
    addresses = Counter(region.address for region in problem.regions)
    for region in problem.regions:
        address = region.address
        if not NAME.fullmatch(region.name) or not NAME.fullmatch(region.target):
            yield Fault("name", f"the name {address!r:.80} of a region", NAME_RULE, ":regions", address)
        elif addresses[address] > 1:
            yield Fault(
                "name", f"{address} is declared twice", "each region of a target once", ":regions", address
            )
        elif address in problem.objects or address in problem.fixtures:
            what = f"{address} is both a region of {region.target} and an object or fixture"
            yield Fault("name", what, "different names", ":regions", address)


def _numbers(region: Region) -> Iterator[Fault]:
    """Check that rectangles and angles are finite, bounded and ordered."""
    address = region.address
    for row in region.ranges:
        x0, y0, x1, y1 = row
        shown = f"{address}: the rectangle ({' '.join(f'{x:g}' for x in row)})"
        if not all(math.isfinite(x) and abs(x) <= MAX_METRES for x in row):
            bound = f"metres from -{MAX_METRES:g} to {MAX_METRES:g}"
            yield Fault("region-ranges", shown, bound, ":regions", address)
        elif x1 < x0 or y1 < y0:
            expected = "(X0 Y0 X1 Y1) with X0 <= X1 and Y0 <= Y1"
            yield Fault("region-ranges", f"{shown} has swapped corners", expected, ":regions", address)
    for low, high in region.yaw:
        if not (abs(low) <= MAX_RADIANS and abs(high) <= MAX_RADIANS and low <= high):
            expected = f"(LOW HIGH) with LOW <= HIGH, radians from -{MAX_RADIANS:g} to {MAX_RADIANS:g}"
            yield Fault(
                "region-ranges", f"{address}: the yaw ({low:g} {high:g})", expected, ":regions", address
            )
    if len(region.rgba) not in (0, 4) or not all(math.isfinite(x) for x in region.rgba):
        yield Fault("region-ranges", f"{address}: the colour {region.rgba}", "4 numbers", ":regions", address)


def _target(problem: Problem, region: Region) -> Iterator[Fault]:
    """Check that a region, to which an atom refers, is a rectangle on the workspace or a site of something else."""
    entities, address = {**problem.fixtures, **problem.objects}, region.address
    if region.target not in entities:
        what = f"{address}: its target {region.target} is not declared"
        yield Fault("region-target", what, f"one of {', '.join(sorted(entities))}", ":regions", address)
        return
    kind = kind_of(problem, region.target)
    if kind == "workspace" and not region.ranges:
        expected = "(:ranges ((X0 Y0 X1 Y1))), metres"
        yield Fault("region-ranges", f"{address} has no extent", expected, ":regions", address)
    elif kind != "workspace" and region.ranges:
        what = f"{address}: ranges are for the workspace only, but {region.target} is {article(kind)}"
        yield Fault(
            "region-ranges", what, "no :ranges; the region is then the site of that name", ":regions", address
        )


def _atom(problem: Problem, atom: Atom, bound: frozenset[str], section: str, index: int) -> Iterator[Fault]:
    """Check number and kinds of the arguments of an atom."""
    kinds = KINDS.get(atom.predicate)
    if kinds is not None and len(atom.args) != len(kinds):
        what = f"{atom} has {_count(atom.args)}"
        yield Fault("arity", what, f"{len(kinds)}: {atom.predicate} takes {_count(kinds)}", section, index)
        return
    for i, name in enumerate(atom.args):
        known = name in bound or name in problem.objects or name in problem.fixtures
        if not known and problem.region(name) is None:
            yield Fault("unknown-name", f"{name} is not declared", "a declared name", section, index)
            continue
        kind = "object" if name in bound else kind_of(problem, name)
        if kinds is not None and kind not in kinds[i]:
            allowed = " or ".join(article(k) for k in sorted(kinds[i]))
            yield Fault("kind", f"{atom}: {name} is {article(kind)}", f"{allowed} there", section, index)
    if kinds is not None and len(atom.args) == 2 and atom.args[0] == atom.args[1]:
        yield Fault("kind", f"{atom} is of {atom.args[0]} and itself", "two names", section, index)


def _count(names: Sized) -> str:
    return f"{len(names)} name{'s' if len(names) != 1 else ''}"


def _places(problem: Problem) -> Iterator[Fault]:
    """Check that nothing is placed twice or, by way of others, on itself."""
    placing = [
        (i, atom) for i, atom in enumerate(problem.init) if atom.predicate in _PLACING and len(atom.args) == 2
    ]
    count = Counter(atom.args[0] for _, atom in placing)
    on: dict[str, str] = {}
    for i, atom in placing:
        name, target = atom.args
        if name in on and count[name] > 1:
            what = f"{name} is placed {count.pop(name)} times"
            yield Fault("placed-twice", what, "one atom that places it", ":init", i)
        region = problem.region(target)
        on[name] = region.target if region is not None else target
    for i, atom in placing:
        seen, name = set[str](), atom.args[0]
        while name in on and name not in seen:
            seen.add(name)
            name = on[name]
        if name == atom.args[0] and name in seen and atom.args[0] != atom.args[1]:
            what = f"{atom} places it, by way of others, on itself"
            yield Fault("placed-in-a-circle", what, "one of them on the workspace", ":init", i)


def _goal(problem: Problem) -> Iterator[Fault]:
    """Check the atoms of a goal, that no part of it is empty, and how often quantifiers repeat it."""
    categories = Counter(problem.objects.values())
    index = evaluations = 0

    def visit(node: Expression, bound: frozenset[str], times: int) -> Iterator[Fault]:
        nonlocal index, evaluations
        match node:
            case Atom():
                yield from _atom(problem, node, bound, ":goal", index)
                index, evaluations = index + 1, evaluations + times
            case And(parts) | Or(parts):
                if not parts:
                    truth = "always" if isinstance(node, And) else "never"
                    what = f"an empty {type(node).__name__} is {truth} true"
                    yield Fault("empty-goal", what, "the conditions that must hold", ":goal")
                for part in parts:
                    yield from visit(part, bound, times)
            case Not(part):
                yield from visit(part, bound, times)
            case ForAll(variables, body):
                for variable, category in variables:
                    times *= categories[category]
                    if not categories[category]:
                        what = (
                            f"no object is a {category}: {variable} has no values and the part is always true"
                        )
                        yield Fault("empty-goal", what, f"one of {', '.join(sorted(categories))}", ":goal")
                    if not _VARIABLE.fullmatch(variable) or kind_is_known(problem, variable):
                        yield Fault(
                            "name", f"the variable {variable!r:.80}", "a new name such as ?x", ":goal"
                        )
                yield from visit(body, bound | {name for name, _ in variables}, times)

    yield from visit(problem.goal, frozenset(), 1)
    if evaluations > MAX_EVALUATIONS:
        what = f"its quantifiers stand for {evaluations} atoms"
        yield Fault("size", what, f"at most {MAX_EVALUATIONS}", ":goal")


def kind_is_known(problem: Problem, name: str) -> bool:
    """Return whether a name is that of an object, fixture or region."""
    return name in problem.objects or name in problem.fixtures or problem.region(name) is not None
