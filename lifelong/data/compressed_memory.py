"""Memory of past tasks that keeps their frames itself, compressed, within a number of bytes."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from lifelong.data.compressed_windows import WINDOWS_FORM, CompressedWindows, Quality, compress
from lifelong.data.memory import TaskMemory, even_shares
from lifelong.data.windows import JoinedWindows, TaskWindows
from lifelong.errors import DataError
from lifelong.types import Batch, Count

COMPRESSED_FORM = {"budget": int, "tasks": {int: WINDOWS_FORM}}  # see `lifelong.checkpoints.check`


class CompressedMemory(TaskMemory[CompressedWindows]):
    """A uniform sample of the windows of each past task, with compressed images, within one budget of bytes.

    The bytes are split evenly over the tasks: when a task is added, the shares of the others shrink. A task keeps the
    first of its windows in a random order, so a smaller share is again a sample without replacement. Where windows have
    several steps, runs of that many neighbouring windows are drawn, because they share most frames: two frames are kept
    for a window instead of T. Nothing is read from the demonstrations again. Actions, readings and instructions are
    kept exactly.

    Args:
        budget: Largest number of bytes over all tasks.
        quality: Quality of the pictures, that of WebP.
        keep_decoded: Whether to keep decoded frames in the process's memory until the next task is added; otherwise
            frames are decoded whenever they are drawn, which takes longer and no memory.
    """

    def __init__(self, budget: Count, quality: Quality = 60, keep_decoded: bool = True) -> None:
        super().__init__(budget)
        self.quality, self.keep_decoded = quality, keep_decoded
        self._decoded: dict[int, _Decoded] = {}

    def nbytes(self) -> int:
        """Return the number of bytes that are kept; never more than the budget."""
        return sum(windows.nbytes() for windows in self._tasks.values())

    def add(self, dataset: TaskWindows, generator: torch.Generator) -> None:
        """Add a task.

        Args:
            dataset: Windows of the task.
            generator: Draws which of its windows are kept.

        Raises:
            DataError: The task is in the memory already, or a task's share of the bytes is less than one window.
        """
        task = dataset.task_id
        self._require_new(task)
        steps = dataset.batch(torch.tensor([0])).actions.shape[1]
        runs = list(torch.arange(len(dataset)).split(steps))
        drawn = torch.randperm(len(runs), generator=generator).tolist()
        order = torch.cat([runs[run] for run in drawn])
        self._tasks[task] = compress(dataset, order, self.budget, self.quality)
        self._shrink()

    def _shrink(self) -> None:
        """Reduce every task to its share; what small tasks do not need is given to the others."""
        self._decoded = {}
        sizes = {t: w.nbytes() if len(w) == w.total else self.budget for t, w in self._tasks.items()}
        for task, share in even_shares(sizes, self.budget).items():
            if self._tasks[task].nbytes() > share:
                self._tasks[task] = self._tasks[task].within(share)
            if not len(self._tasks[task]):
                raise DataError(
                    f"a share of {share} bytes for each of {len(sizes)} tasks holds no window; raise algo.budget "
                    f"({self.budget}), or lower algo.quality or data.image_size"
                )

    def sample(self, n: int, generator: torch.Generator) -> Batch:
        """Return windows drawn uniformly over all that are held, on the CPU, those of one task after those of another.

        Args:
            n: Number of windows. Beyond the number that are held, windows repeat.
            generator: Draws the windows.

        Raises:
            DataError: The memory is empty.
        """
        drawn = self._draw(n, generator)
        if self.keep_decoded and not self._decoded:
            self._decoded = {task: _Decoded(windows) for task, windows in self._tasks.items()}
        held = self._decoded if self.keep_decoded else self._tasks
        return JoinedWindows(list(held.values())).batch(drawn)

    def state_dict(self) -> dict[str, Any]:
        """Return the budget and everything that is kept, by task id."""
        return {"budget": self.budget, "tasks": {task: w.state_dict() for task, w in self._tasks.items()}}

    def load_state_dict(
        self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows] | None = None
    ) -> None:
        """Restore what `state_dict` returned.

        Args:
            state: From `state_dict`.
            datasets: Windows by task id, as `ReplayMemory` needs them; they are not read.

        Raises:
            DataError: The state is not consistent; the memory is unchanged.
        """
        tasks = {task: CompressedWindows.from_state(kept) for task, kept in state["tasks"].items()}
        if odd := [task for task, windows in tasks.items() if windows.task_id != task]:
            raise DataError(
                f"the compressed windows of task {odd[0]} are those of task {tasks[odd[0]].task_id}"
            )
        self.budget, self._tasks, self._decoded = int(state["budget"]), tasks, {}


class _Decoded:
    """Windows with their frames decoded."""

    def __init__(self, windows: CompressedWindows):
        self.windows, self.images = windows, windows.pictures(torch.arange(len(windows.ends)))

    def __len__(self) -> int:
        return len(self.windows)

    def batch(self, indices: Tensor) -> Batch:
        return self.windows.batch(indices, self.images)
