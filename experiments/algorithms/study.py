"""The study of algorithms, in pieces: run what is missing, keep all outcomes, write tables and pictures.

    python experiments/algorithms/study.py list                # each run: done or missing, its cost, its command
    python experiments/algorithms/study.py run --minutes 120   # go on with what is missing, until it is stopped
    python experiments/algorithms/study.py report              # tables and pictures of what is finished

plan.md has what is to be run. A run is a process of its own on one thread. One that was stopped goes on where it was;
of a finished one the records are kept in records/, compressed. All methods are run with one seed before the next, so
that what is finished can be compared at any time. Records of another configuration than today's count as missing.
"""

import argparse
import copy
import json
import lzma
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
from functools import cache, cached_property
from itertools import product
from pathlib import Path
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from libero_env.storage import atomic_path
from lifelong.composition import config_folder
from lifelong.data.demonstrations import find_demos
from lifelong.report.comparison import Plan
from lifelong.report.page import write_report
from lifelong.results.log import ResultLog
from lifelong.results.provenance import result_relevant
from lifelong.settings import Configuration, plain_data

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
RECORDS = HERE / "records"
SETTINGS = ("threads=1", "eval.sim_threads=1", "eval.beside=false", "progress=false")
Draws = tuple[int, int, int]  # seeds of learning, of the order of tasks, and of the demonstrations


@dataclass(frozen=True)
class Method:
    """A method as a study runs it.

    Args:
        overrides: What its command has.
        seeds: Number of seeds, each with an order of the tasks and demonstrations of its own.
    """

    overrides: str
    seeds: int = 3


@dataclass(frozen=True)
class Study:
    """Methods that are compared with each other.

    Args:
        name: The first part of its runs' names.
        overrides: What all its commands have.
        methods: By their names in tables, in the order in which they are run.
        draws: Seeds of each run in their order, beside those of the methods.
    """

    name: str
    overrides: str
    methods: Mapping[str, Method]
    draws: tuple[Draws, ...] = ()


WINDOWS = 18_900  # of all ten tasks, about: what a share of them is in windows
FLAT = 1_063  # bytes of a compressed window, about


def _er(percent: float, seeds: int = 3, batch: int = 32) -> Method:
    """Replay of a share of all windows; half of a step's windows are replayed."""
    budget = round(WINDOWS * percent / 100)
    return Method(f"algo=er algo.memory.budget={budget} train.batch_size={batch}", seeds)


def _compressed(percent: float, seeds: int = 3) -> Method:
    budget = round(WINDOWS * FLAT * percent / 100_000) * 1000
    return Method(f"algo=compressed_er algo.budget={budget} train.batch_size=32", seeds)


def _rank(algorithm: str, rank: int, seeds: int = 3) -> Method:
    return Method(f"algo={algorithm} algo.rank={rank} algo.alpha={2 * rank}", seeds)


GOAL = (
    "benchmark=libero_goal data.demos=20 train.steps_per_epoch=150 eval.episodes=10 eval.horizon=240 "
    # a curve's one point has the starts of the matrix, whose rollouts it shares
    "eval.every=8 eval.curve_episodes=10 eval.selection=reporting eval.cells=sampled eval.cells_share=0.2 "
    "eval.record_every=0"
)
FRONTIER = Study(
    "frontier",
    GOAL,
    {
        "sequential": Method("algo=sequential"),
        "er 2": _er(2, 5),
        "compressed_er 2": _compressed(2, 5),
        "compressed_er 10": _compressed(10, 5),
        "packnet": Method("algo=packnet train.epochs=4 eval.every=4", 5),  # as many updates after pruning
        "lora 16": _rank("lora", 16, 5),
        "iscil 16": _rank("iscil", 16, 5),
        "single_task": Method("algo=single_task"),
        "er 10": _er(10),
        "er 0.5": _er(0.5),
        "er 50": _er(50),
        "compressed_er 0.5": _compressed(0.5),
        "compressed_er 50": _compressed(50),
        "lora 1": _rank("lora", 1),
        "iscil 1": _rank("iscil", 1),
        "lora 4": _rank("lora", 4),
        "iscil 4": _rank("iscil", 4),
        "er 2, whole batch": _er(2, batch=64),
    },
)
CROSSED = tuple((seed, order, data) for order in (1, 2, 3) for data in (1, 2, 3) for seed in (1, 2))
SEEDS = Study(  # with those of the frontier that have one number for all three
    "seeds",
    GOAL,
    {name: Method(FRONTIER.methods[name].overrides, 0) for name in ("sequential", "er 2")},
    tuple(draws for draws in CROSSED if len({*draws}) > 1),
)
_FROZEN = "policy=bc_transformer_frozen policy.encoder.weights="
STARTS = Study(
    "starts",
    f"{GOAL} augmentation=none",
    {
        f"{start}, {name}": Method(f"{replay} {words}")
        for name, replay in (
            ("er 0", "algo=sequential"),
            (
                "er 2",
                "algo=er algo.memory.budget=378",
            ),  # batches as long, so that both begin with the same weights
        )
        for start, words in {
            "scratch": "",
            "imagenet": f"{_FROZEN}imagenet",
            "random": f"{_FROZEN}random",
            "libero_90": "pretrain=libero_90 pretrain.demos=10 pretrain.epochs=1",
        }.items()
    },
)
STUDIES = (FRONTIER, SEEDS, STARTS)

