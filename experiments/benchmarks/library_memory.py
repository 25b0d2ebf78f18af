"""What a library of demonstrations costs: memory, time to open, windows per second, by its size and `data.memory`.

    python experiments/benchmarks/library_memory.py [--demos 250 1000 2000] [--size 32] [--memory host disk]

For each size a file of noise is written to a temporary folder, 100 steps a demonstration with two views. Each way to
hold the frames is measured in a process of its own, on one thread: resident memory after 400 shuffled batches of 64
windows less that before, the part of it that is mapped from files, and windows per second of wall time and of CPU time.
`disk, cold` is the same with the frames removed from the system's cache before, `ahead` with the next batch announced
while the last one is used, which is here 20 ms of waiting, as the steps of a small policy.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np
import torch

from lifelong.data import DemoSource, open_windows
from lifelong.data.frame_cache import cache_root
from lifelong.data.windows import batches_in_order
from lifelong.types import PolicySpec

STEPS, BATCH, BATCHES = 100, 64, 400


def spec(size: int) -> PolicySpec:
    """Two views of `size` by `size` pixels, and readings."""
    return PolicySpec(image_size=(size, size), language_dim=8, seq_len=1)


def write_library(path: Path, demos: int, size: int) -> None:
    """Demonstrations of noise in the original's layout."""
    rng, made_of = np.random.default_rng(0), spec(size)
    noise = rng.integers(0, 256, (STEPS, size, size, 3), dtype=np.uint8)
    with h5py.File(path, "w") as file:
        file.create_group("data").attrs["pairing"] = "aligned"
        for number in range(demos):
            group = file.create_group(f"data/demo_{number}")
            group.attrs["num_samples"] = STEPS
            group["actions"] = rng.uniform(-1, 1, (STEPS, made_of.action_dim))
            for view in made_of.views:
                group[f"obs/{view}"] = np.roll(noise, number, axis=2)
            for key, length in made_of.proprio.items():
                group[f"obs/{key}"] = rng.normal(size=(STEPS, length))


def resident() -> tuple[float, float]:
    """Resident memory of this process, and the part that is mapped from files, MB."""
    lines = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
    return tuple(int(lines[key].split()[0]) / 1024 for key in ("VmRSS", "RssFile"))


def forget(folder: Path) -> None:
    """Remove the frames from the system's cache."""
    for file in folder.rglob("images.u8"):
        handle = os.open(file, os.O_RDONLY)
        os.fsync(handle)
        os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(handle)


def measure(path: Path, size: int, how: str) -> dict[str, float]:
    """Open a library in this process and read shuffled batches."""
    torch.set_num_threads(1)
    memory, _, way = how.partition(", ")
    source, language = DemoSource(path, spec(size)), torch.zeros(8)
    if memory == "disk":
        open_windows(source, language=language, memory=memory)  # writes the frames, once
    before, began = resident(), time.perf_counter()
    windows = open_windows(source, language=language, memory=memory)
    opened = time.perf_counter() - began
    if way:
        forget(cache_root())
    order = torch.randperm(len(windows), generator=torch.Generator().manual_seed(0))[: BATCHES * BATCH]
    waiting = 0.0
    began, cpu = time.perf_counter(), time.process_time()
    chunks = order.split(BATCH)
    for _ in batches_in_order(windows, chunks) if way != "cold" else map(windows.batch, chunks):
        if way:
            time.sleep(0.02)
            waiting += 0.02
    wall, cpu = time.perf_counter() - began - waiting, time.process_time() - cpu
    after = resident()
    return {
        "opening [s]": opened,
        "memory [MB]": after[0] - before[0],
        "mapped [MB]": after[1] - before[1],
        "windows/s": len(order) / wall,
        "windows/s of CPU": len(order) / cpu,
    }


def main() -> None:
    """Print a row for each library and each way to hold it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--demos", type=int, nargs="+", default=[250, 1000, 2000])
    parser.add_argument("--size", type=int, default=32, help="pixels of a side")
    parser.add_argument(
        "--memory",
        nargs="+",
        default=["host", "disk", "disk, cold", "disk, ahead"],
        help="ways to hold frames",
    )
    parser.add_argument("--one", nargs=2, metavar=("FILE", "WAY"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        print(json.dumps(measure(Path(args.one[0]), args.size, args.one[1])))
        return
    for demos in args.demos:
        with tempfile.TemporaryDirectory() as folder:
            path, env = Path(folder) / "library_demo.hdf5", {**os.environ, "LIBERO_CACHE": folder}
            write_library(path, demos, args.size)
            for way in args.memory:
                command = [sys.executable, __file__, "--size", str(args.size), "--one", str(path), way]
                done = subprocess.run(command, env=env, check=True, capture_output=True, text=True)
                found = json.loads(done.stdout.splitlines()[-1])
                values = "  ".join(f"{name} {value:,.1f}" for name, value in found.items())
                print(f"{demos:5d} demonstrations  {way:11s}  {values}", flush=True)


if __name__ == "__main__":
    main()
