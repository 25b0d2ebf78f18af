"""What the default command costs, before and after a change: commits in turn on one machine, by phase.

    python experiments/benchmarks/main_job.py df545aa9 HEAD --rounds 3
    python experiments/benchmarks/main_job.py HEAD --rounds 1 benchmark.tasks=2 data.demos=4 train.epochs=1

Each run is `train.py algo=ewc benchmark=libero_object` in a checkout of its commit, with demonstrations of its own and
everything else cached. Wall time and processor time are of the whole process and its children; the seconds of a phase
are those that the run records, some of which pass beside each other. Results are kept in --out, and not run again.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[2]
PHASES = ("demonstrations", "training", "rollouts", "end of tasks")


def main() -> None:
    args = parse()
    args.out.mkdir(parents=True, exist_ok=True)
    measured = defaultdict(list)
    for number in range(args.rounds):
        for commit in args.commits[:: 1 if number % 2 else -1]:
            file = args.out / f"{commit}_{number}.json"
            if not file.exists():
                file.write_text(json.dumps(measure(commit, args.out / "work", args.overrides)))
            measured[commit].append(json.loads(file.read_text()))
    head = ("commit", "wall, s", "processor, s", *(f"{phase}, s" for phase in PHASES), "just learned", "end")
    print("| " + " | ".join(head) + " |\n|---" + "|---:" * (len(head) - 1) + "|")
    for commit in args.commits:
        rows = measured[commit]
        numbers = [f"{min(row[key] for row in rows):.0f}" for key in ("wall", "processor", *PHASES)]
        rates = [", ".join(f"{row[key]:.0%}" for row in rows) for key in ("just learned", "end")]
        print(f"| {commit} | " + " | ".join([*numbers, *rates]) + " |", flush=True)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("words", nargs="+", help="commits, then overrides with =")
    parser.add_argument("--rounds", type=int, default=3, help="the least of each column is printed")
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "main_job")
    args = parser.parse_intermixed_args()
    args.commits = [revision(word) for word in args.words if "=" not in word]
    args.overrides = [word for word in args.words if "=" in word]
    return args


def revision(word: str) -> str:
    command = ["git", "-C", str(ROOT), "rev-parse", "--short=8", word]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def measure(commit: str, folder: Path, overrides: list[str]) -> dict[str, float]:
    """Return the times, [s], and the success of one run."""
    checkout = folder / commit
    if not checkout.exists():
        command = ["git", "-C", str(ROOT), "worktree", "add", "--detach", str(checkout), commit]
        subprocess.run(command, check=True)
    scratch = folder / "run"
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    env = os.environ | {"LIBERO_DEMOS": str(scratch / "demos"), "PYTHONPATH": str(checkout)}
    env |= {
        "PYTHONDONTWRITEBYTECODE": "",
        "PYTHONPYCACHEPREFIX": str(folder / "bytecode"),
    }  # cached as elsewhere
    job = ["algo=ewc", "benchmark=libero_object", f"runs_dir={scratch / 'runs'}", *overrides]
    before, began = processor_time(), time.perf_counter()
    subprocess.run([sys.executable, str(checkout / "train.py"), *job], env=env, cwd=scratch, check=True)
    wall, processor = time.perf_counter() - began, processor_time() - before
    (log,) = scratch.rglob("results.jsonl")
    return {"wall": wall, "processor": processor, **phases(log)}


def processor_time() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def phases(log: Path) -> dict[str, float]:
    """Return the seconds of each phase that a run has recorded, and its success."""
    records = [json.loads(line) for line in log.read_text().splitlines()]
    seconds = dict.fromkeys(PHASES, 0.0)
    cells = {}
    for record in records:
        kind = record["kind"]
        if kind == "phase" and record["phase"] == "demos":
            seconds["demonstrations"] += record["seconds"]
        elif kind == "loss":
            seconds["training"] += record["seconds"]
        elif kind == "eval":
            seconds["rollouts"] += record["seconds"]
            if record["phase"] == "matrix":
                cells[record["learned"], record["task"]] = sum(record["successes"]) / len(record["successes"])
        elif kind == "cost":
            seconds["end of tasks"] += record["costs"].get("end_task_seconds", 0.0)
    last = max(learned for learned, _ in cells)
    just = [rate for (learned, task), rate in cells.items() if learned == task]
    end = [rate for (learned, _), rate in cells.items() if learned == last]
    return seconds | {"just learned": sum(just) / len(just), "end": sum(end) / len(end)}


if __name__ == "__main__":
    main()
