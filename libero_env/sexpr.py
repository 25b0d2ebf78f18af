"""S-expressions: text -> nested lists of words that remember their line, and numbers as arithmetic."""

import ast
import math
import operator
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import NoReturn

from libero_env.errors import BDDLError


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
    """The node as text, on one line."""
    return node.text if isinstance(node, Word) else f"({' '.join(map(show, node.items))})"


def parse_tree(text: str, file: str) -> List:
    """The one list that the text holds; `;` starts a comment.

    Raises:
        BDDLError: brackets do not match, or the text is not one list.
    """
    stack: list[tuple[list, int]] = [([], 1)]
    line = 1
    for token in re.findall(r";[^\n]*|[()]|\n|[^\s();]+", text):
        if token == "\n":
            line += 1
        elif token == "(":
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


_OPERATORS: dict[type, Callable[..., float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
}


def number(text: str) -> float:
    """The value of `0.25`, `-pi/4`, `2*pi`: numbers, pi, + - * / and signs, never executed.

    Raises:
        ValueError: the text is anything else, or not finite.
    """
    if len(text) > 64:  # the parser itself fails on very deep nesting
        raise ValueError(text)
    try:
        value = _value(ast.parse(text, mode="eval").body)
    except (SyntaxError, ZeroDivisionError, RecursionError) as error:
        raise ValueError(text) from error
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def _value(node: ast.expr) -> float:
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            return float(value)
        case ast.Name(id="pi") | ast.Attribute(value=ast.Name(id="np" | "math"), attr="pi"):
            return math.pi
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            return _OPERATORS[type(op)](_value(left), _value(right))
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
            return _OPERATORS[type(op)](_value(operand))
    raise ValueError(ast.dump(node))
