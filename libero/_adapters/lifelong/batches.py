"""The original's batches, nested dictionaries of tensors, as the batches of `lifelong`."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader, default_collate


@dataclass(frozen=True)
class DictBatch:
    """Nested dictionary of tensors with a common batch axis."""

    data: Any

    def __len__(self) -> int:
        if isinstance(self.data, dict):
            return max((len(DictBatch(part)) for part in self.data.values()), default=0)
        return len(self.data) if isinstance(self.data, Tensor) and self.data.dim() else 0

    def to(self, device: torch.device | str) -> "DictBatch":
        """Return the batch on another device."""
        return DictBatch(map_tensors(self.data, lambda x: x.to(device, non_blocking=True)))

    def join(self, other: "DictBatch") -> "DictBatch":
        """Return this batch followed by another, with the entries that both have."""
        return DictBatch(_join(self.data, other.data))


class DictWindows:
    """Any dataset of nested dictionaries of tensors as `lifelong.data.windows.TaskWindows`; workers read for `load`."""

    def __init__(self, dataset: Any, task_id: int, num_workers: int = 0):
        self.dataset, self.task_id, self.num_workers = dataset, task_id, num_workers

    def __len__(self) -> int:
        return len(self.dataset)

    def batch(self, indices: Tensor) -> DictBatch:
        """Return the windows of the given indices, (B,) int64."""
        return DictBatch(default_collate([self.dataset[int(i)] for i in indices]))

    def load(self, batches: Iterable[Tensor]) -> Iterator[DictBatch]:
        """Return the windows of each tensor of indices, read ahead by worker processes."""
        sampler = [indices.tolist() for indices in batches]
        return map(DictBatch, DataLoader(self.dataset, batch_sampler=sampler, num_workers=self.num_workers))


def map_tensors(node: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """Return a nested dictionary with a function applied to all its tensors; the argument is not changed."""
    if isinstance(node, Tensor):
        return change(node)
    return {k: map_tensors(v, change) for k, v in node.items()} if isinstance(node, dict) else node


def _join(a: Any, b: Any) -> Any:
    if isinstance(a, Tensor):
        return torch.cat([a, b.to(a.device)])
    return {k: _join(v, b[k]) for k, v in a.items() if k in b} if isinstance(a, dict) else a
