"""Experience replay from a memory of compressed frames."""

import torch

from lifelong.algorithms.rehearsal import Rehearsal
from lifelong.data.compressed import COMPRESSED_FORM, CompressedMemory, Quality
from lifelong.types import Batch, Count, Positive


class CompressedER(Rehearsal):
    """Replay as `ER` does, from windows whose frames are kept as small pictures, within a number of bytes.

    The loss and the draws are those of experience replay (Chaudhry et al. 2019): `ratio` windows of earlier tasks join
    each of the batch. What differs is what is kept. `CompressedMemory` has the frames themselves, as WebP of a
    twentieth of their size, so the state is all that later tasks need: demonstrations of earlier tasks may be gone.
    """

    state_form = {"memory": COMPRESSED_FORM}
    tuned = {"ratio": (0.25, 0.5, 1.0, 2.0)}

    def __init__(
        self,
        *,
        budget: Count = 9_500_000,
        quality: Quality = 60,
        ratio: Positive = 1.0,
        keep_decoded: bool = True,
    ):
        """Create the algorithm.

        Args:
            budget: Largest number of bytes kept over all tasks.
            quality: Quality of the pictures, that of WebP.
            ratio: Number of windows replayed for each window of the present task; 1 doubles the batch.
            keep_decoded: Whether decoded frames stay in the process's memory while a task is learned; see
                `CompressedMemory`.
        """
        super().__init__(CompressedMemory(budget, quality, keep_decoded), ratio)

    def _drawn(self, batch: Batch, generator: torch.Generator) -> Batch:
        """Return the windows on the device of the batch: those of the memory are on the CPU."""
        return super()._drawn(batch, generator).to(batch.actions.device)
