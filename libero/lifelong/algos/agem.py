"""Averaged gradient episodic memory."""

from typing import Any

from torch.utils.data import Dataset

from libero.lifelong.algos.base import Sequential
from libero.lifelong.algos.er import grow_memory
from lifelong import algorithms


class AGEM(Sequential):
    """Gradients lose what would raise the loss on earlier tasks; see `lifelong.algorithms.AGEM`.

    `lifelong.n_memories` windows of each task are kept, drawn uniformly.
    """

    def make_hooks(self, cfg: Any) -> algorithms.Algorithm:
        """See `Sequential`."""
        return algorithms.AGEM(budget=cfg.lifelong.n_memories)

    def end_task(self, dataset: Dataset, task_id: int, benchmark: Any, env: Any = None) -> None:
        """Take the task's windows in."""
        grow_memory(self, task_id)
        super().end_task(dataset, task_id, benchmark, env)
