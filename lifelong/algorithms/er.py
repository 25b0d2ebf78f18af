"""Experience replay."""

from collections.abc import Mapping
from typing import Any

import torch

from lifelong.algorithms.base import Algorithm, WindowDataset
from lifelong.data.memory import ReplayMemory
from lifelong.policies.base import Policy
from lifelong.types import Batch


class ER(Algorithm):
    """Join to every batch as many windows of earlier tasks (Chaudhry et al. 2019; LIBERO, section 4).

    The memory is a uniform sample of each task's windows, within one budget over all tasks.
    """

    def __init__(self, *, budget: int = 10_000, ratio: float = 1.0):
        """Make the algorithm.

        Args:
            budget: Largest number of windows kept over all tasks. LIBERO's code keeps 1000 of each of ten.
            ratio: Windows replayed for each window of the present task; 1 doubles the batch.
        """
        self.ratio = ratio
        self.memory = ReplayMemory(budget)

    def mix(self, batch: Batch, generator: torch.Generator) -> Batch:
        """The batch followed by `ratio` times as many windows of earlier tasks."""
        if not len(self.memory):
            return batch
        return batch.join(self.memory.sample(max(1, round(self.ratio * len(batch))), generator))

    def end_task(
        self, task_index: int, dataset: WindowDataset, policy: Policy, generator: torch.Generator
    ) -> None:
        """Take the task's windows in; the earlier tasks' shares shrink."""
        self.memory.add(dataset, generator)

    def state_dict(self) -> dict[str, Any]:
        """Which windows are kept; their frames are read again from the demonstrations."""
        return {"memory": self.memory.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, WindowDataset]) -> None:
        """Take up what `state_dict` gave; the frames come from the datasets."""
        self.memory.load_state_dict(state["memory"], datasets)
