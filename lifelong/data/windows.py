"""Datasets of windows, whatever reads and holds them: what they have in common, parts and joins of them."""

from collections.abc import Callable, Iterator, Sequence, Sized
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import Protocol, TypeVar

import torch
from torch import Tensor

from lifelong.errors import DataError
from lifelong.types import Batch, to_device

Part = TypeVar("Part", bound=Sized)

_CHUNK = 8  # windows that are read at a time


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


def batches_in_order(dataset: WindowDataset, chunks: Sequence[Tensor]) -> Iterator[Batch]:
    """Yield the windows of each list of indices; those of the next one are read ahead, if the dataset can do that.

    Args:
        chunks: Indices of the windows of each batch, (B,) int64.
    """
    for indices, following in zip_longest(chunks, chunks[1:]):
        batch = dataset.batch(indices)
        if following is not None:
            _expect(dataset, following)
        yield batch


def _expect(dataset: WindowDataset, indices: Tensor) -> None:
    if expect := getattr(dataset, "expect", None):
        expect(indices)


def divided(parts: Sequence[Part], indices: Tensor) -> Iterator[tuple[Part, Tensor]]:
    """Yield each part of which there are windows, with their indices in it.

    Args:
        parts: Windows, which are counted through all parts.
        indices: The windows, (n,) int64.
    """
    start = 0
    for part in parts:
        chosen = indices[(indices >= start) & (indices < start + len(part))] - start
        start += len(part)
        if len(chosen):
            yield part, chosen


class JoinedWindows:
    """The windows of several datasets as one dataset; indices are counted through the datasets in order."""

    def __init__(self, datasets: Sequence[WindowDataset]):
        self.datasets = tuple(datasets)

    def __len__(self) -> int:
        return sum(len(dataset) for dataset in self.datasets)

    def batch(self, indices: Tensor) -> Batch:
        """Return the windows of the given indices ((B,) int64), those of one dataset after those of another."""
        first, *rest = [dataset.batch(chosen) for dataset, chosen in divided(self.datasets, indices)]
        return first.join(*rest) if rest else first

    def expect(self, indices: Tensor) -> None:
        """Read the windows of the given indices, (B,) int64, ahead where datasets can."""
        for dataset, chosen in divided(self.datasets, indices):
            _expect(dataset, chosen)


class StageWindows(JoinedWindows):
    """The windows of several datasets as if they were those of one task: of a stage, or of copies of demonstrations.

    Batches have the id of that task, window ids counted through all datasets, and the requested order, so that an
    algorithm can store windows of a stage by the ids in a batch.
    """

    def __init__(self, datasets: Sequence[WindowDataset], task_id: int):
        super().__init__(datasets)
        self.task_id = task_id
        self._ends = torch.tensor([len(d) for d in datasets]).cumsum(0)

    def batch(self, indices: Tensor) -> Batch:
        """Return the windows with these indices ((B,) int64, counted through all datasets) as one batch."""
        indices = torch.as_tensor(indices, dtype=torch.int64, device="cpu")
        batch = super().batch(indices)  # ordered by dataset
        places = torch.bucketize(indices, self._ends, right=True).argsort(stable=True).argsort()
        places, window_ids = (to_device(x, batch.window_ids.device) for x in (places, indices))
        batch = batch.rows(places)
        return replace(batch, task_ids=torch.full_like(batch.task_ids, self.task_id), window_ids=window_ids)


@dataclass(frozen=True, eq=False)
class WindowSubset:
    """Some of a dataset's windows.

    Attributes:
        chosen: Indices of its windows, (n,) int64.
    """

    dataset: WindowDataset
    chosen: Tensor

    def __len__(self) -> int:
        return len(self.chosen)

    def batch(self, indices: Tensor) -> Batch:
        """Return the windows of the given indices ((B,) int64 in [0, n)) as one batch."""
        return self.dataset.batch(self.chosen[indices])

    def expect(self, indices: Tensor) -> None:
        """Read the windows of the given indices, (B,) int64 in [0, n), ahead where the dataset can."""
        _expect(self.dataset, self.chosen[indices])


