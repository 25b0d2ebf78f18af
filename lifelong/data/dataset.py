"""Windows over the demonstrations of one task, held in memory.

Shape legend: F frames of all demonstrations, W = F windows, B batch, T time, V views, H W C image, A action,
L language embedding.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from libero_env.demos.read import Demo
from lifelong.data.source import DemoArrays, DemoSource, check_fits, check_language, last_frames
from lifelong.errors import DataError
from lifelong.types import Batch, Observation, PolicySpec


@dataclass(frozen=True, eq=False)
class SequenceVLDataset:
    """All windows of `seq_len` steps of one task, with the task's language embedding.

    A window starts at every frame and covers the frames t .. t + seq_len - 1 of its demonstration; past the
    end, the last frame and action repeat (robomimic's SequenceDataset with pad_seq_length). Frames are stored
    once: windows are indices, and a batch is one gather per array.

    Build one with `from_file` or `from_demos`.
    """

    images: Tensor  # (F, V, H, W, C) uint8, upright
    proprio: Mapping[str, Tensor]  # name -> (F, D) float32
    actions: Tensor  # (F, A) float32
    last: Tensor  # (F,) int64, last frame of the demonstration that frame belongs to
    language: Tensor  # (L,) float32
    task_id: int
    seq_len: int
    target: torch.device | None = None  # where batches are wanted; None: where the frames are
    pin: bool = False  # gather them in page-locked memory first, so that the copy to a GPU is asynchronous

    def __post_init__(self) -> None:
        if not len(self.actions):
            raise DataError("a dataset needs at least one demonstration with one frame; none was given")

    @classmethod
    def from_file(
        cls,
        path: str | Path,
        *,
        spec: PolicySpec,
        language: Tensor,
        task_id: int = 0,
        limit: int | None = None,
        pairing: str = "aligned",
        labels: str = "expert",
    ) -> "SequenceVLDataset":
        """Reads a demonstration file whole.

        Args:
            path: HDF5 in the original's layout.
            spec: which views and readings, their sizes, and `seq_len`.
            language: (L,) embedding of the instruction.
            task_id: position in the task sequence.
            limit: the first so many demonstrations only.
            pairing: `aligned` pairs each action with the observation before it; `stored` takes the file as it
                is, which in the original's files is the observation after it.
            labels: `expert` or `executed`, see `libero_env.demos.read.read_demos`.

        Raises:
            DemoError: the file is broken; names file, demonstration, key and what was expected.
            DataError: the file is sound but does not fit the spec.
        """
        source = DemoSource(Path(path), spec, limit, pairing, labels)
        language, lengths = check_language(language, spec), source.lengths()
        return cls._filled(source.demos(), lengths, spec, language, task_id)

    @classmethod
    def from_demos(
        cls,
        demos: Sequence[Demo],
        *,
        spec: PolicySpec,
        language: Tensor,
        task_id: int = 0,
        source: str = "demonstrations",
    ) -> "SequenceVLDataset":
        """Joins demonstrations that are in memory already; see `from_file`.

        Raises:
            DataError: they do not fit the spec; names source, demonstration, key and what was expected.
        """
        language = check_language(language, spec)
        for demo in demos:
            check_fits(demo, spec, source)
        return cls._filled(demos, [len(demo) for demo in demos], spec, language, task_id)

    @classmethod
    def _filled(
        cls, demos: Iterable[Demo], lengths: list[int], spec: PolicySpec, language: Tensor, task_id: int
    ) -> "SequenceVLDataset":
        """Arrays of the right size, filled one demonstration after the other."""
        frames, end = sum(lengths), 0
        images = torch.empty(frames, len(spec.views), *spec.image_size, 3, dtype=torch.uint8)
        proprio = {name: torch.empty(frames, size) for name, size in spec.proprio.items()}
        actions = torch.empty(frames, spec.action_dim)
        for demo in demos:
            arrays, rows = DemoArrays.of(demo, spec), slice(end, end + len(demo))
            images[rows], actions[rows], end = arrays.images, arrays.actions, rows.stop
            for name, array in proprio.items():
                array[rows] = arrays.proprio[name]
        return cls(images, proprio, actions, last_frames(lengths), language, task_id, spec.seq_len)

    def __len__(self) -> int:
        """Number of windows, W."""
        return len(self.actions)

    @property
    def demos(self) -> int:
        """Number of demonstrations."""
        return len(self.last.unique())

    def frames(self, indices: Tensor) -> Tensor:
        """Windows (B,) to the frames they cover, (B, T)."""
        steps = torch.arange(self.seq_len, device=self.last.device)
        return torch.minimum(indices[:, None] + steps, self.last[indices][:, None])

    def batch(self, indices: Tensor) -> Batch:
        """The windows of these indices, (B,) int64 in [0, W), as one batch.

        Raises:
            DataError: an index out of range.
        """
        indices = torch.as_tensor(indices, dtype=torch.int64, device=self.last.device)
        if len(indices) and not (int(indices.min()) >= 0 and int(indices.max()) < len(self)):
            raise DataError(
                f"window indices must lie in [0, {len(self)}), got {indices.min()} .. {indices.max()}"
            )
        frames = self.frames(indices)
        gather = lambda x: self._gather(x, frames)  # noqa: E731
        language = self.language.expand(len(indices), -1)
        observation = Observation(
            gather(self.images), {k: gather(v) for k, v in self.proprio.items()}, language
        )
        batch = Batch(observation, gather(self.actions), torch.full_like(indices, self.task_id), indices)
        return batch if self.target is None else batch.to(self.target)

    def _gather(self, array: Tensor, frames: Tensor) -> Tensor:
        """(F, ...) and (B, T) to (B, T, ...)."""
        shape = (frames.numel(), *array.shape[1:])
        out = torch.empty(shape, dtype=array.dtype, pin_memory=True) if self.pin else None
        return torch.index_select(array, 0, frames.flatten(), out=out).view(*frames.shape, *array.shape[1:])

    def to(self, device: torch.device | str) -> "SequenceVLDataset":
        """The same windows held on another device."""
        proprio = {k: v.to(device) for k, v in self.proprio.items()}
        names = ("images", "actions", "last", "language")
        arrays = {name: getattr(self, name).to(device) for name in names}
        return replace(self, proprio=proprio, target=None, pin=False, **arrays)

    def delivering(self, device: torch.device | str, *, pin: bool = False) -> "SequenceVLDataset":
        """The same windows held where they are, with batches given on another device."""
        return replace(self, target=torch.device(device), pin=pin)

    def nbytes(self) -> int:
        """Bytes of memory the frames take."""
        return sum(x.nbytes for x in (self.images, self.actions, self.last, *self.proprio.values()))


def batches(
    dataset: SequenceVLDataset,
    batch_size: int,
    generator: torch.Generator | None = None,
    drop_last: bool = False,
) -> Iterator[Batch]:
    """One pass over all windows.

    Args:
        dataset: the windows.
        batch_size: B; the last batch may be smaller.
        generator: shuffles; drawn from once, when iteration starts. None: in order.
        drop_last: leave a smaller last batch out.
    """
    order = (
        torch.arange(len(dataset)) if generator is None else torch.randperm(len(dataset), generator=generator)
    )
    for indices in order.split(batch_size):
        if len(indices) == batch_size or not drop_last:
            yield dataset.batch(indices)
