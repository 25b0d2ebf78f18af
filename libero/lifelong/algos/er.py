"""Experience replay."""

from collections.abc import Iterable, Iterator
from typing import Any

import torch
from torch.utils.data import Dataset

from libero.lifelong.algos.base import Sequential
from lifelong import algorithms
from lifelong.data.memory import ReplayMemory


def cycle(dl: Iterable[Any]) -> Iterator[Any]:
    """Yield the items of a loader, again and again."""
    while True:
        yield from dl


def merge_datas(x: Any, y: Any) -> Any:
    """Return two batches joined: dictionaries of tensors, whose first dimension is the batch."""
    if isinstance(x, dict):
        return type(x)((key, merge_datas(x[key], y[key])) for key in x)
    return torch.cat([x, y], dim=0)


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
