"""train.py from its command line to a report, also when killed and resumed."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from libero_env.demos.config import GENERATOR
from lifelong.launch import main

pytestmark = [pytest.mark.sim, pytest.mark.slow]

ROOT = Path(__file__).parents[2]
# with a memory, masks, adapters, a policy for each task, and all tasks at once; every one: test_sequence, test_gpu
ALGORITHMS = ("er", "packnet", "dmpel", "single_task", "multitask")
TINY = (
    "preset=smoke", "benchmark=libero_object", "benchmark.tasks=2", "algo=packnet", "threads=1", "data.demos=2",
    "data.seq_len=2",
    "train.epochs=2", "train.steps_per_epoch=2", "train.batch_size=4", "eval.every=1", "eval.horizon=12",
    "eval.episodes=2", "eval.curve_episodes=1", "train.warmup_steps=0"
)  # fmt: skip


@pytest.fixture(scope="module")
def home(tmp_path_factory, demos) -> Path:
    folder = tmp_path_factory.mktemp("home")
    (folder / "demos").symlink_to(demos)
    return folder


@pytest.fixture
def here(home, monkeypatch) -> Path:
    """The home, where the process of the tests is as one that was started there."""
    monkeypatch.chdir(home)
    monkeypatch.setenv("LIBERO_DEMOS", str(home / "demos"))
    monkeypatch.setattr(sys, "argv", ["train.py"])
    return home


def start(home: Path, runs: Path, *overrides: str) -> subprocess.Popen:
    env = os.environ | {"LIBERO_DEMOS": str(home / "demos")}
    command = [sys.executable, str(ROOT / "train.py"), *overrides, f"runs_dir={runs}"]
    return subprocess.Popen(
        command, env=env, cwd=home, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def finish(process: subprocess.Popen) -> str:
    output, _ = process.communicate(timeout=900)
    assert process.returncode == 0, output
    return output


def run_dir(runs: Path) -> Path:
    (log,) = runs.rglob("results.jsonl")
    return log.parent


def records(path: Path) -> list[dict]:
    lines = (path / "results.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


def test_smoke_from_the_command_line_to_a_report(home, here, tmp_path, capsys):
    command = (
        *("preset=smoke", "algo=er", "data.demos=3", "train.epochs=2", "eval.curve=none", "eval.select=last"),
        *("eval.horizon=90", "eval.episodes=3"),
    )
    output = finish(start(home, tmp_path, *command))
    path = run_dir(tmp_path)
    assert path == tmp_path / "first_steps" / "er" / "bc_transformer_small_seed1"
    assert "2 tasks learned" in output
    summary = json.loads((path / "results.json").read_text())
    assert summary["finished"] and summary["tasks_learned"] == 2
    assert summary["metrics"].keys() >= {"fwt", "nbt", "auc"}
    assert summary["success_matrix"]["rates"][0][0] > 0, "a first report shows some success"
    assert summary["demonstrations"]["generators"] == [GENERATOR] * 2
    (learned_from,) = (r for r in records(path) if r["kind"] == "demonstrations")
    assert len(set(learned_from["digests"])) == 2 and len(set(learned_from["counts"])) == 1
    page = (path / "report.html").read_text()
    assert GENERATOR in page
    assert "<svg" in page and "data:image/webp" in page
    kept = {p.name for p in (path / "checkpoints").iterdir()}
    assert {"task_0.safetensors", "task_1.safetensors"} <= kept
    assert sorted(p.name for p in home.iterdir()) == ["demos"]  # nothing else is left where it was started
    command = (*command, f"runs_dir={tmp_path}")
    assert main([*command]) == 0 and "is finished" in capsys.readouterr().out
    assert main([*command, "train.lr=0.5"]) == 2
    told = capsys.readouterr().err
    assert "train.lr 0.002 -> 0.5" in told and "run_id=" in told and "Traceback" not in told


@pytest.mark.release
@pytest.mark.parametrize("seed", [2, 3])  # the first: test_docs, by the command of README.md
def test_the_smallest_preset_learns_both_tasks(seed, home, tmp_path):
    finish(start(home, tmp_path, "preset=smoke", f"seed={seed}", "eval.cells=diagonal"))
    summary = json.loads((run_dir(tmp_path) / "results.json").read_text())
    (first, _), (_, second) = summary["success_matrix"]["rates"]
    assert first >= 0.6 and second >= 0.3


def without_curve(words):
    """Return the words of a command that says nothing of a learning curve."""
    return [word for word in words if not word.startswith(("eval.curve_episodes", "eval.every"))]


def test_a_sweep_of_algorithms_ends_with_a_comparison_report(home, tmp_path):
    few = ("train.epochs=1", "eval.horizon=4", "eval.episodes=1", "eval.curve=none", "eval.select=last")
    tiny = (*(t for t in without_curve(TINY) if not t.startswith("algo")), *few, "benchmark.tasks=1")
    output = finish(start(home, tmp_path, "-m", f"algo={','.join(ALGORITHMS)}", *tiny))
    assert f"{len(ALGORITHMS)} runs compared" in output
    assert len(list(tmp_path.glob("sweep/algo-*/report.html"))) == 1
    for algo in ALGORITHMS:
        (path,) = (tmp_path / "libero_object" / algo).glob("*/results.json")
        found = json.loads(path.read_text())
        assert found["finished"] and found["tasks_learned"] == 1, algo


def test_errors_of_the_command_line_are_one_line(home, tmp_path):
    process = start(home, tmp_path, "preset=smoke", "benchmark=libero_object", "benchmark.tasks=[butter]")
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 2
    assert "unknown task of libero_object 'butter'" in output and "Traceback" not in output
    assert len(output.strip().splitlines()) == 1, output
    assert not list(tmp_path.rglob("config.yaml")), "nothing stands in the way of the mended command"


def test_rollouts_of_another_back_end_are_named(here, tmp_path, capsys):
    pytest.importorskip("mujoco_warp")
    short = ("benchmark.tasks=1", "algo=sequential", "eval.curve=none", "eval.select=last", "eval.horizon=4")
    other = ('eval.backend="warp,device=cpu"', f"runs_dir={tmp_path}")
    assert main([*without_curve(TINY), *short, "train.epochs=1", *other]) == 0
    path = run_dir(tmp_path)
    assert "1 task learned" in capsys.readouterr().out
    assert records(path)[0]["backend"] == "warp"
    assert "simulated by" in (path / "report.html").read_text()
