"""Findings of the linter, and the lines of a task file that they refer to."""

import difflib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

from libero_env.tasks.problem import Atom
from libero_env.tasks.sexpr import List, Word

Level = Literal["error", "warning", "info"]
LEVELS: tuple[Level, ...] = ("error", "warning", "info")  # the most severe first


@dataclass(frozen=True)
class Finding:
    """One finding about a task.

    Attributes:
        file: Name of the file or id of the task.
        line: Line, from 1.
        level: `error` (the task does not work), `warning` (it is doubtful) or `info`.
        rule: Name of the rule, such as `unknown-name`.
        what: What is wrong.
        remedy: How to fix it.
    """

    file: str
    line: int
    level: Level
    rule: str
    what: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.level}: {self.what} [{self.rule}] -> {self.remedy}"


def spell(atom: Atom) -> str:
    """Return an atom as task files contain it."""
    return f"({atom.predicate} {' '.join(atom.args)})"


class Lines:
    """Line numbers of the parts of a task file.

    Attributes:
        entities: Name of an object or fixture -> line.
        regions: Address of a region -> line.
        init: Line of each init atom.
        goal: Line of each atom of the goal, in reading order.
    """

    def __init__(self, tree: List):
        self._sections = {node.head: node for node in tree.items if isinstance(node, List)}
        self.entities = {name: line for head in (":fixtures", ":objects") for name, line in self._names(head)}
        self.regions = dict(self._regions())
        self.init = [item.line for item in self._items(":init")]
        self.goal = [line for item in self._items(":goal") for line in _atom_lines(item)]

    def section(self, head: str) -> int:
        """Return the line of a section such as `:goal`; 1 where there is none."""
        return self._sections[head].line if head in self._sections else 1

    def of(self, name: str) -> int:
        """Return the line of the declaration of an object, fixture or region."""
        return self.entities.get(name, self.regions.get(name, 1))

    def _items(self, head: str) -> tuple[Word | List, ...]:
        return self._sections[head].items[1:] if head in self._sections else ()

    def _names(self, head: str) -> Iterator[tuple[str, int]]:
        items = [item for item in self._items(head) if isinstance(item, Word)]
        before = [None, *items[:-1]]
        for item, last in zip(items, before, strict=False):
            if item.text != "-" and (last is None or last.text != "-"):
                yield item.text, item.line

    def _regions(self) -> Iterator[tuple[str, int]]:
        for node in self._items(":regions"):
            if not isinstance(node, List) or not node.items or not isinstance(node.items[0], Word):
                continue
            for part in node.items[1:]:
                if isinstance(part, List) and part.head == ":target" and isinstance(part.items[-1], Word):
                    yield f"{part.items[-1].text}_{node.items[0].text}", node.line


def _atom_lines(node: Word | List) -> Iterator[int]:
    if isinstance(node, List) and node.head in ("and", "or", "not", "forall"):
        for part in node.items[2:] if node.head == "forall" else node.items[1:]:
            yield from _atom_lines(part)
    else:
        yield node.line


class Report:
    """Collection of the findings about one task file.

    Attributes:
        lines: Line numbers of the parts of the file.
        categories: Categories of the declared objects; empty until the file is parsed.
        findings: Findings so far.
    """

    def __init__(self, file: str, tree: List):
        self.file, self.lines = file, Lines(tree)
        self.categories: set[str] = set()
        self.findings: list[Finding] = []

    def error(self, line: int, rule: str, what: str, remedy: str) -> None:
        """Add a finding because of which the task does not work."""
        self.findings.append(Finding(self.file, line, "error", rule, what, remedy))

    def warning(self, line: int, rule: str, what: str, remedy: str) -> None:
        """Add a finding because of which the task probably does not work as intended."""
        self.findings.append(Finding(self.file, line, "warning", rule, what, remedy))

    def info(self, line: int, rule: str, what: str, remedy: str) -> None:
        """Add a finding that is good to know."""
        self.findings.append(Finding(self.file, line, "info", rule, what, remedy))

    @property
    def broken(self) -> bool:
        """Whether there is an error."""
        return any(finding.level == "error" for finding in self.findings)

    def sorted(self) -> list[Finding]:
        """Return the findings by line, the most severe of a line first, without duplicates."""
        return sorted(set(self.findings), key=lambda f: (f.line, LEVELS.index(f.level), f.rule, f.what))

    def suggest(self, name: str, valid: Iterable[str]) -> str:
        """Return the remedy for a name that does not exist."""
        names = sorted(valid)
        if close := difflib.get_close_matches(name, names, n=3, cutoff=0.5):
            return f"did you mean {' or '.join(close)}?"
        return f"one of {', '.join(names)}" if names else "declare it"
