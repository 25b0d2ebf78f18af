"""Costs of algorithms: operations against formulas, without side effects of counting."""

import copy
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import nn

from lifelong.algorithms import Algorithm, Sequential
from lifelong.algorithms.agem import AGEM
from lifelong.algorithms.anchor import Anchored
from lifelong.algorithms.er import ER
from lifelong.data.memory import ReplayMemory
from lifelong.data.windows import StageWindows, WindowSubset, count_frames
from lifelong.nn import TemporalLSTM
from lifelong.report.tables import COST_COLUMNS
from lifelong.seeding import generator, seeded
from lifelong.training.costs import action_costs, count_flops, peak_costs, step_costs, stored_bytes
from lifelong.training.settings import FitSettings
from lifelong.training.step import Step
from lifelong.types import Batch
from tests.harness import sequences
from tests.harness.algorithms import POLICIES, make_policy
from tests.harness.policies import small_rnn
from tests.harness.sequences import EVERY, SPEC

dataset = partial(sequences.dataset, demos=1)
SETTINGS = FitSettings(epochs=1, batch_size=9, precision="fp32")


def counted(work) -> int:
    with count_flops() as counter:
        work()
    return counter.get_total_flops()


def test_attention_and_recurrence_count_as_the_products_they_are():
    lstm, x = nn.LSTM(5, 7, batch_first=True), torch.randn(2, 3, 5)
    assert counted(lambda: lstm(x)) == 2 * 2 * 3 * 4 * 7 * (5 + 7)
    q = torch.randn(2, 4, 6, 8)  # (B, heads, T, dim): q k' and the weighted sum
    attend = nn.functional.scaled_dot_product_attention
    assert counted(lambda: attend(q, q, q)) == 2 * (2 * 2 * 4 * 6 * 6 * 8)
    assert counted(lambda: lstm(x)[0].sum().backward()) == 3 * 2 * 2 * 3 * 4 * 7 * (5 + 7)
    linear = nn.Linear(5, 4)
    assert counted(lambda: linear(x[0]).sum().backward()) == 2 * (2 * 3 * 5 * 4)  # no gradient of the input


@pytest.mark.parametrize(
    ("kind", "make"),
    [(kind, Sequential) for kind in POLICIES] + [("bc_transformer", one) for one in EVERY.values()],
    ids=[*POLICIES, *EVERY],
)
def test_costs_of_two_small_steps_determine_those_of_any(kind: str, make: Callable[[], Algorithm]):
    policy, algorithm, first, second = make_policy(kind), make(), dataset(0), dataset(1)
    algorithm.begin_task(0, first, policy)
    algorithm.begin_phase(algorithm.phases()[0], policy)
    algorithm.end_phase(algorithm.phases()[0], policy)
    algorithm.end_task(0, first, policy, generator(0))
    algorithm.begin_task(1, second, policy)
    algorithm.begin_phase(algorithm.phases()[0], policy)
    said = step_costs(policy, algorithm, second, 9)["flops_per_step"]
    step = Step(policy, algorithm, torch.optim.AdamW(algorithm.trained(policy)), SETTINGS)
    algorithm.mode_train(policy)
    algorithm.after_step = lambda policy: None  # counted by nobody: a thousandth, of adapted weights
    products = counted(lambda: step(second.batch(torch.arange(9)), generator(0)))
    pulled = sum(map(torch.Tensor.numel, algorithm.anchor.values())) if isinstance(algorithm, Anchored) else 0
    assert (
        0 <= said - products - 5 * pulled < 30 + 3 * len(list(policy.parameters()))
    )  # numbers beside weights


def test_a_penalty_of_ones_own_counts_by_its_element_wise_operations():
    class Decay(Sequential):
        """A product and a sum; for its gradient two products by 1 and a sum of these."""

        def penalty(self, policy):
            return torch.stack([(p * p).sum() for p in policy.parameters()]).sum()

    policy = make_policy()
    plain, found = (
        step_costs(policy, one, dataset(0), 8)["flops_per_step"] for one in (Sequential(), Decay())
    )
    weights, tensors = sum(p.numel() for p in policy.parameters()), len(list(policy.parameters()))
    assert 4 * weights < found - plain <= 5 * weights + 3 * tensors + 30