# the study before this one, whose records README.md is made of
REFERENCES = ("er", "sequential", "single_task")  # that each other method is compared with
WINDOW = 64 * 64 * 3 * 2 + 4 * (7 + 2 + 3 + 7)  # bytes: two images, readings and the action


def _plain(algorithms: str, seeds: int, more: str = "") -> dict[str, Method]:
    return {name: Method(f"algo={name} {more}", seeds) for name in algorithms.split()}


def _memories(megabytes: float) -> dict[str, Method]:
    size = int(megabytes * 1e6)
    return {
        f"er {megabytes:g} MB": Method(f"algo=er algo.memory.budget={size // WINDOW}"),
        f"compressed_er {megabytes:g} MB": Method(f"algo=compressed_er algo.budget={size}"),
    }


_SMALL = "train.steps_per_epoch=75 eval.episodes=10"
_SAMPLED = "eval.every=8 eval.cells=sampled eval.cells_share=0.3"
_ENDS = "eval.cells=diagonal_and_last_row eval.curve=none"
_GOAL = f"benchmark=libero_goal data.demos=20 eval.horizon=240 {_SMALL}"
_LONG = (
    "benchmark=libero_130 data.demos=10 train.steps_per_epoch=75 eval.episodes=1 eval.cells=sampled "
    "eval.cells_share=0.02 eval.curve=none eval.horizon=300"
)
_BRIEF = (
    f"benchmark=libero_goal benchmark.tasks=3 data.demos=20 train.epochs=2 train.steps_per_epoch=75 {_ENDS} "
    "eval.episodes=1 eval.horizon=10"
)
_TEN = "sequential er packnet lora single_task ewc iscil dmpel derpp multitask"
EARLIER = (
    Study("goal", f"{_GOAL} {_SAMPLED}", _plain(_TEN, 5)),
    Study(
        "memory", f"{_GOAL} {_ENDS}", {n: m for size in (0.1, 1.0, 10.0) for n, m in _memories(size).items()}
    ),
    Study(
        "ten_demonstrations",
        f"benchmark=libero_object data.demos=10 {_SMALL} {_SAMPLED}",
        _plain("sequential er packnet lora single_task iscil", 3),
    ),
    Study(
        "libero_130",
        _LONG,
        {
            **_plain("sequential er compressed_er lora", 1),
            **_plain("packnet", 1, "algo.prune_perc=0.98"),
        },
    ),
    Study(
        "costs",
        _BRIEF,
        _plain(" ".join(sorted(f.stem for f in (config_folder() / "algo").glob("*.yaml"))), 1),
    ),
)


@dataclass(frozen=True)
class Planned:
    """A run of the study."""

    study: Study
    method: str
    draws: Draws

    @property
    def seed(self) -> int:
        """Seed of learning."""
        return self.draws[0]

    @property
    def name(self) -> str:
        """Its name in lists."""
        seed, order, data = self.draws
        more = "" if seed == order == data else f"_order{order}_data{data}"
        return f"{self.study.name}/{re.sub('[ ,]+', '_', self.method)}/seed{seed}{more}"

    @property
    def seeds(self) -> dict[str, int]:
        """What tells it from other runs of its method."""
        seed, order, data = self.draws
        found = {"seed": seed, "benchmark.order_seed": order, "data.seed": data}
        if self.draws in self.study.draws:  # a mask of cells of its own
            found["eval.cells_seed"] = 100 * seed + 10 * order + data
        return found

    @property
    def settings(self) -> tuple[str, ...]:
        """Overrides of its method."""
        own = self.study.methods[self.method].overrides
        return tuple(
            {word.split("=")[0]: word for word in (*self.study.overrides.split(), *own.split())}.values()
        )

    @property
    def overrides(self) -> list[str]:
        """What its command has beyond `python train.py`."""
        return [*self.settings, *(f"{key}={seed}" for key, seed in self.seeds.items()), *SETTINGS]

    @property
    def id(self) -> str:
        """What its directory's name ends with."""
        return self.name.replace("/", "-")

    def directory(self, folder: Path) -> Path | None:
        """Return its directory in a folder of runs; None if there is none."""
        return next((file.parent for file in folder.glob(f"*/*/*_{self.id}/config.yaml")), None)

    @property
    def record(self) -> Path:
        """File that keeps its configuration and its records."""
        return RECORDS / f"{self.name}.json.xz"

    @cached_property
    def config(self) -> dict[str, Any]:
        """Its configuration as it is today."""
        config = copy.deepcopy(_composed(*self.settings, *SETTINGS))  # to compose takes forty times as long
        for key, seed in self.seeds.items():
            OmegaConf.update(config, key, seed)
        return plain_data(config)

    def is_done(self) -> bool:
        """Return whether there are records, of today's configuration."""
        if not self.record.exists():
            return False
        was, now = (
            {key: value for key, value in result_relevant(config).items() if value is not None}
            for config in (yaml.load(_read(self.record)["config"], yaml.CSafeLoader), self.config)
        )
        return {k: v for k, v in was.items() if k in now or k not in CHOSEN} == now

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


