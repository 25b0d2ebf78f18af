"""Experience replay."""

from lifelong.algorithms.rehearsal import Rehearsal
from lifelong.data.memory import ReplayMemory
from lifelong.types import Positive


class ER(Rehearsal):
    """Join windows of earlier tasks to every batch (Chaudhry et al. 2019; LIBERO, section 4).

    `ReplayMemory` is a uniform sample of each task's windows, within one budget over all tasks. LIBERO's code, where
    the paper says trajectories, has `FirstWindows`: the first thousand windows of each task's file. With that go the
    results of Liu et al., table 8 (FWT / NBT / AUC of ResNet-T: LONG .48 / .32 / .32, SPATIAL .65 / .27 / .56,
    OBJECT .67 / .43 / .44, GOAL .64 / .34 / .49).
    """

    tuned = {"ratio": (0.25, 0.5, 1.0, 2.0)}

    def __init__(self, *, memory: ReplayMemory, ratio: Positive = 1.0):
        """Create the algorithm.

        Args:
            memory: Memory of earlier tasks' windows, `ReplayMemory` or `FirstWindows`.
            ratio: Number of windows replayed for each window of the present task; 1 doubles the batch.
        """
        super().__init__(memory, ratio)
