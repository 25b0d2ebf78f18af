"""Linter of task files: what is wrong or doubtful, where, and how to fix it.

What needs the simulator is in `lint.scene`.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from libero_env.assets.arena import workspace_of_problem
from libero_env.assets.pack import Pack, select_pack
from libero_env.design.lint.report import Finding, Level, Report, lines_of_yaml
from libero_env.design.lint.scene import check_scene
from libero_env.errors import BDDLError, UnknownNameError
from libero_env.objects.model import OPPOSITE_STATES
from libero_env.tasks import Task, bddl
from libero_env.tasks.benchmark import task_of_file
from libero_env.tasks.builder import language_from_name
from libero_env.tasks.expression import And, Atom, Expression, Not
from libero_env.tasks.problem import Problem, ProblemError
from libero_env.tasks.rules import PLACING
from libero_env.tasks.sexpr import parse_tree
from libero_env.tasks.suites import iter_yaml_tasks
from libero_env.workspaces import WORKSPACES

__all__ = ["Finding", "lint_file", "lint_task", "lint_text", "lint_yaml"]

STARTS = 5  # initial states that are checked by default
# words of categories that do not name the object
_QUALITIES = {
    *("and", "of", "the", "two", "new", "black", "white", "red", "yellow", "wooden", "flat", "short"),
    *("glazed", "rim", "region", "side", "contain", "init"),
}
_ALSO = {"shelf": "cabinet", "cabinet": "drawer"}  # other words in common use
_PARTS = {"drawer", "compartment", "layer", "side", "shelf", "region", "of"}  # of objects that have sides
_SIDES = ({"top", "middle", "bottom"}, {"left", "right"}, {"front", "back"})


def lint_task(task: Task, pack: Pack | None = None, *, starts: int = STARTS) -> list[Finding]:
    """Return the findings about a task; lines are those of the text that `libero tasks show` prints.

    Args:
        pack: Models to use; None is `select_pack()`.
        starts: Number of initial states to check; 0 simulates nothing.
    """
    return lint_text(task.bddl_text, task.id, task, pack, starts=starts)


def lint_yaml(path: str | Path, pack: Pack | None = None, *, starts: int = STARTS) -> Iterator[list[Finding]]:
    """Yield the findings about each task of a YAML file, by its lines; see `lint_task`.

    Raises:
        LiberoError: A task is not valid.
    """
    for task, source in list(iter_yaml_tasks(path)):
        report = Report(lines_of_yaml(task.problem, source))
        yield _findings(report, task, pack or select_pack(), starts)


def lint_file(path: str | Path, pack: Pack | None = None, *, starts: int = STARTS) -> list[Finding]:
    """Return the findings about a BDDL file; see `lint_task`.

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
    reader = bddl.Reader(file)
    report = Report(reader)
    try:
        problem = reader.problem(parse_tree(text, file))
    except ProblemError as error:
        problem = error.problem
        report.violations(error)
        if any(one.rule == "size" for one in error.violations):
            return report.sorted()
    except BDDLError as error:
        return [_syntax(error, file)]
    if task is None:
        task = task_of_file(Path(file).stem, problem)
    for section in problem.unknown_sections:
        report.add("warning", 1, "unknown-section", f"the section {section:.40} has no effect", "remove it")
    if _words(named := language_from_name(task.name)) != _words(told := task.bddl_language):
        what = f"the name says {named!r}, and :language {told!r}: policies receive {task.language!r}"
        remedy = (
            "the original tells the name; use the instruction as name, words joined by _, for both to agree"
        )
        report.add("info", reader.line(":language"), "language", what, remedy)
    return _findings(report, task, pack or select_pack(), starts)


def _findings(report: Report, task: Task, pack: Pack, starts: int) -> list[Finding]:
    """Return what is in a report, and what is found in a task."""
    problem = task.problem
    _check_categories(report, problem, pack)
    _check_goal(report, problem)
    _check_regions(report, problem)
    _check_places(report, problem)
    _check_words(report, task, pack)
    if starts and not report.broken:
        check_scene(report, task, pack, starts)
    return report.sorted()


