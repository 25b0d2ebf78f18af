"""Does a policy forget less by learning from its own success than from demonstrations, at equal gain?

python experiments/reward/experiment.py run --runs runs/reward --jobs 2   # what is missing; records/ keeps it
python experiments/reward/experiment.py                                   # the tables, of what is kept

README.md has the plan. A run is one process on one thread; a killed one goes on.
"""

import argparse
import json
import lzma
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pilot import RECORDS, ROOT, START, make_start, train
from scipy.stats import spearmanr

from lifelong.results.log import ResultLog
from lifelong.results.records import EvalRecord
from lifelong.results.results import Results
from lifelong.stats.intervals import mean_and_half_width

KNOWN = (1, 2, 4, 5, 8)  # goals that the start solves in 45 to 80 % of 20, and that are never trained again
NEW = {
    1: (6, 9, 7),
    2: (9, 7, 6),
    3: (7, 6, 9),
}  # goals that it solves in 25 to 35 %, in the order of each seed
ITERATIONS = 12
STREAM = (
    *("data.demos=20", "eval.episodes=20", "eval.cells=diagonal_and_last_row", "eval.curve=all"),
    *("eval.curve_episodes=30", "eval.select=last", "eval.reuse=true", "policy.stochastic=true"),
)
REWARD = ("learner=grpo", "learner.processes=1", f"train.epochs={ITERATIONS}", f"eval.every={ITERATIONS}")
CLONED = ("train.steps_per_epoch=10", "train.epochs=40", "eval.every=1")
SLOW = ("train.lr=1e-4", "train.lr_min=1e-4", "train.warmup_steps=0", "train.grad_clip=1.0")
ADAPTER = ("algo=lora_one", "algo.base_tasks=0")
ARMS = {
    "reward": ("algo=sequential", *REWARD),
    "reward, one adapter": (*ADAPTER, *REWARD, "train.lr=1e-3", "train.lr_min=1e-3"),
    "demonstrations": ("algo=sequential", *CLONED),
    "demonstrations, one adapter": (*ADAPTER, *CLONED),
    "demonstrations, 2 % replayed": ("algo=er", "algo.memory.budget=300", *CLONED),
    "demonstrations, slowly": ("algo=sequential", *CLONED, *SLOW, "train.steps_per_epoch=50"),
}


@dataclass(frozen=True)
class Planned:
    """A run: an arm with a seed."""

    arm: str
    seed: int

    @property
    def name(self) -> str:
        """Its name, of its directory and its record."""
        return f"{self.arm.replace(',', '').replace(' %', '').replace(' ', '_')}_seed{self.seed}"

    @property
    def record(self) -> Path:
        """File that keeps its records and its diagnosis."""
        return RECORDS / f"{self.name}.json.xz"

    def make(self, runs: Path) -> None:
        """Make the run, diagnose it, and keep what came of it."""
        tasks = (*KNOWN, *NEW[self.seed])
        reached = [1.0] * len(NEW[self.seed])  # GRPO makes all its iterations, unless nothing fails
        if self.arm != "reward" and not self.arm.startswith("reward,"):
            reached = [rate for _, rate in Kept(Planned("reward", self.seed)).gains]
        until = ",".join(map(str, (*[0.0] * len(KNOWN), *reached)))
        words = (
            f"benchmark.tasks=[{','.join(map(str, tasks))}]",
            f"eval.until=[{until}]",
            f"init_from={START}",
        )
        seeds = (f"seed={self.seed}", f"data.seed={self.seed}")
        directory = train(runs, self.name, (*STREAM, *ARMS[self.arm], *words, *seeds))
        command = [sys.executable, "-m", "libero_cli", "diagnose", str(directory), "--held-out", "10"]
        subprocess.run(command, check=True, cwd=ROOT)
        content = {name: (directory / name).read_text() for name in ("results.jsonl", "diagnosis.json")}
        RECORDS.mkdir(exist_ok=True)
        self.record.write_bytes(lzma.compress(json.dumps(content).encode(), preset=9))


