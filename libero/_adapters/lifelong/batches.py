"""Batches of dictionaries that the algorithms of `lifelong` can join, cut and move."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset, default_collate


@dataclass(frozen=True)
class DictBatch:
    """A nested dictionary of tensors with one batch axis, under the methods of `lifelong.types.Batch`."""

    data: Any

    def __len__(self) -> int:
        return _size(self.data)

    def to(self, device: torch.device | str) -> "DictBatch":
        """The same on another device."""
        return DictBatch(map_tensors(self.data, lambda x: x.to(device, non_blocking=True)))

    def rows(self, rows: slice) -> "DictBatch":
        """Some of the windows."""
        return DictBatch(map_tensors(self.data, lambda x: x[rows]))

    def join(self, other: "DictBatch") -> "DictBatch":
        """This batch followed by another; what only one of them has is left out."""
        return DictBatch(_joined(self.data, other.data))


class DictWindows:
    """Any dataset of dictionaries as the windows of a task; see `lifelong.algorithms.base.WindowDataset`."""

    def __init__(self, dataset: Dataset, task_id: int):
        self.dataset, self.task_id = dataset, task_id

    def __len__(self) -> int:
        return len(self.dataset)  # type: ignore[arg-type]

    def batch(self, indices: Tensor) -> DictBatch:
        """The windows of these indices, (B,) int64."""
        return DictBatch(default_collate([self.dataset[int(i)] for i in indices]))


def map_tensors(node: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """A nested dictionary with all its tensors changed; the one given is left as it was."""
    if isinstance(node, Tensor):
        return change(node)
    return {k: map_tensors(v, change) for k, v in node.items()} if isinstance(node, dict) else node


def _joined(a: Any, b: Any) -> Any:
    if isinstance(a, Tensor):
        return torch.cat([a, b.to(a.device)])
    return {k: _joined(v, b[k]) for k, v in a.items() if k in b} if isinstance(a, dict) else a


def _size(node: Any) -> int:
    if isinstance(node, dict):
        return max((_size(part) for part in node.values()), default=0)
    return len(node) if isinstance(node, Tensor) and node.dim() else 0
