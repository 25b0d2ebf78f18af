"""S-expressions: text -> nested lists of words that remember their line, and numbers as arithmetic."""

import math
import re
from dataclasses import dataclass
from typing import NoReturn

from libero_env.errors import BDDLError

MAX_DEPTH = 64  # brackets in brackets; deeper is a mistake, and what walks a tree is recursive

_TOKEN = re.compile(r";[^\n]*|[()]|\n|[^\s();]+")
_UNREADABLE = re.compile("[\x00-\x08\x0e-\x1f\x7f\ud800-\udfff]")
_SHOWN = 80  # characters of a node in a message


@dataclass(frozen=True)
class Word:
    """Anything between blanks and brackets."""

    text: str
    line: int


@dataclass(frozen=True)
class List:
    """What stands between a ( and its )."""

    items: "tuple[Word | List, ...]"
    line: int

    @property
    def head(self) -> str:
        """The first word in lower case; empty where the list starts with no word."""
        return self.items[0].text.casefold() if self.items and isinstance(self.items[0], Word) else ""


def fail(file: str, line: int, what: str, expected: str) -> NoReturn:
    """Raise the error of a task file, in one form everywhere."""
    raise BDDLError(f"{file}:{line}: {what}; expected {expected}")


def show(node: Word | List) -> str:
    """The node as text, on one line, its end left off where it is long."""
    text = _text(node)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def _text(node: Word | List) -> str:
    return node.text if isinstance(node, Word) else f"({' '.join(map(_text, node.items))})"


def parse_tree(text: str, file: str) -> List:
    """The one list that the text holds; `;` starts a comment.

    Raises:
        BDDLError: brackets do not match or go too deep, the text is not one list, or it holds characters that
            no text file has.
    """
    if bad := _UNREADABLE.search(text):
        line = text.count("\n", 0, bad.start()) + 1
        fail(file, line, f"the character {bad[0]!a}", "text; is this a task file, and is it whole?")
    stack: list[tuple[list, int]] = [([], 1)]
    line = 1
    for token in _TOKEN.findall(text):
        if token == "\n":
            line += 1
        elif token == "(":
            if len(stack) > MAX_DEPTH:
                fail(file, line, f"more than {MAX_DEPTH} brackets inside each other", "a flatter expression")
            stack.append(([], line))
        elif token == ")":
            if len(stack) == 1:
                fail(file, line, "a ) closes nothing", "as many ( as )")
            items, start = stack.pop()
            stack[-1][0].append(List(tuple(items), start))
        elif not token.startswith(";"):
            stack[-1][0].append(Word(token, line))
    if len(stack) > 1:
        fail(file, stack[-1][1], "this ( is never closed", "as many ( as )")
    roots = stack[0][0]
    if len(roots) != 1 or not isinstance(roots[0], List):
        line = roots[1].line if len(roots) > 1 else 1
        fail(file, line, f"{len(roots)} expressions at the top", "one (define (problem NAME) ...)")
    return roots[0]


_FACTOR = re.compile(
    r"\s*([-+*/]?)((?:\s*[-+])*)\s*(?:((?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)|(?:np\.|math\.)?pi\b)\s*",
    re.ASCII | re.IGNORECASE,
)


def number(text: str) -> float:
    """The value of `0.25`, `-pi/4`, `2*pi`: numbers, pi, + - * / and signs, never executed.

    Raises:
        ValueError: the text is anything else, or not finite.
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
