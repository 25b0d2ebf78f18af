"""Values as text and plain data; every other module may use these, and none of their own.

closest, suggest      the valid name that is nearest to a wrong one, and `Did you mean 'x'?` for messages
shorten, shown        a text, and the `repr` of any value, cut to a length
printable             a text without control characters
flatten               a nested mapping as one with dotted keys
plain, json_safe      arrays, tuples, dataclasses and bytes as lists, mappings and texts; no NaN in the latter
to_json               the text of a JSON file (`libero_env.storage` writes and reads them)
duration, show_bytes, quantity   3 min 20 s, 1.5 GB, 5.38 M
Table, Cell           rows of cells: in columns, as CSV and as plain data
"""

import csv
import dataclasses
import difflib
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any


def closest(name: object, valid: Iterable[object]) -> str | None:
    """Return the valid name that is most like another one, upper or lower case; None where none is like it."""
    folded = {str(one).casefold(): str(one) for one in valid}
    near = difflib.get_close_matches(str(name).casefold(), folded, n=1)
    return folded[near[0]] if near else None


def suggest(name: object, valid: Iterable[object]) -> str:
    """Return ` Did you mean 'x'?` for the nearest valid name, or an empty text where none is near."""
    near = closest(name, valid)
    return "" if near is None else f" Did you mean {near!r}?"


def shorten(text: str, length: int = 80) -> str:
    """Return a text; one that is longer than `length` characters ends in `...`."""
    return text if len(text) <= length else f"{text[: length - 3]}..."


def shown(value: object, length: int = 80) -> str:
    """Return the `repr` of a value for a message, shortened."""
    try:
        return shorten(repr(value), length)
    except (ValueError, RecursionError):  # a whole number of more than 4300 digits
        return f"a value of type {type(value).__name__} that is too large to be shown"


def printable(text: str) -> str:
    """Return a text for a terminal: control characters that came from a file or a user are escaped."""
    return "".join(c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in text)


def flatten(values: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    """Return a nested mapping as one: `{"a": {"b": 1}}` becomes `{"a.b": 1}`."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        flat |= flatten(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return flat


def plain(value: Any) -> Any:
    """Return data as mappings with texts as keys, lists, numbers and texts.

    Arrays, numbers of NumPy, tuples, sets, dataclasses, paths and bytes are converted; other objects stay.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {k if isinstance(k, str) else str(plain(k)): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(part) for part in value]
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    if hasattr(value, "tolist"):  # of arrays and numbers of NumPy
        return value.tolist()
    return str(value) if hasattr(value, "__fspath__") else value


def json_safe(value: Any) -> Any:
    """Return plain data with None for numbers that are not finite, as JSON has no NaN; see `plain`."""
    value = plain(value)
    if isinstance(value, dict):
        return {key: json_safe(part) for key, part in value.items()}
    if isinstance(value, list):
        return [json_safe(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_json(value: Any) -> str:
    """Return the text of a JSON file, which ends with a line break; see `json_safe`."""
    return json.dumps(json_safe(value), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def duration(seconds: float) -> str:
    """Return a time for readers: 0.4 s, 42 s, 3 min 20 s, 2 h 05 min."""
    if not math.isfinite(seconds):
        return "unknown time"
    if seconds < 1:
        return f"{seconds:.1g} s" if seconds else "0 s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def counted(count: int, noun: str) -> str:
    """Return a number with its noun: `1 task`, `10 tasks`, `2 policies`."""
    plural = f"{noun[:-1]}ies" if noun.endswith("y") else f"{noun}es" if noun.endswith("s") else f"{noun}s"
    return f"{count:,} {noun if count == 1 else plural}"


def show_bytes(count: float) -> str:
    """Return a number of bytes as text, such as `1.5 GB`."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"


def quantity(value: float, unit: str = "") -> str:
    """Return a number with three digits and its SI prefix: 5.38 M, 1.20 TFLOP, 512 B."""
    value = float(f"{value:.3g}") if value >= 1000 else value
    for power, prefix in ((12, "T"), (9, "G"), (6, "M"), (3, "k")):
        if value >= 10**power:
            digits = f"{value / 10**power:#.3g}".rstrip(".")
            return f"{digits} {prefix}{unit}".rstrip()
    return f"{value:.0f} {unit}".rstrip()


@dataclass(frozen=True)
class Cell:
    """A cell, of which all but the text is for pages.

    Attributes:
        text: What it says.
        note: What stands behind that, smaller.
        strong: Whether it is bold.
        title: What is shown where it is pointed at.
    """

    text: object
    note: str = ""
    strong: bool = False
    title: str = ""

    def __str__(self) -> str:
        return str(self.text)


@dataclass(frozen=True)
class Table:
    """A table, as text of a terminal, CSV and plain data, and for the template of a page.

    Attributes:
        heads: Heads of the columns.
        rows: Cells: texts, numbers or `Cell`s.
        left: Number of columns that are aligned at the left; the others are at the right.
    """

    heads: Sequence[object]
    rows: Sequence[Sequence[object]]
    left: int = 1

    def __bool__(self) -> bool:
        return bool(self.rows)

    def __str__(self) -> str:
        cells = [[str(cell) for cell in row] for row in (self.heads, *self.rows)]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        lines = (
            (
                cell.ljust(w) if i < self.left else cell.rjust(w)
                for i, (cell, w) in enumerate(zip(row, widths, strict=True))
            )
            for row in cells
        )
        return "\n".join("  ".join(line).rstrip() for line in lines)

    @property
    def cells(self) -> list[list[Cell]]:
        """Heads and rows as cells; heads begin with a capital letter, but for names, which are `Cell`s."""
        heads = [h if isinstance(h, Cell) else Cell(str(h)[:1].upper() + str(h)[1:]) for h in self.heads]
        return [heads, *([c if isinstance(c, Cell) else Cell(c) for c in row] for row in self.rows)]

    def data(self) -> list[dict[str, str]]:
        """Return a dictionary for each row: head -> text."""
        return [dict(zip(map(str, self.heads), map(str, row), strict=True)) for row in self.rows]

    def csv(self) -> str:
        """Return it as CSV."""
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([self.heads, *self.rows])
        return text.getvalue()
