"""The choices of LIBERO's code, each told apart from ours by what it does."""

import copy
import dataclasses

import pytest
import torch

from libero_env.errors import UnknownNameError
from lifelong import checkpoints
from lifelong.algorithms.importance import BatchFisher
from lifelong.launch import check_choices
from lifelong.seeding import generator
from lifelong.settings import build
from lifelong.training.fit import fit
from lifelong.training.settings import FitSettings
from tests.harness import sequences
from tests.harness.algorithms import assert_resumed_equals_uninterrupted, by_hand, learn, outputs
from tests.harness.configs import CONFIGS, FILES, composed
from tests.harness.fakes import DeepPolicy, LinearPolicy, Windows

WITH_COMPAT = ("er", "agem", "ewc", "packnet")


def made(name: str, compat: str, *overrides: str):
    """An algorithm as the configuration builds it."""
    return build(composed(f"algo={name}", f"compat={compat}", *overrides).algo)


def mirrored(batch, draws):
    """Stands for an augmentation: actions change sign."""
    return dataclasses.replace(batch, actions=-batch.actions)


# --- ER and A-GEM


@pytest.mark.parametrize("name", ["er", "agem"])
def test_memory_is_the_first_windows_of_each_task_in_file_order(name):
    ours, theirs = made(name, "none", "algo.memory.budget=14"), made(name, "libero", "algo.memory.budget=7")
    for task in range(3):
        for algorithm in (ours, theirs):
            algorithm.end_task(task, Windows(task), LinearPolicy(), generator(task))
    kept = {name: a.state_dict()["memory"]["indices"] for name, a in (("ours", ours), ("theirs", theirs))}
    assert {t: len(i) for t, i in kept["theirs"].items()} == {"0": 7, "1": 7, "2": 7}  # they do not shrink
    assert all(torch.equal(i, torch.arange(7)) for i in kept["theirs"].values())
    assert len(ours.memory) == 14
    assert not any(torch.equal(i.sort().values, torch.arange(len(i))) for i in kept["ours"].values())


def test_memory_may_be_longer_than_a_task_and_is_restored():
    algorithm = made("er", "libero", "algo.memory.budget=30")
    algorithm.end_task(0, Windows(0, size=20), LinearPolicy(), generator(0))
    algorithm.end_task(1, Windows(1, size=40), LinearPolicy(), generator(0))
    assert algorithm.memory.shares == {0: 20, 1: 30}
    other = made("er", "libero", "algo.memory.budget=30")
    other.load_state_dict(algorithm.state_dict(), {0: Windows(0, size=20), 1: Windows(1, size=40)})
    batch = Windows(2).batch(torch.arange(8))
    mixed = [a.mix(batch, generator(5)) for a in (algorithm, other)]
    assert len(mixed[0]) == 16 and torch.equal(mixed[0].actions, mixed[1].actions)
    other.end_task(2, Windows(2, size=40), LinearPolicy(), generator(0))
    assert other.memory.shares == {0: 20, 1: 30, 2: 30}


@pytest.mark.parametrize("compat", ["none", "libero"])
def test_agem_augments_its_reference_as_the_original_only(compat):
    algorithm = made("agem", compat, "algo.memory.budget=20")
    algorithm.set_augmentation(mirrored)
    algorithm.end_task(0, Windows(0), LinearPolicy(), generator(0))
    algorithm.mix(Windows(1).batch(torch.arange(20)), generator(0))
    reference, stored = algorithm._reference, Windows(0)
    sign = -1 if compat == "libero" else 1
    assert torch.equal(reference.actions[:, 0], sign * stored.targets[reference.window_ids])


# --- EWC


def test_ewc_strength_goes_with_the_estimate():
    assert (
        made("ewc", "none").strength == 1500 and made("ewc", "none", "algo/estimator=batch").strength == 5e4
    )
    theirs = made("ewc", "libero")
    assert (theirs.strength, theirs.gamma) == (5e4, 0.9)
    assert (type(theirs.estimator), theirs.estimator.windows) == (BatchFisher, 0)
    assert made("ewc", "libero", "algo.strength=3.0").strength == 3.0


def test_ewc_fisher_is_of_augmented_batches_of_all_windows_in_training_mode():
    policy, data, modes = LinearPolicy(), Windows(size=600), []
    loss = policy.loss
    policy.loss = lambda batch: modes.append((policy.training, len(batch))) or loss(batch)
    theirs = made("ewc", "libero", "algo.estimator.batch_size=300").estimator
    fisher = theirs.estimate(data, policy.eval(), generator(0), mirrored)
    assert modes == [(True, 300), (True, 300)] and not policy.training
    order = torch.randperm(600, generator=generator(0))
    data.targets.neg_()
    halves = [by_hand(policy, data)[half].mean(0).square() for half in order.split(300)]
    torch.testing.assert_close(fisher["linear.weight"], (halves[0] + halves[1]) / 2)

    modes.clear()
    ours = made("ewc", "none", "algo/estimator=batch", "algo.estimator.batch_size=300").estimator
    estimate = ours.estimate(data, policy, generator(0), mirrored)
    assert not torch.allclose(estimate["linear.weight"], fisher["linear.weight"])
    assert [size for _, size in modes] == [300, 212]


# --- PackNet


