"""How fast a policy is trained, and what it takes: steps/s, peak memory, share of the processor's peak.

    python experiments/benchmarks/training_speed.py                       # bc_transformer at the paper's size
    python experiments/benchmarks/training_speed.py --policy bc_transformer_small --image 64 --window 1 --batch 64
    python experiments/benchmarks/training_speed.py --variants bf16 bf16_graphs --profile

A step is the trainer's own (`lifelong.training.step`): forward, backward, clipping, AdamW, on a batch in memory;
data_and_policy_speed.py measures how it comes there. Every variant runs in a process of its own, so that peak
memory is its own, and one that the processor cannot do costs its row only. Operations are counted, not estimated.
On some virtual machines bfloat16 needs ONEDNN_MAX_CPU_ISA=AVX512_CORE_BF16.
"""

import argparse
import json
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir

from lifelong.algorithms import Sequential
from lifelong.data import fake_batch
from lifelong.policies import Policy
from lifelong.seeding import generator
from lifelong.settings import build
from lifelong.training.costs import step_costs
from lifelong.training.precision import keep_freed_memory
from lifelong.training.settings import FitSettings
from lifelong.training.step import Step
from lifelong.types import Batch, PolicySpec

CONFIGS = Path(__file__).parents[2] / "configs"
# Dense bf16 TFLOP/s that the makers state, by a part of the device's name.
PEAKS = {"H200": 989.0, "H100": 989.0, "A100": 312.0, "L40S": 362.0, "RTX 4090": 165.0, "L4": 121.0}
VARIANTS: dict[str, dict] = {
    "fp32": {"precision": "fp32"},
    "fp32_contiguous": {"precision": "fp32", "channels_last": False},
    "fp32_compiled": {"precision": "fp32", "compile": "default"},
    "bf16": {"precision": "bf16"},
    "bf16_contiguous": {"precision": "bf16", "channels_last": False},
    "bf16_accumulate_4": {"precision": "bf16", "accumulate": 4},
    "bf16_compiled": {"precision": "bf16", "compile": "default"},
    "bf16_graphs": {"precision": "bf16", "compile": "reduce-overhead"},
}
ON_CPU = ("fp32", "fp32_contiguous", "bf16", "bf16_contiguous", "bf16_accumulate_4")


@dataclass(frozen=True)
class Job:
    """What is measured; see the command line."""

    variant: str
    policy: str
    batch: int
    window: int
    image: int
    device: str
    threads: int
    steps: int
    profile: bool


class Windows:
    """As many random windows as a batch has."""

    def __init__(self, batch: Batch):
        self.whole = batch

    def __len__(self) -> int:
        return len(self.whole)

    def batch(self, indices: torch.Tensor) -> Batch:
        """The first so many of them."""
        return self.whole.rows(slice(0, len(indices)))


def prepare(job: Job) -> tuple[Policy, Batch]:
    """The policy and a batch, on their device."""
    spec = PolicySpec(image_size=(job.image, job.image), language_dim=768, seq_len=job.window)
    torch.manual_seed(0)
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        policy = build(compose("config", [f"policy={job.policy}"]).policy, spec=spec)
    if not VARIANTS[job.variant].get("channels_last", True):
        policy.to(memory_format=torch.contiguous_format)
    return policy.to(job.device).train(), fake_batch(spec, job.batch, generator(0)).to(job.device)


def make_step(job: Job, policy: Policy) -> Step:
    """The trainer's step in a variant."""
    variant = {name: value for name, value in VARIANTS[job.variant].items() if name != "channels_last"}
    settings = FitSettings(batch_size=job.batch, **variant)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=settings.lr)
    return Step(policy, Sequential(), optimizer, settings)


