"""Experience replay."""

from typing import Any

from torch.utils.data import Dataset

from libero.lifelong.algos.base import Sequential
from lifelong import algorithms
from lifelong.data.memory import ReplayMemory


class ER(Sequential):
    """Joins to every batch as many windows of earlier tasks; see `lifelong.algorithms.ER`.

    `lifelong.n_memories` windows of each task are kept, drawn uniformly (the original keeps the first of each file).
    """

    def make_hooks(self, cfg: Any) -> algorithms.Algorithm:
        """See `Sequential`."""
        return algorithms.ER(memory=ReplayMemory(cfg.lifelong.n_memories))

    def end_task(self, dataset: Dataset, task_id: int, benchmark: Any, env: Any = None) -> None:
        """Add the task's windows to the memory, whose native budget is that of all tasks together."""
        self.hooks.memory.budget = self.cfg.lifelong.n_memories * (task_id + 1)
        super().end_task(dataset, task_id, benchmark, env)
