"""Windows over the demonstrations of one task, with the frames in memory or on disk.

Shape legend: F frames of all demonstrations, W = F windows, B batch, T time, V views, H W C image, D size of a reading,
A action, L language embedding.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from libero_env.demos.read import Episode
from lifelong.data.frame_cache import FrameFile
from lifelong.data.source import DemoSource, check_fits, check_language, demo_tensors, last_frames
from lifelong.errors import DataError
from lifelong.types import Batch, Observation, PolicySpec, to_device


@dataclass(frozen=True, eq=False)
class SequenceVLDataset:
    """All windows of `seq_len` steps of one task, with the task's language embedding.

    A window starts at every frame and covers the frames t .. t + seq_len - 1 of its demonstration; past the
    end, the last frame and action repeat (robomimic's SequenceDataset with pad_seq_length). Frames are stored
    once: windows are indices, and a batch is one gather per array.

    Build one with `from_file`, `from_source` or `from_demos`.

    Attributes:
        images: (F, V, H, W, C) uint8, upright; in memory, or a file of them.
        proprio: Name to (F, D) float32.
        actions: (F, A) float32.
        last: Index of the last frame of each frame's demonstration, (F,) int64.
        language: Embedding of the instruction, (L,) float32.
        seq_len: Number of steps in a window, T.
        batch_device: Device of the batches; None for the device of the frames.
        pin_memory: Whether batches are gathered in page-locked memory first, so that they are copied to a GPU
            asynchronously.
    """

    images: Tensor | FrameFile
    proprio: Mapping[str, Tensor]
    actions: Tensor
    last: Tensor
    language: Tensor
    task_id: int
    seq_len: int
    batch_device: torch.device | None = None
    pin_memory: bool = False

    def __post_init__(self) -> None:
        if not len(self.actions):
            raise DataError("a dataset needs at least one demonstration with one frame; none was given")

    @classmethod
    def from_file(
        cls, path: str | Path, *, spec: PolicySpec, language: Tensor, task_id: int = 0, **reading: Any
    ) -> "SequenceVLDataset":
        """Read all frames of a demonstration file into memory.

        Args:
            path: HDF5 file in the original's layout.
            spec: Views, readings, their sizes, and `seq_len`.
            language: Embedding of the instruction, (L,).
            reading: Further fields of `DemoSource`.

        Raises:
            DemoError: The file is broken; the message names file, demonstration, key and what was expected.
            DataError: The file is valid but does not fit the spec.
        """
        return cls.from_source(DemoSource(Path(path), spec, **reading), language=language, task_id=task_id)

    @classmethod
    def from_source(cls, source: DemoSource, *, language: Tensor, task_id: int = 0) -> "SequenceVLDataset":
        """Read what a source describes into memory; see `from_file`."""
        language = check_language(language, source.spec)
        return cls._filled(source.demos(), source.lengths, source.spec, language, task_id)

    @classmethod
    def from_demos(
        cls,
        demos: Sequence[Episode],
        *,
        spec: PolicySpec,
        language: Tensor,
        task_id: int = 0,
        source: str = "demonstrations",
    ) -> "SequenceVLDataset":
        """Copy demonstrations that are in memory already.

        Args:
            demos: The demonstrations.
            spec: As for `from_file`.
            language: As for `from_file`.
            task_id: As for `from_file`.
            source: Where they come from, for error messages.

        Raises:
            DataError: They do not fit the spec; the message names source, demonstration, key and what was expected.
        """
        language = check_language(language, spec)
        for demo in demos:
            check_fits(demo, spec, source)
        return cls._filled(demos, [len(demo) for demo in demos], spec, language, task_id)

    @classmethod
    def _filled(
        cls, demos: Iterable[Episode], lengths: list[int], spec: PolicySpec, language: Tensor, task_id: int
    ) -> "SequenceVLDataset":
        """Return a dataset whose tensors are filled one demonstration after the other."""
        frames, end, rows = sum(lengths), 0, slice(0, 0)
        images = torch.empty(frames, len(spec.views), *spec.image_size, 3, dtype=torch.uint8)
        proprio = {name: torch.empty(frames, size) for name, size in spec.proprio.items()}
        actions = torch.empty(frames, spec.action_dim)
        for demo in demos:
            rows = slice(end, end + len(demo))
            if rows.stop > frames:
                break
            images[rows], readings, actions[rows] = demo_tensors(demo, spec)
            for name, reading in readings.items():
                proprio[name][rows] = reading
            end = rows.stop
        if rows.stop != frames:
            raise DataError(
                f"{rows.stop} frames were read where {frames} were counted: a file was changed meanwhile"
            )
        return cls(images, proprio, actions, last_frames(lengths), language, task_id, spec.seq_len)

    def __len__(self) -> int:
        """Return the number of windows, W."""
        return len(self.actions)

    @property
    def demos(self) -> int:
        """Number of demonstrations."""
        return len(self.last.unique())

    def frames(self, indices: Tensor) -> Tensor:
        """Return the indices of the frames, (B, T), that the given windows (B,) cover."""
        indices = indices.to(self.last.device)
        steps = torch.arange(self.seq_len, device=self.last.device)
        return torch.minimum(indices[:, None] + steps, self.last[indices][:, None])

    def narrowed(self, indices: Tensor) -> tuple["SequenceVLDataset", Tensor]:
        """Return these windows without frames that none of the given ones (n,) covers, and the given ones' indices.

        Frames on disk stay as they are: they take no memory.
        """
        used = self.frames(indices if len(indices) else torch.zeros(1, dtype=torch.int64)).unique()
        if isinstance(self.images, FrameFile) or len(used) == len(self):
            return self, indices
        # demonstrations end at the last of their frames that is still there: no given window reaches beyond it
        last = torch.searchsorted(used, self.last[used], right=True) - 1
        rows = {name: getattr(self, name)[used] for name in ("images", "actions")}
        proprio = {name: reading[used] for name, reading in self.proprio.items()}
        places = torch.searchsorted(used, indices.to(used.device)).to(indices.device)
        return replace(self, proprio=proprio, last=last, **rows), places

    def batch(self, indices: Tensor) -> Batch:
        """Return the windows of the given indices, (B,) int64 in [0, W), as one batch.

        Raises:
            DataError: An index is out of range.
        """
        indices = torch.as_tensor(indices, dtype=torch.int64)  # checked here: on a GPU that would wait
        if len(indices) and not (int(indices.min()) >= 0 and int(indices.max()) < len(self)):
            raise DataError(
                f"window indices must lie in [0, {len(self)}), got {indices.min()} .. {indices.max()}"
            )
        indices = to_device(indices, self.last.device)
        frames = self.frames(indices)
        gather = lambda x: self._gather(x, frames)  # noqa: E731
        language = self.language.expand(len(indices), -1)
        observation = Observation(
            gather(self.images), {k: gather(v) for k, v in self.proprio.items()}, language
        )
        is_pad = frames - indices[:, None] < torch.arange(self.seq_len, device=frames.device)
        task_ids = torch.full_like(indices, self.task_id)
        batch = Batch(observation, gather(self.actions), task_ids, indices, is_pad)
        return batch if self.batch_device is None else batch.to(self.batch_device)

    def _gather(self, array: Tensor | FrameFile, frames: Tensor) -> Tensor:
        """Return the rows (B, T, ...) of an array (F, ...) at frames (B, T)."""
        shape = (frames.numel(), *array.shape[1:])
        dtype = torch.uint8 if isinstance(array, FrameFile) else array.dtype
        out = torch.empty(shape, dtype=dtype, pin_memory=True) if self.pin_memory else None
        if isinstance(array, FrameFile):
            rows = array.rows(frames.flatten(), out)
        else:
            rows = torch.index_select(array, 0, frames.flatten(), out=out)
        return rows.view(*frames.shape, *array.shape[1:])

    def expect(self, indices: Tensor) -> None:
        """Read the windows of the given indices, (B,) int64, ahead where frames are on disk."""
        if isinstance(self.images, FrameFile):
            self.images.expect(self.frames(torch.as_tensor(indices, device="cpu")).flatten())

    def to(self, device: torch.device | str) -> "SequenceVLDataset":
        """Return the same windows, held on another device."""
        proprio = {k: v.to(device) for k, v in self.proprio.items()}
        names = ("images", "actions", "last", "language")
        arrays = {name: getattr(self, name).to(device) for name in names}
        return replace(self, proprio=proprio, batch_device=None, pin_memory=False, **arrays)

    def with_batches_on(self, device: torch.device | str, *, pin_memory: bool = False) -> "SequenceVLDataset":
        """Return the same windows, held where they are, with batches on another device."""
        return replace(self, batch_device=torch.device(device), pin_memory=pin_memory)

    def nbytes(self) -> int:
        """Return the number of bytes of the frames."""
        return sum(x.nbytes for x in (self.images, self.actions, self.last, *self.proprio.values()))
