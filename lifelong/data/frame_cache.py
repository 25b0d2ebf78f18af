"""Frames on disk, read when a batch needs them, for datasets that are larger than memory.

There is a folder of the cache for each demonstration file and each choice of what is read of it:

    images.u8     (F, V, H, W, C) uint8 without a header
    arrays.npz    proprioception, actions, last frames of the demonstrations

Frames are read by position and not mapped: mapped pages count as memory of the process, and a mapped file that another
process truncates ends this one with a signal.
"""

import hashlib
import json
import math
import os
import shutil
import threading
import weakref
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from libero_env.demos.read import demo_files
from libero_env.paths import cache_dir
from libero_env.storage import atomic_folder, atomic_write_npz, cached_folder, open_for_owner
from libero_env.text import show_bytes
from lifelong.data.source import DemoSource, demo_tensors, last_frames
from lifelong.errors import DataError

_FORMAT = 1
_READ_AT_ONCE = 1 << 26  # [bytes] when all frames are read
_moving = threading.Lock()  # of the position of a file


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
        self._file = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0))
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
        rows = torch.empty(len(frames), *self.shape[1:], dtype=torch.uint8) if out is None else out
        places = rows.view(len(frames), self._size).numpy()
        for start, first, count in _runs(frames):
            self._read(places[start : start + count], first)
        return rows

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
        frames = torch.empty(self.shape, dtype=torch.uint8, device=device)
        for indices in torch.arange(len(self)).split(step):
            frames[indices[0] : indices[-1] + 1] = self.rows(indices).to(device)
        return frames

    def _read(self, rows: np.ndarray, first: int) -> None:
        """Fill rows (n, bytes) with the frames from `first` on."""
        left, offset = rows.reshape(-1).data, first * self._size
        while left:
            try:
                count = _read_at(self._file, left, offset)
            except OSError as error:
                raise DataError(f"{self._path}: the frames cannot be read ({error})") from error
            if not count:
                raise DataError(
                    f"{self._path} ends before frame {offset // self._size} of {len(self)}: another process "
                    "changed it. Run the same command again: the frames are written again"
                )
            left, offset = left[count:], offset + count


def _read_at(file: int, place: memoryview, offset: int) -> int:
    """Read bytes at a position of a file; return how many there were."""
    if hasattr(os, "preadv"):
        return os.preadv(file, [place], offset)
    with _moving:  # on Windows
        os.lseek(file, offset, os.SEEK_SET)
        found = os.read(file, len(place))
    place[: len(found)] = found
    return len(found)


def _runs(frames: Tensor) -> Iterator[tuple[int, int, int]]:
    """Yield the parts of a list of indices that count up by one: place in the list, first index, length."""
    numbers = frames.numpy()
    ends = np.flatnonzero(np.diff(numbers) != 1) + 1
    starts = np.concatenate([[0], ends]) if len(numbers) else ends
    for start, end in zip(starts.tolist(), [*ends.tolist(), len(numbers)], strict=False):
        yield start, int(numbers[start]), end - start


def cache_root() -> Path:
    """Return the folder of all frames on disk, `frames` in the cache folder."""
    return cache_dir() / "frames"


def ensure_frames(source: DemoSource) -> Path:
    """Return the folder of a source, after building it if there is none that is intact.

    Raises:
        DemoError: The file is broken.
        LiberoError: The file does not fit the spec, or the folder cannot be written.
    """
    spec = asdict(source.spec)  # but `seq_len`, since windows are made from the arrays later
    read = {key: spec[key] for key in ("views", "image_size", "proprio", "action_dim")}
    read |= {"format": _FORMAT, **{key: getattr(source, key) for key in ("limit", "pairing", "labels")}}
    key = json.dumps([str(source.path.resolve()), read], sort_keys=True)
    folder = cache_root() / f"{source.path.stem}-{hashlib.sha256(key.encode()).hexdigest()[:24]}"
    stats = [(part.name, part.stat()) for part in demo_files(source.path)]
    files = [(name, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns) for name, stat in stats]

    def build() -> None:
        needed, free = source.nbytes(), shutil.disk_usage(folder.parent).free
        if needed > free:
            raise OSError(f"{show_bytes(needed)} are needed and {show_bytes(free)} are free")
        with atomic_folder(folder) as part:
            part.chmod(0o755 & part.stat().st_mode)
            _write_arrays(source, part)

    cached_folder(folder, build, json.dumps(files))
    return folder


def _write_arrays(source: DemoSource, folder: Path) -> None:
    """Write the arrays, with the images of one demonstration in memory at a time."""
    lengths: list[int] = []
    kept: list[dict[str, Tensor]] = []
    with open(folder / "images.u8", "wb", opener=open_for_owner) as file:
        for demo in source.demos():
            images, proprio, actions = demo_tensors(demo, source.spec)
            file.write(images.contiguous().numpy().data)
            lengths.append(len(demo))
            kept.append({"actions": actions} | {f"proprio/{name}": x for name, x in proprio.items()})
        file.flush()
        os.fsync(file.fileno())
    joined = {name: torch.cat([demo[name] for demo in kept]).numpy() for name in kept[0]}
    atomic_write_npz(folder / "arrays.npz", {"last": last_frames(lengths).numpy(), **joined}, fsync=True)
