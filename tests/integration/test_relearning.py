"""`libero relearn` on a run of `libero train`."""

import sys

import pytest

from libero_cli.main import main
from lifelong.results.relearning import read_relearning

pytestmark = [pytest.mark.sim, pytest.mark.slow]

TINY = (
    *("preset=smoke", "benchmark=libero_object", "benchmark.tasks=2", "threads=1", "data.demos=2"),
    "data.seq_len=2",
    *("train.epochs=1", "train.steps_per_epoch=4", "train.batch_size=4", "eval.horizon=6", "eval.episodes=1"),
    *("eval.curve_episodes=1", "train.warmup_steps=0", "policy.encoder.width=4", "algo=lora"),
)


def test_from_the_command_line(tmp_path, demos, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["libero"])
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("LIBERO_DEMOS", str(demos))

    def call(*words: str) -> str:
        assert main(words) == 0
        return capsys.readouterr().out

    call("train", *TINY, f"runs_dir={tmp_path / 'runs'}")
    (config,) = (tmp_path / "runs" / "libero_object" / "lora").glob("*/config.yaml")
    run = config.parent
    steps = ("relearn", str(run), "--steps", "4", "--every", "2")
    command = (*steps, "--held-out", "1")
    said = call(*command)
    assert "savings" in said and "report.html" in said
    found = read_relearning(run)
    assert [(r.task, r.start) for r in found] == [(0, "final"), (0, "initial")]
    assert found[0].needed == 0, "an adapter's task is not forgotten"
    assert call(*command) == said and read_relearning(run) == found

    said = call(*steps, "--episodes", "2")
    assert "error just learned" not in said and "success just learned" in said
    *before, final, initial = read_relearning(run)
    assert before == found and {final.episodes, initial.episodes} == {2}
    assert (final.learned_error, final.needed) == (1.0, 0), "what never succeeded is back at once"
