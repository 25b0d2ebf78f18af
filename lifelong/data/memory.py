"""Memory of past tasks for rehearsal."""

from collections.abc import Mapping, Sized
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from lifelong.data.windows import (
    JoinedWindows,
    KeptWindows,
    TaskWindows,
    count_frames,
    gripper_phases,
    tasks_of,
)
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
    In memory are the frames of these windows only. The state has their indices: frames are read from the
    demonstrations again.

    Args:
        budget: Largest number of windows over all tasks.
    """

    def __init__(self, budget: Count) -> None:
        super().__init__(budget)  # a task's windows are indices (n,) into its dataset
        self._held: dict[int, KeptWindows] = {}

    def add(self, dataset: TaskWindows, generator: torch.Generator) -> None:
        """Add a task.

        Args:
            generator: Draws which of its windows are kept.

        Raises:
            DataError: The task is in the memory already.
        """
        task = dataset.task_id
        self._require_new(task)
        order = self._order(dataset, generator)
        shares = self._shares({**self.shares, task: len(order)})
        for other, held in self._held.items():
            self._hold(other, held.first(shares[other]) if shares[other] < len(held) else held)
        self._hold(task, KeptWindows.of(dataset, order[: shares[task]].clone()))

    def _order(self, dataset: TaskWindows, generator: torch.Generator) -> Tensor:
        """Return a task's windows (W,) in the order in which they are kept: the first as long as there is room."""
        return torch.randperm(len(dataset), generator=generator)

    def _shares(self, sizes: Mapping[int, int]) -> dict[int, int]:
        """Return each task's share; what small tasks do not need is given to the others."""
        return even_shares(sizes, self.budget)

    def _hold(self, task: int, windows: KeptWindows) -> None:
        self._held[task], self.tasks[task] = windows, windows.ids

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
        return JoinedWindows(list(self._held.values())).batch(chosen)

    def count_frames(self) -> int:
        """Count the frames of the windows, one that several windows cover once."""
        return sum(count_frames(held.dataset, held.chosen) for held in self._held.values())

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
        held: dict[int, KeptWindows] = {}
        for task, kept in indices.items():
            dataset = datasets[task]  # one at a time is whole
            if len(kept) and int(kept.max()) >= len(dataset):
                raise DataError(
                    f"the memory holds window {int(kept.max())} of task {task}, whose dataset has "
                    f"{len(dataset)}: its demonstrations are not those of the interrupted run"
                )
            held[task] = KeptWindows.of(dataset, kept)
        self.budget, self.tasks, self._held = int(state["budget"]), indices, held


class PhaseMemory(ReplayMemory):
    """As many windows of each phase of a task, within one budget.

    The phase-centric memory of PHASER (Chen et al. 2026, arXiv:2606.03598): in a uniform sample, short phases such as
    a grasp are rare. Phases are `lifelong.data.windows.gripper_phases`, and those with few windows give room to others.

    Departures: the paper also finds phases by a vision-language model, and replays most what is most at risk; here a
    phase ends where the gripper's command changes, and windows are drawn uniformly over the memory.

    Args:
        budget: Largest number of windows over all tasks.
    """

    def _order(self, dataset: TaskWindows, generator: torch.Generator) -> Tensor:
        """Return the windows (W,) so that every beginning of them has as many of each phase, at random otherwise."""
        order = super()._order(dataset, generator)
        phases = gripper_phases(dataset)[order]
        turn = torch.zeros_like(order)  # number of earlier windows of the same phase
        for phase in phases.unique():
            turn[phases == phase] = torch.arange(int((phases == phase).sum()))
        return order[turn.argsort(stable=True)]


class FirstWindows(ReplayMemory):
    """The first windows of each past task, in the order of its file: the memory of LIBERO's code.

    Of tasks that are learned together, the first ones of each are kept.

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
        self.budget = max(self.budget, len(self))

    def _order(self, dataset: TaskWindows, generator: torch.Generator) -> Tensor:
        tasks = tasks_of(dataset)
        return torch.cat([(tasks == task).nonzero()[: self.per_task, 0] for task in tasks.unique()])

    def _shares(self, sizes: Mapping[int, int]) -> dict[int, int]:
        return dict(sizes)
