"""Memory of past tasks for rehearsal."""

from collections.abc import Mapping, Sized
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from lifelong.data.windows import JoinedWindows, TaskWindows, WindowSubset, count_frames
from lifelong.errors import DataError
from lifelong.types import Batch, Count

Kept = TypeVar("Kept", bound=Sized)

MEMORY_FORM = {"budget": int, "indices": {str: Tensor}}  # see `lifelong.checkpoints.check`


def even_shares(sizes: Mapping[int, int], budget: int) -> dict[int, int]:
    """Return each task's share of a budget: equal ones, where what small tasks do not need is given to the others.

    Args:
        sizes: What each task needs at most, by task id.
        budget: Sum of the shares at most.
    """
    shares, left = {}, budget
    tasks = sorted(sizes, key=lambda task: (sizes[task], task))
    for position, task in enumerate(tasks):
        shares[task] = min(sizes[task], left // (len(tasks) - position))
        left -= shares[task]
    return shares


class TaskMemory(Generic[Kept]):
    """What memories of past tasks share: one budget, windows by task, and draws of as many as a batch needs.

    Args:
        budget: Largest size over all tasks, in the memory's own unit.
    """

    def __init__(self, budget: Count) -> None:
        self.budget = budget
        self.tasks: dict[int, Kept] = {}  # task id -> its windows

    def __len__(self) -> int:
        """Return the number of windows in the memory."""
        return sum(map(len, self.tasks.values()))

    @property
    def shares(self) -> dict[int, int]:
        """Number of windows of each task, by task id."""
        return {task: len(windows) for task, windows in self.tasks.items()}

    def state_dict(self) -> dict[str, Any]:
        """Return the budget and everything that is kept, by task id."""
        tasks = {task: kept.state_dict() for task, kept in self.tasks.items()}  # type: ignore[attr-defined]
        return {"budget": self.budget, "tasks": tasks}

    def _require_new(self, task: int) -> None:
        """Raise DataError where the task is in the memory already."""
        if task in self.tasks:
            raise DataError(f"task {task} is in the memory already; it holds {sorted(self.tasks)}")

    def _draw(self, n: int, generator: torch.Generator) -> Tensor:
        """Draw positions of windows, (n,) int64, uniformly over all that are held; beyond their number they repeat.

        Raises:
            DataError: The memory is empty.
        """
        size = len(self)
        if not size:
            raise DataError("nothing to sample: the memory is empty. Add a task first")
        rounds = [torch.randperm(size, generator=generator) for _ in range(-(-n // size))]
        return torch.cat(rounds)[:n]


class ReplayMemory(TaskMemory[Tensor]):
    """A uniform sample of the windows of each past task, within one budget.

    The budget is split evenly over the tasks: when a task is added, the shares of the others shrink. A task keeps a
    prefix of one random permutation of its windows, so a smaller share is again a uniform sample without replacement.
    Only indices are kept; frames stay in the datasets.

    Args:
        budget: Largest number of windows over all tasks.
    """

    def __init__(self, budget: Count) -> None:
        super().__init__(budget)  # a task's windows are indices (n,) into its dataset
        self._datasets: dict[int, TaskWindows] = {}

    def add(self, dataset: TaskWindows, generator: torch.Generator) -> None:
        """Add a task.

        Args:
            generator: Draws which of its windows are kept.

        Raises:
            DataError: The task is in the memory already.
        """
        task = dataset.task_id
        self._require_new(task)
        self._datasets[task] = dataset
        self.tasks[task] = torch.randperm(len(dataset), generator=generator)[: self.budget]
        self._shrink()

    def _shrink(self) -> None:
        """Reduce every task to its share; what small tasks do not need is given to the others."""
        for task, share in even_shares(self.shares, self.budget).items():
            self.tasks[task] = self.tasks[task][:share].clone()

    def sample(self, n: int, generator: torch.Generator) -> Batch:
        """Return windows drawn uniformly over all that are held, those of one task after those of another.

        Args:
            n: Number of windows. Beyond the number that are held, windows repeat.
            generator: Draws the windows.

        Raises:
            DataError: The memory is empty.
        """
        return self._windows(self._draw(n, generator))

    def _windows(self, chosen: Tensor) -> Batch:
        """Return windows by their positions (B,) in the memory."""
        kept = [WindowSubset(self._datasets[task], indices) for task, indices in self.tasks.items()]
        return JoinedWindows(kept).batch(chosen)

    def count_frames(self) -> int:
        """Count the frames of the windows, one that several windows cover once."""
        return sum(count_frames(self._datasets[task], indices) for task, indices in self.tasks.items())

    def state_dict(self) -> dict[str, Any]:
        """Return the budget and the indices by task id; frames are read again from the demonstrations."""
        return {"budget": self.budget, "indices": {str(task): i.clone() for task, i in self.tasks.items()}}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        """Restore what `state_dict` returned.

        Args:
            state: From `state_dict`.
            datasets: Windows by task id, at least of the tasks in the state.

        Raises:
            DataError: A dataset is missing or has fewer windows than the state refers to; the memory is unchanged.
        """
        # on the host, as those that `add` draws: batches are divided there
        saved = {task: kept.to("cpu", copy=True) for task, kept in state["indices"].items()}
        for task, kept in saved.items():
            if not task.isdecimal() or kept.dtype != torch.int64 or kept.dim() != 1 or (kept < 0).any():
                raise DataError(f"the memory's windows of task {task!r} are not indices")
        indices = {int(task): kept for task, kept in saved.items()}
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
        self.budget, self.tasks, self._datasets = int(state["budget"]), indices, held


class FirstWindows(ReplayMemory):
    """The first windows of each past task, in the order of its file: the memory of LIBERO's code.

    A thousand of them are the first eight or so demonstrations, not a sample of the task. With `batch_size` they come
    as from its loader: in passes in which no window repeats, whose last batch is short. A pass ends with the epoch
    here, so that an epoch can be repeated; there it goes on.

    Args:
        budget: Number of windows kept of each task.
        batch_size: Number of windows of a batch, however many are asked for; None: as many as are asked for, drawn
            anew for each batch.
    """

    def __init__(self, budget: Count, batch_size: Count | None = None) -> None:
        super().__init__(budget)
        self.per_task, self.batch_size = budget, batch_size
        self._pass: tuple[torch.Generator | None, Tensor] = (None, torch.empty(0, dtype=torch.int64))

    def sample(self, n: int, generator: torch.Generator) -> Batch:
        """Return the next windows of the pass, or a sample as `ReplayMemory.sample`.

        Args:
            n: Number of windows, where there is no `batch_size`.
            generator: Draws the order of each pass; another one than before starts a new pass.

        Raises:
            DataError: The memory is empty.
        """
        if self.batch_size is None or not len(self):
            return super().sample(n, generator)
        drawn_by, left = self._pass
        if drawn_by is not generator or not len(left):
            left = torch.randperm(len(self), generator=generator)
        self._pass = (generator, left[self.batch_size :])
        return self._windows(left[: self.batch_size])

    def add(self, dataset: TaskWindows, generator: torch.Generator) -> None:
        """Add a task; see `ReplayMemory.add`. The shares of the other tasks stay as they are."""
        super().add(dataset, generator)
        self.tasks[dataset.task_id] = torch.arange(min(self.per_task, len(dataset)))

    def _shrink(self) -> None:
        self.budget = self.per_task * len(self.tasks)
