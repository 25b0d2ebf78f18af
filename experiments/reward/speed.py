"""How many control steps a second `learner=grpo` collects, and where an iteration's time goes.

python experiments/reward/speed.py --runs runs/speed     # two suites, one and two processes: 10 min

The policy is untrained, so all episodes have full length.
"""

import argparse
import os
import pstats
import shutil
import subprocess
import sys
from pathlib import Path

from lifelong.results.log import ResultLog
from lifelong.results.records import CollectionRecord, CostRecord, LossRecord

ROOT = Path(__file__).parents[2]
SETTINGS = (
    *(
        "learner=grpo",
        "algo=sequential",
        "train.epochs=1",
        "data.demos=1",
        "benchmark.tasks=[6]",
        "threads=1",
    ),
    *("eval.sim_threads=1", "eval.episodes=1", "eval.curve=none", "eval.select=last", "eval.record_every=0"),
    "progress=false",
)
PARTS = {  # of one process, by the function that has all of it
    "physics": ("simulation.py", "step"),
    "drawing": ("observations.py", "render_cameras"),
    "policy": ("experience.py", "act"),
    "all of the collection": ("experience.py", "collect"),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "speed")
    runs = parser.parse_args().runs.resolve()
    print("| suite | processes | control steps/s | collection, s | 32 steps of 512 frames, s | memory, GB |")
    print("|---|---:|---:|---:|---:|---:|")
    for suite in ("libero_object", "libero_goal"):
        for processes in (1, 2):
            print(iteration(runs, suite, processes))
    for suite in ("libero_object", "libero_goal"):
        print(f"{suite}, one process: {shares(runs / f'{suite}.prof')}")


def iteration(runs: Path, suite: str, processes: int) -> str:
    """Run one iteration, of one process with a profile, and return its row."""
    shutil.rmtree(runs / suite, ignore_errors=True)
    runs.mkdir(parents=True, exist_ok=True)
    profile = ("-m", "cProfile", "-o", str(runs / f"{suite}.prof")) if processes == 1 else ()
    words = (*SETTINGS, f"benchmark={suite}", f"learner.processes={processes}", f"runs_dir={runs}")
    command = [sys.executable, *profile, str(ROOT / "train.py"), *words]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=os.environ | {"OMP_NUM_THREADS": "1"})
    (log,) = runs.glob(f"{suite}/*/*/results.jsonl")
    results = ResultLog(log).read()
    (collected,), (learned,) = results.of(CollectionRecord), results.of(LossRecord)
    memory = max(r.costs.get("peak_memory_bytes", 0) for r in results.of(CostRecord)) / 1e9
    seconds = learned.seconds - collected.seconds
    rate = collected.steps / collected.seconds
    return f"| {suite} | {processes} | {rate:.0f} | {collected.seconds:.0f} | {seconds:.0f} | {memory:.1f} |"


def shares(profile: Path) -> str:
    """Return the share of the collection that each part takes."""
    found = pstats.Stats(str(profile)).stats  # type: ignore[attr-defined]
    spent = {
        part: max(value[3] for key, value in found.items() if key[0].endswith(file) and key[2] == name)
        for part, (file, name) in PARTS.items()
    }
    whole = spent.pop("all of the collection")
    return ", ".join(f"{part} {seconds / whole:.0%}" for part, seconds in spent.items())


if __name__ == "__main__":
    main()
