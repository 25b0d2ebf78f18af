"""Random generators from lists of whole numbers; the global generators stay as they are."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch


def generator(*seed: int, device: torch.device | str = "cpu") -> torch.Generator:
    """A torch generator for a list of whole numbers."""
    return torch.Generator(device).manual_seed(_word(seed))


@contextmanager
def seeded(*seed: int, device: torch.device | str = "cpu") -> Iterator[None]:
    """Within the context, torch's global generators start from a seed; afterwards they are as before."""
    device = torch.device(device)
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(_word(seed))
        yield


def _word(seed: Sequence[int]) -> int:
    return int(np.random.SeedSequence(list(seed)).generate_state(1, np.uint64)[0] >> np.uint64(1))
