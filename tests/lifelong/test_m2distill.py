"""What distillation of features and of the action distribution promises."""

import copy
from dataclasses import replace

import pytest
import torch

from lifelong.algorithms import ER, M2Distill
from lifelong.algorithms.contrib.m2distill import distances
from lifelong.data.memory import ReplayMemory
from lifelong.nn.augmentation import RandomShift
from lifelong.policies.history import HistoryPolicy
from lifelong.seeding import generator
from lifelong.training.costs import stored_bytes
from lifelong.training.fit import fit
from tests.harness import sequences
from tests.harness.algorithms import POLICIES, SMALL, learn_frames, make_policy

KINDS = {"image", "language", "proprio", "policy"}


def pair(kind: str = "bc_transformer", head: str = "gmm"):
    """Return a teacher, a student that is equal to it, both without dropout, and an observation."""
    policy = make_policy(kind, head).eval()
    return policy, copy.deepcopy(policy), sequences.dataset(0).batch(torch.arange(6)).observation


@pytest.mark.parametrize("head", ["gmm", "deterministic", "flow"])
@pytest.mark.parametrize("kind", POLICIES)
def test_all_distances_and_their_gradients_are_zero_at_the_old_weights(kind, head):
    teacher, student, observation = pair(kind, head)
    found = distances(student, teacher, observation)
    assert found.keys() == KINDS
    assert all(distance.item() == pytest.approx(0, abs=1e-6) for distance in found.values())
    torch.stack(list(found.values())).sum().backward()
    assert all(p.grad is None or p.grad.abs().max() < 1e-5 for p in student.parameters())


def moved(student: HistoryPolicy, pattern: str) -> None:
    with torch.no_grad():
        for name, p in student.named_parameters():
            if pattern in name:
                p.add_(0.1 * torch.randn(p.shape, generator=generator(1)))


@pytest.mark.parametrize(("part", "kinds"), [
    ("language.linear", {"language", "policy"}), ("proprio.linears", {"proprio", "policy"}),
    ("encoders.", {"image", "policy"}), ("transformer.", {"policy"}), ("head.", {"policy"})
])  # fmt: skip
def test_each_distance_tells_of_its_own_modality(part, kinds):
    teacher, student, observation = pair()
    moved(student, part)
    found = distances(student, teacher, observation)
    assert {name for name, distance in found.items() if distance.item() > 1e-6} == kinds
    assert all(distance.item() >= 0 for distance in found.values())


@pytest.mark.parametrize("kind", ["language", "image", "proprio"])
def test_a_step_against_a_distance_brings_that_modality_back(kind):
    teacher, student, observation = pair()
    moved(student, "")
    before = distances(student, teacher, observation)[kind]
    before.backward()
    with torch.no_grad():
        for p in student.parameters():
            if p.grad is not None:
                p -= 1e-3 * p.grad
    assert distances(student, teacher, observation)[kind].item() < before.item()


def test_the_image_distance_is_the_sum_over_the_cameras_of_squared_norms():
    teacher, student, observation = pair()
    moved(student, "encoders.")
    with torch.no_grad():
        old, new = (p.modalities(p.encode(observation))["agentview_rgb"] for p in (teacher, student))
    expected = (old - new).square().sum(-1).mean()
    assert distances(student, teacher, observation)["image"].item() == pytest.approx(
        expected.item(), rel=1e-5
    )


def test_the_penalty_is_the_weighted_sum_on_earlier_windows():
    algorithm = M2Distill(image=2.0, language=3.0, proprio=5.0, policy=7.0, ratio=0.5)
    policy = make_policy()
    batch = sequences.dataset(1).batch(torch.arange(8))
    assert algorithm.mix(batch, generator(0)) is batch and algorithm.penalty(policy) is None
    algorithm.end_task(0, sequences.dataset(0), policy, generator(0))
    teacher = copy.deepcopy(policy).eval()
    moved(policy.eval(), "")
    mixed = algorithm.mix(batch, generator(0))
    assert mixed.task_ids.tolist() == [1] * 8 + [0] * 4
    drawn = algorithm.distilled
    assert drawn.task_ids.tolist() == [0] * 4
    found = distances(policy, teacher, drawn.observation)
    expected = 2 * found["image"] + 3 * found["language"] + 5 * found["proprio"] + 7 * found["policy"]
    assert algorithm.penalty(policy).item() == pytest.approx(expected.item(), rel=1e-4)
    assert algorithm.penalty(policy) is None  # each draw counts once


def test_what_is_distilled_on_is_augmented_as_batches_are():
    algorithm = M2Distill(ratio=1.0)
    algorithm.set_augmentation(RandomShift(3))
    algorithm.end_task(0, sequences.dataset(0), make_policy(), generator(0))
    algorithm.mix(sequences.dataset(1).batch(torch.arange(8)), generator(0))
    drawn = algorithm.distilled
    kept = sequences.dataset(0).batch(drawn.window_ids)
    assert torch.equal(drawn.actions, kept.actions)
    assert not torch.equal(drawn.observation.images, kept.observation.images)


def test_distillation_keeps_features_and_actions_nearer_than_replay_alone():
    found = []
    for algorithm in (
        ER(memory=ReplayMemory(20)),
        M2Distill(budget=20, image=0.1, language=0.1, proprio=0.1, policy=1.0),
    ):
        policy = make_policy()
        learn_frames(algorithm, policy, 0)
        teacher = copy.deepcopy(policy).eval()
        fit(policy, sequences.dataset(1), algorithm, settings=replace(SMALL, epochs=6, lr=3e-3), seed=(1,))
        with torch.no_grad():
            seen = sequences.dataset(0).batch(torch.arange(20)).observation
            found.append(distances(policy.eval(), teacher, seen))
    replay, distilled = found
    assert all(distilled[kind] < replay[kind] for kind in KINDS)


def test_it_stores_the_windows_and_one_copy_of_the_weights():
    policy, algorithm, replay = make_policy(), M2Distill(budget=25), ER(memory=ReplayMemory(25))
    for stored in (algorithm, replay):
        stored.end_task(0, sequences.dataset(0), policy, generator(0))
    weights = sum(t.nbytes for t in policy.state_dict().values())
    assert stored_bytes(algorithm) == stored_bytes(replay) + weights
