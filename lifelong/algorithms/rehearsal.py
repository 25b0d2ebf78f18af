"""What methods share that keep windows of earlier tasks in a memory."""

import torch

from lifelong.algorithms.base import Algorithm
from lifelong.data.compressed import CompressedMemory
from lifelong.data.memory import MEMORY_FORM, ReplayMemory
from lifelong.data.windows import TaskWindows
from lifelong.errors import ConfigError
from lifelong.policies.base import Policy
from lifelong.types import Batch


class Rehearsal(Algorithm):
    """Every task's windows go into a memory when it ends; windows of earlier tasks join later batches."""

    state_form = {"memory": MEMORY_FORM}
    plain_start = True
    adds_windows = True

    def __init__(self, memory: ReplayMemory | CompressedMemory, ratio: float):
        """Create the algorithm.

        Args:
            memory: Memory of earlier tasks' windows.
            ratio: Number of windows drawn for each window of a batch; 1 where the memory has a batch size of its own.

        Raises:
            ConfigError: The memory has a batch size, and the ratio is not 1.
        """
        self.memory, self.ratio = memory, ratio
        if getattr(memory, "batch_size", None) is not None:
            if ratio != 1:
                raise ConfigError(
                    "algo.ratio has no effect with algo.memory.batch_size; leave it at 1, or set "
                    "algo.memory.batch_size=null"
                )
            self.tuned = {key: values for key, values in self.tuned.items() if key != "ratio"}

    def mix(self, batch: Batch, generator: torch.Generator) -> Batch:
        """Return the batch followed by `ratio` times as many windows of earlier tasks."""
        return batch.join(self._drawn(batch, generator)) if len(self.memory) else batch

    def _drawn(self, batch: Batch, generator: torch.Generator) -> Batch:
        """Return `ratio` times as many windows of earlier tasks as the batch has, at least one."""
        return self.memory.sample(max(1, round(self.ratio * len(batch))), generator)

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Add the task's windows to the memory."""
        self.memory.add(dataset, generator)
