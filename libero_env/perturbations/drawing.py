"""Random numbers of perturbations: of each draw by its name, so that they depend on no batch and no order."""

import hashlib

import numpy as np


class DrawKey:
    """Name of a draw, from which generators are made.

    Args:
        *words: What the draw depends on, as texts and whole numbers.
    """

    def __init__(self, *words: object):
        self._words = words

    def generator(self, *words: object) -> np.random.Generator:
        """Return the generator of a part of the draw; the same words give the same numbers."""
        text = "\0".join(map(str, (*self._words, *words)))
        digest = hashlib.sha256(text.encode()).digest()
        return np.random.Generator(np.random.PCG64(int.from_bytes(digest[:16], "little")))


def draw_key(kind: str, seed: int, task: str, start: object = "", attempt: int = 0) -> DrawKey:
    """Return the key of a draw. Severity is not part of it: a more severe draw goes further in the same direction.

    Args:
        kind: Name of the kind.
        seed: Seed of the perturbation.
        task: Id of the task without perturbations, such as `libero_goal/3`.
        start: Index of the initial state, or another name of the start; empty for draws of a whole task.
        attempt: Number of draws of these names that were not valid.
    """
    return DrawKey("libero perturbation", kind, seed, task, start, attempt)


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
