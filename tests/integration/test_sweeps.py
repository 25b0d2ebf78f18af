"""A sweep under other launchers than Hydra's basic one: the same numbers, errors that are told, and going on."""

import io
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import redirect_stdout
from pathlib import Path

import pytest

from lifelong.launch import main

pytestmark = [pytest.mark.sim, pytest.mark.slow]

ROOT = Path(__file__).parents[2]
TINY = "preset=smoke benchmark=libero_object benchmark.tasks=1 threads=1 data.demos=2 data.seq_len=2 train.epochs=1 "
TINY += "train.warmup_steps=0 "
TINY += "train.steps_per_epoch=2 train.batch_size=4 eval.curve=none eval.select=last eval.horizon=8 eval.episodes=2"
JOBLIB = ("hydra/launcher=workstation", "hydra.launcher.n_jobs=2")
SUBMITIT = ("hydra/launcher=submitit_local",)
RAY = (
    "hydra/launcher=ray",
    "+hydra.launcher.ray.init.num_cpus=2",
    "+hydra.launcher.ray.init.include_dashboard=false",
)
PLUG_INS = {SUBMITIT: "hydra_submitit_launcher", RAY: "hydra_ray_launcher"}
SEEDS = "seed=1,2,-1"  # the last is refused


def start(home: Path, runs: Path, *words: str) -> subprocess.Popen:
    env = os.environ | {"LIBERO_DEMOS": str(home / "demos"), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(ROOT / "train.py"), "-m", *TINY.split(), *words, f"runs_dir={runs}"]
    return subprocess.Popen(
        command, env=env, cwd=home, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def jobs(runs: Path) -> dict[int, dict]:
    found = [json.loads(file.read_text()) for file in runs.glob("sweep/*/jobs/*/job.json")]
    return {record["number"]: record for record in found}


def outcomes(runs: Path) -> dict[str, list]:
    found = {}
    for file in sorted(runs.rglob("results.jsonl")):
        records = [json.loads(line) for line in file.read_text().splitlines()]
        kept = [r for r in records if r["kind"] in ("loss", "eval")]
        times = ("seconds", "crc32")
        found[file.parent.name] = [{k: v for k, v in r.items() if k not in times} for r in kept]
    return found


@pytest.fixture(scope="module")
def plain(tmp_path_factory, demos) -> tuple[Path, Path]:
    """A sweep of Hydra's basic launcher: one job cannot be run. Return the home and its runs."""
    home = tmp_path_factory.mktemp("home")
    (home / "demos").symlink_to(demos)
    runs, said = home / "plain", io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(said):
        patch.setattr(sys, "argv", ["train.py"])
        patch.setenv("LIBERO_DEMOS", str(home / "demos"))
        patch.chdir(home)
        assert main(["-m", *TINY.split(), SEEDS, f"runs_dir={runs}"]) == 2
    assert "2 runs compared" in said.getvalue()
    return home, runs


def check(process: subprocess.Popen, folder: Path, runs: Path) -> dict[int, dict]:
    """Wait for a sweep's end; it has the numbers of the plain one and tells what failed. Return its jobs."""
    output, _ = process.communicate(timeout=600)
    assert process.returncode == 2, output
    assert "2 runs compared" in output and "2 done, 1 failed of 3 jobs" in output
    assert outcomes(folder) == outcomes(runs)
    found = jobs(folder)
    assert {n: r["status"] for n, r in found.items()} == dict(enumerate(["done", "done", "failed"]))
    assert found[2]["error"] == "seed is -1; expected greater than or equal to 0"
    for each in (folder, runs):
        assert len(list(each.glob("sweep/seed-*/report.html"))) == 1
    return found


@pytest.mark.parametrize("launcher", [SUBMITIT, RAY], ids=["submitit_local", "ray"])
def test_other_launchers_give_the_same_numbers_and_tell_what_failed(plain, launcher, tmp_path) -> None:
    pytest.importorskip(f"hydra_plugins.{PLUG_INS[launcher]}")
    home, runs = plain
    check(start(home, tmp_path, *launcher, SEEDS), tmp_path, runs)


def test_a_sweep_of_workers_whose_parent_is_killed_goes_on_with_what_is_missing(plain, tmp_path) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    home, runs = plain
    words = (*JOBLIB, SEEDS)
    process = start(home, tmp_path, *words)
    deadline = time.monotonic() + 300
    while not any(r["status"] == "done" for r in jobs(tmp_path).values()) and time.monotonic() < deadline:
        assert process.poll() is None or jobs(tmp_path)
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    done = {n: r["started"] for n, r in jobs(tmp_path).items() if r["status"] == "done"}
    assert done
    again = check(start(home, tmp_path, *words), tmp_path, runs)
    for number, started in done.items():
        assert again[number]["started"] == started, "what was done is not run again"
