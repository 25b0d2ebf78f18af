"""Check that the instruction and the goal name the same objects."""

import re
from collections.abc import Iterable

from libero_env.assets.arena import WORKSPACES
from libero_env.assets.pack import Pack
from libero_env.design.lint.report import Report
from libero_env.tasks import Task
from libero_env.tasks.problem import Problem

# words of categories that do not name the object
_QUALITIES = {
    *("and", "of", "the", "two", "new", "black", "white", "red", "yellow", "wooden", "flat", "short"),
    *("glazed", "rim", "region", "side", "contain", "init"),
}
_ALSO = {"shelf": "cabinet", "cabinet": "drawer"}  # other words in common use
_PARTS = {"drawer", "compartment", "layer", "side", "shelf", "region", "of"}  # of objects that have sides
_SIDES = ({"top", "middle", "bottom"}, {"left", "right"}, {"front", "back"})


def check_words(report: Report, task: Task, pack: Pack) -> None:
    """Check the instruction of the file, and that of the task's name where they differ."""
    line = report.lines.section(":language")
    texts = {task.bddl_language: ""}
    if _words(task.language) != _words(task.bddl_language):
        what = f"policies receive {task.language!r}, which is the task's name, and not {task.bddl_language!r}"
        report.info(line, "language", what, "use the instruction as the task's name, words joined by _")
        if task.suite != "file":
            texts[task.language] = " (of the task's name)"
    if not _words(task.bddl_language):
        report.error(line, "language", "the instruction is empty", "add it to :language")
        return
    for text, source in texts.items():
        _check_goal_named(report, task.problem, text, line, source)
        _check_scene_has(report, task.problem, text, line, source, pack)
        _check_sides(report, task.problem, text, line, source)


def _check_goal_named(report: Report, problem: Problem, text: str, line: int, source: str) -> None:
    """Check that the instruction names everything in the goal."""
    words = set(_words(text))
    for atom in problem.goal.atoms():
        for name in atom.args:
            region = problem.region(name)
            entity = region.target if region is not None else name
            category = {**problem.objects, **problem.fixtures}.get(entity)
            if category is None or category in WORKSPACES:
                continue
            known = [*_words_for(category), *(_tokens(region.name) if region is not None else ())]
            if not any(_same(token, word) for token in known for word in words):
                what = f"no word of the instruction{source} names {name} of the goal's {atom}"
                report.warning(
                    line, "instruction", what, f"name it {' '.join(_tokens(category))}, or fix the goal"
                )


def _check_scene_has(report: Report, problem: Problem, text: str, line: int, source: str, pack: Pack) -> None:
    """Check that everything that the instruction names exists."""
    here = [t for c in (*problem.objects.values(), *problem.fixtures.values()) for t in _words_for(c)]
    here += [token for region in problem.regions for token in _tokens(region.name)]
    heads = {tokens[-1] for c in pack.categories() if (tokens := _tokens(c))}
    there = lambda word: any(_same(token, word) for token in here)  # noqa: E731
    words = _words(text)
    for word, before in zip(words, ["", *words], strict=False):
        if word in heads and not there(word) and not there(before):  # "cream cheese box" is not a box
            what = f"the instruction{source} names a {word}, but there is none"
            report.warning(
                line, "instruction", what, "add one to :objects or :fixtures, or change the instruction"
            )


def _check_sides(report: Report, problem: Problem, text: str, line: int, source: str) -> None:
    """Check that the goal does not require another side than the one that the instruction names."""
    words = _words(text)
    mentioned = {word for word, after in zip(words, [*words[1:], ""], strict=True) if after in _PARTS}
    regions = [r for atom in problem.goal.atoms() for n in atom.args if (r := problem.region(n)) is not None]
    for sides in _SIDES:
        asked = {token for region in regions for token in _tokens(region.name)} & sides
        named = mentioned & sides
        if asked and named and not asked & named:
            what = f"the instruction{source} names {_list(named)}, but the goal {_list(asked)}"
            report.warning(line, "instruction", what, "fix one of them")


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


def _list(words: Iterable[str]) -> str:
    return " and ".join(sorted(words))
