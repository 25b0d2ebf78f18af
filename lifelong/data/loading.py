"""A task's windows, held in the chosen kind of memory.

    device   all frames in GPU memory; nothing is copied while training
    pinned   in host memory; batches are gathered in page-locked memory and copied while the GPU computes
    host     in host memory; batches are copied when they are requested
    disk     on disk, see `lifelong.data.frame_cache`; a batch is read when it is requested, or ahead, and copied as
             for `pinned`
    auto     `device` if the frames fit into GPU memory, else `pinned`; without a GPU `host`; `disk` if they do not
             fit into host memory

The batches are bitwise the same. `auto` decides for each task when its windows are read, so tasks that are held for
rehearsal fill the GPU first, then host memory, then the disk.
"""

import torch
from torch import Tensor

from libero_env.memory import host_memory
from libero_env.storage import read_npz
from libero_env.text import show_bytes
from lifelong.data.dataset import SequenceVLDataset
from lifelong.data.frame_cache import FrameFile, ensure_frames
from lifelong.data.settings import MEMORY
from lifelong.data.source import DemoSource, check_language
from lifelong.errors import DataError

_GPU_RESERVE = 0.4  # [share of GPU memory] kept free for training
_HOST_RESERVE = 0.25  # [share of host memory] kept free for everything else
_HOST_RESERVE_BYTES = 2**30  # [bytes] host memory kept free at least


def open_windows(
    source: DemoSource,
    *,
    language: Tensor,
    task_id: int = 0,
    device: torch.device | str = "cpu",
    memory: str = "auto",
) -> SequenceVLDataset:
    """Return the windows of a demonstration file.

    Args:
        source: What is read.
        language: Embedding of the instruction, (L,).
        memory: One of `MEMORY`.

    Raises:
        DemoError: The file is broken.
        DataError: The file does not fit the spec or the memory, or the memory is unknown or not available.
    """
    device = torch.device(device)
    if memory not in MEMORY:
        raise DataError(f"data.memory is {memory!r}; valid: {', '.join(MEMORY)}")
    if memory == "auto":
        memory = choose_memory(source.nbytes(), device)
    elif memory != "disk":
        _check_fits(source, memory, device)
    if memory == "pinned" and device.type != "cuda":
        raise DataError(f"data.memory=pinned needs a GPU, and device={device}; valid: auto, host, disk")
    if memory == "disk":
        dataset = _open_on_disk(source, language, task_id)
    else:
        dataset = SequenceVLDataset.from_source(source, language=language, task_id=task_id)
    if memory == "device":
        return dataset.to(device)
    pin = device.type == "cuda" and memory in ("pinned", "disk")
    return dataset.with_batches_on(device, pin_memory=pin) if device.type != "cpu" else dataset


def _open_on_disk(source: DemoSource, language: Tensor, task_id: int) -> SequenceVLDataset:
    language, folder = check_language(language, source.spec), ensure_frames(source)
    arrays = {name: torch.from_numpy(array) for name, array in read_npz(folder / "arrays.npz").items()}
    proprio = {name: arrays[f"proprio/{name}"] for name in source.spec.proprio}
    shape = (len(arrays["last"]), len(source.spec.views), *source.spec.image_size, 3)
    frames = FrameFile(folder / "images.u8", shape)
    return SequenceVLDataset(
        frames, proprio, arrays["actions"], arrays["last"], language, task_id, source.spec.seq_len
    )


def _check_fits(source: DemoSource, memory: str, device: torch.device) -> None:
    """Raise DataError if the frames are more than what is free; they go through host memory to the GPU."""
    places = {"host memory": host_memory()[0]}
    if memory == "device" and device.type == "cuda":
        places["GPU memory"] = torch.cuda.mem_get_info(device)[0]
    needed = source.nbytes()
    for place, free in places.items():
        if needed > free:
            raise DataError(
                f"{source.path} needs {show_bytes(needed)} of {place} and {show_bytes(free)} are free; set "
                "data.memory=disk, a smaller data.image_size or fewer data.demos"
            )


def choose_memory(nbytes: int, device: torch.device) -> str:
    """Return the kind of memory for the given number of bytes of frames, by what is free now."""
    if device.type == "cuda":
        free, total = torch.cuda.mem_get_info(device)
        if nbytes <= free - _GPU_RESERVE * total:
            return "device"
    free, total = host_memory()
    if nbytes > free - max(_HOST_RESERVE * total, _HOST_RESERVE_BYTES):
        return "disk"
    return "pinned" if device.type == "cuda" else "host"
