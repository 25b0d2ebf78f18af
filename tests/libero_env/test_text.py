"""Values as text and plain data."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from libero_env.errors import BrokenFileError
from libero_env.storage import read_json, write_json
from libero_env.text import (
    Cell,
    Table,
    duration,
    flatten,
    json_safe,
    printable,
    quantity,
    shorten,
    show_bytes,
    shown,
)


@dataclass(frozen=True)
class Sample:
    path: Path
    rows: np.ndarray


def test_long_values_are_cut():
    assert shorten("a" * 80) == "a" * 80
    assert shorten("a" * 81) == "a" * 77 + "..."
    assert shown("a", 80) == "'a'" and len(shown(list(range(1000)))) == 80
    assert "too large" in shown(10**5000)
    assert printable("a\x1b[2J\n") == "a\\x1b[2J\n"


def test_data_survive_json(tmp_path):
    value = {"a": {"b": (1, np.float64("nan"))}, 3: Sample(Path("x"), np.eye(2)), "raw": b"text"}
    safe = json_safe(value)
    assert safe == {"a": {"b": [1, None]}, "3": {"path": "x", "rows": [[1, 0], [0, 1]]}, "raw": "text"}
    write_json(tmp_path / "file.json", value)
    assert read_json(tmp_path / "file.json") == safe == json.loads(json.dumps(safe))
    (tmp_path / "file.json").write_text("{")
    with pytest.raises(BrokenFileError, match="file.json is not JSON"):
        read_json(tmp_path / "file.json", BrokenFileError)


def test_flatten_joins_keys():
    assert flatten({"a": {"b": {"c": 1}}, "d": [2]}) == {"a.b.c": 1, "d": [2]}


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0, "0 s"), (0.42, "0.4 s"), (59.6, "1 min 00 s"), (200, "3 min 20 s"), (7500, "2 h 05 min")],
)
def test_durations(seconds, text):
    assert duration(seconds) == text


def test_amounts():
    assert (quantity(5.38e6), quantity(512, "B"), quantity(1.2e12, "FLOP")) == (
        "5.38 M",
        "512 B",
        "1.20 TFLOP",
    )
    assert (quantity(999_600), quantity(999.6), quantity(9.996e9)) == ("1.00 M", "1000", "10.0 G")
    assert (show_bytes(512), show_bytes(1.5e9)) == ("512 B", "1.5 GB")


def test_columns_are_aligned():
    table = Table(["", "n"], [[Cell("plate", "of wood"), 10], ["mug", 5]])
    assert str(table) == "        n\nplate  10\nmug     5" and table.csv() == ",n\nplate,10\nmug,5\n"
    assert table.data() == [{"": "plate", "n": "10"}, {"": "mug", "n": "5"}]
    heads = Table(["method", Cell("er"), Cell("Er")], []).cells[0]
    assert [head.text for head in heads] == ["Method", "er", "Er"], "names stay as they are"
