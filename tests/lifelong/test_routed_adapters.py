"""What IsCiL and CLARE promise, as properties."""

import copy

import pytest
import torch
from torch import nn

from lifelong.algorithms import CLARE, DMPEL, IsCiL
from lifelong.algorithms.contrib.clare import BASE
from lifelong.errors import CheckpointError, ConfigError
from lifelong.nn.experts import adaptable_modules, expert_output
from lifelong.nn.routing import Discriminator, cluster_centres, groups_of_rows, nearest_key
from lifelong.seeding import generator
from lifelong.types import Observation
from tests.harness import sequences
from tests.harness.algorithms import POLICIES, everything, frame, learn_frames, make_policy, predict
from tests.harness.fakes import DeepPolicy


def iscil(**changes) -> IsCiL:
    return IsCiL(**({"rank": 2, "alpha": 4.0, "bases": 4, "states": 20} | changes))


def clare(**changes) -> CLARE:
    sizes = {"rank": 2, "hidden": 2, "discriminator_steps": 5, "threshold": 1.5, "windows": 8}
    return CLARE(**(sizes | changes))


BOTH = pytest.mark.parametrize("make", [iscil, clare], ids=["iscil", "clare"])


# --- both


@BOTH
@pytest.mark.parametrize("kind", POLICIES)
def test_base_and_earlier_adapters_never_change(make, kind):
    policy, algorithm, kept = make_policy(kind), make(), {}
    learn_frames(algorithm, policy, 0)
    base = copy.deepcopy(policy.state_dict())
    for task in (1, 2, 3):
        learn_frames(algorithm, policy, task)
        library = algorithm.state_dict()["library"]
        for old, adapters in kept.items():
            sequences.assert_same(library[old], adapters)
        kept[task] = copy.deepcopy(library[task])
        assert any(pair["b"].any() for pair in library[task].values())
    sequences.assert_same(dict(policy.state_dict()), dict(base))


@pytest.mark.parametrize("make", [iscil, clare, lambda: DMPEL(rank=2, pool=2, recall_steps=20)])
def test_no_task_number_is_needed(make):
    policy, algorithm = make_policy(), make()
    learn_frames(algorithm, policy, 0, 1, 2)
    answers = [predict(algorithm, policy, everything(1), task) for task in (0, 2, 7)]
    assert torch.equal(answers[0], answers[1]) and torch.equal(answers[0], answers[2])
    assert not torch.equal(answers[0], policy.eval().predict(everything(1)))


@BOTH
@pytest.mark.parametrize("kind", POLICIES)
def test_rows_of_a_batch_do_not_mix(make, kind):
    policy, algorithm = make_policy(kind), make()
    learn_frames(algorithm, policy, 0, 1, 2)
    together = predict(algorithm, policy, everything(1).join(everything(2)))
    apart = torch.cat([predict(algorithm, policy, everything(task)) for task in (1, 2)])
    torch.testing.assert_close(together, apart, rtol=1e-4, atol=1e-5)


@BOTH
@pytest.mark.parametrize("head", ["gmm", "flow"])
def test_actions_depend_on_no_other_episode(make, head):
    """Each of two episodes acts as if it were alone, also once the policy has a history."""
    policy, algorithm = make_policy(head=head), make()
    policy.stochastic = False
    learn_frames(algorithm, policy, 0, 1, 2)
    seen = everything(1).rows(torch.tensor([0])).join(everything(2).rows(torch.tensor([10]))).observation
    with algorithm.policy_for(1, policy) as acting:
        acting.eval().reset(2)
        both = torch.stack([acting.act(frame(seen, step)) for step in range(3)])
        for row in range(2):
            proprio = {k: v[[row]] for k, v in seen.proprio.items()}
            alone = Observation(seen.images[[row]], proprio, seen.language[[row]])
            acting.reset(1)
            actions = torch.stack([acting.act(frame(alone, step)) for step in range(3)])
            torch.testing.assert_close(both[:, [row]], actions, rtol=1e-4, atol=1e-5)


@BOTH
def test_a_state_that_does_not_fit_together_is_refused(make):
    policy, algorithm = make_policy(), make()
    learn_frames(algorithm, policy, 0, 1)
    state = algorithm.state_dict() | {"library": {}, "prototypes": {1: torch.zeros(2)}}
    state = {key: value for key, value in state.items() if key in algorithm.state_form}
    with pytest.raises(CheckpointError, match="do not go together"):
        make().load_state_dict(state, {})


