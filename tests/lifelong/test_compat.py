"""The choices of LIBERO's code, each told apart from ours by what it does."""

import copy
import dataclasses

import pytest
import torch

from lifelong.algorithms.importance import BatchFisher
from lifelong.errors import ConfigError
from lifelong.seeding import generator
from lifelong.settings import build
from lifelong.training.fit import fit
from lifelong.training.settings import FitSettings
from lifelong.training.step import Step
from tests.harness import sequences
from tests.harness.algorithms import assert_resumed_equals_uninterrupted, by_hand
from tests.harness.configs import FILES, composed
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
    algorithm = made("er", "libero", "algo.memory.budget=30", "algo.memory.batch_size=8")
    algorithm.end_task(0, Windows(0, size=20), LinearPolicy(), generator(0))
    algorithm.end_task(1, Windows(1, size=40), LinearPolicy(), generator(0))
    assert algorithm.memory.shares == {0: 20, 1: 30}
    other = made("er", "libero", "algo.memory.budget=30", "algo.memory.batch_size=8")
    other.load_state_dict(algorithm.state_dict(), {0: Windows(0, size=20), 1: Windows(1, size=40)})
    batch = Windows(2).batch(torch.arange(8))
    mixed = [a.mix(batch, generator(5)) for a in (algorithm, other)]
    assert len(mixed[0]) == 16 and torch.equal(mixed[0].actions, mixed[1].actions)
    other.end_task(2, Windows(2, size=40), LinearPolicy(), generator(0))
    assert other.memory.shares == {0: 20, 1: 30, 2: 30}


@pytest.mark.parametrize("name", ["er", "agem"])
def test_a_ratio_without_effect_is_refused_and_not_tuned(name):
    with pytest.raises(ConfigError, match=r"algo.ratio has no effect with algo.memory.batch_size"):
        made(name, "libero", "algo.ratio=0.5")
    assert made(name, "none").tuned and not made(name, "libero").tuned
    assert made(name, "libero", "algo.memory.batch_size=null", "algo.ratio=0.5").tuned


@pytest.mark.parametrize("compat", ["none", "libero"])
def test_agem_augments_its_reference_as_the_original_only(compat):
    sizes = () if compat == "none" else ("algo.memory.batch_size=20",)
    algorithm = made("agem", compat, "algo.memory.budget=20", *sizes)
    algorithm.set_augmentation(mirrored)
    algorithm.end_task(0, Windows(0), LinearPolicy(), generator(0))
    algorithm.mix(Windows(1).batch(torch.arange(20)), generator(0))
    reference, stored = algorithm.reference, Windows(0)
    sign = -1 if compat == "libero" else 1
    assert torch.equal(reference.actions[:, 0], sign * stored.targets[reference.window_ids])


def test_windows_of_the_memory_come_in_passes_without_repetition_as_from_a_loader():
    algorithm = made("er", "libero", "algo.memory.budget=10", "algo.memory.batch_size=8")
    for task in range(2):
        algorithm.end_task(task, Windows(task), LinearPolicy(), generator(0))
    batch, draws = Windows(2).batch(torch.arange(3)), generator(1)
    drawn = [algorithm.mix(batch, draws) for _ in range(6)]
    assert [len(mixed) - 3 for mixed in drawn] == [8, 8, 4, 8, 8, 4]  # whatever the batch's size is
    replayed = [
        [(int(t), int(w)) for t, w in zip(m.task_ids[3:], m.window_ids[3:], strict=True)] for m in drawn
    ]
    everything = sorted((task, window) for task in range(2) for window in range(10))
    assert sorted(sum(replayed[:3], [])) == everything and sorted(sum(replayed[3:], [])) == everything
    assert replayed[:3] != replayed[3:]
    again = generator(1)  # an epoch that is repeated draws the same, wherever the last pass ended
    algorithm.mix(batch, generator(7))
    assert torch.equal(algorithm.mix(batch, again).window_ids, drawn[0].window_ids)


# --- EWC


def test_ewc_strength_goes_with_the_estimate():
    assert made("ewc", "none").strength == 15  # that of the small mixture
    assert made("ewc", "none", "policy=bc_mlp_small").strength == 1500
    assert made("ewc", "none", "algo/estimator=batch").strength == 5e4
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
def test_packnet_zeroes_frozen_gradients_after_they_are_clipped_as_the_original_only(compat):
    """What is frozen counts in the norm that is clipped, so less is left for the weights that move."""
    policy, algorithm, _ = learned(compat, 0.0, tasks=1)
    algorithm.begin_task(1, Windows(1), policy)
    algorithm.begin_phase(algorithm.phases()[0], policy)
    optimizer = torch.optim.SGD(algorithm.trained(policy), lr=0.0)
    settings = FitSettings(grad_clip=1e-3, precision="fp32")
    algorithm.mode_train(policy)
    Step(policy, algorithm, optimizer, settings)(Windows(1).batch(torch.arange(8)), generator(0))
    left = torch.stack([p.grad.norm() for p in policy.parameters() if p.grad is not None]).norm().item()
    assert left == pytest.approx(1e-3, rel=1e-3) if compat == "none" else 0 < left < 0.99e-3
    owned = algorithm.state_dict()["owner"]["head.weight"] == 1
    assert owned.any() and not policy.head.weight.grad[owned].any()