def _syntax(error: BDDLError, file: str) -> Finding:
    """Return the finding of an error of the parser."""
    remedy = f"write {error.expected}" if error.expected else "fix the file"
    return Finding(file, error.line, "error", "syntax", error.what, remedy)


def _check_categories(report: Report, problem: Problem, pack: Pack) -> None:
    categories = set(pack.categories())
    workspaces = [name for name, category in problem.fixtures.items() if category in WORKSPACES]
    for name, category in {**problem.objects, **problem.fixtures}.items():
        if category not in categories and name not in workspaces:
            valid = categories | set(WORKSPACES) if name in problem.fixtures else categories
            what = f"{name}: no model of {category!r} exists"
            remedy = report.suggest(category, valid)
            report.add("error", report.lines.line("", name), "unknown-category", what, remedy)
    at = report.lines.line(":fixtures")
    if len(workspaces) != 1:
        what = f"{len(workspaces)} workspaces among the fixtures"
        report.add("error", at, "workspace", what, f"declare one of {', '.join(WORKSPACES)}")
        return
    try:
        expected = workspace_of_problem(problem.name).name
    except UnknownNameError as error:
        what, remedy = f"no problem class is named {problem.name}", str(error).split("Valid: ")[-1]
        report.add("warning", 1, "problem-name", what, remedy)
        return
    if expected != (own := problem.fixtures[workspaces[0]]):
        what = f"{problem.name} takes place on a {expected}, but the workspace is a {own}"
        remedy = "change one of them; only the workspace has an effect here"
        report.add("warning", 1, "problem-name", what, remedy)


def _check_goal(report: Report, problem: Problem) -> None:
    """Check that a goal does not ask for a condition and its opposite."""
    parts = problem.goal.parts if isinstance(problem.goal, And) else ()
    for part in parts:
        opposite: Expression | None = part.part if isinstance(part, Not) else None
        if isinstance(part, Atom) and part.predicate in ("Open", "Turnon"):
            opposite = Atom(OPPOSITE_STATES[part.predicate.lower()].capitalize(), part.args)
        if opposite in parts:
            what = f"the goal asks for {part} and for {opposite}, which never hold together"
            report.add("error", report.lines.line(":goal"), "contradiction", what, "remove one of them")


def _check_regions(report: Report, problem: Problem) -> None:
    used = {name for atom in (*problem.init, *problem.goal.atoms()) for name in atom.args} | {*problem.zones}
    goal = {name for atom in problem.goal.atoms() for name in atom.args}
    seen: dict[tuple, str] = {}
    for region in problem.regions:
        line, address = report.lines.regions.get(region.address, 1), region.address
        if address not in used | set(problem.obj_of_interest):
            is_known = region.target in report.lines.entities
            lost = "" if is_known else f", and its target {region.target} is not declared"
            what = f"no atom names {address}{lost}"
            report.add("info", line, "unused-region", what, "remove it, or use it")
        for x0, y0, x1, y1 in region.ranges:
            if address in goal and (x0 == x1 or y0 == y1):
                what = f"{address}: the rectangle ({x0:g} {y0:g} {x1:g} {y1:g}) is empty"
                remedy = "write (X0 Y0 X1 Y1) with X0 < X1 and Y0 < Y1"
                report.add("error", line, "region-ranges", what, remedy)
        key = (region.target, region.ranges, region.yaw)
        if region.ranges and address in used and (first := seen.setdefault(key, address)) != address:
            what = f"{address} is the same region as {first}"
            report.add("warning", line, "duplicate-region", what, "use one of the two")


def _check_places(report: Report, problem: Problem) -> None:
    """Check that every object and fixture is placed."""
    placed = {atom.args[0] for atom in problem.init if atom.predicate in PLACING and len(atom.args) == 2}
    for name in (*problem.objects, *problem.fixtures):
        if name not in placed and problem.kind_of(name) != "workspace":
            is_object = name in problem.objects
            where = "" if is_object else "; it stands in the centre of the workspace"
            remedy = f"add (On {name} REGION) to :init"
            level: Level = "error" if is_object else "warning"
            what = f"no init atom places {name}{where}"
            report.add(level, report.lines.line("", name), "not-placed", what, remedy)
    declared = {*report.lines.entities, *report.lines.regions}
    for name in problem.obj_of_interest:
        if name not in declared:
            line = report.lines.line(":obj_of_interest")
            remedy = report.suggest(name, declared)
            report.add("warning", line, "unknown-name", f"{name} is not declared", remedy)
    if not problem.obj_of_interest:
        what = "there is no object of interest"
        report.add("info", 1, "interest", what, "list the objects of the goal in :obj_of_interest")