# --- IsCiL


def test_centres_are_those_of_separate_clusters():
    draws = generator(0)
    means = 10 * torch.eye(3, 5)
    points = (means[:, None] + 0.1 * torch.randn(3, 40, 5, generator=draws)).flatten(0, 1)
    centres = cluster_centres(points, 3, draws)
    assert torch.cdist(means, centres).amin(1).max() < 0.1
    torch.testing.assert_close(centres.sort(0).values, points.view(3, 40, 5).mean(1).sort(0).values)
    assert len(cluster_centres(points[:2], 5, draws)) == 2


def test_iscil_retrieves_the_task_whose_prototype_is_most_similar():
    prototypes = {3: torch.eye(4)[:2], 5: torch.eye(4)[2:]}
    states = torch.tensor([[2.0, 0.1, 0, 0], [0.1, 0, 0, 3], [0, 1, 0.9, 0], [0, 0, 5, -1]])
    assert nearest_key(states, prototypes).tolist() == [3, 5, 3, 5]
    found = groups_of_rows(torch.tensor([3, 5, 3]))
    assert [(key, rows.tolist()) for key, rows in found] == [(3, [0, 2]), (5, [1])]
    assert groups_of_rows(torch.tensor([5, 5])) == [(5, None)]


def retrieved(algorithm, policy, batch) -> list[int]:
    predict(algorithm, policy, batch)
    seen, spied = [], algorithm.retrieve
    algorithm.retrieve = lambda x: seen.append(type(algorithm).retrieve(algorithm, x)) or seen[-1]
    predict(algorithm, policy, batch)
    algorithm.retrieve = spied
    return seen[-1].tolist()


def test_iscil_actions_on_states_that_retrieve_an_earlier_adapter_stay_bit_identical():
    policy, algorithm, kept = make_policy(), iscil(), {}
    learn_frames(algorithm, policy, 0, 1)
    for task in (1, 2, 3):
        if task > 1:
            learn_frames(algorithm, policy, task)
        batch = everything(task)
        mine = torch.tensor([t == task for t in retrieved(algorithm, policy, batch)]).nonzero()[:, 0]
        assert len(mine) >= 15, "its own states retrieve a task's adapter"
        kept[task] = batch.rows(mine), predict(algorithm, policy, batch.rows(mine))
        for old, (seen, before) in kept.items():
            assert set(retrieved(algorithm, policy, seen)) == {old}
            assert torch.equal(predict(algorithm, policy, seen), before)


def test_iscil_adapters_start_as_the_one_that_is_retrieved_most():
    policy, algorithm = make_policy(), iscil()
    learn_frames(algorithm, policy, 0, 1, 2)
    algorithm.begin_task(3, sequences.dataset(1), policy)
    sequences.assert_same(algorithm.state_dict()["library"][3], algorithm.state_dict()["library"][1])
    algorithm.trained(policy)
    with torch.no_grad():
        algorithm.library.parameters(3)[0].zero_()
    assert algorithm.library.parameters(1)[0].any()


def test_iscil_starts_from_the_base_where_that_is_nearest():
    policy, algorithm = make_policy(), iscil()
    learn_frames(algorithm, policy, 0)
    algorithm.begin_task(1, sequences.dataset(0), policy)
    assert not any(pair["b"].any() for pair in algorithm.state_dict()["library"][1].values())


def test_policies_that_iscil_cannot_embed_are_named():
    algorithm = iscil(base_tasks=0)
    algorithm.library[0] = {}
    with pytest.raises(ConfigError, match="DeepPolicy has no encode"), algorithm.policy_for(0, DeepPolicy()):
        pass


# --- CLARE


def inputs(seed: int, n: int = 60) -> torch.Tensor:
    """Samples of two tokens on a plane of six dimensions, another for each seed."""
    plane = torch.randn(2, 6, generator=generator(99, seed))
    return torch.randn(n, 2, 2, generator=generator(seed)) @ plane


def fitted(*seeds: int, hidden: int = 4) -> dict[int, Discriminator]:
    return {s: Discriminator.fit(inputs(s), hidden, 300, 1e-2, generator(s)) for s in seeds}


