"""The same sweep under every launcher: the numbers, a job that fails, and a parent that is killed at random moments.

    python experiments/sweeps/launchers.py                             # basic, joblib, submitit_local
    python experiments/sweeps/launchers.py ray --address HOST:PORT     # on a Ray cluster that is there
    python experiments/sweeps/launchers.py joblib --kills 10

Two algorithms and three learning rates, one of which is refused: six jobs, four of which learn a task for a few steps.
Every launcher has a folder of its own, which is kept: a comparison that was stopped goes on. Exit status 1 where
numbers differ.
"""

import argparse
import json
import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
TINY = "preset=smoke benchmark=libero_object benchmark.tasks=1 threads=1 data.demos=2 train.epochs=1 "
TINY += "train.warmup_steps=0 "
TINY += "train.steps_per_epoch=2 train.batch_size=4 eval.curve=none eval.select=last eval.horizon=8 eval.episodes=2"
SWEPT = ("algo=sequential,er", "train.lr=1e-3,-1,1e-4")
EXPECTED = ["done", "failed", "done"] * 2
LAUNCHERS = {
    "basic": (),
    "joblib": ("hydra/launcher=workstation", "hydra.launcher.n_jobs=2"),
    "submitit_local": ("hydra/launcher=submitit_local",),
    "ray": (
        "hydra/launcher=ray_cluster",
        "hydra.launcher.ray.remote.num_cpus=1",
        "hydra.launcher.ray.remote.num_gpus=0",
    ),
}


class Launch:
    """A sweep under a launcher.

    Args:
        name: One of `LAUNCHERS`.
        home: Folder of demonstrations and of the launchers' folders.
        address: Address of a Ray cluster.
    """

    def __init__(self, name: str, home: Path, address: str):
        self.name, self.home, self.runs = name, home, home / name
        own = (f"hydra.launcher.ray.init.address='{address}'",) if name == "ray" else ()
        words = [*TINY.split(), *LAUNCHERS[name], *own, *SWEPT, f"runs_dir={self.runs}"]
        self.command = [sys.executable, str(ROOT / "train.py"), "-m", *words]

    def start(self) -> "subprocess.Popen[bytes]":
        """Start the sweep; its output is in a file beside its folder."""
        self.home.mkdir(parents=True, exist_ok=True)
        environment = os.environ | {"LIBERO_DEMOS": str(self.home / "demos"), "OMP_NUM_THREADS": "1"}
        with (self.home / f"{self.name}.txt").open("ab") as out:
            return subprocess.Popen(
                self.command, env=environment, cwd=self.home, stdout=out, stderr=subprocess.STDOUT
            )

    def jobs(self) -> list[dict[str, Any]]:
        """Return the records of the jobs, by number."""
        found = [json.loads(file.read_text()) for file in self.runs.glob("sweep/*/jobs/*/job.json")]
        return sorted(found, key=lambda record: record["number"])

    def outcomes(self) -> dict[str, list[dict[str, Any]]]:
        """Return all losses and evaluations of each run, without times."""
        found = {}
        for file in sorted(self.runs.rglob("results.jsonl")):
            records = [json.loads(line) for line in file.read_text().splitlines()]
            kept = [record for record in records if record["kind"] in ("loss", "eval")]
            name = str(file.parent.relative_to(self.runs))
            found[name] = [
                {k: v for k, v in record.items() if k not in ("seconds", "crc32")} for record in kept
            ]
        return found

    def compared(self) -> int:
        """Return the number of runs on the sweep's page; 0 without one."""
        pages = list(self.runs.glob("sweep/*/report.html"))
        learned = {record["run"] for record in self.jobs() if record["status"] == "done"}
        return len(learned) if len(pages) == 1 else 0


def check(launch: Launch, status: int, base: Launch) -> bool:
    """Print what became of a sweep beside that of the basic launcher, and return whether it is the same."""
    jobs, own, theirs = launch.jobs(), launch.outcomes(), base.outcomes()
    same = sum(own.get(name) == records for name, records in theirs.items() if records)
    numbers = sum(len(records) for records in own.values())
    statuses = [job["status"] for job in jobs]
    seconds = sum(job["seconds"] for job in jobs)
    places = sorted({f"{job['host']}:{job['pid']}" for job in jobs})
    print(
        f"{launch.name:15} exit status {status}, {statuses.count('done')} done, {statuses.count('failed')} failed, "
        f"{launch.compared()} compared; {same} runs with the same {numbers} records; {seconds:.0f} s in "
        f"{len(places)} processes",
        flush=True,
    )
    return status == 2 and statuses == EXPECTED and same == 4 == launch.compared() and own == theirs


def kill_often(launch: Launch, base: Launch, kills: int, longest: float, seed: int) -> bool:
    """Kill the parent of the sweep at random moments, starting it again each time; return whether it ends the same.

    Where it ends before it is killed, its folder is emptied and it starts anew.
    """
    rng, done, good = random.Random(seed), 0, True
    before: dict[int, str] = {}
    while done < kills:
        process, moment = launch.start(), rng.uniform(0, longest)
        try:
            status = process.wait(timeout=moment)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
            done += 1
            finished = {job["number"]: job["started"] for job in launch.jobs() if job["status"] == "done"}
            again = [number for number, started in before.items() if finished.get(number) != started]
            good &= not again
            print(
                f"kill {done}: after {moment:5.1f} s; done {sorted(finished)}"
                + (f"; RUN AGAIN: {again}" if again else ""),
                flush=True,
            )
            before = finished
        else:
            good &= check(launch, status, base)
            shutil.rmtree(launch.runs)
            before = {}
    return check(launch, launch.start().wait(), base) and good


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("launchers", nargs="*", help=f"of {', '.join(LAUNCHERS)} (default: all but ray)")
    parser.add_argument("--home", type=Path, default=ROOT / "runs" / "launchers")
    parser.add_argument("--address", default="auto", help="of the Ray cluster")
    parser.add_argument("--kills", type=int, default=0, help="how often the parent is killed")
    parser.add_argument("--longest", type=float, default=60.0, help="latest moment of a kill [s]")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    args = parser.parse_args()
    names = [name for name in args.launchers or ("joblib", "submitit_local") if name != "basic"]
    if unknown := set(names) - set(LAUNCHERS):
        parser.error(f"no launcher {', '.join(sorted(unknown))}; there are {', '.join(LAUNCHERS)}")
    home = args.home.resolve()
    base = Launch("basic", home, args.address)
    print(shlex.join(base.command), flush=True)
    good = check(base, base.start().wait(), base)
    for name in names:
        launch = Launch(name, home, args.address)
        if args.kills:
            shutil.rmtree(launch.runs, ignore_errors=True)
            good &= kill_often(launch, base, args.kills, args.longest, args.seed)
        else:
            good &= check(launch, launch.start().wait(), base)
    print("all the same" if good else "NOT the same")
    return int(not good)


if __name__ == "__main__":
    sys.exit(main())
