"""`libero relearn` on a run from train.py."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from lifelong.results.relearning import read_relearning

pytestmark = [pytest.mark.sim, pytest.mark.slow]

ROOT = Path(__file__).parents[2]
TINY = (
    *("preset=smoke", "benchmark=libero_object", "benchmark.tasks=2", "threads=1", "data.demos=2"),
    *("train.epochs=1", "train.steps_per_epoch=4", "train.batch_size=4", "eval.horizon=6", "eval.episodes=1"),
    *("eval.curve_episodes=1", "policy.encoder.width=4", "algo=lora"),
)


def test_from_the_command_line(tmp_path, demos):
    env = os.environ | {"LIBERO_CACHE": str(tmp_path / "cache"), "LIBERO_DEMOS": str(demos)}

    def call(*words: str) -> str:
        done = subprocess.run(
            [sys.executable, *words], env=env, cwd=ROOT, capture_output=True, text=True, timeout=900
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    call("train.py", *TINY, f"runs_dir={tmp_path / 'runs'}")
    (config,) = (tmp_path / "runs" / "libero_object" / "lora").glob("*/config.yaml")
    run = config.parent
    command = ("-m", "libero_env.cli", "relearn", str(run), "--steps", "4", "--every", "2", "--held-out", "1")
    said = call(*command)
    assert "savings" in said and "report.html" in said
    found = read_relearning(run)
    assert [(r.task, r.start) for r in found] == [(0, "final"), (0, "initial")]
    assert found[0].needed == 0, "an adapter's task is not forgotten"
    assert call(*command) == said and read_relearning(run) == found

    said = call(*command, "--episodes", "2")
    assert "error just learned" in said and "success just learned" in said
    *before, final, initial = read_relearning(run)
    assert before == found and {final.episodes, initial.episodes} == {2}
    assert (final.learned_error, final.needed) == (1.0, 0), "what never succeeded is back at once"