@dataclass(frozen=True)
class Kept:
    """What is kept of a finished run."""

    run: Planned

    @cached_property
    def content(self) -> dict[str, str]:
        """Its files by name."""
        return json.loads(lzma.decompress(self.run.record.read_bytes()))

    @cached_property
    def results(self) -> Results:
        """Its records."""
        with tempfile.TemporaryDirectory() as scratch:
            log = Path(scratch) / "results.jsonl"
            log.write_text(self.content["results.jsonl"])
            return ResultLog(log).read()

    @cached_property
    def diagnosis(self) -> dict[str, Any]:
        """Its diagnosis."""
        return json.loads(self.content["diagnosis.json"])

    @cached_property
    def gains(self) -> list[tuple[float, float]]:
        """Success on each new goal before and after learning it, 30 starts."""
        curves = [r for r in self.results.of(EvalRecord) if r.phase == "curve" and r.task >= len(KNOWN)]
        points = [[r.rate for r in curves if r.task == task] for task in sorted({r.task for r in curves})]
        return [(found[0], found[-1]) for found in points]

    @cached_property
    def lost(self) -> float:
        """Mean success on the known goals before the new ones less that after all of them, 20 starts each."""
        matrix, _ = self.results.success_matrix()
        known = range(len(KNOWN))
        return float(np.mean([matrix[task, task] - matrix[-1, task] for task in known]))

    @cached_property
    def outcomes(self) -> dict[str, float]:
        """What the tables have of it; shares of success in points."""
        matrix, _ = self.results.success_matrix()
        before, after = np.mean(self.gains, axis=0)
        first, second = len(KNOWN), len(KNOWN) + 1
        moved = [one["kl"] for one in self.diagnosis["moved"] if one["task"] >= len(KNOWN)]
        drifts = {
            place: float(np.mean([d["relative"] for d in self.diagnosis["drifts"]
                                  if d["place"] == place and d["task"] < len(KNOWN)]))
            for place in ("features", "latents", "actions")
        }  # fmt: skip
        return {
            "gained": 100 * (after - before),
            "lost of the known": 100 * self.lost,
            "lost of the new": 100 * float(np.mean([matrix[k, k] - matrix[-1, k] for k in (first, second)])),
            "KL, nats": float(np.sum(moved)),
            **{f"drift of {place}": value for place, value in drifts.items()},
            "updates": sum(self.results.costs(task).get("updates", 0.0) for task in range(len(matrix))),
            "hours": sum(self.results.seconds_by_phase().values()) / 3600,
        }


def runs() -> list[Planned]:
    """Return all runs, in the order in which they are made: seed after seed, that which others wait for first."""
    return [Planned(arm, seed) for seed in NEW for arm in ARMS]


def table() -> list[str]:
    """Return the lines of the tables: means of each arm with Student's interval over seeds, and the correlation."""
    kept = {arm: [Kept(run) for run in runs() if run.arm == arm and run.record.exists()] for arm in ARMS}
    found = {arm: [one.outcomes for one in ones] for arm, ones in kept.items() if ones}
    if not found:
        return ["no run is kept"]
    names = list(next(iter(found.values()))[0])
    lines = ["| | seeds | " + " | ".join(names) + " |", "|---|---:|" + "---:|" * len(names)]
    for arm, rows in found.items():
        cells = [_cell([row[name] for row in rows]) for name in names]
        lines.append(f"| {arm} | {len(rows)} | " + " | ".join(cells) + " |")
    every = [row for rows in found.values() for row in rows]
    if len(every) > 3:
        rank = spearmanr([r["KL, nats"] for r in every], [r["lost of the known"] for r in every]).statistic
        lines += [
            "",
            f"Rank correlation of KL and success lost on the known goals, {len(every)} runs: {rank:.2f}.",
        ]
    return lines


def _cell(values: Sequence[float]) -> str:
    mean, half = mean_and_half_width(np.array(values))
    return f"{mean:.3g}" + (f" ± {half:.2g}" if np.isfinite(half) else "")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", nargs="?", choices=["run"])
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "reward")
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    if args.what == "run":
        folder = args.runs.resolve()
        make_start(folder)
        missing = [run for run in runs() if not run.record.exists()]
        for first in (True, False):  # the supervised arms stop where the first has come
            with ThreadPoolExecutor(args.jobs) as pool:
                chosen = [run for run in missing if (run.arm == "reward") == first]
                for _ in pool.map(lambda run: run.make(folder), chosen):
                    pass
    print("\n".join(table()))


if __name__ == "__main__":
    main()
