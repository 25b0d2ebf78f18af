"""What replay of latents through frozen features promises."""

import copy
import math
from dataclasses import replace

import pytest
import torch

from lifelong.algorithms import MLR
from lifelong.algorithms.base import load_algorithm
from lifelong.algorithms.contrib.mlr import adjust, describe, encoded, feature_parameters, similar_pairs
from lifelong.data.latents import LatentMemory, LatentWindows
from lifelong.errors import CheckpointError, DataError, PolicyError
from lifelong.nn.tokens import ProprioScaling
from lifelong.policies.history import HistoryPolicy
from lifelong.seeding import generator
from lifelong.streams import StageWindows
from lifelong.training.costs import step_costs, stored_bytes
from tests.harness import sequences
from tests.harness.algorithms import MIXING, POLICIES, learn_frames, make_policy
from tests.harness.fakes import LinearPolicy, Windows

TWO_VIEWS = replace(sequences.SPEC, views=("a", "b"), proprio={"x": 2, "y": 3})


def learned(tasks: int, kind: str = "bc_transformer", **settings):
    policy, algorithm = make_policy(kind), MLR(**settings)
    learn_frames(algorithm, policy, *range(tasks))
    return policy, algorithm


def random_observation(spec, windows: int = 2):
    draws = generator(0)
    images = torch.randint(
        0, 256, (windows, 3, len(spec.views), 16, 16, 3), generator=draws, dtype=torch.uint8
    )
    proprio = {name: torch.randn(windows, 3, size, generator=draws) for name, size in spec.proprio.items()}
    observation = sequences.dataset(0).batch(torch.arange(windows)).observation
    return replace(observation, images=images, proprio=proprio)


@pytest.mark.parametrize("kind", POLICIES)
def test_frozen_features_have_no_dropout_of_readings(kind):
    policy, algorithm = learned(1, kind)
    for module in policy.modules():
        if isinstance(module, ProprioScaling):
            module.dropout = 0.5
    algorithm.begin_task(1, sequences.dataset(1), policy)
    algorithm.mode_train(policy)
    batch = sequences.dataset(1).batch(torch.arange(16)).observation
    first, second = (policy.encode(batch).flatten() for _ in range(2))
    assert torch.equal(first, second)


# --- parts of the features


@pytest.mark.parametrize("kind", POLICIES)
def test_the_modalities_are_all_of_the_features_and_each_tells_of_its_own(kind):
    policy = make_policy(kind, spec=TWO_VIEWS).eval()
    observation = random_observation(TWO_VIEWS)
    parts = policy.modalities(policy.encode(observation))
    views = ["images"] if kind == "bc_vilt" else ["a", "b"]
    assert sorted(parts) == sorted(["language", "proprio", *views])
    numbers = torch.cat([part.flatten(2) for part in parts.values()], -1)
    assert numbers.shape == policy.encode(observation).flatten(2).shape
    assert torch.equal(numbers.sort(-1).values, policy.encode(observation).flatten(2).sort(-1).values)

    def changed(other):
        now = policy.modalities(policy.encode(other))
        return {name for name in parts if not torch.equal(parts[name], now[name])}

    assert changed(replace(observation, proprio={k: v + 1 for k, v in observation.proprio.items()})) == {
        "proprio"
    }
    second = observation.images.clone()
    second[:, :, 1] = 255 - second[:, :, 1]
    assert changed(replace(observation, images=second)) == {views[-1]}
    assert "language" in changed(replace(observation, language=observation.language + torch.arange(4.0)))


@pytest.mark.parametrize("kind", ["bc_transformer", "bc_rnn", "bc_mlp"])
def test_without_a_camera_there_are_the_other_parts(kind):
    policy = make_policy(kind, spec=replace(sequences.SPEC, views=())).eval()
    observation = sequences.dataset(0).batch(torch.arange(3)).observation
    blind = replace(observation, images=observation.images[:, :, :0])
    assert sorted(policy.modalities(policy.encode(blind))) == ["language", "proprio"]


def test_a_policy_that_does_not_name_its_parts_says_so():
    policy = make_policy()
    with pytest.raises(PolicyError, match=r"BCTransformer has no modalities\(features\).*choose another"):
        HistoryPolicy.modalities(policy, torch.zeros(1))


# --- what is frozen


