"""Training with groups, blurred boundaries and pretraining, and a run that starts from its weights."""

import sys
from pathlib import Path

import pytest
import torch

from lifelong import checkpoints
from lifelong.launch import main

pytestmark = [pytest.mark.sim, pytest.mark.slow]

TINY = (
    "preset=smoke", "benchmark=libero_object", "benchmark.tasks=2", "threads=1", "data.demos=2",
    "data.seq_len=2", "train.epochs=1",
    "train.steps_per_epoch=2", "train.batch_size=4", "eval.horizon=6", "eval.episodes=1", "eval.curve_episodes=1",
    "policy.encoder.width=4", "train.warmup_steps=0"
)  # fmt: skip


def train(home: Path, *overrides: str) -> int:
    """Return the status of a run in a folder."""
    return main([*TINY, f"runs_dir={home / 'runs'}", *overrides])


def test_streams_from_the_command_line(tmp_path, demos, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["train.py"])
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("LIBERO_DEMOS", str(demos))
    stream = (
        "algo=er", "benchmark.tasks=3", "stream.base_tasks=2", "pretrain.suite=libero_object",
        "pretrain.tasks=[5]"
    )  # fmt: skip
    assert train(tmp_path, *stream, "data.memory=disk") == 0
    output = capsys.readouterr().out
    assert "1 task of libero_object" in output and "Tasks 1-2/3: together" in output
    assert "3 tasks learned" in output
    assert list((tmp_path / "cache" / "frames").glob("*/images.u8"))
    (before,) = (tmp_path / "runs" / "pretrain" / "libero_object").glob("*/checkpoints/task_0.safetensors")
    assert train(tmp_path, *stream, "data.memory=host") == 0
    assert "is finished" in capsys.readouterr().out  # where frames lie does not make another run

    one = ("benchmark.tasks=1", "run_id=from", f"init_from={before}", "train.lr=0", "train.lr_min=0")
    assert train(tmp_path, "algo=sequential", *one) == 0
    (after,) = (tmp_path / "runs").glob("libero_object/sequential/*/checkpoints/task_0.safetensors")
    weights, kept = (checkpoints.load(file)["policy"] for file in (before, after))
    assert all(torch.equal(weights[name], kept[name]) for name in weights)

    assert train(tmp_path, "algo=sequential", "init_from=nowhere", "run_id=none") == 2
    assert "no checkpoint at nowhere" in capsys.readouterr().err
    assert not list((tmp_path / "runs" / "libero_object" / "sequential").glob("*_none"))
