"""Linter of task files: what is wrong or doubtful, where, and how to fix it.

Categories and places are checked here, the instruction in `lint.instruction`, what needs the simulator in `lint.scene`.
"""

import re
from collections.abc import Iterable
from pathlib import Path

from libero_env.assets.arena import WORKSPACES, workspace_of_problem
from libero_env.assets.pack import Pack, select_pack
from libero_env.design.lint.instruction import check_words
from libero_env.design.lint.report import Finding, Report
from libero_env.design.lint.scene import check_scene
from libero_env.errors import BDDLError, UnknownNameError
from libero_env.sim.predicates import PREDICATES
from libero_env.tasks import Task, bddl
from libero_env.tasks.builder import FILE, language_from_name
from libero_env.tasks.problem import Problem, ProblemError
from libero_env.tasks.sexpr import parse_tree

__all__ = ["Finding", "lint_file", "lint_task", "lint_text"]

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
        text = bddl.read_text(path)
    except BDDLError as error:
        return [_syntax(error, str(path))]
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
    try:
        problem = bddl.problem_of(tree, file)
    except ProblemError as error:
        problem = error.problem
        report.violations(error)
        if any(one.rule == "size" for one in error.violations):
            return report.sorted()
    except BDDLError as error:
        return [_syntax(error, file)]
    if task is None:
        name = Path(file).stem
        task = Task(FILE, 0, name, language_from_name(name), problem.language, problem)
    _check_categories(report, problem, pack)
    _check_atoms(report, problem)
    _check_regions(report, problem)
    _check_places(report, problem)
    check_words(report, task, pack)
    if starts and not report.broken:
        check_scene(report, task, pack, starts)
    return report.sorted()


def _syntax(error: BDDLError, file: str) -> Finding:
    """Return the finding of an error of the parser."""
    parts = re.fullmatch(r"(\d+): (.*?)(?:; expected (.*))?", str(error).removeprefix(f"{file}:"), re.DOTALL)
    line, what, expected = parts.groups() if parts else (1, str(error), None)
    return Finding(
        file, int(line), "error", "syntax", what, f"write {expected}" if expected else "fix the file"
    )


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


def _check_atoms(report: Report, problem: Problem) -> None:
    """Check that predicates exist, and that fixtures stand in regions of the workspace."""
    atoms = zip((*problem.init, *problem.goal.atoms()), (*report.lines.init, *report.lines.goal), strict=True)
    for atom, line in atoms:
        if atom.predicate not in PREDICATES:
            what = f"the predicate of {atom} does not exist"
            report.error(line, "unknown-predicate", what, report.suggest(atom.predicate, PREDICATES))
    for atom, line in zip(problem.init, report.lines.init, strict=True):
        if atom.args[0] in problem.fixtures and atom.predicate in ("On", "In"):
            region = problem.region(atom.args[-1])
            if region is None or not region.ranges:
                what = f"{atom} does not place it: a fixture stands in a region of the workspace"
                remedy = "name a region with :ranges whose target is the workspace"
                report.error(line, "kind", what, remedy)


def _check_regions(report: Report, problem: Problem) -> None:
    used = {name for atom in (*problem.init, *problem.goal.atoms()) for name in atom.args}
    goal = {name for atom in problem.goal.atoms() for name in atom.args}
    seen: dict[tuple, str] = {}
    for region in problem.regions:
        line, address = report.lines.regions.get(region.address, 1), region.address
        if address not in used | set(problem.obj_of_interest):
            is_known = region.target in report.lines.entities
            lost = "" if is_known else f", and its target {region.target} is not declared"
            report.info(line, "unused-region", f"no atom names {address}{lost}", "remove it, or use it")
        for x0, y0, x1, y1 in region.ranges:
            if address in goal and (x0 == x1 or y0 == y1):
                what = f"{address}: the rectangle ({x0:g} {y0:g} {x1:g} {y1:g}) is empty"
                report.error(line, "region-ranges", what, "write (X0 Y0 X1 Y1) with X0 < X1 and Y0 < Y1")
        key = (region.target, region.ranges, region.yaw)
        if region.ranges and address in used and (first := seen.setdefault(key, address)) != address:
            report.warning(
                line, "duplicate-region", f"{address} is the same region as {first}", "use one of the two"
            )


def _check_places(report: Report, problem: Problem) -> None:
    """Check that every object and fixture is placed."""
    placed = {atom.args[0] for atom in problem.init if atom.predicate in ("On", "In") and len(atom.args) == 2}
    for name in (*problem.objects, *problem.fixtures):
        if name not in placed and problem.kind_of(name) != "workspace":
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
