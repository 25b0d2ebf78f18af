"""Findings of the linter, and the lines of a task file that they refer to."""

import difflib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from libero_env.tasks.bddl import Reader
from libero_env.tasks.expression import Atom
from libero_env.tasks.problem import Problem, ProblemError
from libero_env.tasks.schema import Source

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


def lines_of_yaml(problem: Problem, source: Source) -> Reader:
    """Return a reader that knows the lines of a task's YAML file; what is from elsewhere has the line of `scene`."""
    reader = Reader(source.name)

    def line(path: str, label: object = "") -> int:
        file, _, number = source.places.get(str(label), "").rpartition(":")
        found = source.line_of((path,)) if source.line_of else None
        return int(number) if file == source.name else found or 1

    keys = {":init": "place", ":fixtures": "furniture"}
    sections = (":language", ":fixtures", ":objects", ":obj_of_interest", ":init", ":goal")
    reader.sections = {section: line(keys.get(section, section[1:])) for section in sections}
    reader.entities = {name: line("scene", name) for name in (*problem.fixtures, *problem.objects)}
    reader.regions = {region.address: line("scene", region.address) for region in problem.regions}
    reader.init = [line("scene", atom) for atom in problem.init]
    reader.goal = [line("scene", atom) for atom in problem.goal.atoms()]
    return reader


class Report:
    """Collection of the findings about one task file.

    Attributes:
        lines: Reader of the file, which knows the lines of its parts.
        findings: Findings so far.
    """

    def __init__(self, lines: Reader):
        self.file, self.lines = lines.file, lines
        self.findings: list[Finding] = []

    def add(self, level: Level, line: int, rule: str, what: str, remedy: str) -> None:
        """Add a finding; see `Finding`."""
        self.findings.append(Finding(self.file, line, level, rule, what, remedy))

    def violations(self, error: ProblemError) -> None:
        """Add all that is wrong with a problem from which no scene can be built."""
        for one in error.violations:
            line = self.lines.line(one.section, one.part)
            self.add("error", line, one.rule, one.what, f"expected {one.expected}")

    def init(self, problem: Problem) -> Iterable[tuple[Atom, int]]:
        """Return the init atoms with their lines."""
        return zip(problem.init, self.lines.init, strict=True)

    def goal(self, problem: Problem) -> Iterable[tuple[Atom, int]]:
        """Return the atoms of the goal with their lines."""
        return zip(problem.goal.atoms(), self.lines.goal, strict=True)

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
