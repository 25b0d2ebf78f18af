"""Frames in a file, of which only those are read that a batch needs.

They are read by position and not mapped: mapped pages count as memory of the process, and a mapped file that another
process truncates ends this one with a signal.
"""

import math
import os
import weakref
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lifelong.errors import DataError

_READ_AT_ONCE = 1 << 26  # [bytes] when all frames are read


class FrameFile:
    """Frames (F, ...) uint8 in a file without a header.

    Args:
        path: File, which holds exactly these frames.
        shape: Number of frames, and the shape of one.

    Attributes:
        shape: As given.
    """

    def __init__(self, path: Path, shape: tuple[int, ...]):
        self.shape, self._path, self._size = shape, path, math.prod(shape[1:])
        self._file = os.open(path, os.O_RDONLY)
        weakref.finalize(self, os.close, self._file)
        if hasattr(os, "posix_fadvise"):  # what lies beside a frame is not needed with it
            os.posix_fadvise(self._file, 0, 0, os.POSIX_FADV_RANDOM)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, frames: Tensor) -> Tensor:
        """Return frames by index, as a tensor does; see `rows`."""
        return self.rows(frames)

    @property
    def nbytes(self) -> int:
        """Number of bytes of the frames, on the disk."""
        return math.prod(self.shape)

    def rows(self, frames: Tensor, out: Tensor | None = None) -> Tensor:
        """Return frames by index, (n, ...) uint8, as `torch.index_select` does.

        Args:
            frames: Indices, (n,) int64 in [0, F).
            out: Tensor to write them to; None for a new one.

        Raises:
            DataError: The file cannot be read, or is shorter than it was.
        """
        found = torch.empty(len(frames), *self.shape[1:], dtype=torch.uint8) if out is None else out
        places = found.view(len(frames), self._size).numpy()
        for start, first, count in _runs(frames):
            self._read(places[start : start + count], first)
        return found

    def expect(self, frames: Tensor) -> None:
        """Let the system read frames ahead, while the caller does something else.

        Args:
            frames: Indices, (n,) int64 in [0, F).
        """
        if hasattr(os, "posix_fadvise"):
            for _, first, count in _runs(frames):
                os.posix_fadvise(self._file, first * self._size, count * self._size, os.POSIX_FADV_WILLNEED)

    def to(self, device: torch.device | str) -> Tensor:
        """Return all frames as a tensor on a device."""
        step = max(1, _READ_AT_ONCE // self._size)
        found = torch.empty(self.shape, dtype=torch.uint8, device=device)
        for indices in torch.arange(len(self)).split(step):
            found[indices[0] : indices[-1] + 1] = self.rows(indices).to(device)
        return found

    def _read(self, rows: np.ndarray, first: int) -> None:
        """Fill rows (n, bytes) with the frames from `first` on."""
        left, offset = rows.reshape(-1).data, first * self._size
        while left:
            try:
                count = os.preadv(self._file, [left], offset)
            except OSError as error:
                raise DataError(f"{self._path}: the frames cannot be read ({error})") from error
            if not count:
                raise DataError(
                    f"{self._path} ends before frame {offset // self._size} of {len(self)}: another process "
                    "changed it. Run the same command again: the frames are written again"
                )
            left, offset = left[count:], offset + count


def _runs(frames: Tensor) -> Iterator[tuple[int, int, int]]:
    """Yield the parts of a list of indices that count up by one: place in the list, first index, length."""
    numbers = frames.numpy()
    ends = np.flatnonzero(np.diff(numbers) != 1) + 1
    starts = np.concatenate([[0], ends]) if len(numbers) else ends
    for start, end in zip(starts.tolist(), [*ends.tolist(), len(numbers)], strict=False):
        yield start, int(numbers[start]), end - start
