"""Loading and a training step of the paper's ResNet-T, ours and the original's, on one file and in one run.

    python experiments/benchmarks/compare_training.py --original ~/original/bin/python [--file demo.hdf5]

Windows of 10 steps with two 128x128 views, batches of 32, no worker processes. The original is called as its own
training does; README.md tells what its interpreter needs. Every measurement is the best of several in a process of
its own, so that peak memory is its own. Ours convert pictures to floating point in the step, the original's in the
loader; all of training is loading, augmentation (shifts and colours) and the step. On some virtual machines bfloat16
needs ONEDNN_MAX_CPU_ISA=AVX512_CORE_BF16.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from loader_speed import write_noise

from lifelong.algorithms import Sequential
from lifelong.data import DemoSource, open_windows
from lifelong.seeding import generator
from lifelong.settings import build
from lifelong.training.distributed import Ranks
from lifelong.training.precision import keep_freed_memory
from lifelong.training.settings import FitSettings
from lifelong.training.step import Step
from lifelong.types import Batch, PolicySpec

CONFIGS = Path(__file__).parents[2] / "configs"
WORKER = Path(__file__).with_name("original_training.py")
SPEC = PolicySpec(language_dim=768, proprio={"joint_states": 7, "gripper_states": 2})


def best(call: Callable[[], object], times: int) -> float:
    """Seconds of the fastest call, after one to warm up."""
    call()
    taken = []
    for _ in range(times):
        began = time.perf_counter()
        call()
        taken.append(time.perf_counter() - began)
    return min(taken)


def measure_here(path: Path, precision: str, args: argparse.Namespace) -> dict[str, float]:
    """What the worker of the original measures, of ours."""
    torch.set_num_threads(args.threads)
    keep_freed_memory()
    torch.manual_seed(0)
    dataset = open_windows(DemoSource(path, SPEC), language=torch.zeros(SPEC.language_dim), memory="host")
    draws = torch.Generator().manual_seed(0)
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        config = compose("config", ["policy=bc_transformer", "augmentation=shift_jitter"])
    policy = build(config.policy, spec=SPEC).train()
    settings = FitSettings(batch_size=args.batch, precision=precision)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=settings.lr)
    augment = build(config.augmentation)
    plain, whole = (
        Step(policy, Sequential(), optimizer, settings, augmentation, Ranks())
        for augmentation in (None, augment)
    )

    def load() -> Batch:
        return dataset.batch(torch.randperm(len(dataset), generator=draws)[: args.batch])

    held = load()
    return {
        "windows": args.batch / best(load, 10 * args.batches),
        "step": best(lambda: plain(held, generator(0), 1e-4), args.steps),
        "all": best(lambda: whole(load(), generator(0), 1e-4), args.steps),
        "memory": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        "parameters": sum(p.numel() for p in policy.parameters()),
    }


def measure_original(path: Path, args: argparse.Namespace) -> dict[str, float]:
    """The original, by its interpreter."""
    source = {"PYTHONPATH": str(args.source.resolve())} if args.source else {}
    numbers = [args.batch, SPEC.seq_len, args.batches, args.steps, args.threads]
    done = subprocess.run(
        [args.original, "-W", "ignore", WORKER, path, *map(str, numbers)],
        capture_output=True,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": str(args.threads)} | source,
    )
    if done.returncode:
        raise SystemExit(f"the original stopped:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def row(name: str, found: dict[str, float], original: dict[str, float]) -> str:
    """One line of the table."""
    ratios = [
        found["windows"] / original["windows"],
        *(original[k] / found[k] for k in ("step", "all", "memory")),
    ]
    cells = [f"{found['windows']:.0f}", f"{found['step']:.2f}", f"{found['all']:.2f}"]
    cells.append(f"{found['memory'] / 2**30:.2f}")
    texts = [f"{cell} ({ratio:.1f})" for cell, ratio in zip(cells, ratios, strict=True)]
    return f"| {name} | {' | '.join(texts)} |"


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--original", required=True, help="the original's interpreter")
    parser.add_argument(
        "--source", type=Path, help="the original's repository, if that has no libero.lifelong"
    )
    parser.add_argument("--file", type=Path, help="a demonstration file with 128x128 pictures")
    parser.add_argument("--demos", type=int, default=10, help="demonstrations of the file of noise")
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--batches", type=int, default=5, help="read for each measurement")
    parser.add_argument("--steps", type=int, default=3, help="made for each measurement")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--precisions", nargs="+", default=["fp32", "bf16"])
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["LIBERO_CACHE"] = folder
        path = args.file or write_noise(Path(folder) / "noise_demo.hdf5", args.demos, 130)
        original = measure_original(path, args)
        print(f"torch {torch.__version__}, {args.threads} threads, batches of {args.batch}\n")
        print("| | windows/s | step, s | all of training, s | peak GiB |\n|---|" + "---:|" * 4)
        print(row(f"the original, {original['parameters']:,.0f} parameters", original, original), flush=True)
        for precision in args.precisions:
            with ProcessPoolExecutor(1, get_context("spawn")) as pool:
                try:
                    found = pool.submit(measure_here, path, precision, args).result()
                except BrokenProcessPool:
                    print(f"{precision}: the process died", file=sys.stderr)
                    continue
            print(row(f"here, {precision}, {found['parameters']:,.0f}", found, original), flush=True)


if __name__ == "__main__":
    main()
