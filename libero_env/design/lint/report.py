"""What a linter says: findings, and the lines of a task file that they are about."""

import difflib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

from libero_env.tasks.problem import Atom
from libero_env.tasks.sexpr import List, Word

Level = Literal["error", "warning", "info"]
LEVELS: tuple[Level, ...] = ("error", "warning", "info")  # the gravest first


@dataclass(frozen=True)
class Finding:
    """Something wrong (`error`), doubtful (`warning`) or worth knowing (`info`) about a task."""

    file: str
    line: int
    level: Level
    rule: str  # `unknown-name`
    what: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.level}: {self.what} [{self.rule}] -> {self.remedy}"


def spell(atom: Atom) -> str:
    """Return the atom as a task file has it."""
    return f"({atom.predicate} {' '.join(atom.args)})"


class Lines:
    """Where in a task file things are said.

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
        """Line of a section, such as `:goal`; 1 where there is none."""
        return self._sections[head].line if head in self._sections else 1

    def of(self, name: str) -> int:
        """Line of the declaration of an object, fixture or region."""
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
    """Findings about one task file as they come in.

    Attributes:
        lines: Where things are said.
        categories: Of the objects that the file declares, as far as it can be read.
        findings: So far.
    """

    def __init__(self, file: str, tree: List):
        self.file, self.lines = file, Lines(tree)
        self.categories: set[str] = set()
        self.findings: list[Finding] = []

    def error(self, line: int, rule: str, what: str, remedy: str) -> None:
        """Return the task does not work as it is."""
        self.findings.append(Finding(self.file, line, "error", rule, what, remedy))

    def warning(self, line: int, rule: str, what: str, remedy: str) -> None:
        """It works, and probably not as it was meant."""
        self.findings.append(Finding(self.file, line, "warning", rule, what, remedy))

    def info(self, line: int, rule: str, what: str, remedy: str) -> None:
        """Worth knowing."""
        self.findings.append(Finding(self.file, line, "info", rule, what, remedy))

    @property
    def broken(self) -> bool:
        """Whether there is an error."""
        return any(finding.level == "error" for finding in self.findings)

    def sorted(self) -> list[Finding]:
        """Return the findings by line, the gravest of a line first, each once."""
        return sorted(set(self.findings), key=lambda f: (f.line, LEVELS.index(f.level), f.rule, f.what))

    def suggest(self, name: str, valid: Iterable[str]) -> str:
        """Return a remedy for a name that does not exist."""
        names = sorted(valid)
        if close := difflib.get_close_matches(name, names, n=3, cutoff=0.5):
            return f"did you mean {' or '.join(close)}?"
        return f"one of {', '.join(names)}" if names else "declare it"