@pytest.mark.parametrize("ratio", [0.125, 0.375, 1.0, 1.5])
def test_replay_counts_by_its_share_of_a_step_whose_gradient_costs_twice_the_loss(ratio):
    policy, first, second = make_policy(), dataset(0), dataset(1)
    costs = {}
    for algorithm in (Sequential(), ER(memory=ReplayMemory(9), ratio=ratio)):
        algorithm.end_task(0, first, policy, generator(0))
        costs[type(algorithm)] = step_costs(policy, algorithm, second, 16)["flops_per_step"]
    assert costs[ER] == (1 + ratio) * costs[Sequential]
    forward = counted(lambda: policy.loss(second.batch(torch.arange(16))))
    assert 2.5 * forward < costs[Sequential] < 3 * forward  # the images need no gradient


def test_count_flops_changes_neither_policy_nor_algorithm():
    policy, algorithm, windows = make_policy(), AGEM(memory=ReplayMemory(9)), dataset(1)
    algorithm.end_task(0, dataset(0), policy, generator(0))
    policy.train()
    before, state = copy.deepcopy(policy.state_dict()), torch.random.get_rng_state()
    step_costs(policy, algorithm, windows, 8)
    action_costs(policy, windows.language)
    assert policy.training and all(p.grad is None for p in policy.parameters())
    assert algorithm.reference is None
    assert torch.equal(torch.random.get_rng_state(), state)
    assert all(torch.equal(v, before[k]) for k, v in policy.state_dict().items())


def test_parameters_and_trained_parameters():
    policy = make_policy()
    everything = sum(p.numel() for p in policy.parameters())
    for p in policy.encoders.parameters():
        p.requires_grad_(False)
    costs = step_costs(policy, Sequential(), dataset(0), 4)
    frozen = sum(p.numel() for p in policy.encoders.parameters())
    assert costs["parameters"] == everything
    assert costs["parameters_trained"] == everything - frozen


def test_an_action_of_a_recurrent_policy_costs_less_with_carried_memory():
    lstm = partial(TemporalLSTM, hidden=16, layers=1)
    with seeded(1):
        window, carried = (small_rnn(SPEC, temporal=lstm, memory=m) for m in ("window", "reset"))
    read_anew = SPEC.seq_len - 1  # steps of the window that a carried memory has behind it
    step = 2 * sum(w.numel() for w in window.rnn.parameters() if w.dim() == 2)
    costs = [action_costs(p, torch.ones(SPEC.language_dim))["flops_per_action"] for p in (window, carried)]
    assert costs[0] - costs[1] == read_anew * step


@pytest.mark.parametrize("stage", [False, True], ids=["a task", "two tasks learned together"])
def test_a_memory_stores_a_frame_of_several_windows_once(stage: bool):
    parts = [dataset(0), dataset(1)] if stage else [dataset(0)]
    learned = StageWindows(parts, 0) if stage else parts[0]
    er = ER(memory=ReplayMemory(9))
    er.end_task(0, learned, make_policy(), generator(0))
    kept = er.state_dict()["memory"]["indices"]["0"].tolist()
    # a window covers three frames, fewer at the end of its demonstration
    ends = {i: 20 * (i // 20) + 20 for i in kept}
    frames = {frame for i in kept for frame in range(i, min(i + 3, ends[i]))}
    assert 9 < len(frames) < 27, "some windows overlap"
    assert stored_bytes(er) == len(frames) * (16 * 16 * 3 + 4 * 2 + 4 * 7) + 9 * 8  # and an index each


def test_windows_whose_frames_are_not_known_count_one_by_one():
    whole = dataset(0)

    class Plain:
        def __len__(self) -> int:
            return len(whole)

        def batch(self, indices: torch.Tensor) -> Batch:
            return whole.batch(indices)

    assert count_frames(Plain(), torch.tensor([0, 1, 2])) == 9
    assert count_frames(whole, torch.tensor([0, 1, 2])) == 5
    assert count_frames(WindowSubset(whole, torch.tensor([7, 18, 19])), torch.tensor([1, 2])) == 2
    assert count_frames(whole, torch.tensor([], dtype=torch.int64)) == 0


def test_peak_memory_is_that_of_this_process():
    assert (
        Path("/proc/self/status").exists() is False
        or peak_costs(torch.device("cpu"))["peak_memory_bytes"] > 2**26
    )
    assert set(peak_costs(torch.device("cpu"))) <= set(COST_COLUMNS)
