"""Why a run forgets: estimators against known values, and the measurement on runs of three tasks."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from torch.distributions import Normal, kl_divergence

from libero_eval.diagnosis import measure
from libero_eval.diagnosis.measure import diagnose, divergence, drift, overlap, parts_of, swap, updates
from libero_eval.diagnosis.page import findings, write_diagnosis
from libero_eval.relearning import error_on
from libero_eval.requests import DiagnoseRequest
from lifelong.algorithms.base import acting_with
from lifelong.algorithms.lora import LoRA
from lifelong.algorithms.single_task import SingleTask
from lifelong.checkpoints import load
from lifelong.errors import LifelongError
from lifelong.evaluation.restore import LoadedRun
from lifelong.nn import GMMHead
from lifelong.policies.base import copy_weights
from lifelong.stats.representations import (
    effective_rank,
    fisher_overlap,
    linear_cka,
    relative_distance,
    stable_rank,
)
from tests.harness.policies import small_transformer
from tests.harness.sequences import SPEC, dataset, run_context, sequence

ORTHOGONAL = np.linalg.qr(np.random.default_rng(1).normal(size=(6, 6)))[0]
FEATURES = np.random.default_rng(0).normal(size=(40, 6))


def test_cka_is_one_for_what_is_rotated_scaled_and_shifted_and_follows_its_formula():
    assert linear_cka(FEATURES, 3 * FEATURES @ ORTHOGONAL + 2) == pytest.approx(1)
    other = np.random.default_rng(2).normal(size=(40, 3))
    x, y = FEATURES - FEATURES.mean(0), other - other.mean(0)
    expected = np.linalg.norm(y.T @ x) ** 2 / (np.linalg.norm(x.T @ x) * np.linalg.norm(y.T @ y))
    assert linear_cka(FEATURES, other) == pytest.approx(expected) and expected < 0.5
    assert linear_cka(np.eye(4)[:, :1], np.array([[0.0], [0], [1], [1]])) == pytest.approx(1 / 3)
    assert np.isnan(linear_cka(FEATURES, np.ones((40, 2))))


def test_ranks_of_known_matrices():
    one = np.linalg.svd(np.outer(np.arange(1.0, 5), np.arange(1.0, 4)), compute_uv=False)
    assert stable_rank(one) == pytest.approx(1) and effective_rank(one) == pytest.approx(1)
    assert stable_rank(np.ones(5)) == 5 and effective_rank(np.ones(5)) == pytest.approx(5)
    assert stable_rank(np.array([2.0, 1.0])) == 1.25
    assert effective_rank(np.array([0.5, 0.25, 0.25])) == pytest.approx(2**1.5)


def test_fisher_overlap_is_one_for_proportional_and_zero_for_disjoint_matrices():
    first = np.array([1.0, 3.0, 0.0])
    assert fisher_overlap(first, 7 * first) == pytest.approx(1)
    assert fisher_overlap(first, np.array([0.0, 0.0, 2.0])) == 0
    assert fisher_overlap(np.array([1.0, 0]), np.array([1.0, 3])) == pytest.approx(0.5)
    assert np.isnan(fisher_overlap(first, np.zeros(3)))


def test_the_distance_is_relative_to_what_was():
    assert relative_distance(np.array([3.0, 4]), np.array([3.0, 9])) == 1
    assert np.isnan(relative_distance(np.zeros(2), np.ones(2)))


# --- on policies


def policies():
    torch.manual_seed(0)
    policy = small_transformer(SPEC).eval()
    then = copy_weights(policy)
    now = {n: v + 0.1 * torch.randn_like(v) if v.is_floating_point() else v for n, v in then.items()}
    return policy, then, now


def test_parts_are_all_of_the_policy_and_those_that_compute_them():
    policy, then, _ = policies()
    batch = dataset(0).batch(torch.arange(8))
    parts = parts_of(policy, batch)
    assert sorted(sum(parts.values(), [])) == sorted(then)
    assert {n.partition(".")[0] for n in parts["temporal"]} == {"transformer"}
    assert {n.partition(".")[0] for n in parts["head"]} == {"head"}


def test_swapping_all_parts_gives_the_old_error_and_one_part_that_of_its_weights():
    policy, then, now = policies()
    batch = dataset(0).batch(torch.arange(8))
    parts, error = parts_of(policy, batch), partial(error_on, batch=batch)
    found = swap(policy, 0, then, now, parts, error, "error")
    assert found.learned == error(policy)
    whole = swap(policy, 0, then, now, {"all": list(then)}, error, "error")
    assert whole.swapped["all"] == found.learned != found.final
    with acting_with(policy, now | {n: then[n] for n in parts["head"]}):
        assert error(policy) == found.swapped["head"]
    known = replace(found, learned=0.1, final=0.5, swapped={"head": 0.2})
    assert known.restored("head") == pytest.approx(0.75)
    for final in (0.1, 1.05 * known.learned):  # of a twentieth no part can be told
        assert np.isnan(replace(known, final=final).restored("head"))


def test_what_changed_shows_where_it_changed():
    policy, then, _ = policies()
    batch = dataset(0).batch(torch.arange(8))
    parts = parts_of(policy, batch)
    name = next(n for n in parts["head"] if then[n].dim() == 2)
    change = torch.outer(torch.arange(1.0, 1 + len(then[name])), torch.ones(then[name].shape[1]))
    now = then | {name: then[name] + change}
    (update,) = updates(2, then, now, parts)
    assert (update.task, update.part) == (2, "head")
    assert update.stable == pytest.approx(1, abs=1e-5)
    assert update.nuclear == pytest.approx(float(change.norm()), rel=1e-5)
    assert update.relative == pytest.approx(float(change.norm() / then[name].norm()), rel=1e-5)
    features, latents, actions = drift(policy, 0, then, now, batch)
    assert features.relative == latents.relative == 0 < actions.relative
    assert features.cka == pytest.approx(1) == latents.cka


# --- on runs


@pytest.fixture
def learned(tmp_path, monkeypatch):
    """Return a function that learns three tasks and stands for reading the run back."""

    def learn(algorithm) -> DiagnoseRequest:
        context = run_context(tmp_path, algorithm)
        sequence(context).run()

        def restore(path, *, after=None, **_):
            folder = context.directory.checkpoints
            there = folder.tasks()
            after = there[-1] if after is None else after
            if after not in there:
                raise LifelongError(f"{path} has no checkpoint after task {after}; valid: {there}")
            state = load(folder.task_path(after))
            fresh = run_context(tmp_path, algorithm)
            policy, found = fresh.policy, fresh.algorithm
            policy.load_state_dict(state["policy"])
            found.load_state_dict(state["algorithm"], {k: dataset(k) for k in range(3)})
            return LoadedRun(
                tmp_path, folder.task_path(after), tuple(context.tasks), after, policy.eval(), found, context.eval, 1,
                torch.device("cpu"), None, (), context.data,
            )  # fmt: skip

        def windows(run, task, *_):
            return dataset(task), dataset(task).batch(torch.arange(8))

        monkeypatch.setattr(measure, "restore", restore)
        monkeypatch.setattr(measure, "read_config", lambda *_: None)
        monkeypatch.setattr(measure, "task_windows", windows)
        return DiagnoseRequest(run=tmp_path)

    return learn


def test_a_finished_run_is_diagnosed_and_its_page_written(learned, tab):
    request = learned("sequential")
    found = diagnose(request)
    assert found.learned == 3 and not found.notes
    assert [s.task for s in found.swaps] == [0, 1]
    assert [o.tasks for o in found.overlaps] == [(0, 1), (0, 2), (1, 2)]
    # task 1 kept the weights that it began with, those of its best epoch
    assert {(u.task, u.part) for u in found.updates} == {(2, "encoder"), (2, "temporal"), (2, "head")}
    assert [m.task for m in found.moved] == [1, 2] and found.moved[0].kl == 0 < found.moved[1].kl
    assert all(0 < o.all <= 1 for o in found.overlaps)
    assert diagnose(request) == found, "the same call gives the same numbers"
    written = write_diagnosis(found, request.run)
    assert tab.faults_on_a_phone(written) == []
    page = written.read_text(encoding="utf-8")
    assert "Parts put back" in page and "Updates of later tasks" in page
    saved = json.loads((request.run / "diagnosis.json").read_text(encoding="utf-8"))
    assert saved["swaps"][0]["learned"] == found.swaps[0].learned
    assert findings(found)[0].startswith("Task 1: error ")


@pytest.mark.parametrize("algorithm", ["packnet", SingleTask])
def test_weights_of_a_tasks_own_are_not_lost(learned, algorithm):
    found = diagnose(learned(algorithm))
    assert all(s.learned == s.final and set(s.swapped.values()) == {s.final} for s in found.swaps)
    assert all(d.relative == 0 for d in found.drifts)
    assert not found.updates and "gives each task weights of its own" in found.notes[0]
    assert "nothing is lost" in findings(found)[1]


def test_one_adapter_for_all_tasks_has_updates_and_a_frozen_part_no_overlap(learned):
    found = diagnose(learned(lambda: LoRA(rank=2, alpha=4.0, adapters="shared", adapted=("head.*",))))
    assert not found.notes and {(u.task, u.part) for u in found.updates} == {(2, "head")}
    policy, then, _ = policies()
    parts = parts_of(policy, dataset(0).batch(torch.arange(8)))
    fisher = {name: then[name].square() for name in parts["head"]}
    shared = overlap((0, 1), fisher, fisher, parts)
    assert shared.all == pytest.approx(1) and np.isnan(shared.parts["encoder"])


def test_the_divergence_of_single_gaussians_is_that_of_its_formula():
    torch.manual_seed(0)
    policy = small_transformer(SPEC, head=partial(GMMHead, hidden=16, modes=1, min_std=0.3))
    then, batch = copy_weights(policy), dataset(0).batch(torch.arange(20))
    now = {n: v + 0.3 * torch.randn_like(v) if n.startswith("head.") else v for n, v in then.items()}
    shape = []
    for weights in (then, now):
        with acting_with(policy, weights), torch.no_grad():
            params = policy.eval().head(policy.over_time(policy.encode(batch.observation)))
            shape.append(Normal(params["means"].squeeze(-2), params["stds"].squeeze(-2)))
    expected = kl_divergence(*shape).sum(-1).mean().item()
    found = divergence(policy, then, now, batch, torch.Generator().manual_seed(0))
    assert found == pytest.approx(expected, rel=0.08) and expected > 0.3
    assert divergence(policy, then, then, batch, torch.Generator()) == 0


def test_unfinished_runs_say_so_and_missing_checkpoints_are_named(learned):
    request = learned("sequential")
    checkpoints = request.run / "checkpoints"
    (checkpoints / "task_2.safetensors").rename(checkpoints / "kept")
    found = diagnose(request)
    assert found.notes == ("The run is not finished: 2 of 3 tasks are learned.",) and len(found.swaps) == 1
    (checkpoints / "kept").rename(checkpoints / "task_2.safetensors")
    (checkpoints / "task_1.safetensors").unlink()
    with pytest.raises(LifelongError, match="no checkpoint after task 1; valid: \\[0, 2\\]"):
        diagnose(request)
    (checkpoints / "task_2.safetensors").unlink()
    with pytest.raises(LifelongError, match="learned its 1 tasks in one stage; a diagnosis needs two"):
        diagnose(request)


def test_experts_beside_the_layers_are_refused_by_name(learned, monkeypatch):
    request = learned(SingleTask)
    monkeypatch.setattr(SingleTask, "acts_by_weights", False)
    with pytest.raises(LifelongError, match="SingleTask acts with experts beside the policy's layers"):
        diagnose(request)
