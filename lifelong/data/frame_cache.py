"""Frames on disk, read when a batch needs them, for datasets that are larger than memory.

There is a folder for each demonstration file and each choice of what is read of it:

    images.u8     (F, V, H, W, C) uint8 without a header, see `lifelong.data.frame_file`
    arrays.npz    proprioception, actions, last frames of the demonstrations
    index.json    shape and digest of the images, and what the folder was made from

The folder's name is a digest of the file (path, size, modification time, and samples of its bytes) and of what is
read, so a file that was recorded again has another folder. A folder gets its name when it is complete, so a killed
process leaves none. If several processes need the same folder, one builds it and the others wait.

Each file has a checksum, and a folder where one does not fit is built again. Of the images, which may be larger than
memory, 64 MiB are compared whenever they are opened: all, or blocks of 1 MiB at equal distances.
"""

import hashlib
import json
import logging
import math
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

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
from lifelong.data.dataset import SequenceVLDataset
from lifelong.data.frame_file import FrameFile
from lifelong.data.source import DemoSource, check_language, demo_tensors, last_frames
from lifelong.errors import DataError

_FORMAT = 1
_SAMPLES, _SAMPLE_BYTES = 64, 4096  # number and size of the blocks of a file that are in its digest
_BLOCKS, _BLOCK_BYTES = 64, 1 << 20  # likewise of the images
_PATIENCE, _LONGEST_BUILD = (
    10.0,
    4 * 3600.0,
)  # [s] for a process that builds: until a line says so, and in all
_log = logging.getLogger(__name__)


def open_on_disk(source: DemoSource, *, language: Tensor, task_id: int = 0) -> SequenceVLDataset:
    """Return the windows of a file, with the images on disk. The folder is built if it does not exist.

    Args:
        source: What is read.
        language: Embedding of the instruction, (L,).
        task_id: Position in the task sequence.

    Raises:
        DemoError: The file is broken.
        DataError: The file does not fit the spec, or there is not enough space on the disk.
    """
    language = check_language(language, source.spec)
    folder, shape = _ensure_folder(source)
    arrays = {name: torch.from_numpy(array) for name, array in read_npz(folder / "arrays.npz").items()}
    proprio = {name: arrays[f"proprio/{name}"] for name in source.spec.proprio}
    frames = FrameFile(folder / "images.u8", shape)
    return SequenceVLDataset(
        frames, proprio, arrays["actions"], arrays["last"], language, task_id, source.spec.seq_len
    )


def cache_root() -> Path:
    """Return the folder of all frames on disk, `frames` in the cache folder."""
    return cache_dir() / "frames"


def _ensure_folder(source: DemoSource) -> tuple[Path, tuple[int, ...]]:
    """Return the folder of a source and the shape of its images, after building it if there is none that is intact."""
    fingerprint = _fingerprint(source.path)
    made_from = {"source": str(source.path.resolve()), "file": fingerprint, "read": _array_settings(source)}
    digest = hashlib.sha256(json.dumps(made_from, sort_keys=True).encode()).hexdigest()[:24]
    root = cache_root()
    folder = root / f"{source.path.stem}-{digest}"
    check_trusted(root)
    if (shape := _intact_shape(folder)) is None:
        with _building(folder, source):
            if (
                shape := _intact_shape(folder, silent=True)
            ) is None:  # no other process has built it meanwhile
                shutil.rmtree(folder, ignore_errors=True)
                shape = _build(source, folder, made_from)
                _remove_stale(root, made_from)
    return folder, shape


def _intact_shape(folder: Path, silent: bool = False) -> tuple[int, ...] | None:
    """Return the shape of the images in a folder whose checksums fit; None for any other."""
    if not (folder / "index.json").exists():
        return None
    try:
        index = read_record(folder / "index.json")
        if index is None:  # also that of an earlier version, which has no checksum
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
def _building(folder: Path, source: DemoSource) -> Iterator[None]:
    """Let one process at a time build a folder; the lock of a process that is killed is free."""
    lock = FileLock(folder.with_name(f".{folder.name}.lock"))
    try:
        make_cache_folder(folder.parent)
        try:
            lock.acquire(timeout=_PATIENCE)
        except Timeout:
            _log.warning("waiting for another process, which writes %s", folder)
            lock.acquire(timeout=_LONGEST_BUILD)
    except Timeout:
        raise DataError(
            f"{folder}: another process has written it for {_LONGEST_BUILD / 3600:.0f} hours; end that process"
        ) from None
    except OSError as error:
        raise _cannot_be_written(folder, source, error) from error
    try:
        yield
    finally:
        lock.release()


def _cannot_be_written(folder: Path, source: DemoSource, error: OSError) -> DataError:
    return DataError(
        f"{folder}: the frames of {source.path} cannot be written ({error}). Free some space, choose another "
        "folder with LIBERO_CACHE, or set data.memory=host"
    )


def _build(source: DemoSource, folder: Path, made_from: dict[str, Any]) -> tuple[int, ...]:
    """Write the folder of a source in one step; return the shape of the images."""
    needed = source.nbytes()
    try:
        free = shutil.disk_usage(folder.parent).free
        if needed > free:
            raise OSError(f"{needed / 2**30:.1f} GiB are needed and {free / 2**30:.1f} GiB are free")
        with atomic_folder(folder) as part:
            part.chmod(0o755 & part.stat().st_mode)
            shape = _write_arrays(source, part)
            digest = _images_digest(part / "images.u8")
            write_record(
                part / "index.json", {"format": _FORMAT, "shape": shape, "images": digest, **made_from}
            )
        return shape
    except OSError as error:
        raise _cannot_be_written(folder, source, error) from error


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
            found = json.loads(index.read_text(encoding="utf-8"))
            if found["source"] == made_from["source"] and found["file"] != made_from["file"]:
                shutil.rmtree(index.parent, ignore_errors=True)


def _images_digest(path: Path) -> str:
    """Return a digest of the size of a file, and of all or 64 MiB of its bytes."""
    size = path.stat().st_size
    digest = hashlib.sha256(str(size).encode())
    blocks = min(_BLOCKS, math.ceil(size / _BLOCK_BYTES))
    with open(path, "rb") as file:
        for k in range(blocks):
            file.seek(
                (size - _BLOCK_BYTES) * k // (blocks - 1)
                if size > _BLOCKS * _BLOCK_BYTES
                else k * _BLOCK_BYTES
            )
            digest.update(file.read(_BLOCK_BYTES))
    return digest.hexdigest()


def _fingerprint(path: Path) -> str:
    """Return a digest that changes with a file, or with the parts in a folder; only samples of it are read."""
    digest = hashlib.sha256()
    for part in demo_files(path):
        stat = part.stat()
        digest.update(f"{part.name} {stat.st_size} {stat.st_mtime_ns}".encode())
        with open(part, "rb") as file:
            for k in range(_SAMPLES):
                file.seek(max(0, stat.st_size - _SAMPLE_BYTES) * k // (_SAMPLES - 1))
                digest.update(file.read(_SAMPLE_BYTES))
    return digest.hexdigest()


def _array_settings(source: DemoSource) -> dict[str, Any]:
    """Return the settings that determine the arrays; `seq_len` does not, since windows are made from them later."""
    spec = asdict(source.spec)
    read = {key: spec[key] for key in ("views", "image_size", "proprio", "action_dim")}
    return read | {
        "format": _FORMAT,
        "limit": source.limit,
        "pairing": source.pairing,
        "labels": source.labels,
    }