@pytest.mark.parametrize("kind", POLICIES)
def test_features_stay_bit_identical_and_the_rest_learns(kind):
    policy, algorithm = learned(1, kind)
    dataset = sequences.dataset(0)
    before, weights = encoded(policy, dataset, torch.arange(20)), copy.deepcopy(policy.state_dict())
    learn_frames(algorithm, policy, 1, 2)
    assert torch.equal(encoded(policy, dataset, torch.arange(20)), before)
    moved = {name for name, value in policy.state_dict().items() if not torch.equal(value, weights[name])}
    frozen = set(feature_parameters(make_policy(kind), dataset.batch(torch.arange(2))))
    assert frozen == set(algorithm.frozen) and moved == set(dict(policy.named_parameters())) - frozen
    assert any("encoders" in name for name in frozen) and any("head" in name for name in moved)


def test_frozen_modules_have_no_dropout_and_others_do():
    policy, algorithm = learned(2, "bc_vilt")
    algorithm.mode_train(policy)
    assert not policy.spatial.training and not any(m.training for m in policy.encoders.modules())
    assert policy.transformer.training and policy.head.training


def test_a_pretrained_policy_is_frozen_at_once():
    policy = make_policy()
    before = encoded(policy, sequences.dataset(0), torch.arange(20))
    algorithm = MLR(base_tasks=0)
    learn_frames(algorithm, policy, 0)
    assert torch.equal(encoded(policy, sequences.dataset(0), torch.arange(20)), before)
    assert algorithm.memory.shares == {0: 20}


def test_several_base_tasks_keep_latents_of_the_last_one():
    _, algorithm = learned(3, base_tasks=2)
    assert algorithm.memory.shares == {1: 20, 2: 20}


# --- what is replayed


@pytest.mark.parametrize("kind", POLICIES)
def test_replayed_latents_are_the_features_of_the_frames_within_half_a_step(kind):
    policy, algorithm = learned(3, kind)
    for task, windows in algorithm.memory.tasks.items():
        order = torch.randperm(20, generator=generator(task))
        exact = encoded(policy, sequences.dataset(task), order)
        error = (windows.values(torch.arange(20)) - exact).abs()
        assert (error <= windows.step / 2 * 1.001 + 1e-6).all()
        assert windows.step.max() < (exact.max() - exact.min()) / 255 * 1.001
        assert torch.equal(windows.actions, sequences.dataset(task).batch(order).actions)


def test_the_penalty_is_the_loss_of_the_replayed_windows():
    policy, algorithm = learned(2, ratio=2.0, adjustment=0.0)
    dataset = sequences.dataset(2)
    algorithm.begin_task(2, dataset, policy)
    policy.eval()
    algorithm.mix(dataset.batch(torch.arange(20)), generator(0))
    both = sequences.dataset(0).batch(torch.arange(20)).join(sequences.dataset(1).batch(torch.arange(20)))
    found, exact = algorithm.penalty(policy), 2.0 * policy.loss(both)  # 40 windows are drawn of 40
    assert found.item() == pytest.approx(exact.item(), rel=0.02)
    assert algorithm.penalty(policy) is None  # each draw counts once


@pytest.mark.parametrize(
    ("budget", "keep", "shares"), [(30, 1.0, [10, 10, 10]), (100, 0.5, [10, 10, 10]), (25, 1.0, [8, 8, 9])]
)
def test_the_budget_is_never_exceeded_and_shared_evenly(budget, keep, shares):
    _, algorithm = learned(3, budget=budget, keep=keep)
    assert sorted(algorithm.memory.shares.values()) == shares
    latents, actions = algorithm.memory.sample(40, generator(0))
    assert len(latents) == len(actions) == 40


def test_latents_take_a_byte_for_each_number():
    _, algorithm = learned(2)
    tokens, readings = 3 * 3 * 8, 3 * 7 * 4  # T tokens of E numbers, T actions of A floats
    per_window = tokens + readings
    assert 40 * per_window < stored_bytes(algorithm) < 40 * per_window + 1200


def test_a_step_costs_less_than_one_of_fine_tuning_with_the_same_windows():
    policy, algorithm = learned(2)
    plain = step_costs(make_policy(), sequences.ALGORITHMS["sequential"](), sequences.dataset(1), 8)
    algorithm.begin_task(2, sequences.dataset(2), policy)
    costs = step_costs(policy, algorithm, sequences.dataset(2), 8)
    assert costs["flops_per_step"] < plain["flops_per_step"]
    assert costs["parameters_trained"] < plain["parameters_trained"]


