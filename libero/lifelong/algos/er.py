"""Experience replay."""

from typing import Any

from torch.utils.data import Dataset

from libero.lifelong.algos.base import Sequential
from lifelong import algorithms


class ER(Sequential):
    """Every batch is joined by as many windows of earlier tasks; see `lifelong.algorithms.ER`.

    `lifelong.n_memories` windows of each task are kept, drawn uniformly (the original keeps the file's first).
    """

    def make_hooks(self, cfg: Any) -> algorithms.Algorithm:
        """See `Sequential`."""
        return algorithms.ER(budget=cfg.lifelong.n_memories)

    def end_task(self, dataset: Dataset, task_id: int, benchmark: Any, env: Any = None) -> None:
        """Take the task's windows in."""
        grow_memory(self, task_id)
        super().end_task(dataset, task_id, benchmark, env)


def grow_memory(algo: Sequential, task_id: int) -> None:
    """Room for one more task: the memory's budget is over all of them, the original's for each."""
    memory: Any = algo.hooks
    memory.memory.budget = algo.cfg.lifelong.n_memories * (task_id + 1)