@dataclass(frozen=True, eq=False)
class KeptWindows(WindowSubset):
    """Windows of a dataset that are kept when it is gone, with the ids that they had in it.

    `dataset` holds their frames, and no others where it can.

    Attributes:
        ids: Their indices in the dataset that they are of, (n,) int64.
    """

    ids: Tensor

    @classmethod
    def of(cls, dataset: WindowDataset, ids: Tensor) -> "KeptWindows":
        """Return windows of a dataset by their indices (n,)."""
        return cls(*_holding(dataset, ids), ids)

    def first(self, count: int) -> "KeptWindows":
        """Return the first windows."""
        return KeptWindows(*_holding(self.dataset, self.chosen[:count]), self.ids[:count].clone())

    def batch(self, indices: Tensor) -> Batch:
        """Return the windows of the given indices ((B,) int64 in [0, n)) as one batch."""
        batch = super().batch(indices)
        return replace(batch, window_ids=to_device(self.ids[indices], batch.window_ids.device))


def _holding(dataset: WindowDataset, indices: Tensor) -> tuple[WindowDataset, Tensor]:
    """Return a dataset that holds some windows (n,), without other frames where it can, and their indices in it."""
    if isinstance(dataset, WindowSubset):
        return _holding(dataset.dataset, dataset.chosen[indices])
    if not isinstance(dataset, StageWindows):
        narrowed = getattr(dataset, "narrowed", None)
        return narrowed(indices) if narrowed else (dataset, indices)
    parts: list[WindowDataset] = []
    places, start, end = torch.zeros_like(indices), 0, 0
    for part in dataset.datasets:
        mine = (indices >= start) & (indices < start + len(part))
        if mine.any():
            held, found = _holding(part, indices[mine] - start)
            places[mine] = found + end
            parts, end = [*parts, held], end + len(held)
        start += len(part)
    return StageWindows(parts, dataset.task_id), places


@torch.no_grad()
def of_episodes(dataset: WindowDataset, read: Callable[[Batch], Tensor]) -> tuple[Tensor, Tensor]:
    """Read something of every demonstration's first window.

    A dataset that reads a file knows the last frame of each window's demonstration (`last`). Without it every window
    counts as a demonstration.

    Args:
        dataset: Windows, which may be parts or joins of others.
        read: Function from a batch of B windows to a tensor (B, ...).

    Returns:
        What was read of each of D demonstrations, (D, ...), and to which of them each window belongs, (W,) int64.
    """
    if isinstance(dataset, JoinedWindows):
        parts = [of_episodes(part, read) for part in dataset.datasets]
        offsets = torch.tensor([0] + [len(values) for values, _ in parts]).cumsum(0).tolist()
        moved = [of_window + offset for (_, of_window), offset in zip(parts, offsets, strict=False)]
        return torch.cat([values for values, _ in parts]), torch.cat(moved)
    if isinstance(dataset, WindowSubset):
        values, of_window = of_episodes(dataset.dataset, read)
        return values, of_window[dataset.chosen.to(of_window.device)]
    ends, of_window = getattr(dataset, "last", torch.arange(len(dataset))).unique(return_inverse=True)
    starts = torch.cat([ends.new_zeros(1), ends[:-1] + 1])
    return torch.cat([read(dataset.batch(indices)) for indices in starts.split(_CHUNK)]), of_window


def frames_of(dataset: WindowDataset, readings: Sequence[str], most: int = 20_000) -> tuple[Tensor, Tensor]:
    """Return readings and actions of the frames of a dataset, on the CPU.

    A dataset that reads a file has them in arrays (`proprio`, `actions`). Of others, the first frames of up to `most`
    windows at equal distances are read.

    Args:
        dataset: Windows, which may be parts or joins of others.
        readings: Names of the readings, which are joined.
        most: Largest number of windows that are read.

    Returns:
        Readings (F, D), and actions (F, A).
    """
    if isinstance(dataset, JoinedWindows):
        parts = [frames_of(part, readings, most) for part in dataset.datasets]
        return torch.cat([r for r, _ in parts]), torch.cat([a for _, a in parts])
    proprio, actions = getattr(dataset, "proprio", None), getattr(dataset, "actions", None)
    if proprio is None or actions is None:
        chosen = torch.linspace(0, len(dataset) - 1, min(len(dataset), most)).long().unique()
        batches = [dataset.batch(part) for part in chosen.split(256)]
        proprio = {n: torch.cat([b.observation.proprio[n][:, 0] for b in batches]) for n in readings}
        actions = torch.cat([b.actions[:, 0] for b in batches])
    none = actions.new_zeros(len(actions), 0)
    return torch.cat([none, *(proprio[name] for name in readings)], dim=1).cpu(), actions.cpu()