# --- all of them


def test_the_sequence_sets_the_augmentation_of_its_algorithm(tmp_path):
    context = dataclasses.replace(sequences.run_context(tmp_path, "ewc"), augment=mirrored)
    sequences.sequence(context)
    assert context.algorithm.augment is mirrored


def test_killed_and_resumed_equals_uninterrupted(tmp_path, monkeypatch):
    """EWC's estimate needs the augmentation even where a process was killed just before it."""
    run_context = sequences.run_context
    monkeypatch.setattr(
        sequences, "run_context", lambda *a: dataclasses.replace(run_context(*a), augment=mirrored)
    )
    assert_resumed_equals_uninterrupted(tmp_path, lambda: made("ewc", "libero"), monkeypatch)


# --- the switch


@pytest.mark.parametrize("name", sorted(f.stem for f in FILES if str(f.parent) == "algo"))
def test_compat_libero_sets_every_choice(name):
    config = composed(f"algo={name}", "preset=laptop", "compat=libero")
    ours = composed(f"algo={name}", "preset=laptop")
    chosen = [(one.eval.selection, one.eval.select, one.policy.stochastic) for one in (config, ours)]
    assert chosen == [("reporting", "first_best", True), ("apart", "last", False)]
    assert (config.algo != ours.algo) == (name in WITH_COMPAT)
    build(config.algo)


PAPER = {  # what `preset=paper compat=libero` sets beside algorithms
    "language": {"model": "bert", "pad_to": 25, "numbered": False},
    "data": {"pairing": "stored"},
    "train": {"lr_every": "epoch", "last_batch": "short", "statistics_first": True, "precision": "fp32"},
    "eval": {"precision": "fp32", "selection": "reporting", "select": "first_best"},
    "policy": {"stochastic": True, "normalise_proprio": False, "standardise_language": False},
}
ENCODERS = {
    "bc_transformer": {"norm": "batch", "pixels": "libero", "init": "libero"},
    "bc_rnn": {"norm": "batch", "pixels": "libero", "init": "libero"},
    "bc_vilt": {"norm": "batch", "pixels": "libero", "rectify": False},
}


@pytest.mark.parametrize("policy", ENCODERS)
def test_the_paper_preset_with_compat_libero_is_the_original(policy):
    config = composed("preset=paper", "compat=libero", f"policy={policy}")
    ours = composed("preset=paper", f"policy={policy}")
    for group, values in PAPER.items():
        assert {key: config[group][key] for key in values} == values
    assert {key: config.policy.encoder[key] for key in ENCODERS[policy]} == ENCODERS[policy]
    assert not set(ENCODERS[policy].items()) & set(ours.policy.encoder.items())
    for part in {"temporal", "spatial"} & set(config.policy) if policy != "bc_rnn" else ():
        assert (config.policy[part].attention_dropout, config.policy[part].drop_path) == (0.0, 0.1)
    assert config.policy.get("memory", "none") == "none"
    assert [a["_target_"].rpartition(".")[2] for a in config.augmentation.augmentations] == [
        "SharedJitter",
        "SharedShift",
    ]
    assert config.augmentation != ours.augmentation and ours.language.model == "minilm"


def test_presets_for_small_machines_keep_their_inputs_and_their_training():
    for preset in ("laptop", "smoke"):
        theirs, ours = composed(f"preset={preset}", "compat=libero"), composed(f"preset={preset}")
        for group in ("data", "augmentation", "train"):
            assert theirs[group] == ours[group], (preset, group)
        assert theirs.language.model == ours.language.model == "minilm", "which is never padded"
        assert theirs.policy.encoder == ours.policy.encoder


def test_the_command_line_wins_over_compat():
    chosen = composed("preset=paper", "compat=libero", "language=minilm", "augmentation=none")
    assert chosen.language.model == "minilm" and not chosen.augmentation.augmentations
    config = composed(
        "algo=ewc", "compat=libero", "eval.selection=apart", "policy.stochastic=false", "algo.strength=7"
    )
    assert (config.eval.selection, config.policy.stochastic, config.algo.strength) == ("apart", False, 7)
