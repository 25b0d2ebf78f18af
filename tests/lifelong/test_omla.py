"""What OMLA promises, as properties: adapters that begin at a prior, which learned adapters move."""

import copy

import pytest
import torch

from lifelong.algorithms import OMLA, LoRA
from lifelong.errors import CheckpointError
from tests.harness import sequences
from tests.harness.algorithms import learn, outputs
from tests.harness.fakes import DeepPolicy, Windows

SMALL = {"rank": 2, "alpha": 4.0}


def policy() -> DeepPolicy:
    torch.manual_seed(0)
    return DeepPolicy()


def learned(algorithm: LoRA, tasks: int) -> DeepPolicy:
    """Learn tasks of pairs, and return the policy."""
    acting = policy()
    for task in range(tasks):
        learn(algorithm, acting, task)
    return acting


def adapter(algorithm: OMLA, task: int) -> dict[str, torch.Tensor]:
    """Return A, B and own copies of a learned task as one flat table."""
    state = algorithm.state_dict()
    pairs = {f"{n}.{k}": t for n, pair in state["library"][task].items() for k, t in pair.items()}
    return {name: value.clone() for name, value in {**pairs, **state["kept"][task]}.items()}


def prior(algorithm: OMLA) -> dict[str, torch.Tensor]:
    found = algorithm.state_dict()["prior"]
    pairs = {f"{n}.{k}": t for n, pair in found["pairs"].items() for k, t in pair.items()}
    return {name: value.clone() for name, value in {**pairs, **found["own"]}.items()}


def test_without_a_rate_it_is_lora_to_the_bit() -> None:
    ends = []
    for learner in (LoRA(**SMALL), OMLA(prior_rate=0.0, **SMALL)):
        acting = learned(learner, 4)
        state = learner.state_dict()
        assert state.pop("prior", None) is None
        ends.append((dict(acting.state_dict()), state))
    sequences.assert_same(ends[1][0], ends[0][0])
    sequences.assert_same(ends[1][1], ends[0][1])


def test_the_first_adapter_is_learned_as_by_lora() -> None:
    ends = [dict(learned(learner, 2).state_dict()) for learner in (LoRA(**SMALL), OMLA(**SMALL))]
    sequences.assert_same(ends[1], ends[0])


@pytest.mark.parametrize("rate", [0.25, 1.0])
def test_the_prior_moves_by_its_rate_towards_each_learned_adapter(rate) -> None:
    learner = OMLA(prior_rate=rate, **SMALL)
    acting = learned(learner, 1)
    assert learner.state_dict()["prior"] is None, "the base has no adapter"
    learner.begin_task(1, Windows(1), copy.deepcopy(acting))
    before = prior(learner)
    assert all(not value.any() for name, value in before.items() if name.endswith(".b"))
    learner = OMLA(prior_rate=rate, **SMALL)
    acting = learned(learner, 1)
    for task in (1, 2, 3):
        learn(learner, acting, task)
        own, after = adapter(learner, task), prior(learner)
        assert own.keys() == after.keys() == before.keys()
        for name, value in after.items():
            expected = before[name] + rate * (own[name] - before[name])
            torch.testing.assert_close(value, expected, rtol=1e-5, atol=1e-6)
        assert any(not torch.equal(after[name], before[name]) for name in after)
        before = after


def test_a_task_begins_with_the_adapted_weights_of_the_prior() -> None:
    learner = OMLA(**SMALL)
    acting = learned(learner, 2)
    base, start = learner.state_dict()["base"], prior(learner)
    moved = 0
    learner.begin_task(2, Windows(2), acting)
    for name, value in acting.named_parameters():
        if f"{name}.a" in start:
            added = learner.scale * (start[f"{name}.b"] @ start[f"{name}.a"]).view(value.shape)
            torch.testing.assert_close(value.detach(), base[name] + added)
            moved += int(added.any())
        elif name in start:
            assert torch.equal(value.detach(), start[name])
    assert moved


def test_earlier_adapters_and_their_answers_never_change() -> None:
    learner, acting = OMLA(**SMALL), policy()
    kept: dict[int, tuple] = {}
    for task in range(4):
        learn(learner, acting, task)
        for earlier, (answers, weights) in kept.items():
            assert torch.equal(outputs(learner, acting, earlier), answers)
            if weights is not None:
                sequences.assert_same(adapter(learner, earlier), weights)
        kept[task] = outputs(learner, acting, task), adapter(learner, task) if task else None


def test_a_prior_of_other_weights_is_refused(tmp_path) -> None:
    learner = OMLA(**SMALL)
    learned(learner, 2)
    state = learner.state_dict()
    name = next(iter(state["prior"]["pairs"]))
    wrong = {**state["prior"]["pairs"], name: {"a": torch.zeros(2, 1), "b": torch.zeros(1, 2)}}
    for pairs in (wrong, {}):
        damaged = {**state, "prior": {**state["prior"], "pairs": pairs}}
        with pytest.raises(CheckpointError, match="the adapter of|the prior is not"):
            OMLA(**SMALL).load_state_dict(damaged, {})


def test_the_prior_costs_the_storage_of_one_adapter() -> None:
    lora, omla = LoRA(**SMALL), OMLA(**SMALL)
    for learner in (lora, omla):
        learned(learner, 2)
    adapted = [*lora.library.parameters(1), *lora.state_dict()["kept"][1].values()]
    assert sum(value.numel() for value in prior(omla).values()) == sum(p.numel() for p in adapted)
