"""Which draws are used: the first for which the goal is false and that the expert solves, as far as that was measured.

A draw is numbered from 0. `data/draws.json` has the numbers of those that replace earlier ones, by kind, severity,
seed, task and start; `libero perturb certify --keep` writes it.
"""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from libero_env.perturbations.value import Perturbation

_overlay: dict[str, int] = {}


def kept_path() -> Path:
    """Return the file of the package with the numbers of draws."""
    return Path(str(resources.files("libero_env"))) / "perturbations" / "data" / "draws.json"


@cache
def _kept() -> Mapping[str, int]:
    path = kept_path()
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def draw_name(one: "Perturbation", task: str, start: object = "") -> str:
    """Return the name of a draw in the file.

    Args:
        one: Perturbation.
        task: Id of the task without perturbations.
        start: Index of the initial state; empty for what is drawn once for the task.
    """
    return f"{task} {one.kind}={float(one.severity):g}@{one.seed} {start}".rstrip()


def first_attempt(one: "Perturbation", task: str, start: object = "") -> int:
    """Return the number of the first draw that may be used; see `draw_name`."""
    name = draw_name(one, task, start)
    return _overlay[name] if name in _overlay else _kept().get(name, 0)


@contextmanager
def trying(attempts: Mapping[str, int]) -> Iterator[None]:
    """Use other draws in the block.

    Args:
        attempts: Name of a draw -> number of the first that may be used.
    """
    before = dict(_overlay)
    _overlay.update(attempts)
    try:
        yield
    finally:
        _overlay.clear()
        _overlay.update(before)
