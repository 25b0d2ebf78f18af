"""The first half hour with a GPU: does everything run on it, is it right, and is it as fast as expected?

    python experiments/benchmarks/first_gpu.py --folder runs/first_gpu          # 40 minutes at most
    python experiments/benchmarks/first_gpu.py --folder runs/first_gpu --only machine tests
    python experiments/benchmarks/first_gpu.py --folder runs/first_gpu --table  # of what has been run

Each check is a command with a time limit and an expectation, which was written without a GPU at hand: what is far from
it is worth a look. results.jsonl in the folder has a line for each; what succeeded is not run again. Output is kept in
NAME.txt.
"""

import argparse
import json
import os
import shlex
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

ROOT = Path(__file__).parents[2]
PYTHON = shlex.quote(sys.executable)
BENCHMARKS = f"{PYTHON} {ROOT}/experiments/benchmarks"
LEARNING = f"{PYTHON} -m tests.harness.gpu_learning cuda"
TRAIN = f"{PYTHON} {ROOT}/train.py device=cuda runs_dir=. data.demos=4 benchmark.tasks=2"
PAPER = (
    f"{TRAIN} preset=paper language=minilm algo=er train.epochs=1 train.steps_per_epoch=200 eval.curve=none "
    "eval.select=last eval.cells=last_row eval.episodes=2 eval.horizon=20"
)
SMOKE = f"{TRAIN} preset=smoke algo=ewc deterministic=true eval.horizon=20"
WARP = f"{PYTHON} {ROOT}/experiments/warp/parity.py"
SAME = "cmp */ewc/*_3/*/task_1.safetensors */ewc/*_{}/*/task_1.safetensors"


@dataclass(frozen=True)
class Check:
    """A command of bash, which is run in the folder, the seconds that it may take, and what it should print."""

    name: str
    seconds: int
    command: str
    expected: str


CHECKS = [
    Check(
        "machine",
        120,
        "libero doctor --gpu",
        "status 0; several processes draw on the GPU, a frame below 2 ms",
    ),
    Check(
        "demonstrations",
        150,
        "for n in 1 4 16; do timeout 45 libero demos generate --task libero_object/0 --n $n --workers $n "
        "--folder demos_$n || exit 1; done",
        "15 s each at most; where one hangs, the driver does in many processes at once: --workers 1",
    ),
    Check(
        "tests",
        300,
        f"{PYTHON} -m pytest -q -m gpu {ROOT}/tests/lifelong",
        "all pass: every algorithm learns as on the CPU, batches and memories are the CPU's",
    ),
    Check("late", 60, f"{LEARNING} late", "0: copies to the host are not read before they are there"),
    Check("waits", 60, f"{LEARNING} step preset=paper", "no waits"),
    Check("waits_libero", 60, f"{LEARNING} step preset=paper,compat=libero", "no waits"),
    Check(
        "speed",
        270,
        f"{BENCHMARKS}/training_speed.py --variants fp32 bf16 bf16_contiguous bf16_compiled bf16_graphs --profile",
        "bf16 25 to 40 ms a step; contiguous up to a fifth faster; compiled 20 to 25 ms; at most 12 GiB",
    ),
    Check("paper", 150, f"{PAPER} run_id=1", "epochs of 7 s (task 1) and 14 s (task 2)"),
    Check(
        "paper_libero",
        150,
        f"{PAPER} run_id=2 augmentation=libero policy.encoder.norm=batch train.precision=fp32",
        "epochs of 8 and 16 s",
    ),
    Check(
        "deterministic",
        120,
        f"{SMOKE} run_id=3 && {SMOKE} run_id=4 && {SAME.format(4)}",
        "the same checkpoints; or an error that names an operation without a deterministic kernel",
    ),
    Check(
        "killed",
        120,
        f"timeout -s KILL 25 {SMOKE} run_id=5; {SMOKE} run_id=5 && {SAME.format(5)}",
        "the same checkpoints as without the kill",
    ),
    Check(
        "rollouts",
        180,
        "libero eval */er/*_1 --suite libero_object/0 --episodes 20 --horizon 300 --device cuda",
        "25 ms a step of 20 simulations, two thirds of it drawing",
    ),
    Check(
        "warp_motion",
        300,
        f"{WARP} motion --backend warp --out motion.jsonl",
        "below 1e-5 rad; compiles for 3 minutes",
    ),
    Check(
        "warp_expert",
        120,
        f"{WARP} expert --backend warp --starts 25 --out expert.jsonl",
        "98 of 100 or more",
    ),
    Check(
        "warp_speed",
        240,
        f"{BENCHMARKS}/gpu.py --worlds 1 64 1024 2048 --steps 10",
        "7 to 12 ms a step up to 64 simulations; 2048 without pictures 70 to 130 ms, with them 300 to 500 ms",
    ),
]


