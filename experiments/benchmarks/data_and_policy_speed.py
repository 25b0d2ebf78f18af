"""How fast windows are gathered, images augmented, and how fast policies act; training_speed.py measures training.

    python experiments/benchmarks/data_and_policy_speed.py [--threads 2] [--steps 5] [--only paper|small|data]

Wall time is what counts on an idle machine; CPU time, beside it, hardly changes when others use the machine too.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir

from lifelong.data import SequenceVLDataset, fake_batch
from lifelong.nn import ColorJitter, RandomShift
from lifelong.settings import build
from lifelong.types import PolicySpec

PAPER = PolicySpec(language_dim=768)
SMALL = PolicySpec(image_size=(64, 64), seq_len=5)
CONFIGS = Path(__file__).parents[2] / "configs"


def timed(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Wall and CPU seconds of one call, after one to warm up."""
    work()
    wall, cpu = time.perf_counter(), time.process_time()
    for _ in range(repeats):
        work()
    return (time.perf_counter() - wall) / repeats, (time.process_time() - cpu) / repeats


def show(name: str, windows: int, seconds: tuple[float, float]) -> None:
    """One line of the table."""
    wall, cpu = seconds
    print(
        f"{name:52} {1000 * wall:9.1f} ms {1000 * cpu:9.1f} ms CPU {windows / wall:9.0f} windows/s",
        flush=True,
    )


def measure_data(repeats: int) -> None:
    """Gathering and augmenting a batch of 32 windows."""
    for name, spec in (("128x128, T=10", PAPER), ("64x64, T=5", SMALL)):
        frames, draws = 3000, torch.Generator().manual_seed(0)
        images = torch.zeros(frames, len(spec.views), *spec.image_size, 3, dtype=torch.uint8)
        proprio = {key: torch.zeros(frames, size) for key, size in spec.proprio.items()}
        last = torch.full((frames,), frames - 1)
        language = torch.zeros(spec.language_dim)
        dataset = SequenceVLDataset(images, proprio, torch.zeros(frames, 7), last, language, 0, spec.seq_len)
        gather = lambda d=dataset, g=draws: d.batch(torch.randint(len(d), (32,), generator=g))  # noqa: E731
        show(f"gather 32 windows, {name}", 32, timed(gather, repeats))
        batch = gather()
        for augmentation in (RandomShift(4), ColorJitter()):
            work = lambda a=augmentation, b=batch, g=draws: a(b, g)  # noqa: E731
            show(f"{type(augmentation).__name__} of 32 windows, {name}", 32, timed(work, repeats))


def measure_policy(name: str, spec: PolicySpec, choice: str, repeats: int) -> None:
    """Measure a step of acting in ten environments."""
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        policy = build(compose("config", [f"policy={choice}"]).policy, spec=spec)
    count = sum(p.numel() for p in policy.parameters())
    print(f"{name}: {count} parameters")
    observation = fake_batch(spec, 10, torch.Generator().manual_seed(0), steps=1).observation
    policy.eval().reset(10)
    act = lambda: policy.act(observation, [torch.Generator() for _ in range(10)])  # noqa: E731
    show(f"act {name}, 10 environments, fp32", 10, timed(act, repeats * spec.seq_len))


def main() -> None:
    """Measures what the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--steps", type=int, default=5, help="repetitions of each measurement")
    parser.add_argument("--only", choices=("paper", "small", "data"))
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    print(f"torch {torch.__version__}, {torch.backends.cpu.get_cpu_capability()}, {args.threads} threads")
    if args.only in (None, "data"):
        measure_data(args.steps)
    if args.only in (None, "small"):
        measure_policy("small, 64x64, T=5", SMALL, "bc_transformer_small", args.steps)
    if args.only in (None, "paper"):
        measure_policy("paper, 128x128, T=10", PAPER, "bc_transformer", args.steps)


if __name__ == "__main__":
    main()
