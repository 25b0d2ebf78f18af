"""Frames on disk, read when a batch needs them, for datasets that are larger than memory.

There is a folder for each demonstration file and each choice of what is read of it:

    images.u8     (F, V, H, W, C) uint8 without a header
    arrays.npz    proprioception, actions, last frames of the demonstrations
    index.json    shape and digest of the images, and what the folder was made from

The folder's name is a digest of the file (path, size, modification time, and samples of its bytes) and of what is
read, so a file that was recorded again has another folder. A folder gets its name when it is complete, so a killed
process leaves none. If several processes need the same folder, one builds it and the others wait.

Each file has a checksum, and a folder where one does not fit is built again. Of the images, which may be larger than
memory, 64 MiB are compared whenever they are opened: all, or blocks of 1 MiB at equal distances.

Frames are read by position and not mapped: mapped pages count as memory of the process, and a mapped file that another
process truncates ends this one with a signal.
"""

import hashlib
import json
import logging
import math
import os
import shutil
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock, Timeout
from torch import Tensor

from libero_env.demos.read import demo_files
from libero_env.paths import cache_dir
from libero_env.storage import (
    atomic_folder,
    atomic_write_npz,
    check_trusted,
    make_cache_folder,
    open_for_owner,
    read_npz,
    read_record,
    write_record,
)
from lifelong.data.source import DemoSource, demo_tensors, last_frames
from lifelong.errors import DataError

_FORMAT = 1
_SAMPLES, _SAMPLE_BYTES = 64, 4096  # number and size of the blocks of a file that are in its digest
_BLOCKS, _BLOCK_BYTES = 64, 1 << 20  # likewise of the images
_READ_AT_ONCE = 1 << 26  # [bytes] when all frames are read
_PATIENCE = 10.0  # [s] for a process that builds, until a line says so
_LONGEST_BUILD = 4 * 3600.0  # [s] for it in all
_log = logging.getLogger(__name__)
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


def ensure_frames(source: DemoSource) -> tuple[Path, tuple[int, ...]]:
    """Return the folder of a source and the shape of its images, after building it if there is none that is intact.

    Raises:
        DemoError: The file is broken.
        DataError: The file does not fit the spec, or the folder cannot be written.
    """
    spec = asdict(source.spec)  # but `seq_len`, since windows are made from the arrays later
    read = {key: spec[key] for key in ("views", "image_size", "proprio", "action_dim")}
    read |= {"format": _FORMAT, **{key: getattr(source, key) for key in ("limit", "pairing", "labels")}}
    made_from = {"source": str(source.path.resolve()), "file": _fingerprint(source.path), "read": read}
    digest = hashlib.sha256(json.dumps(made_from, sort_keys=True).encode()).hexdigest()[:24]
    folder = cache_root() / f"{source.path.stem}-{digest}"
    check_trusted(folder.parent)
    if (shape := _intact_shape(folder)) is not None:
        return folder, shape
    try:
        make_cache_folder(folder.parent)
        with _building(folder):
            shape = _intact_shape(folder, silent=True)
            if shape is None:  # no other process has built it meanwhile
                shutil.rmtree(folder, ignore_errors=True)
                shape = _build(source, folder, made_from)
                _remove_stale(folder.parent, made_from)
    except OSError as error:
        raise DataError(
            f"{folder}: the frames of {source.path} cannot be written ({error}). Free some space, choose another "
            "folder with LIBERO_CACHE, or set data.memory=host"
        ) from error
    return folder, shape


def _intact_shape(folder: Path, silent: bool = False) -> tuple[int, ...] | None:
    """Return the shape of the images in a folder whose checksums fit; None for any other."""
    if not (folder / "index.json").exists():
        return None
    try:
        index = read_record(folder / "index.json")
        if index is None:
            raise ValueError("index.json has no checksum, or another")
        if _images_digest(folder / "images.u8") != index["images"]:
            raise ValueError("images.u8 has another checksum than when it was written")
        read_npz(folder / "arrays.npz")
        return tuple(index["shape"])
    except (ValueError, KeyError, OSError) as error:
        if not silent:
            _log.warning("%s is not used (%s); its frames are written again", folder, error)
        return None


@contextmanager
def _building(folder: Path) -> Iterator[None]:
    """Let one process at a time build a folder; the lock of a process that is killed is free."""
    lock = FileLock(folder.with_name(f".{folder.name}.lock"))
    try:
        lock.acquire(timeout=_PATIENCE)
    except Timeout:
        _log.warning("waiting for another process, which writes %s", folder)
        try:
            lock.acquire(timeout=_LONGEST_BUILD)
        except Timeout:
            hours = _LONGEST_BUILD / 3600
            raise DataError(
                f"{folder}: another process has written it for {hours:.0f} hours; end that process"
            ) from None
    try:
        yield
    finally:
        lock.release()


def _build(source: DemoSource, folder: Path, made_from: dict[str, Any]) -> tuple[int, ...]:
    """Write the folder of a source in one step; return the shape of the images."""
    needed, free = source.nbytes(), shutil.disk_usage(folder.parent).free
    if needed > free:
        raise OSError(f"{needed / 2**30:.1f} GiB are needed and {free / 2**30:.1f} GiB are free")
    with atomic_folder(folder) as part:
        part.chmod(0o755 & part.stat().st_mode)
        shape = _write_arrays(source, part)
        digest = _images_digest(part / "images.u8")
        write_record(part / "index.json", {"format": _FORMAT, "shape": shape, "images": digest, **made_from})
    return shape


def _write_arrays(source: DemoSource, folder: Path) -> tuple[int, ...]:
    """Write the arrays, with the images of one demonstration in memory at a time; return the shape of the images."""
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
    return (sum(lengths), len(source.spec.views), *source.spec.image_size, 3)


def _remove_stale(root: Path, made_from: dict[str, Any]) -> None:
    """Remove folders that were made from the same file before it changed; processes that have them open keep them."""
    for index in root.glob("*/index.json"):
        with suppress(OSError, ValueError, KeyError, TypeError):  # a broken one is left to whoever needs it
            other = json.loads(index.read_text(encoding="utf-8"))
            if other["source"] == made_from["source"] and other["file"] != made_from["file"]:
                shutil.rmtree(index.parent, ignore_errors=True)


def _images_digest(path: Path) -> str:
    """Return a digest of the size of a file, and of all or 64 MiB of its bytes."""
    digest = hashlib.sha256(str(path.stat().st_size).encode())
    _add_blocks(digest, path, _BLOCKS, _BLOCK_BYTES)
    return digest.hexdigest()


def _fingerprint(path: Path) -> str:
    """Return a digest that changes with a file, or with the parts in a folder; only samples of it are read."""
    digest = hashlib.sha256()
    for part in demo_files(path):
        stat = part.stat()
        digest.update(f"{part.name} {stat.st_size} {stat.st_mtime_ns}".encode())
        _add_blocks(digest, part, _SAMPLES, _SAMPLE_BYTES)
    return digest.hexdigest()


def _add_blocks(digest: Any, path: Path, most: int, length: int) -> None:
    """Add a file's bytes to a digest, or those of blocks that are spread evenly over it."""
    size = path.stat().st_size
    blocks = min(most, math.ceil(size / length))
    with open(path, "rb") as file:
        for k in range(blocks):
            file.seek((size - length) * k // (blocks - 1) if size > most * length else k * length)
            digest.update(file.read(length))
