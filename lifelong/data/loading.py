"""A task's windows, read by the backend and held in the memory that the settings name.

    device   all frames in the GPU's memory: nothing is copied while training
    pinned   in host memory; batches are gathered in page-locked memory and copied while the GPU computes
    host     in host memory; batches are copied when they are asked for
    mmap     on disk, see `lifelong.data.frame_cache`; batches go the way of `pinned`
    auto     device if the GPU has the room, else pinned; without a GPU host; mmap if memory has no room

Batches are the same to the bit. `auto` decides for each task when it is read, so that tasks held for rehearsal
fill the GPU first, then the memory, then the disk.
"""

import os
from pathlib import Path

import torch
from torch import Tensor

from lifelong.data import frame_cache
from lifelong.data.dataset import SequenceVLDataset
from lifelong.data.robomimic_backend import RobomimicWindows
from lifelong.data.source import DemoSource
from lifelong.errors import DataError

MEMORY = ("auto", "host", "pinned", "device", "mmap")
BACKENDS = ("native", "robomimic")

_GPU_RESERVE = 0.4  # of the GPU's memory is left to training
_HOST_RESERVE = 0.25  # of the machine's memory, or
_HOST_LEAST = 2**30  # so many bytes, are left to everything else


def open_windows(
    source: DemoSource,
    *,
    language: Tensor,
    task_id: int = 0,
    device: torch.device | str = "cpu",
    memory: str = "auto",
    backend: str = "native",
) -> SequenceVLDataset | RobomimicWindows:
    """The windows of a demonstration file.

    Args:
        source: What is read.
        language: (L,) embedding of the instruction.
        task_id: Position in the task sequence.
        device: Where batches are wanted.
        memory: One of `MEMORY`.
        backend: `native`, or `robomimic`: each window is read through robomimic's SequenceDataset, for those who
            want to be sure that it is the same data; slow.

    Raises:
        DemoError: The file is broken.
        DataError: It does not fit the spec, an unknown memory or backend, or one that is not there.
    """
    device = torch.device(device)
    for key, value, valid in (("memory", memory, MEMORY), ("backend", backend, BACKENDS)):
        if value not in valid:
            raise DataError(f"data.{key} is {value!r}; valid: {', '.join(valid)}")
    if backend == "robomimic":
        return RobomimicWindows(source, language=language, task_id=task_id, device=device)
    if memory == "auto":
        memory = choose(source.nbytes(), device)
    if memory == "pinned" and device.type != "cuda":
        raise DataError(f"data.memory=pinned is for a GPU, and device={device}; valid: auto, host, mmap")
    if memory == "mmap":
        dataset = frame_cache.mapped(source, language=language, task_id=task_id)
    else:
        dataset = SequenceVLDataset.from_file(
            source.path,
            spec=source.spec,
            language=language,
            task_id=task_id,
            limit=source.limit,
            pairing=source.pairing,
            labels=source.labels,
        )
    if memory == "device":
        return dataset.to(device)
    pin = device.type == "cuda" and memory in ("pinned", "mmap")
    return dataset.delivering(device, pin=pin) if device.type != "cpu" else dataset


def choose(nbytes: int, device: torch.device) -> str:
    """The memory for so many bytes of frames, by what is free now."""
    if device.type == "cuda":
        free, total = torch.cuda.mem_get_info(device)
        if nbytes <= free - _GPU_RESERVE * total:
            return "device"
    free, total = host_memory()
    if nbytes > free - max(_HOST_RESERVE * total, _HOST_LEAST):
        return "mmap"
    return "pinned" if device.type == "cuda" else "host"


def host_memory() -> tuple[int, int]:
    """Bytes of memory that are available and that there are; those of the container, where one sets a limit."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    free = total // 2  # where the system does not say
    meminfo = Path("/proc/meminfo")
    if meminfo.exists():
        lines = dict(line.split(":") for line in meminfo.read_text().splitlines())
        free = int(lines["MemAvailable"].split()[0]) * 1024
    limit, used = (_cgroup(name) for name in ("memory.max", "memory.current"))
    if limit is not None and used is not None and limit < total:
        return min(free, max(limit - used, 0)), limit
    return free, total


def _cgroup(name: str) -> int | None:
    """A figure of this process's container (cgroup v2); None where there is none."""
    try:
        text = (Path("/sys/fs/cgroup") / name).read_text().strip()
    except OSError:
        return None
    return int(text) if text.isdecimal() else None
