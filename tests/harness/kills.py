"""Runs that are killed at random moments and resumed, and the comparison of what they end in."""

import json
import os
import random
import subprocess
import sys
import time
from pathlib import Path

import torch

from lifelong import checkpoints

ROOT = Path(__file__).parents[2]
START_UP = 0.2  # share of the kills that come before the process has written anything
HALF_WRITTEN = 0.3  # share of the others that come while a file is being written
DEADLINE = 1800.0  # s; of a machine that has other things to do
TINY = (
    "preset=smoke", "benchmark=libero_object", "benchmark.tasks=2", "threads=1", "data.demos=2",
    "data.seq_len=2", "train.epochs=2",
    "train.steps_per_epoch=2", "train.batch_size=4", "eval.every=1", "eval.horizon=3", "eval.episodes=1",
    "train.warmup_steps=0", "eval.curve_episodes=1", "eval.record_every=0", "progress=false"
)  # fmt: skip


def start(algo: str, runs: Path, demos: Path, *more: str) -> subprocess.Popen:
    command = [sys.executable, str(ROOT / "train.py"), *TINY, f"algo={algo}", f"runs_dir={runs}", *more]
    env = os.environ | {"LIBERO_DEMOS": str(demos)}
    runs.mkdir(exist_ok=True)
    log = open(runs / "output.txt", "a")  # noqa: SIM115 - the process keeps it
    with log:
        return subprocess.Popen(command, env=env, cwd=runs, stdout=log, stderr=log)


def finish(process: subprocess.Popen, runs: Path) -> Path:
    """Wait for successful termination and return the run's directory."""
    try:
        status = process.wait(DEADLINE)
    finally:
        process.kill()  # nothing happens to one that has ended
        process.wait()
    assert status == 0, (runs / "output.txt").read_text()
    (log,) = runs.rglob("results.jsonl")
    return log.parent


def written(runs: Path) -> dict[Path, tuple[int, int]]:
    """Return every file with its modification time and size, temporary files included."""
    found = {}
    for path in runs.rglob("*"):
        try:
            stat = path.stat()
        except FileNotFoundError:  # renamed meanwhile
            continue
        if path.is_file() and path.name != "output.txt":
            found[path] = (stat.st_mtime_ns, stat.st_size)
    return found


def kill_somewhere(process: subprocess.Popen, runs: Path, draws: random.Random) -> bool:
    """Kill a process during start-up, after some changes of files, or within one; return False if it ended before."""
    if draws.random() < START_UP:
        time.sleep(draws.uniform(0.0, 2.0))
    else:
        within = draws.random() < HALF_WRITTEN
        wait_for_changes(process, runs, draws.randint(1, 6), within=within)
        time.sleep(0.0 if within else draws.uniform(0.0, 0.1))
    process.kill()
    return process.wait() == -9


def wait_for_changes(process: subprocess.Popen, runs: Path, wanted: int, *, within: bool) -> None:
    """Wait for a number of changes of files, or, from then on, for a file that is not complete yet."""
    seen, deadline = written(runs), time.monotonic() + DEADLINE
    while process.poll() is None and time.monotonic() < deadline:
        now = written(runs)
        wanted, seen = wanted - (now != seen), now
        if wanted <= 0 and (not within or any(path.suffix == ".part" for path in now)):
            return
        time.sleep(0.0 if within and wanted <= 0 else 0.003)  # it runs on the same cores


def outcome(run: Path) -> dict[tuple, dict]:
    """Return the measurements without times; a record that was written twice must be the same both times."""
    found: dict[tuple, dict] = {}
    for line in (run / "results.jsonl").read_text().splitlines():
        record = json.loads(line)
        if record["kind"] in ("loss", "eval", "task_end"):
            record = {name: value for name, value in record.items() if name not in ("seconds", "crc32")}
            key = tuple(record.get(name) for name in ("kind", "phase", "learned", "task", "epoch"))
            assert found.setdefault(key, record) == record
    return found


def assert_same(a, b, where: str = "") -> None:
    assert type(a) is type(b), where
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            assert_same(a[key], b[key], f"{where}/{key}")
    elif isinstance(a, list | tuple):
        assert len(a) == len(b), where
        for i, pair in enumerate(zip(a, b, strict=True)):
            assert_same(*pair, f"{where}/{i}")
    elif isinstance(a, torch.Tensor):
        assert torch.equal(a, b), where
    else:
        assert a == b or (a != a and b != b), where


def assert_same_runs(again: Path, whole: Path) -> None:
    """Check that two runs measured the same, ended with the same weights to the bit, and left nothing half written."""
    assert outcome(again) == outcome(whole) and outcome(whole)
    metrics = [json.loads((run / "results.json").read_text())["metrics"] for run in (again, whole)]
    assert metrics[0] == metrics[1]
    for task in (0, 1):
        files = [run / "checkpoints" / f"task_{task}.safetensors" for run in (again, whole)]
        assert_same(*map(checkpoints.load, files))
    assert not list(again.rglob("*.part")), "what a killed process leaves half written is cleared away"
