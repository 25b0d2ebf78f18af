"""What each algorithm promises, as properties."""

import copy

import pytest
import torch

from lifelong import checkpoints
from lifelong.algorithms import ER, EWC, PackNet
from lifelong.algorithms.anchor import WeightedDistance
from lifelong.algorithms.importance import BatchFisher, SampleFisher
from lifelong.data.memory import ReplayMemory
from lifelong.seeding import generator
from tests.harness.algorithms import by_hand, learn, outputs
from tests.harness.fakes import DeepPolicy, LinearPolicy, Windows

# --- ER


def test_er_keeps_its_budget_and_replays_earlier_tasks_only():
    policy, algorithm, draws = LinearPolicy(), ER(memory=ReplayMemory(25)), generator(0)
    for task in range(4):
        batch = Windows(task).batch(torch.arange(8))
        mixed = algorithm.mix(batch, draws)
        assert len(mixed) == (16 if task else 8)
        assert torch.equal(mixed.actions[:8], batch.actions)
        assert set(mixed.task_ids[8:].tolist()) <= set(range(task))
        learn(algorithm, policy, task)
        assert len(algorithm.memory) <= 25
    assert set(algorithm.memory.shares) == set(range(4))


# --- EWC


def test_ewc_has_no_penalty_before_the_first_task_ends():
    assert EWC().penalty(LinearPolicy()) is None


@pytest.mark.parametrize("estimator", [SampleFisher(), BatchFisher()])
def test_ewc_penalty_is_zero_at_the_anchor_and_only_there(estimator):
    policy, algorithm = LinearPolicy(), EWC(estimator=estimator)
    learn(algorithm, policy, 0)
    assert algorithm.penalty(policy).item() == 0
    with torch.no_grad():
        policy.linear.weight[0, 0] += 0.1
    assert algorithm.penalty(policy).item() > 0


def test_the_distance_from_an_anchor_is_the_written_out_sum_whatever_lies_how_in_memory():
    """What a checkpoint holds is contiguous; a resumed run goes on to the same bits."""
    draws = generator(0)
    channels_last = {"memory_format": torch.channels_last}
    shapes = torch.zeros(6, 4, 3, 3).to(**channels_last), torch.zeros(5, 9).T, torch.zeros(7), torch.zeros(())
    drawn = [[torch.empty_like(t).copy_(torch.rand(t.shape, generator=draws)) for t in shapes] for _ in "abc"]
    weights, anchors, importance = [t.requires_grad_() for t in drawn[0]], drawn[1], drawn[2]

    def gradients(value):
        return value, *torch.autograd.grad(3 * value, weights)

    written = sum((o * (w - a).square()).sum() for w, a, o in zip(weights, anchors, importance, strict=True))
    found = gradients(WeightedDistance.apply(anchors, importance, *weights))
    torch.testing.assert_close(found, gradients(written))
    stored = ([t.contiguous() for t in tensors] for tensors in (anchors, importance))
    resumed = gradients(WeightedDistance.apply(*stored, *weights))
    assert all(torch.equal(a, b) and a.stride() == b.stride() for a, b in zip(found, resumed, strict=True))


def test_fisher_per_sample_is_the_mean_squared_gradient_of_single_windows():
    policy, data = LinearPolicy(), Windows(size=7)
    fisher = SampleFisher(windows=0).estimate(data, policy, generator(0))
    torch.testing.assert_close(fisher["linear.weight"], by_hand(policy, data).square().mean(0))


def test_fisher_of_one_batch_is_the_squared_mean_gradient():
    policy, data = LinearPolicy(), Windows(size=8)
    fisher = BatchFisher(windows=0, batch_size=8).estimate(data, policy, generator(0))
    torch.testing.assert_close(fisher["linear.weight"], by_hand(policy, data).mean(0).square())


def test_fisher_per_sample_ignores_dropout_and_changes_no_state():
    policy, data = DeepPolicy(), Windows()
    policy.train()
    before = copy.deepcopy(policy.state_dict())
    first, second = (SampleFisher().estimate(data, policy, generator(s)) for s in (0, 0))
    assert all(torch.equal(first[n], second[n]) for n in first)
    assert policy.training and all(p.grad is None for p in policy.parameters())
    assert all(torch.equal(v, before[n]) for n, v in policy.state_dict().items())


