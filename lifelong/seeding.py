"""Random generators from lists of integers; the global generators are left unchanged.

A run's seed is followed by a word that says what is drawn with it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # judging needs no PyTorch
    import torch

INIT = 0  # the policy's first weights
FIT = 1  # batches of training
END_TASK = 2  # what an algorithm draws when a task ends
ROLLOUT = 3  # actions of a policy that draws them
BLUR = 4  # windows of other tasks at blurred boundaries
RELEARN = 5  # batches of relearning
LATENCY = 6  # time that inference takes
BEGIN_TASK = 7  # what an algorithm draws when the first task begins
EVALUATION = 4  # the same as ROLLOUT in `libero eval`, whose seed is not a run's


def generator(*seed: int, device: torch.device | str = "cpu") -> torch.Generator:
    """Return a generator that is seeded with a list of integers."""
    import torch

    return torch.Generator(device).manual_seed(_to_word(seed))


@contextmanager
def seeded(*seed: int, device: torch.device | str = "cpu") -> Iterator[None]:
    """Seed torch's global generators with a list of integers; restore them when the context ends."""
    import torch

    device = torch.device(device)
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(_to_word(seed))
        yield


def _to_word(seed: Sequence[int]) -> int:
    """Return a seed of 63 bits; lists that differ give independent seeds."""
    return int(np.random.SeedSequence(list(seed)).generate_state(1, np.uint64)[0] >> np.uint64(1))
