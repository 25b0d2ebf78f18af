"""The study of algorithms, in pieces: run what is missing, keep all outcomes, write tables and pictures.

    python experiments/algorithms/study.py list                # each run: done or missing, its cost, its command
    python experiments/algorithms/study.py run --minutes 120   # go on with what is missing, until it is stopped
    python experiments/algorithms/study.py report              # tables and pictures of what is finished
    python experiments/algorithms/table.py                     # puts the tables into README.md

plan.md has what is to be run; README.md what came of it. A run is a process of its own on one thread. One that was
stopped goes on where it was; of a finished one the records are kept in records/, compressed. All methods are run with
one seed before the next, so that what is finished can be compared at any time. Records of another configuration than
today's count as missing.
"""

import argparse
import json
import lzma
import math
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import chdir
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml
from hydra import compose, initialize_config_dir

from libero_env.storage import atomic_path
from lifelong.composition import config_folder
from lifelong.data.demonstrations import find_demos
from lifelong.report.comparison import Plan
from lifelong.report.page import write_report
from lifelong.results.log import ResultLog
from lifelong.results.provenance import result_relevant
from lifelong.results.shifts import shift_scores
from lifelong.settings import Configuration, plain_data

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
RECORDS = HERE / "records"
REFERENCES = ("er", "sequential", "single_task")  # that each other method is compared with
# an order of the tasks and demonstrations for each seed: what they do is in the differences between seeds
BY_SEED = ("seed", "benchmark.order_seed", "data.seed")
SETTINGS = ("threads=1", "eval.sim_threads=1", "progress=false")
WINDOW = 64 * 64 * 3 * 2 + 4 * (7 + 2 + 3 + 7)  # bytes: two images, readings and the action


@dataclass(frozen=True)
class Study:
    """Methods that are compared with each other.

    Args:
        name: Its folder beside this file, and the first part of its runs' names.
        methods: What the command of each has, by its name in tables, in the order in which they are run.
        seeds: Number of seeds of each.
        overrides: What all its commands have.
        shifts: Perturbations under which finished runs are evaluated besides, each alone.
        shifted: The methods of which they are.
    """

    name: str
    methods: Mapping[str, tuple[str, ...]]
    seeds: int
    overrides: tuple[str, ...]
    shifts: tuple[str, ...] = ()
    shifted: tuple[str, ...] = ()


def _plain(*algorithms: str) -> dict[str, tuple[str, ...]]:
    return {name: (f"algo={name}",) for name in algorithms}


def _memories(megabytes: float) -> dict[str, tuple[str, ...]]:
    """Replay of windows as they are and compressed, in as many bytes."""
    size = int(megabytes * 1e6)
    return {
        f"er {megabytes:g} MB": ("algo=er", f"algo.memory.budget={size // WINDOW}"),
        f"compressed_er {megabytes:g} MB": ("algo=compressed_er", f"algo.budget={size}"),
    }


LONG = (
    *("benchmark=libero_130", "data.demos=10", "train.steps_per_epoch=75", "eval.episodes=1"),
    *("eval.cells=sampled", "eval.cells_share=0.02", "eval.curve=none", "eval.horizon=300"),
)
SMALL = ("train.steps_per_epoch=75", "eval.episodes=10")
SAMPLED = ("eval.every=8", "eval.cells=sampled", "eval.cells_share=0.3")
ENDS = ("eval.cells=diagonal_and_last_row", "eval.curve=none")  # just learned and final; neither NBT nor AUC
BRIEF = (  # of which only costs are read
    *("benchmark=libero_goal", "benchmark.tasks=3", "data.demos=20"),
    *("train.epochs=2", "train.steps_per_epoch=75", "eval.episodes=1"),
    *("eval.cells=diagonal_and_last_row", "eval.curve=none", "eval.horizon=10"),
)
ALL = sorted(file.stem for file in (config_folder() / "algo").glob("*.yaml"))
GOAL = ("benchmark=libero_goal", "data.demos=20", "eval.horizon=240", *SMALL)
TEN = ("sequential", "er", "packnet", "lora", "single_task", "ewc", "iscil", "dmpel", "derpp", "multitask")
STUDIES = (
    Study(
        "goal",
        _plain(*TEN),
        5,
        (*GOAL, *SAMPLED),
        shifts=("instruction=0.6", "camera=0.2"),
        shifted=("er", "lora", "iscil", "dmpel"),
    ),
    Study(
        "memory",
        {name: words for size in (0.1, 1.0, 10.0) for name, words in _memories(size).items()},
        3,
        (*GOAL, *ENDS),
    ),
    Study(
        "ten_demonstrations",
        _plain("sequential", "er", "packnet", "lora", "single_task", "iscil"),
        3,
        ("benchmark=libero_object", "data.demos=10", *SMALL, *SAMPLED),
    ),
    Study(
        "libero_130",
        {
            **_plain("sequential", "er", "compressed_er", "lora"),
            "packnet": ("algo=packnet", "algo.prune_perc=0.98"),
        },
        1,
        LONG,
    ),
    Study("costs", _plain(*ALL), 1, BRIEF),
)


