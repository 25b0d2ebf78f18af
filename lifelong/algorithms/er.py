"""Experience replay."""

from collections.abc import Mapping
from typing import Any

import torch

from lifelong.algorithms.base import Algorithm
from lifelong.data.memory import MEMORY_FORM, ReplayMemory
from lifelong.data.windows import TaskWindows
from lifelong.policies.base import Policy
from lifelong.types import Batch, NonNegative


class ER(Algorithm):
    """Join windows of earlier tasks to every batch (Chaudhry et al. 2019; LIBERO, section 4).

    `ReplayMemory` is a uniform sample of each task's windows, within one budget over all tasks. LIBERO's code, where
    the paper says trajectories, has `FirstWindows`: the first thousand windows of each task's file. With that go the
    results of Liu et al., table 8 (FWT / NBT / AUC of ResNet-T: LONG .48 / .32 / .32, SPATIAL .65 / .27 / .56,
    OBJECT .67 / .43 / .44, GOAL .64 / .34 / .49).
    """

    state_form = {"memory": MEMORY_FORM}
    tuned = {"ratio": (0.25, 0.5, 1.0, 2.0)}
    plain_start = True

    def __init__(self, *, memory: ReplayMemory, ratio: NonNegative = 1.0):
        """Create the algorithm.

        Args:
            memory: Memory of earlier tasks' windows, `ReplayMemory` or `FirstWindows`.
            ratio: Number of windows replayed for each window of the present task; 1 doubles the batch.
        """
        self.memory, self.ratio = memory, ratio

    def mix(self, batch: Batch, generator: torch.Generator) -> Batch:
        """Return the batch followed by `ratio` times as many windows of earlier tasks."""
        if not len(self.memory):
            return batch
        return batch.join(self.memory.sample(max(1, round(self.ratio * len(batch))), generator))

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Add the task's windows to the memory."""
        self.memory.add(dataset, generator)

    def state_dict(self) -> dict[str, Any]:
        """Return which windows are kept; their frames are read again from the demonstrations."""
        return {"memory": self.memory.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        """Restore what `state_dict` returned; the frames come from the datasets."""
        self.memory.load_state_dict(state["memory"], datasets)
