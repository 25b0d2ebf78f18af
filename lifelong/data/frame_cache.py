"""Frames on disk, mapped into memory: datasets that are larger than it.

A folder for each demonstration file and choice of what is read of it:

    images.u8     (F, V, H, W, C) uint8, nothing else: the system reads a page when a batch needs it
    arrays.npz    proprioception, actions, ends of demonstrations
    index.json    their shape, and what they were made from

The folder's name is a digest of the file (its place, size, time of change, and samples of its bytes) and of what
is read, so a file that was recorded anew is another folder. It gets its name when it is complete: a process that
was killed leaves none, and of several that want the same one builds while the others wait.
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
from lifelong.data.source import DemoArrays, DemoSource, check_language, last_frames
from lifelong.errors import DataError

_FORMAT = 1
_SAMPLES, _SAMPLE = 64, 4096  # blocks of a file that its digest looks at, bytes of each


def mapped(source: DemoSource, *, language: Tensor, task_id: int = 0) -> SequenceVLDataset:
    """The windows of a file with their pictures mapped from disk; made now where that has not been done.

    Args:
        source: What is read.
        language: (L,) embedding of the instruction.
        task_id: Position in the task sequence.

    Raises:
        DemoError: The file is broken.
        DataError: It does not fit the spec, or the disk has no room.
    """
    language = check_language(language, source.spec)
    folder = _ensure(source)
    index = json.loads((folder / "index.json").read_text())
    with np.load(folder / "arrays.npz", allow_pickle=False) as file:
        arrays = {name: torch.from_numpy(file[name]) for name in file.files}
    proprio = {name: arrays[f"proprio/{name}"] for name in source.spec.proprio or ()}
    images = np.memmap(folder / "images.u8", dtype=np.uint8, mode="r", shape=tuple(index["shape"]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the map is not writable, and nobody writes to it
        frames = torch.from_numpy(images)
    return SequenceVLDataset(
        frames, proprio, arrays["actions"], arrays["last"], language, task_id, source.spec.seq_len
    )


def cache_root() -> Path:
    """`frames` in the cache folder."""
    return cache_dir() / "frames"


def _ensure(source: DemoSource) -> Path:
    """The folder of a source, complete."""
    fingerprint = _fingerprint(source.path)
    made_from = {"source": str(source.path.resolve()), "file": fingerprint, "read": _settings(source)}
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
            raise OSError(f"{needed / 2**30:.1f} GiB are needed and {free / 2**30:.1f} are free")
        with atomic_folder(folder) as part:
            index = {"format": _FORMAT, "shape": _write_arrays(source, part), **made_from}
            (part / "index.json").write_text(json.dumps(index, indent=1))
    except OSError as error:
        raise DataError(
            f"{folder}: the frames of {source.path} cannot be written ({error}). Make room there, name another "
            "folder with LIBERO_CACHE, or set data.memory=host"
        ) from error


def _write_arrays(source: DemoSource, folder: Path) -> tuple[int, ...]:
    """Write the arrays, holding one demonstration at a time; the shape of the pictures."""
    lengths, kept = [], []
    with open(folder / "images.u8", "wb") as file:
        for demo in source.demos():
            arrays = DemoArrays.of(demo, source.spec)
            file.write(arrays.images.contiguous().numpy().data)
            lengths.append(len(demo))
            kept.append({"actions": arrays.actions} | {f"proprio/{k}": v for k, v in arrays.proprio.items()})
        file.flush()
        os.fsync(file.fileno())
    joined = {name: torch.cat([demo[name] for demo in kept]).numpy() for name in kept[0]}
    np.savez(folder / "arrays.npz", last=last_frames(lengths).numpy(), **joined)
    return (sum(lengths), len(source.spec.views), *source.spec.image_size, 3)


def _remove_stale(root: Path, made_from: dict[str, Any]) -> None:
    """Remove what was made from the same file before it changed; processes that have it open keep it."""
    for index in root.glob("*/index.json"):
        found = json.loads(index.read_text())
        if found["source"] == made_from["source"] and found["file"] != made_from["file"]:
            shutil.rmtree(index.parent, ignore_errors=True)


def _fingerprint(path: Path) -> str:
    """A digest of a file, or of the parts in a folder, that changes with it; reads little of it."""
    digest = hashlib.sha256()
    for part in demo_files(path):
        stat = part.stat()
        digest.update(f"{part.name} {stat.st_size} {stat.st_mtime_ns}".encode())
        with open(part, "rb") as file:
            for k in range(_SAMPLES):
                file.seek(max(0, stat.st_size - _SAMPLE) * k // (_SAMPLES - 1))
                digest.update(file.read(_SAMPLE))
    return digest.hexdigest()


def _settings(source: DemoSource) -> dict[str, Any]:
    """What decides the arrays; windows are made of them later, so `seq_len` is not among it."""
    spec = asdict(source.spec)
    read = {key: spec[key] for key in ("views", "image_size", "proprio", "action_dim")}
    return read | {
        "format": _FORMAT,
        "limit": source.limit,
        "pairing": source.pairing,
        "labels": source.labels,
    }