def _check_words(report: Report, task: Task, pack: Pack) -> None:
    """Check the instruction of the file, and that of the task's name where policies receive it."""
    line = report.lines.line(":language")
    texts = {task.bddl_language: ""}
    if _words(task.language) != _words(task.bddl_language):
        texts[task.language] = " (of the task's name)"
    if not _words(task.bddl_language):
        report.add("error", line, "language", "the instruction is empty", "add it to :language")
        return
    for text, source in texts.items():
        words = _words(text)
        for what, remedy in (
            *_unnamed(task.problem, words, source),
            *_absent(task.problem, words, source, pack),
            *_wrong_sides(task.problem, words, source),
        ):
            report.add("warning", line, "instruction", what, remedy)


def _unnamed(problem: Problem, words: Sequence[str], source: str) -> Iterator[tuple[str, str]]:
    """Yield what is in the goal and is not named by an instruction, each with a remedy."""
    for atom in problem.goal.atoms():
        for name in atom.args:
            region = problem.region(name)
            entity = region.target if region is not None else name
            category = {**problem.objects, **problem.fixtures}.get(entity)
            if category is None or category in WORKSPACES:
                continue
            tokens = [*_words_for(category), *(_tokens(region.name) if region is not None else ())]
            if not any(_same(token, word) for token in tokens for word in words):
                what = f"no word of the instruction{source} names {name} of the goal's {atom}"
                yield what, f"name it {' '.join(_tokens(category))}, or fix the goal"


def _absent(problem: Problem, words: Sequence[str], source: str, pack: Pack) -> Iterator[tuple[str, str]]:
    """Yield what an instruction names and is not in the scene, each with a remedy."""
    here = [t for c in (*problem.objects.values(), *problem.fixtures.values()) for t in _words_for(c)]
    here += [token for region in problem.regions for token in _tokens(region.name)]
    heads = {tokens[-1] for c in pack.categories() if (tokens := _tokens(c))}
    for word, before in zip(words, ["", *words], strict=False):
        is_there = any(_same(token, one) for token in here for one in (word, before))
        if word in heads and not is_there:  # "cream cheese box" is not a box
            what = f"the instruction{source} names a {word}, but there is none"
            yield what, "add one to :objects or :fixtures, or change the instruction"


def _wrong_sides(problem: Problem, words: Sequence[str], source: str) -> Iterator[tuple[str, str]]:
    """Yield the sides that an instruction names where the goal is about others, each with a remedy."""
    mentioned = {word for word, after in zip(words, [*words[1:], ""], strict=True) if after in _PARTS}
    regions = [r for atom in problem.goal.atoms() for n in atom.args if (r := problem.region(n)) is not None]
    for sides in _SIDES:
        asked = {token for region in regions for token in _tokens(region.name)} & sides
        named = mentioned & sides
        if asked and named and not asked & named:
            named_text, asked_text = (" and ".join(sorted(words)) for words in (named, asked))
            yield f"the instruction{source} names {named_text}, but the goal {asked_text}", "fix one of them"


def _words(text: str) -> list[str]:
    return [_singular(word) for word in re.findall("[a-z]+", text.casefold())]


def _tokens(name: str) -> list[str]:
    """Return the words of a name that name the object: `white_yellow_mug` -> [mug]."""
    return [word for word in _words(name) if word not in _QUALITIES]


def _words_for(category: str) -> list[str]:
    """Return the words that an instruction may use for an object of a category."""
    return [name for token in _tokens(category) for name in (token, _ALSO.get(token, token))]


def _singular(word: str) -> str:
    return word[:-1] if word.endswith("s") and not word.endswith("ss") and len(word) > 3 else word


def _same(token: str, word: str) -> bool:
    """Return whether the words are equal or one is the end of the other: a frypan is a pan."""
    short, long = sorted((token, word), key=len)
    return token == word or (len(short) >= 3 and long.endswith(short))
