"""Frames on disk, mapped into memory, for datasets that are larger than memory.

There is a folder for each demonstration file and each choice of what is read of it:

    images.u8     (F, V, H, W, C) uint8 without a header; the system reads a page when a batch needs it
    arrays.npz    proprioception, actions, last frames of the demonstrations
    index.json    shape of the images, and what the folder was made from

The folder's name is a digest of the file (path, size, modification time, and samples of its bytes) and of what is
read, so a file that was recorded again has another folder. A folder gets its name when it is complete, so a killed
process leaves none. If several processes need the same folder, one builds it and the others wait.
"""

import hashlib
import json
import os
import shutil
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock
from torch import Tensor

from libero_env.demos.read import demo_files
from libero_env.paths import cache_dir
from libero_env.storage import atomic_folder
from lifelong.data.dataset import SequenceVLDataset
from lifelong.data.source import DemoSource, check_language, demo_tensors, last_frames
from lifelong.errors import DataError

_FORMAT = 1
_SAMPLES, _SAMPLE_BYTES = 64, 4096  # number and size of the blocks of a file that are in its digest


def open_mapped(source: DemoSource, *, language: Tensor, task_id: int = 0) -> SequenceVLDataset:
    """Return the windows of a file, with the images mapped from disk. The folder is built if it does not exist.

    Args:
        source: What is read.
        language: Embedding of the instruction, (L,).
        task_id: Position in the task sequence.

    Raises:
        DemoError: The file is broken.
        DataError: The file does not fit the spec, or there is not enough space on the disk.
    """
    language = check_language(language, source.spec)
    folder = _ensure_folder(source)
    index = json.loads((folder / "index.json").read_text())
    with np.load(folder / "arrays.npz", allow_pickle=False) as file:
        arrays = {name: torch.from_numpy(file[name]) for name in file.files}
    proprio = {name: arrays[f"proprio/{name}"] for name in source.spec.proprio}
    images = np.memmap(folder / "images.u8", dtype=np.uint8, mode="r", shape=tuple(index["shape"]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the map is not writable, and nothing writes to it
        frames = torch.from_numpy(images)
    return SequenceVLDataset(
        frames, proprio, arrays["actions"], arrays["last"], language, task_id, source.spec.seq_len
    )


def cache_root() -> Path:
    """Return the folder of all mapped frames, `frames` in the cache folder."""
    return cache_dir() / "frames"


def _ensure_folder(source: DemoSource) -> Path:
    """Return the folder of a source, after building it if it does not exist."""
    fingerprint = _fingerprint(source.path)
    made_from = {"source": str(source.path.resolve()), "file": fingerprint, "read": _array_settings(source)}
    digest = hashlib.sha256(json.dumps(made_from, sort_keys=True).encode()).hexdigest()[:24]
    root = cache_root()
    folder = root / f"{source.path.stem}-{digest}"
    if folder.is_dir():
        return folder
    root.mkdir(parents=True, exist_ok=True)
    with FileLock(root / f".{folder.name}.lock"):
        if not folder.is_dir():
            _build(source, folder, made_from)
            _remove_stale(root, made_from)
    return folder


def _build(source: DemoSource, folder: Path, made_from: dict[str, Any]) -> None:
    """Write the folder of a source in one step."""
    needed, free = source.nbytes(), shutil.disk_usage(folder.parent).free
    try:
        if needed > free:
            raise OSError(f"{needed / 2**30:.1f} GiB are needed and {free / 2**30:.1f} GiB are free")
        with atomic_folder(folder) as part:
            index = {"format": _FORMAT, "shape": _write_arrays(source, part), **made_from}
            (part / "index.json").write_text(json.dumps(index, indent=1))
    except OSError as error:
        raise DataError(
            f"{folder}: the frames of {source.path} cannot be written ({error}). Free some space, choose another "
            "folder with LIBERO_CACHE, or set data.memory=host"
        ) from error


def _write_arrays(source: DemoSource, folder: Path) -> tuple[int, ...]:
    """Write the arrays, with the images of one demonstration in memory at a time; return the shape of the images."""
    lengths: list[int] = []
    kept: list[dict[str, Tensor]] = []
    with open(folder / "images.u8", "wb") as file:
        for demo in source.demos():
            images, proprio, actions = demo_tensors(demo, source.spec)
            file.write(images.contiguous().numpy().data)
            lengths.append(len(demo))
            kept.append({"actions": actions} | {f"proprio/{name}": x for name, x in proprio.items()})
        file.flush()
        os.fsync(file.fileno())
    joined = {name: torch.cat([demo[name] for demo in kept]).numpy() for name in kept[0]}
    np.savez(folder / "arrays.npz", last=last_frames(lengths).numpy(), **joined)
    return (sum(lengths), len(source.spec.views), *source.spec.image_size, 3)


def _remove_stale(root: Path, made_from: dict[str, Any]) -> None:
    """Remove folders that were made from the same file before it changed; processes that have them open keep them."""
    for index in root.glob("*/index.json"):
        found = json.loads(index.read_text())
        if found["source"] == made_from["source"] and found["file"] != made_from["file"]:
            shutil.rmtree(index.parent, ignore_errors=True)


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
