"""Whether the instruction and the goal speak of the same things."""

import re
from collections.abc import Iterable

from libero_env.assets.arena import WORKSPACES
from libero_env.assets.pack import Pack
from libero_env.design.lint.report import Report, spell
from libero_env.sim.predicates import atoms_of
from libero_env.tasks import Task
from libero_env.tasks.problem import Problem

# words of names that do not say what a thing is
_QUALITIES = {
    "and",
    "of",
    "the",
    "two",
    "new",
    "black",
    "white",
    "red",
    "yellow",
    "wooden",
    "flat",
    "short",
    "glazed",
    "rim",
    "region",
    "side",
    "contain",
    "init",
}
_ALSO = {"shelf": "cabinet", "cabinet": "drawer"}  # what people call it too
_PARTS = {"drawer", "compartment", "layer", "side", "shelf", "region", "of"}  # what a side is said of
_SIDES = ({"top", "middle", "bottom"}, {"left", "right"}, {"front", "back"})


def check_words(report: Report, task: Task, pack: Pack) -> None:
    """Return the instruction of the file, and the one that the task's name spells where it says something else."""
    line = report.lines.section(":language")
    texts = {task.bddl_language: ""}
    if _words(task.language) != _words(task.bddl_language):
        what = f"policies are told {task.language!r}, as the task's name spells it, and not {task.bddl_language!r}"
        report.info(line, "language", what, "name the task by its instruction, words joined by _")
        if task.suite != "file":
            texts[task.language] = " (of the task's name)"
    if not _words(task.bddl_language):
        report.error(line, "language", "the instruction is empty", "say what is to be done")
        return
    for text, source in texts.items():
        _check_goal_named(report, task.problem, text, line, source)
        _check_scene_has(report, task.problem, text, line, source, pack)
        _check_sides(report, task.problem, text, line, source)


def _check_goal_named(report: Report, problem: Problem, text: str, line: int, source: str) -> None:
    """Everything that the goal is about is named."""
    words = set(_words(text))
    for atom in atoms_of(problem.goal):
        for name in atom.args:
            region = problem.region(name)
            thing = region.target if region is not None else name
            category = {**problem.objects, **problem.fixtures}.get(thing)
            if category is None or category in WORKSPACES:
                continue
            said = [*_calls(category), *(_tokens(region.name) if region is not None else ())]
            if not any(_same(token, word) for token in said for word in words):
                what = f"no word of the instruction{source} names {name} of the goal's {spell(atom)}"
                report.warning(
                    line, "instruction", what, f"call it {' '.join(_tokens(category))}, or mend the goal"
                )


def _check_scene_has(report: Report, problem: Problem, text: str, line: int, source: str, pack: Pack) -> None:
    """Everything that is named is there."""
    here = [t for c in (*problem.objects.values(), *problem.fixtures.values()) for t in _calls(c)]
    here += [token for region in problem.regions for token in _tokens(region.name)]
    heads = {tokens[-1] for c in pack.categories() if (tokens := _tokens(c))}
    there = lambda word: any(_same(token, word) for token in here)  # noqa: E731
    words = _words(text)
    for word, before in zip(words, ["", *words], strict=False):
        if word in heads and not there(word) and not there(before):  # "cream cheese box" is no box
            what = f"the instruction{source} names a {word}, and there is none"
            report.warning(
                line, "instruction", what, "add one to :objects or :fixtures, or say something else"
            )


def _check_sides(report: Report, problem: Problem, text: str, line: int, source: str) -> None:
    """Return the side that the goal asks for is not the opposite of the one that is named."""
    words = _words(text)
    told = {word for word, after in zip(words, [*words[1:], ""], strict=True) if after in _PARTS}
    regions = [
        r for atom in atoms_of(problem.goal) for n in atom.args if (r := problem.region(n)) is not None
    ]
    for sides in _SIDES:
        asked = {token for region in regions for token in _tokens(region.name)} & sides
        named = told & sides
        if asked and named and not asked & named:
            what = f"the instruction{source} says {_list(named)}, and the goal {_list(asked)}"
            report.warning(line, "instruction", what, "mend one of them")


def _words(text: str) -> list[str]:
    return [_singular(word) for word in re.findall("[a-z]+", text.casefold())]


def _tokens(name: str) -> list[str]:
    """Return the words of a name that say what it is: `white_yellow_mug` -> [mug]."""
    return [word for word in _words(name) if word not in _QUALITIES]


def _calls(category: str) -> list[str]:
    """What an instruction may call a thing of a category."""
    return [name for token in _tokens(category) for name in (token, _ALSO.get(token, token))]


def _singular(word: str) -> str:
    return word[:-1] if word.endswith("s") and not word.endswith("ss") and len(word) > 3 else word


def _same(token: str, word: str) -> bool:
    """Equal, or one is the end of the other: a frypan is a pan."""
    short, long = sorted((token, word), key=len)
    return token == word or (len(short) >= 3 and long.endswith(short))


def _list(words: Iterable[str]) -> str:
    return " and ".join(sorted(words))