@cache
def _composed(*overrides: str) -> DictConfig:
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        return compose("config", [*overrides])


CHOSEN = ("data.drawing", "eval.cells_seed")  # what a run chooses where its command does not
FILES = {"config": "config.yaml", "records": "results.jsonl", "relearning": "relearning.jsonl"}


def _read(record: Path) -> dict[str, str]:
    return json.loads(lzma.decompress(record.read_bytes()))


def planned(studies: Sequence[Study] = STUDIES) -> list[Planned]:
    """Return all runs, in the order in which they are made: seed after seed."""
    runs = []
    for study in studies:
        draws = [(seed, seed, seed) for seed in range(1, 6)]
        own = [(m, d) for d in draws for m, method in study.methods.items() if d[0] <= method.seeds]
        runs += [
            Planned(study, m, d) for m, d in (*own, *((m, d) for d, m in product(study.draws, study.methods)))
        ]
    return runs


def show(runs: Sequence[Planned]) -> None:
    """Print each run, and how long the missing ones take if they cost what those of the same algorithm did."""
    hours: dict[str, list[float]] = {}
    missing = []
    for run in runs:
        if run.is_done():
            spent = _hours(run)
            hours.setdefault(run.method, []).append(spent)
            print(f"done     {60 * spent:4.0f} min  python train.py {shlex.join(run.overrides)}")
        else:
            missing.append(run)
    for run in missing:
        print(f"missing            python train.py {shlex.join(run.overrides)}")
    known = [h for spent in hours.values() for h in spent]
    if missing and known:
        mean = sum(known) / len(known)
        left = sum(_mean(hours.get(run.method)) or mean for run in missing)
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
    waiting = [run for run in runs if not run.is_done()]
    end, failed = time.monotonic() + 60 * minutes, 0
    active: dict[subprocess.Popen[bytes], Planned] = {}
    try:
        while True:
            while len(active) < jobs and time.monotonic() < end and waiting:
                run = waiting.pop(0)
                active[_start(run, folder)] = run
            if not active or time.monotonic() > end:
                return failed
            for process in [p for p in active if p.poll() is not None]:
                run = active.pop(process)
                directory = run.directory(folder)
                if process.returncode == 0 and directory is not None:
                    run.keep(directory)
                    print(f"{time.strftime('%H:%M')} done: {run.name}", flush=True)
                else:
                    failed += 1
                    print(f"{time.strftime('%H:%M')} failed: {_log(run, folder)}", flush=True)
            time.sleep(1)
    finally:
        for process in active:
            process.send_signal(signal.SIGTERM)  # the records stay; the same command goes on
        for process in active:
            process.wait()


def _start(run: Planned, folder: Path) -> "subprocess.Popen[bytes]":
    _demonstrations(run)
    words = [*run.overrides, f"runs_dir={folder}", f"run_id={run.id}"]  # what is learned before is shared
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


def _log(run: Planned, folder: Path) -> Path:
    return folder / "logs" / f"{run.id}.txt"


def report(runs: Sequence[Planned]) -> None:
    """Write a comparison of the finished runs of each earlier study beside this file."""
    for study in EARLIER:
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
    runs = [
        run
        for run in planned(STUDIES if args.what != "report" else EARLIER)
        if all(word in f"{run.name}/" for word in args.only)
    ]
    if args.what == "run":
        signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))  # and end what runs
        args.runs.mkdir(parents=True, exist_ok=True)
        return int(make(runs, args.runs.resolve(), args.minutes, args.jobs) > 0)
    show(runs) if args.what == "list" else report(runs)
    return 0


if __name__ == "__main__":
    sys.exit(main())