def test_ewc_old_importance_decays_by_gamma():
    policy, algorithm = LinearPolicy(), EWC(gamma=0.5, estimator=SampleFisher(windows=0))
    data = Windows(size=6)
    algorithm.end_task(0, data, policy, generator(0))
    algorithm.end_task(1, data, policy, generator(0))
    expected = 1.5 * by_hand(policy, data).square().mean(0)
    torch.testing.assert_close(algorithm.state_dict()["importance"]["linear.weight"], expected)


# --- PackNet


def test_packnet_old_outputs_stay_bit_identical(tmp_path):
    torch.manual_seed(0)
    policy, algorithm = DeepPolicy(), PackNet(prune_perc=0.5)
    kept = {}
    for task in range(4):
        learn(algorithm, policy, task)
        for old, value in kept.items():
            assert torch.equal(outputs(algorithm, policy, old), value), f"task {old} moved with task {task}"
        kept[task] = outputs(algorithm, policy, task)

    checkpoints.save(tmp_path / "s", {"policy": policy.state_dict(), "algorithm": algorithm.state_dict()})
    state = checkpoints.load(tmp_path / "s")
    later_policy, later = DeepPolicy(), PackNet(prune_perc=0.5)
    later_policy.load_state_dict(state["policy"])
    later.load_state_dict(state["algorithm"], {})
    learn(later, later_policy, 4)
    for old, value in kept.items():
        assert torch.equal(outputs(later, later_policy, old), value)


def test_packnet_owns_a_quarter_of_what_is_free_and_covers_all_weights():
    policy, algorithm = DeepPolicy(width=32), PackNet(prune_perc=0.75)
    for task in range(3):
        learn(algorithm, policy, task)
        owners = algorithm.state_dict()["owner"].values()
        owned = sum(int((o == task + 1).sum()) for o in owners) / sum(o.numel() for o in owners)
        assert owned == pytest.approx(0.25 * 0.75**task, rel=0.05)
        if task:  # the first one also trains norms and biases
            assert algorithm.count_trained(policy) == sum(int((o == task + 1).sum()) for o in owners)
    assert set(algorithm.state_dict()["owner"]) == {n for n, p in policy.named_parameters() if p.dim() > 1}


def test_packnet_says_when_no_weight_is_free(caplog):
    policy, algorithm = DeepPolicy(), PackNet(prune_perc=0.01)
    learn(algorithm, policy, 0)
    assert "no free weight" not in caplog.text
    learn(algorithm, policy, 1)
    assert "task 2 has no free weight in" in caplog.text and "algo.prune_perc" in caplog.text


def test_packnet_trains_norms_and_biases_with_the_first_task_only():
    policy, algorithm = DeepPolicy(), PackNet()
    fresh = copy.deepcopy(policy.state_dict())
    learn(algorithm, policy, 0)
    first = copy.deepcopy(policy.state_dict())
    learn(algorithm, policy, 1)
    second = policy.state_dict()
    for name in ("norm.running_mean", "norm.weight", "head.bias", "memory.bias_hh_l0"):
        assert not torch.equal(first[name], fresh[name])
        assert torch.equal(first[name], second[name])
    assert not torch.equal(first["head.weight"], second["head.weight"])


def test_packnet_trains_all_weights_with_a_first_stage_of_several_tasks():
    policy, algorithm = DeepPolicy(), PackNet()
    fresh = copy.deepcopy(policy.state_dict())
    learn(algorithm, policy, 2)  # a stage has the number of its last task
    first = copy.deepcopy(policy.state_dict())
    learn(algorithm, policy, 3)
    for name in ("norm.running_mean", "norm.weight", "head.bias", "memory.bias_hh_l0"):
        assert not torch.equal(first[name], fresh[name])
        assert torch.equal(first[name], policy.state_dict()[name])