def measure(job: Job) -> dict[str, float | str]:
    """Median seconds of a step, peak memory in bytes, operations of a step; with `profile` torch's table."""
    torch.set_num_threads(job.threads)
    keep_freed_memory()
    policy, batch = prepare(job)
    step, draws, cuda = make_step(job, policy), generator(0), job.device.startswith("cuda")
    wait = torch.cuda.synchronize if cuda else lambda: None
    for _ in range(5 if cuda else 1):  # kernels are chosen, graphs are recorded
        step(batch, draws, 1e-4)
    wait()
    seconds = []
    for _ in range(job.steps):
        began = time.perf_counter()
        step(batch, draws, 1e-4)
        wait()
        seconds.append(time.perf_counter() - began)
    memory = (
        torch.cuda.max_memory_allocated()
        if cuda
        else 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    )
    table = profiled(step, batch, cuda) if job.profile else ""
    # afterwards: counting needs memory of its own
    flops = step_costs(policy, Sequential(), Windows(batch.to("cpu")), job.batch)["flops_per_step"]
    return {"seconds": sorted(seconds)[len(seconds) // 2], "memory": memory, "flops": flops, "table": table}


def profiled(step: Step, batch: Batch, cuda: bool) -> str:
    """What three steps spend their time on."""
    activities = [
        torch.profiler.ProfilerActivity.CPU,
        *([torch.profiler.ProfilerActivity.CUDA] if cuda else []),
    ]
    with torch.profiler.profile(activities=activities) as profile:
        for _ in range(3):
            step(batch, generator(0), 1e-4)
    order = "self_device_time_total" if cuda else "self_cpu_time_total"
    return profile.key_averages().table(sort_by=order, row_limit=15, max_name_column_width=60)


def row(name: str, batch: int, found: dict, peak: float | None) -> str:
    """One line of the table."""
    rate = found["flops"] / found["seconds"] / 1e12
    share = f"{rate / peak:.1%}" if peak else ""
    return (
        f"| {name} | {1000 * found['seconds']:.1f} | {1 / found['seconds']:.2f} | {batch / found['seconds']:.0f} "
        f"| {found['memory'] / 2**30:.2f} | {rate:.3g} | {share} |"
    )


def arguments() -> argparse.Namespace:
    """The command line."""
    cuda = torch.cuda.is_available()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--policy", default="bc_transformer", choices=sorted(f.stem for f in CONFIGS.glob("policy/*.yaml"))
    )
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS if cuda else ON_CPU))
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--window", type=int, default=10, help="steps per window")
    parser.add_argument("--image", type=int, default=128, help="pixels")
    parser.add_argument("--device", default="cuda" if cuda else "cpu")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--steps", type=int, default=50 if cuda else 3, help="timed; the median counts")
    parser.add_argument(
        "--peak", type=float, help="TFLOP/s of the device in bf16, where it is not a known GPU"
    )
    parser.add_argument("--profile", action="store_true", help="torch.profiler's table of each variant")
    parser.add_argument("--json", type=Path, help="write the figures there too")
    return parser.parse_args()


def main() -> None:
    """Measure one variant after another."""
    args = arguments()
    device = (
        torch.cuda.get_device_name()
        if args.device.startswith("cuda")
        else torch.backends.cpu.get_cpu_capability()
    )
    peak = args.peak or next((value for name, value in PEAKS.items() if name in device), None)
    print(
        f"{args.policy}, {args.batch} windows of {args.window} steps, two views of {args.image} x {args.image}"
    )
    print(f"torch {torch.__version__}, {device}, {args.threads} threads\n")
    print(
        "| variant | ms/step | steps/s | windows/s | peak GiB | TFLOP/s | of bf16 peak |\n|---|" + "---:|" * 6
    )
    given = {k: v for k, v in vars(args).items() if k not in ("variants", "peak", "json")}
    jobs, found = [Job(variant=name, **given) for name in args.variants], {}
    for job in jobs:
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            try:
                found[job.variant] = pool.submit(measure, job).result()
            except BrokenProcessPool:
                print(f"| {job.variant} | the process died |" + " |" * 5, flush=True)
                continue
        print(row(job.variant, args.batch, found[job.variant], peak), flush=True)
    for name, figures in found.items():
        if args.profile:
            print(f"\n{name}\n{figures['table']}")
    if args.json:
        args.json.write_text(
            json.dumps([asdict(job) | found.get(job.variant, {}) for job in jobs], indent=1) + "\n"
        )


if __name__ == "__main__":
    main()
