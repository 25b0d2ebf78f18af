"""Does a policy that succeeds at times learn from its own episodes? Success over the iterations of `learner=grpo`.

python experiments/reward/pilot.py run --runs runs/reward     # what is missing, one core a seed; records/ keeps it
python experiments/reward/pilot.py                            # the table, of what is kept
"""

import argparse
import lzma
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from lifelong.results.log import ResultLog
from lifelong.results.records import CollectionRecord, EvalRecord

ROOT = Path(__file__).parents[2]
RECORDS = Path(__file__).parent / "records"
START = Path(__file__).parent / "start.safetensors"  # kept, as other processors learn other weights
SEEDS = (1, 2)
SHARED = (
    "benchmark=libero_goal",
    "threads=1",
    "eval.sim_threads=1",
    "eval.record_every=0",
    "eval.beside=false",
    "eval.horizon=160",
)
# all ten goals together, and so few steps that each is solved at times
BASE = (
    "algo=multitask",
    "data.demos=5",
    "train.epochs=5",
    "train.steps_per_epoch=30",
    "eval.episodes=20",
    "eval.curve=none",
)
LEARNED = (
    *("learner=grpo", "learner.processes=1", "algo=sequential", "benchmark.tasks=[6]", "data.demos=1"),
    *("eval.episodes=10", "eval.curve=all", "eval.curve_episodes=40", "eval.every=10", "eval.select=last"),
)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", nargs="?", choices=["run"])
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "reward")
    args = parser.parse_args()
    if args.what == "run":
        make_start(args.runs.resolve())
        with ThreadPoolExecutor(len(SEEDS)) as pool:
            for _ in pool.map(partial(learn, args.runs.resolve()), SEEDS):
                pass
    print("\n".join(table()))


def make_start(runs: Path) -> None:
    """Learn the weights that all runs begin with, if they are not kept."""
    if not START.exists():
        made = train(runs, "start", BASE)
        keep(made, "start")
        shutil.copyfile(made / "checkpoints" / "task_9.safetensors", START)


def learn(runs: Path, seed: int) -> None:
    """Learn with a seed, and keep the records."""
    name = f"pilot_seed{seed}"
    keep(train(runs, name, (*LEARNED, f"seed={seed}", f"init_from={START}")), name)


def keep(run: Path, name: str) -> None:
    """Keep a run's records under a name."""
    RECORDS.mkdir(exist_ok=True)
    packed = lzma.compress((run / "results.jsonl").read_bytes(), preset=9)
    (RECORDS / f"{name}.jsonl.xz").write_bytes(packed)


def train(runs: Path, name: str, words: tuple[str, ...]) -> Path:
    """Make a run, or go on with it, and return its directory."""
    command = [sys.executable, str(ROOT / "train.py"), *SHARED, *words, f"run_id={name}", f"runs_dir={runs}"]
    subprocess.run(command, check=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    (log,) = runs.glob(f"*/*/*{name}/results.jsonl")
    return log.parent


def table() -> list[str]:
    """Return the lines of the table: ten iterations a row, of each seed."""
    lines = [
        "| seed | iterations | drawn | groups with spread | entropy | steps/s | mean actions, after them |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    for file in sorted(RECORDS.glob("pilot_seed*.jsonl.xz")):
        seed = file.name.removeprefix("pilot_seed").partition(".")[0]
        with lzma.open(file) as packed:
            log = file.with_suffix("")
            log.write_bytes(packed.read())
        results = ResultLog(log).read()
        log.unlink()
        collected = results.of(CollectionRecord)
        curve = {r.epoch: sum(r.successes) for r in results.of(EvalRecord) if r.phase == "curve"}
        lines.append(f"| {seed} | before | | | | | {curve[0]} of 40 |")
        for last in sorted(curve)[1:]:
            rows = [r for r in collected if last - 10 < r.epoch <= last]
            drawn = sum(r.successes for r in rows) / sum(r.episodes for r in rows)
            groups = sum(r.groups for r in rows) / len(rows)
            entropy = sum(r.entropy for r in rows) / len(rows)
            speed = sum(r.steps for r in rows) / sum(r.seconds for r in rows)
            cells = (f"{drawn:.0%}", f"{groups:.1f} of 16", f"{entropy:.2f}", f"{speed:.0f}")
            lines.append(f"| | to {last} | {' | '.join(cells)} | {curve[last]} of 40 |")
    return lines


if __name__ == "__main__":
    main()
