"""Code out of running text: blocks by line numbers, their indentation put back, run with what a reader would have."""

import hashlib
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

MANIFEST = Path(__file__).with_name("blocks.yaml")
ROOT = Path(__file__).parents[2]

# What a line of code looks like, in any of the languages of the texts. Prose may not.
CODE = re.compile(
    r"""from\ [\w.]+\ import\ | import\ \w | class\ \w+.*: | def\ \w+\( | @\w+(\(.*\))?$
    | (for|while|if|elif|with)\ .*:$ | else:$ | return\b | print\( | export\ \w+= | \(?:?define\b | \(:\w+
    | </?\w+[ >] | assert\ | [├└│]
    | [\w.]+(\[.+\])?\ [-+*]?=\ \S | [\w.]+\([^一-鿿]*\)$ | [\w.]+\($ | "\w+":\ | '\w+':\ | [])}]+,?$ | -+\w+(/\w+)?$
    | \("[A-Z]\w+",""",
    re.VERBOSE,
)


@dataclass(frozen=True)
class Block:
    """A block of a text.

    Attributes:
        text: file it is in.
        id: name by which checks call it.
        chapter: blocks of one chapter run one after the other, in one scope.
        lines: first and last line, counted from 1.
        digest: of the lines, so that a changed text is noticed.
        kind: `python`, `bash`, `xml`, `bddl`; `shown` for what is there to be looked at: output, folders, goals.
        falls: line -> depth of indentation where it ends an indented part.
        replace: line -> what stands there instead.
        given: Python of names that the reader is expected to have.
        helpers: function of `completions` that writes what the text leaves out; it adds to the scope.
        why: for all of these.
        file: where XML goes.
    """

    text: str
    id: str
    chapter: str
    lines: tuple[int, int]
    digest: str
    kind: str = "python"
    falls: Mapping[int, int] = field(default_factory=dict)
    replace: Mapping[int, str] = field(default_factory=dict)
    given: str = ""
    helpers: str = ""
    why: str = ""
    file: str = ""

    @property
    def numbers(self) -> range:
        """Its line numbers."""
        return range(self.lines[0], self.lines[1] + 1)

    @property
    def runs(self) -> str:
        """How much of it is the text's own."""
        if self.kind == "shown":
            return "checked"
        return (
            "completed" if self.replace or self.helpers else "with names given" if self.given else "as typed"
        )

    def source(self, text: Sequence[str]) -> str:
        """Its code, with indentation and with the lines that are replaced."""
        lines: list[str] = []
        falls = {}
        for n in self.numbers:
            if n in self.falls:
                falls[len(lines)] = self.falls[n]
            lines += self.replace.get(n, text[n - 1]).splitlines() or [""]
        return reindent(lines, falls) if self.kind == "python" else "\n".join(lines) + "\n"


def load_blocks() -> list[Block]:
    """All blocks, in the order in which they run."""
    found = yaml.safe_load(MANIFEST.read_text(encoding="utf-8"))
    return [
        Block(text=text, **{**facts, "lines": tuple(facts["lines"])})
        for text, listed in found.items()
        for facts in listed
    ]


def digest(lines: Iterable[str]) -> str:
    """Of some lines, blanks at their ends aside."""
    return hashlib.sha256("\n".join(line.strip() for line in lines).encode()).hexdigest()[:12]


def reindent(lines: Sequence[str], falls: Mapping[int, int]) -> str:
    """Python whose lines have lost their indentation, with it.

    A line that ends with a colon opens a part; a part ends where `falls` says so: position of a line -> depth. Inside
    brackets and long strings indentation is free.
    """
    depth, inside, out = 0, Scanner(), []
    for position, line in enumerate(lines):
        if not inside.open:
            depth = falls.get(position, depth)
        out.append("    " * depth + line.strip())
        code = inside.feed(line.strip() + "\n").rstrip()
        if not inside.open and code.endswith(":"):
            depth += 1
    return "\n".join(out) + "\n"


class Scanner:
    """Follows brackets and strings through lines of Python."""

    def __init__(self) -> None:
        self.brackets, self.quote = 0, ""

    @property
    def open(self) -> bool:
        """Whether the next line continues this one."""
        return bool(self.brackets or len(self.quote) == 3)

    def feed(self, line: str) -> str:
        """Take a line; what of it is neither string nor comment."""
        code, i = "", 0
        while i < len(line):
            if self.quote:
                if line[i] == "\\":
                    i += 1
                elif line.startswith(self.quote, i):
                    i += len(self.quote) - 1
                    self.quote = ""
            elif line[i] == "#":
                break
            elif line[i] in "\"'":
                self.quote = line[i] * 3 if line.startswith(line[i] * 3, i) else line[i]
                i += len(self.quote) - 1
            else:
                self.brackets += (line[i] in "([{") - (line[i] in ")]}")
                code += line[i]
            i += 1
        if len(self.quote) == 1:
            self.quote = ""
        return code


def left_out(text: Sequence[str], blocks: Iterable[Block]) -> list[str]:
    """Lines that look like code and are in no block, with their numbers."""
    taken = {n for block in blocks for n in block.numbers}
    return [
        f"{n}: {line.strip()}"
        for n, line in enumerate(text, start=1)
        if n not in taken and CODE.match(line.strip())
    ]


def execute(block: Block, text: Sequence[str], scope: dict[str, Any]) -> None:
    """Run a Python block in a scope, as a script in the folder `notebooks` would."""
    from tests.walkthroughs import completions

    name = str(ROOT / "notebooks" / f"{block.id}.py")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a reader sees them and goes on
        if block.given:
            exec(compile(block.given, f"{name} (given)", "exec"), scope)  # noqa: S102
        if block.helpers:
            scope.update(getattr(completions, block.helpers)(scope))
        exec(compile(block.source(text), name, "exec"), scope)  # noqa: S102
