"""The task sequence: killed anywhere and resumed, it comes to the same records and weights."""

import pytest

from lifelong.results.records import EvalRecord, LossRecord, TaskEndRecord
from lifelong.training.costs import COSTS
from tests.harness.algorithms import assert_resumed_equals_uninterrupted
from tests.harness.sequences import ALGORITHMS, TASKS, run_context, sequence


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_killed_at_every_write_and_resumed_equals_uninterrupted(tmp_path, algo, monkeypatch):
    assert assert_resumed_equals_uninterrupted(tmp_path, algo, monkeypatch) > 5


def test_the_records_are_complete(tmp_path):
    sequence(p := run_context(tmp_path, "packnet")).run()
    results = p.directory.log.read()
    assert len(results.of(TaskEndRecord)) == TASKS
    evals = results.of(EvalRecord)
    assert len([r for r in evals if r.phase == "matrix"]) == TASKS * (TASKS + 1) // 2
    assert sorted((r.learned, r.epoch) for r in evals if r.phase == "curve") == [
        (task, epoch) for task in range(TASKS) for epoch in (0, 1, 2)
    ]
    assert {r.epoch for r in results.of(LossRecord)} == {1, 2, 3, 4}  # training and retraining
    assert all(set(results.costs(task)) >= set(COSTS) - {"peak_gpu_bytes"} for task in range(TASKS))
    assert all(set(r.init_states) == ({0, 1, 2} if r.phase == "matrix" else {48, 49}) for r in evals)


def test_select_last_keeps_the_last_weights(tmp_path):
    p = run_context(tmp_path, "sequential")
    object.__setattr__(p.eval, "select", "last")
    sequence(p).run()
    assert not p.directory.checkpoints.best_path.exists()
    assert {r.best_epoch for r in p.directory.log.read().of(TaskEndRecord)} == {2}
