"""Linter of task files: what is wrong or doubtful, where, and how to fix it.

Names and atoms are checked here, the instruction in `lint.instruction`, what needs the simulator in `lint.scene`.
"""

import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from libero_env.assets.arena import WORKSPACES, workspace_of_problem
from libero_env.assets.pack import Pack, select_pack
from libero_env.design.lint.instruction import check_words
from libero_env.design.lint.report import Finding, Report, spell
from libero_env.design.lint.scene import check_scene
from libero_env.errors import BDDLError, UnknownNameError
from libero_env.sim.predicates import PREDICATES, atoms_of
from libero_env.tasks import Task, bddl
from libero_env.tasks.authoring import FILE
from libero_env.tasks.builder import language_from_name
from libero_env.tasks.problem import And, Atom, Expression, ForAll, Not, Or, Problem
from libero_env.tasks.sexpr import List, Word, parse_tree

__all__ = ["Finding", "lint_file", "lint_task", "lint_text"]

_ENTITY = frozenset({"object", "fixture"})
_PLACE = _ENTITY | {"region"}
_ANY = _PLACE | {"workspace"}
# Predicate -> kinds that each of its arguments may have; predicates that users register are not checked.
KINDS: dict[str, tuple[frozenset[str], ...]] = {
    "On": (_ENTITY, _PLACE),
    "In": (_ENTITY, frozenset({"region"})),
    "Stack": (_ENTITY, _PLACE),
    "Up": (_ENTITY,),
    "Open": (_PLACE,),
    "Close": (_PLACE,),
    "Turnon": (_PLACE,),
    "Turnoff": (_PLACE,),
    "Incontact": (_ANY - {"region"}, _ANY - {"region"}),
    "Printjointstate": (_PLACE,),
}
STARTS = 5  # initial states that are checked by default


def lint_task(task: Task, pack: Pack | None = None, *, starts: int = STARTS) -> list[Finding]:
    """Return the findings about a task; lines are those of the text that `libero tasks show` prints.

    Args:
        task: Task to check.
        pack: Models to use; None is `select_pack()`.
        starts: Number of initial states to check; 0 simulates nothing.
    """
    return lint_text(task.bddl_text, task.id, task, pack, starts=starts)


