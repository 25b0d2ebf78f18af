"""Random numbers of perturbations: of each sample by its name, so that they depend on no batch and no order.

Samples of a name are numbered from 0; used is the first for which the goal is false and that the expert solves, as far
as that was measured. `data/draws.json` has the numbers of those that replace earlier ones, by kind, severity, seed,
task and start; `libero perturb certify --keep` writes it.
"""

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from importlib import resources
from pathlib import Path

import numpy as np

from libero_env.storage import read_json

_overlay: dict[str, int] = {}


class SampleKey:
    """Name of a sample, from which generators are made.

    Args:
        *words: What the sample depends on, as texts and whole numbers.
    """

    def __init__(self, *words: object):
        self._words = words

    def generator(self, *words: object) -> np.random.Generator:
        """Return the generator of a part of the sample; the same words give the same numbers."""
        text = "\0".join(map(str, (*self._words, *words)))
        digest = hashlib.sha256(text.encode()).digest()
        return np.random.Generator(np.random.PCG64(int.from_bytes(digest[:16], "little")))


def sample_key(kind: str, seed: int, task: str, start: object = "", attempt: int = 0) -> SampleKey:
    """Return the key of a sample. Severity is not part of it: a more severe one goes further in the same direction.

    Args:
        task: Id of the task without perturbations, such as `libero_goal/3`.
        start: Index of the initial state, or another name of the start; empty for samples of a whole task.
        attempt: Number of samples of these names that were not valid.
    """
    return SampleKey("libero perturbation", kind, seed, task, start, attempt)


def start_name(row: np.ndarray) -> str:
    """Return the name of a start that has no index: a digest of its state."""
    return hashlib.sha256(np.ascontiguousarray(row, "<f8").tobytes()).hexdigest()[:16]


def direction(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return a vector (size,) of length 1 in a direction that is uniform on the sphere."""
    vector = rng.standard_normal(size)
    return vector / np.linalg.norm(vector)


def sign(rng: np.random.Generator) -> int:
    """Return -1 or 1."""
    return int(rng.integers(2)) * 2 - 1


def attempts_file() -> Path:
    """Return the file of the package with the numbers of samples."""
    return Path(str(resources.files("libero_env"))) / "perturbations" / "data" / "draws.json"


@cache
def _certified() -> Mapping[str, int]:
    return read_json(attempts_file())


def first_attempt(name: str) -> int:
    """Return the number of the first sample of a name that may be used, see `Perturbation.sample_name`."""
    return _overlay[name] if name in _overlay else _certified().get(name, 0)


@contextmanager
def trying(attempts: Mapping[str, int]) -> Iterator[None]:
    """Use other samples in the block.

    Args:
        attempts: Name of a sample -> number of the first that may be used.
    """
    before = dict(_overlay)
    _overlay.update(attempts)
    try:
        yield
    finally:
        _overlay.clear()
        _overlay.update(before)
