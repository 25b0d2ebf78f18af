"""Datasets of windows, whatever reads and holds them: what they have in common, parts and joins of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Protocol

from torch import Tensor

from lifelong.types import Batch


class WindowDataset(Protocol):
    """Windows of demonstrations."""

    def __len__(self) -> int: ...

    def batch(self, indices: Tensor) -> Batch:
        """Return the windows of the given indices ((B,) int64) as one batch."""
        ...


class TaskWindows(WindowDataset, Protocol):
    """Windows of one task's demonstrations."""

    @property
    def task_id(self) -> int:
        """Position of the task in the task sequence."""
        ...


class JoinedWindows:
    """The windows of several datasets as one dataset; indices are counted through the datasets in order."""

    def __init__(self, datasets: Sequence[WindowDataset]):
        self.datasets = tuple(datasets)

    def __len__(self) -> int:
        return sum(len(dataset) for dataset in self.datasets)

    def batch(self, indices: Tensor) -> Batch:
        """Return the windows of the given indices ((B,) int64), those of one dataset after those of another."""
        parts, start = [], 0
        for dataset in self.datasets:
            end = start + len(dataset)
            chosen = indices[(indices >= start) & (indices < end)] - start
            start = end
            if len(chosen):
                parts.append(dataset.batch(chosen))
        return reduce(Batch.join, parts)


@dataclass(frozen=True, eq=False)
class WindowSubset:
    """Some of a dataset's windows.

    Attributes:
        dataset: The dataset.
        chosen: Indices of its windows, (n,) int64.
    """

    dataset: WindowDataset
    chosen: Tensor

    def __len__(self) -> int:
        return len(self.chosen)

    def batch(self, indices: Tensor) -> Batch:
        """Return the windows of the given indices ((B,) int64 in [0, n)) as one batch."""
        return self.dataset.batch(self.chosen[indices])
