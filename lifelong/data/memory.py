"""Memory of past tasks for rehearsal."""

from collections.abc import Mapping
from typing import Any, Protocol

import torch
from torch import Tensor

from lifelong.errors import DataError
from lifelong.types import Batch


class TaskWindows(Protocol):
    """What the memory needs of a task's windows, whatever reads and holds them."""

    @property
    def task_id(self) -> int: ...

    def __len__(self) -> int: ...

    def batch(self, indices: Tensor) -> Batch: ...


class ReplayMemory:
    """A uniform sample of windows of each past task, within one budget.

    The budget is split evenly over the tasks: when one arrives, the others shrink. What a task keeps is a
    prefix of one random order of its windows, so a smaller share is again a uniform sample without
    replacement. Only indices are kept; frames stay in the datasets.

    Args:
        budget: largest number of windows over all tasks.

    Raises:
        DataError: a budget below one.
    """

    def __init__(self, budget: int) -> None:
        if budget < 1:
            raise DataError(f"the memory's budget is {budget} windows; it must be at least 1")
        self.budget = budget
        self._datasets: dict[int, TaskWindows] = {}
        self._indices: dict[int, Tensor] = {}  # task id -> (n,) window indices

    def __len__(self) -> int:
        """Windows held; never more than the budget."""
        return sum(len(indices) for indices in self._indices.values())

    @property
    def shares(self) -> dict[int, int]:
        """Windows held of each task, by task id."""
        return {task: len(indices) for task, indices in self._indices.items()}

    def add(self, dataset: TaskWindows, generator: torch.Generator) -> None:
        """Takes a task in; its windows are drawn with the generator.

        Raises:
            DataError: the task is in the memory already.
        """
        task = dataset.task_id
        if task in self._indices:
            raise DataError(f"task {task} is in the memory already; it holds {sorted(self._indices)}")
        self._datasets[task] = dataset
        self._indices[task] = torch.randperm(len(dataset), generator=generator)[: self.budget]
        self._shrink()

    def _shrink(self) -> None:
        """Cuts every task to its share; what small tasks leave unused goes to the others."""
        left, tasks = self.budget, sorted(self._indices, key=lambda t: (len(self._indices[t]), t))
        for position, task in enumerate(tasks):
            share = min(len(self._indices[task]), left // (len(tasks) - position))
            self._indices[task] = self._indices[task][:share].clone()
            left -= share

    def sample(self, n: int, generator: torch.Generator) -> Batch:
        """`n` windows drawn uniformly over all that are held, without repeats while `n` allows.

        Raises:
            DataError: the memory is empty.
        """
        size = len(self)
        if not size:
            raise DataError("nothing to sample: the memory is empty. Add a task first")
        rounds = [torch.randperm(size, generator=generator) for _ in range(-(-n // size))]
        chosen, offset, parts = torch.cat(rounds)[:n], 0, []
        for task, indices in self._indices.items():
            mine = chosen[(chosen >= offset) & (chosen < offset + len(indices))] - offset
            offset += len(indices)
            if len(mine):
                parts.append(self._datasets[task].batch(indices[mine]))
        batch = parts[0]
        for part in parts[1:]:
            batch = batch.join(part)
        return batch

    def state_dict(self) -> dict[str, Any]:
        """Budget and indices by task id; the frames are read again from the demonstrations."""
        return {"budget": self.budget, "indices": {str(task): i.clone() for task, i in self._indices.items()}}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        """Takes up what `state_dict` gave.

        Args:
            state: from `state_dict`.
            datasets: by task id, at least those the state names.

        Raises:
            DataError: a dataset is absent or has fewer windows than the state refers to; nothing is changed then.
        """
        indices = {int(task): i.clone() for task, i in state["indices"].items()}
        absent = sorted(set(indices) - set(datasets))
        if absent:
            raise DataError(
                f"the memory holds windows of tasks {absent}; there are datasets of {sorted(datasets)}"
            )
        held = {task: datasets[task] for task in indices}
        for task, kept in indices.items():
            if len(kept) and int(kept.max()) >= len(held[task]):
                raise DataError(
                    f"the memory holds window {int(kept.max())} of task {task}, whose dataset has "
                    f"{len(held[task])}: its demonstrations are not those of the interrupted run"
                )
        self.budget, self._indices, self._datasets = int(state["budget"]), indices, held


class FirstWindows(ReplayMemory):
    """The first windows of each past task, in the order of its file: the memory of LIBERO's code.

    A thousand of them are the first eight or so demonstrations, not a sample of the task.

    Args:
        per_task: windows kept of each task.
    """

    def __init__(self, per_task: int) -> None:
        super().__init__(per_task)
        self.per_task = per_task

    def add(self, dataset: TaskWindows, generator: torch.Generator) -> None:
        """Takes a task in; nothing is drawn, and no other task shrinks."""
        super().add(dataset, generator)
        self._indices[dataset.task_id] = torch.arange(min(self.per_task, len(dataset)))

    def _shrink(self) -> None:
        self.budget = self.per_task * len(self._indices)