@dataclass(frozen=True)
class Planned:
    """A run of the study."""

    study: Study
    method: str
    seed: int

    @property
    def name(self) -> str:
        """Its name in lists."""
        return f"{self.study.name}/{self.method.replace(' ', '_')}/seed{self.seed}"

    @property
    def overrides(self) -> list[str]:
        """What its command has beyond `python train.py`."""
        seeds = (f"{key}={self.seed}" for key in BY_SEED)
        return [*self.study.methods[self.method], *self.study.overrides, *seeds, *SETTINGS]

    @property
    def record(self) -> Path:
        """File that keeps its configuration and its records."""
        return RECORDS / f"{self.name}.json.xz"

    @cached_property
    def config(self) -> dict[str, Any]:
        """Its configuration as it is today."""
        with initialize_config_dir(str(config_folder()), version_base="1.3"):
            return plain_data(compose("config", self.overrides))

    def is_done(self) -> bool:
        """Return whether there are records, of today's configuration."""
        if not self.record.exists():
            return False
        was, now = (  # a saved configuration also names how pictures were drawn
            {k: v for k, v in result_relevant(config).items() if v is not None and k != "data.drawing"}
            for config in (yaml.safe_load(_read(self.record)["config"]), self.config)
        )
        return was == now

    def missing(self) -> list[str]:
        """Return the shifts that it was not evaluated under; before them "" if the run itself is missing."""
        shifts = self.study.shifts if self.method in self.study.shifted else ()
        if not self.is_done():
            return ["", *shifts]
        with tempfile.TemporaryDirectory() as scratch:
            found = shift_scores(ResultLog(self.unpack(Path(scratch)) / "results.jsonl").read())
        measured = {score.shift for score in found if not math.isnan(score.success("final_shifted").value)}
        return [shift for shift in shifts if shift not in measured]

    def keep(self, directory: Path) -> None:
        """Keep the records of a finished run."""
        there = {name: directory / file for name, file in FILES.items() if (directory / file).is_file()}
        content = {name: path.read_text(encoding="utf-8") for name, path in there.items()}
        content["config"] = re.sub(r"(?m)^runs_dir: .*", "runs_dir: runs", content["config"])  # anyone's
        self.record.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(self.record) as part:
            part.write_bytes(lzma.compress(json.dumps(content).encode(), preset=9))

    def unpack(self, folder: Path) -> Path:
        """Write the kept records as a run's directory, and return it."""
        directory = folder / self.name
        directory.mkdir(parents=True)
        for name, text in _read(self.record).items():
            (directory / FILES[name]).write_text(text, encoding="utf-8")
        return directory


FILES = {"config": "config.yaml", "records": "results.jsonl", "relearning": "relearning.jsonl"}


def _read(record: Path) -> dict[str, str]:
    return json.loads(lzma.decompress(record.read_bytes()))


def planned() -> list[Planned]:
    """Return all runs, in the order in which they are made: seed after seed."""
    return [
        Planned(study, method, seed)
        for seed in range(1, max(study.seeds for study in STUDIES) + 1)
        for study in STUDIES
        if seed <= study.seeds
        for method in study.methods
    ]


def show(runs: Sequence[Planned]) -> None:
    """Print each run, and how long the missing ones take if they cost what those of the same algorithm did."""
    hours: dict[tuple[str, str], list[float]] = {}
    missing = []
    for run in runs:
        if run.is_done():
            spent = _hours(run)
            hours.setdefault((run.study.name, run.method), []).append(spent)
            print(f"done     {60 * spent:4.0f} min  python train.py {shlex.join(run.overrides)}")
        else:
            missing.append(run)
    for run in missing:
        print(f"missing            python train.py {shlex.join(run.overrides)}")
    known = [h for spent in hours.values() for h in spent]
    if missing and known:
        mean = sum(known) / len(known)
        left = sum(_mean(hours.get((run.study.name, run.method))) or mean for run in missing)
        print(
            f"{len(runs) - len(missing)} of {len(runs)} runs are done; the others take about {left:.0f} core hours"
        )