@pytest.mark.parametrize("constant", [False, True])
def test_rounding_keeps_the_ends_of_the_range(constant):
    values = torch.randn(5, 2, 3, generator=generator(0)) * (0 if constant else 4) + 7
    windows = LatentWindows.of(values, torch.zeros(5, 2, 7))
    rounded = windows.values(torch.arange(5))
    assert torch.allclose(rounded.flatten(0, 1).amax(0), values.flatten(0, 1).amax(0), atol=1e-5)
    assert torch.allclose(rounded.flatten(0, 1).amin(0), values.flatten(0, 1).amin(0), atol=1e-5)


# --- similar tasks are held apart


def unit(*angles: float) -> torch.Tensor:
    return torch.stack([torch.tensor([math.cos(a), math.sin(a)]) for a in angles])


def test_the_adjustment_is_the_papers_formula():
    own, near = unit(0.0, 0.0), unit(1.0, 0.4)
    z = 3.0 * unit(0.5, 0.1)
    found = adjust(z, own, near, 0.72)
    expected = sum(max(0.0, abs(t) - abs(t - a) + 0.72 * a) for t in (0.5, 0.1) for a in (1.0, 0.4)) / 2
    assert float(found) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("kind", MIXING)
def test_the_adjustment_acts_on_the_trained_part_of_any_policy(kind):
    policy, algorithm = learned(1, kind, adjustment=5.0)
    dataset = sequences.dataset(1)
    algorithm.begin_task(1, dataset, policy)
    algorithm.trained(policy)
    assert len(algorithm.near) == 1  # with two tasks the only pair is in both halves
    algorithm.mix(dataset.batch(torch.arange(6)), generator(0))
    with_it = algorithm.penalty(policy)
    algorithm.near = algorithm.near[:0]
    algorithm.mix(dataset.batch(torch.arange(6)), generator(0))
    assert with_it.item() != algorithm.penalty(policy).item()
    with_it.backward()
    graded = {name for name, p in policy.named_parameters() if p.grad is not None and p.grad.any()}
    assert graded and not graded & set(algorithm.frozen)


def test_similar_pairs_are_in_the_upper_half_by_both():
    words, images = unit(0.0, 0.1, 1.5, 1.55), unit(0.0, 1.4, 0.1, 0.15)
    # by words 01, 23 and 12; by images 02, 03 and 23
    assert similar_pairs(words, images) == [(2, 3)]


def test_instructions_that_are_learned_together_are_described_apart():
    policy = make_policy()
    together = StageWindows([sequences.dataset(0), sequences.dataset(1)], 1)
    words, images = describe(policy, together)
    apart = [describe(policy, sequences.dataset(task)) for task in (0, 1)]
    order = [0, 1] if torch.allclose(words[0], apart[0][0][0], atol=1e-5) else [1, 0]
    for row, task in enumerate(order):
        assert torch.allclose(words[row], apart[task][0][0], atol=1e-5)
        assert torch.allclose(images[row], apart[task][1][0], atol=0.05)


# --- its state


@pytest.mark.parametrize("name", ["codes", "low", "actions"])
def test_a_state_whose_parts_do_not_fit_is_refused(name, tmp_path):
    policy, algorithm = learned(1)
    state = copy.deepcopy(algorithm.state_dict())
    windows = state["memory"]["tasks"][0]
    windows[name] = windows[name][1:]
    if name == "codes":
        windows["codes"] = windows["codes"].float()
    with pytest.raises(CheckpointError, match="s: latents of the memory contradict"):
        load_algorithm(MLR(), state, {}, policy, tmp_path / "s")


def test_what_it_cannot_work_with_is_said_in_a_line():
    with pytest.raises(PolicyError, match="LinearPolicy has no encode, over_time and head.*choose another"):
        MLR(base_tasks=0).begin_task(0, Windows(0), LinearPolicy())
    memory = LatentMemory(3)
    with pytest.raises(DataError, match="the memory is empty"):
        memory.sample(1, generator(0))
    memory.add(0, torch.zeros(2, 3, 4), torch.zeros(2, 3, 7))
    with pytest.raises(DataError, match="task 0 is in the memory already"):
        memory.add(0, torch.zeros(2, 3, 4), torch.zeros(2, 3, 7))
