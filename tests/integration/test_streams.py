"""train.py with groups, blurred boundaries and pretraining, and a run that starts from its weights."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from lifelong import checkpoints

pytestmark = [pytest.mark.sim, pytest.mark.slow]

ROOT = Path(__file__).parents[2]
TINY = (
    "preset=smoke", "benchmark=libero_object", "benchmark.tasks=2", "threads=1", "data.demos=2", "train.epochs=1",
    "train.steps_per_epoch=2", "train.batch_size=4", "eval.horizon=6", "eval.episodes=1", "eval.curve_episodes=1",
    "policy.encoder.width=4"
)  # fmt: skip


def train(home: Path, *overrides: str) -> tuple[int, str]:
    """Return the status and output of a run in a folder."""
    env = os.environ | {"LIBERO_CACHE": str(home / "cache"), "LIBERO_DEMOS": str(home / "demos")}
    command = [sys.executable, str(ROOT / "train.py"), *TINY, f"runs_dir={home / 'runs'}", *overrides]
    done = subprocess.run(command, env=env, cwd=home, capture_output=True, text=True, timeout=900)
    return done.returncode, done.stdout + done.stderr


def test_streams_from_the_command_line(tmp_path, demos):
    (tmp_path / "demos").symlink_to(demos)
    stream = (
        "algo=er", "benchmark.tasks=2", "benchmark.group_size=2", "pretrain.suite=libero_object",
        "pretrain.tasks=[1]", "stream.demos_later=1", "stream.blur=0.2"
    )  # fmt: skip
    status, output = train(tmp_path, *stream, "data.memory=disk")
    assert status == 0, output
    assert "1 tasks of libero_object" in output and "Tasks 1-2/2: together" in output
    assert "2 tasks learned" in output
    assert list((tmp_path / "cache" / "frames").glob("*/images.u8"))
    (before,) = (tmp_path / "runs" / "pretrain" / "libero_object").glob("*/checkpoints/task_0.safetensors")
    status, output = train(tmp_path, *stream, "data.memory=host")
    assert status == 0 and "is finished" in output, output  # where frames lie does not make another run

    one = ("benchmark.tasks=1", "run_id=from", f"init_from={before}", "train.lr=0", "train.lr_min=0")
    status, output = train(tmp_path, "algo=sequential", *one)
    assert status == 0, output
    (after,) = (tmp_path / "runs").glob("libero_object/sequential/*/checkpoints/task_0.safetensors")
    weights, kept = (checkpoints.load(file)["policy"] for file in (before, after))
    assert all(torch.equal(weights[name], kept[name]) for name in weights)

    status, output = train(tmp_path, "algo=sequential", "init_from=nowhere", "run_id=none")
    assert status == 2 and "no checkpoint at nowhere" in output
    assert not (
        tmp_path / "runs" / "libero_object" / "sequential" / "bc_transformer_small_seed1_none"
    ).exists()