def _hours(run: Planned) -> float:
    """Return the wall time of a kept run, [h]."""
    with tempfile.TemporaryDirectory() as scratch:
        results = ResultLog(run.unpack(Path(scratch)) / "results.jsonl").read()
        return sum(results.seconds_by_phase().values()) / 3600


def _mean(values: Sequence[float] | None) -> float | None:
    return sum(values) / len(values) if values else None


def make(runs: Sequence[Planned], folder: Path, minutes: float, jobs: int) -> int:
    """Make the missing runs, several at a time, until the time is over.

    Returns:
        Number of runs that failed.
    """
    waiting = [(run, parts) for run in runs if (parts := run.missing())]
    end, failed = time.monotonic() + 60 * minutes, 0
    active: dict[subprocess.Popen[bytes], tuple[Planned, list[str]]] = {}
    try:
        while True:
            while len(active) < jobs and time.monotonic() < end and waiting:
                run, parts = waiting.pop(0)
                active[_start(run, parts[0], folder)] = run, parts
            if not active or time.monotonic() > end:
                return failed
            for process in [p for p in active if p.poll() is not None]:
                run, (part, *others) = active.pop(process)
                directory = _directory(run, folder)
                if process.returncode == 0 and directory is not None:
                    run.keep(directory)
                    print(f"{time.strftime('%H:%M')} done: {run.name} {part}", flush=True)
                    if others:
                        waiting.insert(0, (run, others))
                else:
                    failed += 1
                    print(f"{time.strftime('%H:%M')} failed: {_log(run, folder)}", flush=True)
            time.sleep(1)
    finally:
        for process in active:
            process.send_signal(signal.SIGTERM)  # the records stay; the same command goes on
        for process in active:
            process.wait()


def _start(run: Planned, shift: str, folder: Path) -> "subprocess.Popen[bytes]":
    _demonstrations(run)
    words = [*run.overrides, *([f"eval.shift='{shift}'"] if shift else []), f"runs_dir={folder / run.name}"]
    command = [sys.executable, str(ROOT / "train.py"), *words]
    log = _log(run, folder)
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as out:
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        return subprocess.Popen(command, cwd=folder, env=environment, stdout=out, stderr=subprocess.STDOUT)


def _demonstrations(run: Planned) -> None:
    """Record the demonstrations that are missing, before several runs would each do so."""
    config = Configuration(run.config)
    benchmark, data = config.build("benchmark"), config.build("data")
    tasks = benchmark.sequence()
    find_demos(tasks, [data.demos] * len(tasks), data, progress=False)


def _directory(run: Planned, folder: Path) -> Path | None:
    return next((file.parent for file in (folder / run.name).glob("*/*/*/config.yaml")), None)


def _log(run: Planned, folder: Path) -> Path:
    return folder / "logs" / f"{run.name.replace('/', '_')}.txt"


def report(runs: Sequence[Planned]) -> None:
    """Write a comparison of the finished runs of each study beside this file."""
    for study in STUDIES:
        found = [run for run in runs if run.study == study and run.is_done()]
        if not found:
            continue
        references = tuple(name for name in REFERENCES if name in study.methods)
        with (
            tempfile.TemporaryDirectory() as scratch,
            chdir(scratch),
        ):  # runs are named relative to their page
            write_report([run.unpack(Path()) for run in found], Path("report.html"), Plan(references))
            (HERE / study.name).mkdir(exist_ok=True)
            for file in Path().glob("*.*"):
                shutil.move(file, HERE / study.name / file.name)
        print(f"{len(found)} runs: {HERE / study.name / 'report.html'}")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("list", "run", "report"))
    parser.add_argument("--minutes", type=float, default=float("inf"), help="then what runs is stopped")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="runs at a time")
    parser.add_argument(
        "--runs", type=Path, default=ROOT / "runs" / "study", help="folder of unfinished runs"
    )
    parser.add_argument(
        "--only", nargs="+", default=[], help="words that a run's name contains, such as /er/ or seed1"
    )
    args = parser.parse_args()
    runs = [run for run in planned() if all(word in f"{run.name}/" for word in args.only)]
    if args.what == "run":
        signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))  # and end what runs
        args.runs.mkdir(parents=True, exist_ok=True)
        return int(make(runs, args.runs.resolve(), args.minutes, args.jobs) > 0)
    show(runs) if args.what == "list" else report(runs)
    return 0


if __name__ == "__main__":
    sys.exit(main())