@dataclass(frozen=True)
class Outcome:
    """What became of a check: `ok`, `failed` with its status, or `timeout`; the seconds, and the last line printed."""

    name: str
    outcome: str
    seconds: float
    last: str
    device: str


def execute(check: Check, folder: Path) -> Outcome:
    """Run a check in the folder, with all that it starts ended after its time."""
    began, output = time.perf_counter(), folder / f"{check.name}.txt"
    limited = ["timeout", "--kill-after=5", str(check.seconds), "bash", "-c", check.command]
    with open(output, "w", encoding="utf-8") as file:
        commands = f"{Path(sys.executable).parent}:{os.environ['PATH']}"  # where `libero` is
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "PATH": commands}
        status = subprocess.run(
            limited, cwd=folder, env=environment, stdout=file, stderr=subprocess.STDOUT, check=False
        ).returncode
    lines = output.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    outcome = {0: "ok", 124: "timeout", 137: "timeout"}.get(status, f"failed ({status})")
    seconds = round(time.perf_counter() - began, 1)
    return Outcome(check.name, outcome, seconds, lines[-1] if lines else "", torch.cuda.get_device_name())


def read(path: Path) -> dict[str, Outcome]:
    """Return the latest outcome of each check in a file, which may be absent or end in half a line."""
    found = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            outcome = Outcome(**json.loads(line))
        except ValueError:
            continue
        found[outcome.name] = outcome
    return found


def table(outcomes: dict[str, Outcome]) -> str:
    """Return the outcomes and the expectations side by side."""
    rows = ["| check | outcome | s | last line | expected |", "|---|---|---:|---|---|"]
    for check in CHECKS:
        done = outcomes.get(check.name, Outcome(check.name, "not run", 0.0, "", ""))
        last = done.last.replace("|", "/")[:80]
        rows.append(f"| {check.name} | {done.outcome} | {done.seconds:.0f} | {last} | {check.expected} |")
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--folder", type=Path, default=Path("runs/first_gpu"), help="where everything is written"
    )
    parser.add_argument("--only", nargs="+", choices=[c.name for c in CHECKS], help="some checks, run again")
    parser.add_argument("--table", action="store_true", help="print the table of what has been run")
    args = parser.parse_args()
    results = args.folder.resolve() / "results.jsonl"
    if not args.table:
        if not torch.cuda.is_available():
            sys.exit(f"error: PyTorch {torch.__version__} finds no GPU, which every check needs")
        results.parent.mkdir(parents=True, exist_ok=True)
        done = read(results)
        for check in CHECKS:
            again = (
                check.name in args.only if args.only else getattr(done.get(check.name), "outcome", "") != "ok"
            )
            if not again:
                continue
            print(f"{check.name}: at most {check.seconds} s; expected: {check.expected}", flush=True)
            outcome = execute(check, results.parent)
            print(f"  {outcome.outcome} after {outcome.seconds} s: {outcome.last}", flush=True)
            with open(results, "a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(outcome)) + "\n")
    print(table(read(results)))


if __name__ == "__main__":
    main()