def lint_file(path: str | Path, pack: Pack | None = None, *, starts: int = STARTS) -> list[Finding]:
    """Return the findings about a task file; see `lint_task`.

    Raises:
        OSError: The file cannot be read.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        try:
            bddl.read(path)
        except BDDLError as error:
            return [_syntax(error, str(path))]
        raise
    return lint_text(text, str(path), None, pack, starts=starts)


def lint_text(
    text: str, file: str, task: Task | None = None, pack: Pack | None = None, *, starts: int = STARTS
) -> list[Finding]:
    """Return the findings about the text of a task file, by line.

    Args:
        text: Content of the task file.
        file: Name of the file in the findings.
        task: Task of the suite that the text belongs to; None for a user-defined task.
        pack: Models to use; None is `select_pack()`.
        starts: Number of initial states to check; 0 simulates nothing.
    """
    pack = pack or select_pack()
    try:
        tree = parse_tree(text, file)
    except BDDLError as error:
        return [_syntax(error, file)]
    report = Report(file, tree)
    _check_declared(report, tree)
    try:
        problem = bddl.parse(text, file)
    except BDDLError as error:
        finding = _syntax(error, file)
        if all(known.line != finding.line for known in report.findings):
            report.findings.append(finding)
        return report.sorted()
    if task is None:
        name = Path(file).stem
        task = Task(FILE, 0, name, language_from_name(name), problem.language, problem)
    report.categories = set(problem.objects.values())
    _check_categories(report, problem, pack)
    for kind, atoms, lines in (
        ("init", problem.init, report.lines.init),
        ("goal", atoms_of(problem.goal), report.lines.goal),
    ):
        for atom, line in zip(atoms, lines, strict=True):
            _check_atom(report, problem, atom, line, kind)
    _check_goal(report, problem.goal)
    _check_regions(report, problem)
    _check_places(report, problem)
    check_words(report, task, pack)
    if starts and not report.broken:
        check_scene(report, task, pack, starts)
    return report.sorted()


def _syntax(error: BDDLError, file: str) -> Finding:
    """Return the finding of an error of the parser."""
    found = re.fullmatch(r"(\d+): (.*?)(?:; expected (.*))?", str(error).removeprefix(f"{file}:"), re.DOTALL)
    line, what, expected = found.groups() if found else (1, str(error), None)
    return Finding(
        file, int(line), "error", "syntax", what, f"write {expected}" if expected else "fix the file"
    )


def _check_declared(report: Report, tree: List) -> None:
    """Report every name in an atom that is not declared; the parser stops at the first."""
    lines = report.lines
    known = {*lines.entities, *lines.regions}

    def visit(node: Word | List, bound: frozenset[str]) -> None:
        if not isinstance(node, List) or not node.items:
            return
        if node.head in ("and", "or", "not"):
            for part in node.items[1:]:
                visit(part, bound)
        elif node.head == "forall" and len(node.items) == 3 and isinstance(node.items[1], List):
            variables = {word.text for word in node.items[1].items if isinstance(word, Word)}
            visit(node.items[2], bound | variables)
        else:
            for word in node.items[1:]:
                if isinstance(word, Word) and word.text not in known | bound:
                    report.error(
                        word.line,
                        "unknown-name",
                        f"{word.text} is not declared",
                        report.suggest(word.text, known),
                    )

    for section in tree.items:
        if isinstance(section, List) and section.head in (":init", ":goal"):
            for node in section.items[1:]:
                visit(node, frozenset())


def _check_categories(report: Report, problem: Problem, pack: Pack) -> None:
    categories = set(pack.categories())
    workspaces = [name for name, category in problem.fixtures.items() if category in WORKSPACES]
    for name, category in {**problem.objects, **problem.fixtures}.items():
        if category not in categories and name not in workspaces:
            valid = categories | set(WORKSPACES) if name in problem.fixtures else categories
            what = f"{name}: no model of {category!r} exists"
            report.error(report.lines.of(name), "unknown-category", what, report.suggest(category, valid))
    at = report.lines.section(":fixtures")
    if len(workspaces) != 1:
        what = f"{len(workspaces)} workspaces among the fixtures"
        report.error(at, "workspace", what, f"declare one of {', '.join(WORKSPACES)}")
        return
    try:
        expected = workspace_of_problem(problem.name).name
    except UnknownNameError as error:
        report.warning(
            1, "problem-name", f"no problem class is named {problem.name}", str(error).split("Valid: ")[-1]
        )
        return
    if expected != (own := problem.fixtures[workspaces[0]]):
        what = f"{problem.name} takes place on a {expected}, but the workspace is a {own}"
        report.warning(1, "problem-name", what, "change one of them; only the workspace has an effect here")


def kind_of(problem: Problem, name: str) -> str:
    """Return `object`, `fixture`, `workspace` or `region`; a variable of a quantifier is an object."""
    if name in problem.objects or name.startswith("?"):
        return "object"
    if category := problem.fixtures.get(name):
        return "workspace" if category in WORKSPACES else "fixture"
    return "region" if problem.region(name) is not None else "object"


def _check_atom(report: Report, problem: Problem, atom: Atom, line: int, section: str) -> None:
    if atom.predicate not in PREDICATES:
        what = f"the predicate of {spell(atom)} does not exist"
        report.error(line, "unknown-predicate", what, report.suggest(atom.predicate, PREDICATES))
        return
    if (kinds := KINDS.get(atom.predicate)) is None:
        return
    if len(atom.args) != len(kinds):
        what = f"{spell(atom)} has {len(atom.args)} arguments"
        report.error(line, "arity", what, f"{atom.predicate} takes {len(kinds)}")
        return
    for name, allowed in zip(atom.args, kinds, strict=True):
        if (kind := kind_of(problem, name)) not in allowed:
            what = f"{spell(atom)}: {name} is {_article(kind)}"
            remedy = f"name {' or '.join(_article(k) for k in sorted(allowed))} there"
            report.error(line, "kind", what, remedy)
    if section == "init" and atom.args[0] in problem.fixtures and atom.predicate in ("On", "In"):
        region = problem.region(atom.args[1])
        if region is None or not region.ranges:
            what = f"{spell(atom)} does not place it: a fixture stands in a region of the workspace"
            report.error(line, "kind", what, "name a region with :ranges whose target is the workspace")


def _article(kind: str) -> str:
    return f"an {kind}" if kind[0] in "aeiou" else f"a {kind}"


def _check_goal(report: Report, goal: Expression) -> None:
    line = report.lines.section(":goal")
    match goal:
        case (And(()) | Or(())) as node:
            truth = "always" if isinstance(node, And) else "never"
            report.error(
                line,
                "empty-goal",
                f"an empty {type(node).__name__} is {truth} true",
                "add the conditions that must hold",
            )
        case And(parts) | Or(parts):
            for part in parts:
                _check_goal(report, part)
        case Not(part):
            _check_goal(report, part)
        case ForAll(variables, body):
            for variable, category in variables:
                if category not in report.categories:
                    what = f"no object is a {category}: {variable} has no values and the part is always true"
                    report.error(line, "empty-goal", what, report.suggest(category, report.categories))
            _check_goal(report, body)


def _check_regions(report: Report, problem: Problem) -> None:
    used = {name for atom in (*problem.init, *atoms_of(problem.goal)) for name in atom.args}
    goal = {name for atom in atoms_of(problem.goal) for name in atom.args}
    seen: dict[tuple, str] = {}
    for region in problem.regions:
        line, address = report.lines.regions.get(region.address, 1), region.address
        kind = kind_of(problem, region.target) if region.target in report.lines.entities else ""
        if address not in used | set(problem.obj_of_interest):
            lost = "" if kind else f", and its target {region.target} is not declared"
            report.info(line, "unused-region", f"no atom names {address}{lost}", "remove it, or use it")
        elif not kind:
            what = f"{address}: its target {region.target} is not declared"
            report.error(line, "region-target", what, report.suggest(region.target, report.lines.entities))
        elif kind == "workspace" and not region.ranges:
            report.error(
                line, "region-ranges", f"{address} has no extent", "add (:ranges ((X0 Y0 X1 Y1))), metres"
            )
        elif kind != "workspace" and region.ranges:
            what = f"{address}: ranges are for the workspace only, but {region.target} is {_article(kind)}"
            report.error(
                line, "region-ranges", what, "remove :ranges; the region is then the site of that name"
            )
        for x0, y0, x1, y1 in region.ranges:
            if x1 < x0 or y1 < y0 or (address in goal and (x0 == x1 or y0 == y1)):
                add = report.error if address in goal else report.warning
                remedy = "write (X0 Y0 X1 Y1) with X0 < X1 and Y0 < Y1"
                add(
                    line,
                    "region-ranges",
                    f"{address}: the rectangle ({x0:g} {y0:g} {x1:g} {y1:g}) is empty",
                    remedy,
                )
        key = (region.target, region.ranges, region.yaw)
        if region.ranges and address in used and (first := seen.setdefault(key, address)) != address:
            report.warning(
                line, "duplicate-region", f"{address} is the same region as {first}", "use one of the two"
            )


def _check_places(report: Report, problem: Problem) -> None:
    """Check that every object and fixture is placed once."""
    placed = Counter(
        atom.args[0] for atom in problem.init if atom.predicate in ("On", "In") and len(atom.args) == 2
    )
    for name in (*problem.objects, *problem.fixtures):
        if placed[name] > 1:
            what = f"{name} is placed {placed[name]} times"
            report.error(report.lines.section(":init"), "placed-twice", what, "keep one of the atoms")
        elif not placed[name] and kind_of(problem, name) != "workspace":
            add = report.error if name in problem.objects else report.warning
            where = "" if name in problem.objects else "; it stands in the centre of the workspace"
            remedy = f"add (On {name} REGION) to :init"
            add(report.lines.of(name), "not-placed", f"no init atom places {name}{where}", remedy)
    known: Iterable[str] = {*report.lines.entities, *report.lines.regions}
    for name in problem.obj_of_interest:
        if name not in known:
            line = report.lines.section(":obj_of_interest")
            report.warning(line, "unknown-name", f"{name} is not declared", report.suggest(name, known))
    if not problem.obj_of_interest:
        what = "there is no object of interest"
        report.info(1, "interest", what, "list the objects of the goal in :obj_of_interest")
