"""How fast training windows are read: this package's datasets beside robomimic's, on one file and one thread.

    python experiments/benchmarks/loader_speed.py [--file demo.hdf5] [--robomimic ~/robomimic/bin/python]

A batch is 32 windows of 10 steps with two 128x128 views and proprioception, in shuffled order. Conversion to
floating point and augmentation are measured by themselves. robomimic runs in a process of its own, and is used as
the original LIBERO uses it: low-dimensional data in memory, pictures from the file, a torch DataLoader.

Without --file a file of noise in the original's layout, uncompressed, is written to a temporary folder. Wall time is
what counts on an idle machine; CPU time, beside it, hardly changes when others use the machine too.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import torch

from lifelong.data import DemoSource, open_windows
from lifelong.nn import ColorJitter, RandomShift
from lifelong.types import Batch, PolicySpec

BATCH = 32
SPEC = PolicySpec(language_dim=768)
WORKER = Path(__file__).with_name("robomimic_loader.py")
Row = tuple[str, float, float]  # name, windows per second of wall time, of CPU time


def write_noise(path: Path, demos: int, steps: int) -> Path:
    """Demonstrations of noise in the original's layout."""
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        file.create_group("data").attrs["pairing"] = "aligned"
        for number in range(demos):
            group = file.create_group(f"data/demo_{number}")
            group.attrs["num_samples"] = steps
            group["actions"] = rng.uniform(-1, 1, (steps, SPEC.action_dim))
            for view in SPEC.views:
                group[f"obs/{view}"] = rng.integers(0, 256, (steps, *SPEC.image_size, 3), dtype=np.uint8)
            for key, size in SPEC.proprio.items():
                group[f"obs/{key}"] = rng.normal(size=(steps, size))
    return path


def measured(name: str, step: Callable[[], object], repeats: int) -> Row:
    """Windows per second of a call that treats one batch, after two to warm up."""
    step(), step()
    wall, cpu = time.perf_counter(), time.process_time()
    for _ in range(repeats):
        step()
    windows = repeats * BATCH
    return name, windows / (time.perf_counter() - wall), windows / (time.process_time() - cpu)


def shuffled(windows: int) -> Iterator[torch.Tensor]:
    """Indices of batches, pass after pass."""
    draws = torch.Generator().manual_seed(0)
    while True:
        yield from (
            part for part in torch.randperm(windows, generator=draws).split(BATCH) if len(part) == BATCH
        )


def floats(batch: Batch) -> torch.Tensor:
    """(B T V, C, H, W) float32 in [-1, 1], as policies convert pictures; robomimic's `process_obs` has [0, 1]."""
    return batch.observation.images.flatten(0, 2).movedim(-1, 1).to(torch.float32).mul_(2.0 / 255.0).sub_(1.0)


def measure_here(path: Path, repeats: int) -> list[Row]:
    """This package: gathering from memory and from disk, then what is done with a batch."""
    rows, source = [], DemoSource(path, SPEC)
    for memory, where in (("host", "frames in memory"), ("disk", "frames on disk, read before")):
        dataset = open_windows(source, language=torch.zeros(SPEC.language_dim), memory=memory)
        order = shuffled(len(dataset))
        rows.append(measured(f"here, {where}", lambda d=dataset, o=order: d.batch(next(o)), repeats))
    batch, draws = dataset.batch(next(order)), torch.Generator().manual_seed(0)
    rows.append(measured("here, conversion to float32", lambda: floats(batch), max(3, repeats // 10)))
    for augmentation in (RandomShift(4), ColorJitter()):
        work = lambda a=augmentation: a(batch, draws)  # noqa: E731
        rows.append(measured(f"here, {type(augmentation).__name__}", work, max(3, repeats // 10)))
    return rows


def measure_robomimic(python: str, path: Path, repeats: int) -> list[Row]:
    """robomimic's dataset, by another interpreter; no rows where that has none."""
    keys = [json.dumps(list(names)) for names in (SPEC.views, SPEC.proprio)]
    command = [python, str(WORKER), str(path), *keys, str(SPEC.seq_len), str(BATCH), str(repeats)]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    if done.returncode:
        print(f"robomimic is left out: {done.stderr.strip().splitlines()[-1]}", file=sys.stderr)
        return []
    return [tuple(row) for row in json.loads(done.stdout.splitlines()[-1])]


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--file", type=Path, help="a demonstration file with 128x128 pictures")
    parser.add_argument("--robomimic", default=sys.executable, help="an interpreter that has robomimic")
    parser.add_argument("--demos", type=int, default=20, help="demonstrations of the file of noise")
    parser.add_argument("--steps", type=int, default=130, help="steps of each of them")
    parser.add_argument("--repeats", type=int, default=50, help="batches of each measurement")
    args = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["LIBERO_CACHE"] = folder
        path = args.file or write_noise(Path(folder) / "noise_demo.hdf5", args.demos, args.steps)
        rows = measure_here(path, args.repeats)
        rows += measure_robomimic(args.robomimic, path, max(2, args.repeats // 10))
    print(f"torch {torch.__version__}, one thread, batches of {BATCH}\n")
    print("| | windows/s | of CPU time |\n|---|---:|---:|")
    for name, wall, cpu in rows:
        print(f"| {name} | {wall:.0f} | {cpu:.0f} |")


if __name__ == "__main__":
    main()