def frame_moments(frames: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
    """Return mean, standard deviation, least and largest value of readings and actions over frames, (4, D + A).

    Args:
        frames: Readings (F, D) and actions (F, A) of some datasets, see `frames_of`.
    """
    values = torch.cat([torch.cat(pair, dim=1) for pair in frames]).double()
    return torch.stack([values.mean(0), values.std(0, unbiased=False), values.amin(0), values.amax(0)])


def gripper_phases(dataset: WindowDataset) -> Tensor:
    """Return in which phase of its demonstration each window begins, (W,) int64.

    A phase ends where the command of the gripper, the last entry of an action, changes its sign: reaching, carrying,
    releasing, and as many again where something is grasped twice.

    Args:
        dataset: Windows, which may be parts or joins of others.

    Raises:
        DataError: It does not know its actions (`actions`) and the ends of its demonstrations (`last`).
    """
    if isinstance(dataset, JoinedWindows):
        return torch.cat([gripper_phases(part) for part in dataset.datasets])
    if isinstance(dataset, WindowSubset):
        return gripper_phases(dataset.dataset)[dataset.chosen]
    if not (hasattr(dataset, "actions") and hasattr(dataset, "last")):
        raise DataError(
            f"{type(dataset).__name__} does not say where its demonstrations end, without which there are no phases"
        )
    closes, last = dataset.actions[:, -1].cpu() > 0, dataset.last.cpu()
    same = torch.cat([torch.tensor([False]), last[1:] == last[:-1]])
    switched = same & (closes != closes.roll(1))
    passed = switched.cumsum(0)
    first = torch.where(same, 0, torch.arange(len(last))).cummax(0).values
    return passed - passed[first]


def instructions_of(dataset: WindowDataset) -> Tensor:
    """Return the embedded instructions of the tasks that are learned together, (n, L); not those of blurred neighbours.

    Args:
        dataset: Windows of a task or of a stage.
    """
    parts = dataset.datasets if isinstance(dataset, JoinedWindows) else [dataset]
    if isinstance(parts[0], WindowSubset):  # at a blurred boundary the stage's own windows come first
        return instructions_of(parts[0].dataset)
    first = torch.zeros(1, dtype=torch.int64)
    return torch.cat([part.batch(first).observation.language for part in parts]).unique(dim=0)


def tasks_of(dataset: WindowDataset) -> Tensor:
    """Return the task that each window is of, (W,) int64, also where windows of several are learned as one task's."""
    if isinstance(dataset, JoinedWindows):
        return torch.cat([tasks_of(part) for part in dataset.datasets])
    if isinstance(dataset, WindowSubset):
        return tasks_of(dataset.dataset)[dataset.chosen]
    return torch.full((len(dataset),), dataset.task_id)  # type: ignore[attr-defined]


def count_frames(dataset: WindowDataset, indices: Tensor) -> int:
    """Count the frames that some windows cover, a frame of several windows once.

    A dataset that reads a file knows which frames a window covers (`frames`). Without it every window counts with
    frames of its own.

    Args:
        dataset: Windows, which may be parts or joins of others.
        indices: The windows, (n,) int64.
    """
    if not len(indices):
        return 0
    if isinstance(dataset, JoinedWindows):
        return sum(count_frames(part, chosen) for part, chosen in divided(dataset.datasets, indices))
    if isinstance(dataset, WindowSubset):
        return count_frames(dataset.dataset, dataset.chosen[indices])
    if frames := getattr(dataset, "frames", None):
        return len(frames(indices).unique())
    return len(indices) * dataset.batch(indices[:1]).actions.shape[1]
