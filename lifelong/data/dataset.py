"""Windows over the demonstrations of one task, held in memory.

Shape legend: F frames of all demonstrations, W = F windows, B batch, T time, V views, H W C image, A action,
L language embedding.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from libero_env.demos import Demo, read_demos
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
            labels: `expert` or `executed`, see `libero_env.demos.read_demos`.

        Raises:
            DemoError: the file is broken; names file, demonstration, key and what was expected.
            DataError: the file is sound but does not fit the spec.
        """
        keys = [*spec.views, *spec.proprio]
        demos = read_demos(path, keys, limit, pairing=pairing, labels=labels)
        return cls.from_demos(demos, spec=spec, language=language, task_id=task_id, source=str(path))

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
        language = torch.as_tensor(language, dtype=torch.float32)
        if language.shape != (spec.language_dim,):
            raise DataError(
                f"the language embedding has shape {tuple(language.shape)}; the policy's spec expects "
                f"({spec.language_dim},). Choose the language encoder that the spec was made for"
            )
        for demo in demos:
            _check(demo, spec, source)
        demos = [demo for demo in demos if len(demo.actions)]
        lengths = [len(demo.actions) for demo in demos]
        ends = torch.tensor(lengths, dtype=torch.int64).cumsum(0)
        frames = int(ends[-1]) if lengths else 0
        images = torch.empty(frames, len(spec.views), *spec.image_size, 3, dtype=torch.uint8)
        proprio = {name: torch.empty(frames, size) for name, size in spec.proprio.items()}
        actions = torch.empty(frames, spec.action_dim)
        for demo, end in zip(demos, ends.tolist(), strict=True):
            rows = slice(end - len(demo.actions), end)
            for view, key in enumerate(spec.views):
                images[rows, view] = torch.from_numpy(np.ascontiguousarray(demo.obs[key]))
            for name, array in proprio.items():
                array[rows] = torch.from_numpy(np.asarray(demo.obs[name], dtype=np.float32))
            actions[rows] = torch.from_numpy(np.asarray(demo.actions, dtype=np.float32))
        last = (ends - 1).repeat_interleave(torch.tensor(lengths, dtype=torch.int64))
        return cls(images, proprio, actions, last, language, task_id, spec.seq_len)

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
        gather = lambda x: x.index_select(0, frames.flatten()).view(*frames.shape, *x.shape[1:])  # noqa: E731
        language = self.language.expand(len(indices), -1)
        observation = Observation(
            gather(self.images), {k: gather(v) for k, v in self.proprio.items()}, language
        )
        return Batch(observation, gather(self.actions), torch.full_like(indices, self.task_id), indices)

    def to(self, device: torch.device | str) -> "SequenceVLDataset":
        """The same windows held on another device."""
        proprio = {k: v.to(device) for k, v in self.proprio.items()}
        arrays = [x.to(device) for x in (self.actions, self.last, self.language)]
        return SequenceVLDataset(self.images.to(device), proprio, *arrays, self.task_id, self.seq_len)

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


def _check(demo: Demo, spec: PolicySpec, source: str) -> None:
    """Raises DataError when a demonstration does not fit the spec."""
    expected: dict[str, tuple[int, ...]] = dict.fromkeys(spec.views, (*spec.image_size, 3))
    expected |= {name: (size,) for name, size in spec.proprio.items()}
    where = f"{source}: {demo.name}"
    if demo.actions.ndim != 2 or demo.actions.shape[1] != spec.action_dim:
        raise DataError(f"{where}/actions is {demo.actions.shape}; expected (T, {spec.action_dim})")
    for key, shape in expected.items():
        if key not in demo.obs:
            raise DataError(f"{where}/obs/{key} is missing; it has {', '.join(sorted(demo.obs))}")
        found = demo.obs[key].shape
        if found != (len(demo.actions), *shape):
            hint = ""
            if key in spec.views and len(found) == 4:
                hint = f". Set the policy's image_size to {list(found[1:3])}, or record at {list(shape[:2])}"
            raise DataError(
                f"{where}/obs/{key} is {found}; the policy expects {(len(demo.actions), *shape)}{hint}"
            )
        if key in spec.views and demo.obs[key].dtype != np.uint8:
            raise DataError(f"{where}/obs/{key} is {demo.obs[key].dtype}; expected uint8 in 0..255")
