"""Parsing of S-expressions into nested lists of words with line numbers, and of numbers as arithmetic."""

import math
import re
from dataclasses import dataclass

from libero_env.errors import BDDLError
from libero_env.tasks.expression import MAX_DEPTH
from libero_env.text import shorten

MAX_CHARACTERS = 1 << 20  # of a task file; the original's have 4,000

_TOKEN = re.compile(r";[^\n]*|[()]|\n|[^\s();]+")
_UNREADABLE = re.compile("[\x00-\x08\x0e-\x1f\x7f\ud800-\udfff]")


@dataclass(frozen=True)
class Word:
    """Text between blanks and brackets."""

    text: str
    line: int


@dataclass(frozen=True)
class List:
    """Content of a pair of brackets."""

    items: "tuple[Word | List, ...]"
    line: int

    @property
    def head(self) -> str:
        """First word in lower case; empty where the list does not start with a word."""
        return self.items[0].text.casefold() if self.items and isinstance(self.items[0], Word) else ""


def show(node: Word | List) -> str:
    """Return a node as text on one line, truncated where it is long."""
    return shorten(text_of(node))


def text_of(node: Word | List) -> str:
    """Return a node as text on one line."""
    return node.text if isinstance(node, Word) else f"({' '.join(map(text_of, node.items))})"


def parse_tree(text: str, file: str, first: int = 1) -> List:
    """Return the one list in a text; `;` starts a comment.

    Args:
        file: Name of its file for error messages.
        first: Line of the file that the text begins on, from 1.

    Raises:
        BDDLError: Brackets do not match or nest too deeply, the text is not one list, or it contains characters that
            are not text.
    """
    if len(text) > MAX_CHARACTERS:
        raise BDDLError(f"{len(text)} characters", f"a task file of at most {MAX_CHARACTERS}", file, 1)
    if bad := _UNREADABLE.search(text):
        line = text.count("\n", 0, bad.start()) + first
        raise BDDLError(f"the character {bad[0]!a}", "text; is this a complete task file?", file, line)
    stack: list[tuple[list, int]] = [([], first)]
    line = first
    for token in _TOKEN.findall(text):
        if token == "\n":
            line += 1
        elif token == "(":
            if len(stack) > MAX_DEPTH:
                raise BDDLError(f"more than {MAX_DEPTH} nested brackets", "a flatter expression", file, line)
            stack.append(([], line))
        elif token == ")":
            if len(stack) == 1:
                raise BDDLError("a ) closes nothing", "as many ( as )", file, line)
            items, start = stack.pop()
            stack[-1][0].append(List(tuple(items), start))
        elif not token.startswith(";"):
            stack[-1][0].append(Word(token, line))
    if len(stack) > 1:
        raise BDDLError("this ( is never closed", "as many ( as )", file, stack[-1][1])
    roots = stack[0][0]
    if len(roots) != 1 or not isinstance(roots[0], List):
        line = roots[1].line if len(roots) > 1 else first
        raise BDDLError(f"{len(roots)} expressions at the top", "one (define (problem NAME) ...)", file, line)
    return roots[0]


_FACTOR = re.compile(
    r"\s*([-+*/]?)((?:\s*[-+])*)\s*(?:((?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)|(?:np\.|math\.)?pi\b)\s*",
    re.ASCII | re.IGNORECASE,
)


def number(text: str) -> float:
    """Return the value of an expression such as `0.25`, `-pi/4` or `2*pi`, without executing it.

    Args:
        text: Numbers, pi, + - * / and signs.

    Raises:
        ValueError: The text contains anything else, or its value is not finite.
    """
    if len(text) > 64:
        raise ValueError(text)
    total, product, at = 0.0, None, 0
    while at < len(text) or product is None:
        factor = _FACTOR.match(text, at)
        operation = factor[1] if factor else ""
        if factor is None or (operation in ("*", "/") if product is None else not operation):
            raise ValueError(text)
        value = float(factor[3]) if factor[3] else math.pi
        value = -value if factor[2].count("-") % 2 else value
        if product is None or operation in ("+", "-"):
            total, product = total + (product or 0.0), -value if operation == "-" else value
        elif operation == "/" and value == 0:
            raise ValueError(text)
        else:
            product = product * value if operation == "*" else product / value
        at = factor.end()
    if not math.isfinite(total + product):
        raise ValueError(text)
    return total + product