def learned(compat: str, weight_decay: float, tasks: int = 2):
    """A policy after so many tasks, what it was before each, and the algorithm."""
    torch.manual_seed(0)
    policy, algorithm, states = DeepPolicy(), made("packnet", compat, "algo.prune_perc=0.5"), []
    settings = FitSettings(epochs=2, batch_size=8, lr=1e-2, weight_decay=weight_decay, precision="fp32")
    for task in range(tasks):
        states.append((copy.deepcopy(policy.state_dict()), copy.deepcopy(algorithm)))
        algorithm.begin_task(task, Windows(task), policy)
        for number, phase in enumerate(algorithm.phases()):
            algorithm.begin_phase(phase, policy)
            fit(policy, Windows(task), algorithm, settings=settings, seed=(task, number))
            algorithm.end_phase(phase, policy)
        algorithm.end_task(task, Windows(task), policy, generator(task))
    return policy, algorithm, states


def test_packnet_divides_weights_of_linear_layers_and_image_convolutions_only():
    owners = {c: set(learned(c, 0.0, tasks=1)[1].state_dict()["owner"]) for c in ("none", "libero")}
    assert owners["libero"] == {"head.weight"}  # the convolution of the fake policy has one dimension
    assert owners["none"] > {"head.weight", "inner.weight", "memory.weight_hh_l0", "place.weight"}


def test_packnet_masks_keep_frozen_weights_but_for_weight_decay():
    for decay in (0.0, 0.1):
        policy, algorithm, states = learned("libero", decay)
        owned = algorithm.state_dict()["owner"]["head.weight"] == 1
        before, after = states[1][0]["head.weight"][owned], policy.head.weight[owned]
        assert torch.equal(before, after) == (decay == 0.0)
        assert (after.abs() <= before.abs()).all()
        ours, algorithm, states = learned("none", decay)
        owned = algorithm.state_dict()["owner"]["head.weight"] == 1
        assert torch.equal(states[1][0]["head.weight"][owned], ours.head.weight[owned])


def test_packnet_never_trains_biases_and_layer_norms_but_all_else_with_every_task():
    policy, _, states = learned("libero", 0.0)
    fresh, first, second = states[0][0], states[1][0], policy.state_dict()
    for name in ("head.bias", "layer_norm.weight", "norm.bias", "norm.running_mean"):
        assert torch.equal(fresh[name], first[name]) and torch.equal(first[name], second[name]), name
    for name in ("memory.weight_ih_l0", "memory.bias_hh_l0", "place.weight", "inner.weight"):
        assert not torch.equal(fresh[name], first[name]) and not torch.equal(first[name], second[name]), name


@pytest.mark.parametrize("compat", ["none", "libero"])
def test_packnet_forgets_as_the_original_only(compat):
    policy, algorithm, states = learned(compat, 0.1)
    then, before = states[1]
    old = DeepPolicy()
    old.load_state_dict(then)
    assert torch.equal(outputs(before, old, 0), outputs(algorithm, policy, 0)) == (compat == "none")


# --- all of them


def test_another_choice_is_refused():
    with pytest.raises(UnknownNameError, match="Valid: libero, none"):
        check_choices(["algo=er", "compat=robomimic"], [CONFIGS])


def test_the_sequence_sets_the_augmentation_of_its_algorithm(tmp_path):
    context = dataclasses.replace(sequences.run_context(tmp_path, "ewc"), augment=mirrored)
    sequences.sequence(context)
    assert context.algorithm.augment is mirrored


@pytest.mark.parametrize("overrides", [("er", "libero", "algo.memory.budget=5"), ("packnet", "libero")])
def test_a_state_restored_between_tasks_changes_nothing(overrides, tmp_path):
    torch.manual_seed(1)
    policy, algorithm = DeepPolicy(), made(*overrides)
    learn(algorithm, policy, 0)
    checkpoints.save(tmp_path / "s", {"policy": policy.state_dict(), "algorithm": algorithm.state_dict()})
    learn(algorithm, policy, 1)

    state = checkpoints.load(tmp_path / "s")
    other_policy, other = DeepPolicy(), made(*overrides)
    other_policy.load_state_dict(state["policy"])
    other.load_state_dict(state["algorithm"], {0: Windows(0)})
    learn(other, other_policy, 1)
    sequences.assert_same(dict(other_policy.state_dict()), dict(policy.state_dict()))


def test_killed_and_resumed_equals_uninterrupted(tmp_path, monkeypatch):
    """EWC's estimate needs the augmentation even where a process was killed just before it."""
    run_context = sequences.run_context
    monkeypatch.setitem(sequences.ALGORITHMS, "ewc", lambda: made("ewc", "libero"))
    monkeypatch.setattr(
        sequences, "run_context", lambda *a: dataclasses.replace(run_context(*a), augment=mirrored)
    )
    assert_resumed_equals_uninterrupted(tmp_path, "ewc", monkeypatch)


# --- the switch


@pytest.mark.parametrize("name", sorted(f.stem for f in FILES if str(f.parent) == "algo"))
@pytest.mark.parametrize("preset", ["paper", "laptop"])
def test_compat_libero_sets_every_choice(name, preset):
    config = composed(f"algo={name}", f"preset={preset}", "compat=libero")
    assert config.eval.selection == "reporting" and config.eval.select == "best" and config.policy.stochastic
    assert (config.algo != composed(f"algo={name}", f"preset={preset}").algo) == (name in WITH_COMPAT)
    build(config.algo)


def test_compat_none_sets_none_of_them():
    for name in WITH_COMPAT:
        config = composed(f"algo={name}")
        assert config.eval.selection == "apart" and not config.policy.stochastic


def test_values_on_the_command_line_win_over_it():
    config = composed(
        "algo=ewc", "compat=libero", "eval.selection=apart", "policy.stochastic=false", "algo.strength=7"
    )
    assert (config.eval.selection, config.policy.stochastic, config.algo.strength) == ("apart", False, 7)