def knowing(known: dict[int, Discriminator], chosen: dict[int, dict[str, int]]) -> CLARE:
    """CLARE before task 3, with autoencoders of tasks and what they choose, by layer."""
    pair = {"a": torch.zeros(1, 6), "b": torch.zeros(6, 1)}
    algorithm = clare()
    state = {
        **algorithm.state_dict(),
        "task_index": 3,
        "library": {2: dict.fromkeys(chosen[2], pair)},
        "discriminators": {t: dict.fromkeys(chosen[t], d.weights) for t, d in known.items()},
        "chosen": chosen,
    }
    algorithm.load_state_dict(state, {})
    return algorithm


def test_clare_picks_the_autoencoder_that_was_trained_on_such_inputs():
    known = fitted(1, 2, 3)
    algorithm = knowing(known, {1: {"layer": BASE}, 2: {"layer": 2}, 3: {"layer": 2}})
    for seed, used in ((1, BASE), (2, 2), (3, 2)):
        plane = torch.randn(2, 6, generator=generator(99, seed))
        fresh = torch.randn(40, 2, 2, generator=generator(7)) @ plane
        assert (algorithm.route("layer", fresh) == used).float().mean() > 0.9
        assert known[seed].z_scores(fresh).mean() < 1.5 < 5 < known[1 + seed % 3].z_scores(fresh).mean()


def test_clare_expands_above_the_threshold_only():
    algorithm = knowing(fitted(1, 2), {1: {"old": BASE, "new": BASE}, 2: {"old": 2, "new": 2}})
    assert algorithm.compare({"old": inputs(2), "new": inputs(5)}) == {"old": 2, "new": 3}
    algorithm.threshold = 1e9
    assert 3 not in algorithm.compare({"old": inputs(2), "new": inputs(5)}).values()


def test_clare_adds_to_every_layer_or_at_least_to_the_first():
    policy = make_policy()
    for threshold, everywhere in ((0.0, True), (1e9, False)):
        algorithm = clare(threshold=threshold)
        learn_frames(algorithm, policy, 0)
        algorithm.begin_task(1, sequences.dataset(1), policy)
        layers = list(adaptable_modules(policy, ("*",)))
        assert list(algorithm.library[1]) == (layers if everywhere else layers[:1])


def test_clare_layers_that_are_not_new_use_the_adapter_of_the_nearest_task():
    policy, algorithm = make_policy(), clare(threshold=0.0)
    learn_frames(algorithm, policy, 0, 1)
    algorithm.threshold = 1e9
    learn_frames(algorithm, policy, 2)
    uses = algorithm.state_dict()["chosen"][2]
    assert set(uses.values()) <= {BASE, 1, 2} and list(uses.values()).count(2) == 1
    shared = [name for name, task in uses.items() if task == 1]
    before = algorithm.state_dict()["library"][1]
    assert all(name in before and name not in algorithm.state_dict()["library"][2] for name in shared)
    predict(algorithm, policy, everything(2))


def test_clare_adapters_are_a_bottleneck_with_a_relu():
    draws = generator(0)
    network = nn.Sequential(nn.Linear(4, 9), nn.ReLU(), nn.Linear(9, 3))
    pair = {"a": torch.randn(2, 4, generator=draws), "b": torch.randn(3, 2, generator=draws)}
    x = torch.randn(5, 7, 4, generator=draws)
    expected = (x @ pair["a"].T).clamp(min=0) @ pair["b"].T
    torch.testing.assert_close(expert_output(network, x, [pair], relu=True), expected)


def test_clare_adapts_feed_forward_networks_as_a_whole():
    names = adaptable_modules(make_policy("bc_vilt"), ("*",))
    assert {
        "spatial.layers.0.mlp", "transformer.layers.0.mlp", "head.trunk", "transformer.layers.0.qkv"
    } <= set(names)  # fmt: skip
    assert not any(name.startswith(("transformer.layers.0.mlp.", "head.trunk.")) for name in names)
    assert list(adaptable_modules(make_policy(), ("*.mlp",))) == ["transformer.layers.0.mlp"]
    with pytest.raises(ConfigError, match=r"wings.*which has"):
        adaptable_modules(make_policy(), ("wings.*",))
