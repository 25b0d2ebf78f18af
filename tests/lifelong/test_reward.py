"""Learning from reward: the objective against other computations, a bandit, and what a killed run ends in."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy import special, stats

from libero_env.text import quantity
from lifelong.algorithms import AGEM, ER, MIR, IsCiL, LwF, PackNet
from lifelong.context import RunContext
from lifelong.data.memory import ReplayMemory
from lifelong.errors import ConfigError
from lifelong.evaluation.environments import EnvPool
from lifelong.nn import GMMHead
from lifelong.policies.base import copy_weights
from lifelong.report.tables import collection_table
from lifelong.results.records import CollectionRecord, LossRecord
from lifelong.results.run_directory import RunDirectory
from lifelong.reward import grpo as module
from lifelong.reward.experience import Experience, collect
from lifelong.reward.grpo import GRPO, clipped_loss, group_advantages
from lifelong.seeding import generator, seeded
from lifelong.sequence import TaskSequence
from lifelong.streams import StreamSettings
from lifelong.training.settings import FitSettings
from lifelong.types import PolicySpec
from tests.harness.policies import small_mlp
from tests.harness.runs import make_windows
from tests.harness.sequences import FakeEnv, Killed, assert_same, outcome, run_context

SPEC = PolicySpec(views=("agentview_rgb",), image_size=(16, 16), proprio={"x": 2}, language_dim=4, seq_len=1)


class Bandit(FakeEnv):
    """One step, which succeeds where the first action lies in an interval."""

    def reset(self, *, seed=None, options=None):
        return super().reset(options=options if seed is None else {"init_state": np.asarray(seed) % 50})

    def step(self, actions):
        self.steps += 1
        success = self.running & (actions[:, 0] > 0.2) & (actions[:, 0] < 0.7)
        over = np.ones(self.num_envs, bool)
        return self._obs(), success * 1.0, success, over & ~success, {"success": success}


def bandit_context(path, learner: GRPO, **changes: Any) -> RunContext:
    with seeded(5):
        policy = small_mlp(SPEC)
    context = run_context(path, "sequential", tasks=1)
    own: dict[str, Any] = {
        "policy": policy,
        "fit": replace(context.fit, epochs=3, steps_per_epoch=4, batch_size=16, lr=3e-3, lr_min=3e-3),
        "eval": replace(context.eval, settle_steps=0, horizon=2),
        "envs": EnvPool(lambda key: Bandit(*key[:2]), 8),
        "learner": learner,
    }
    return replace(context, **(own | changes))


def learn(context: RunContext) -> TaskSequence:
    sequence = TaskSequence(context, {0: make_windows(0, SPEC)})
    sequence.run()
    return sequence


def test_advantages_are_those_of_each_group():
    rewards = torch.tensor([[1.0, 0, 0, 0], [1, 1, 1, 1], [0, 0, 0, 0], [1, 1, 0, torch.nan]])
    found = group_advantages(rewards)
    assert not found[1:3].any(), "equal rewards tell nothing"
    assert found[3, 3] == 0, "an episode that a simulation error ended has no reward"
    for row, values in ((0, [1, 0, 0, 0]), (3, [1, 1, 0])):
        np.testing.assert_allclose(found[row, : len(values)].numpy(), stats.zscore(values), rtol=1e-6)


def test_the_objective_and_its_gradient_are_those_of_numpy():
    draws = np.random.default_rng(0)
    drawn, advantages = draws.normal(size=500), draws.normal(size=500)
    now = drawn + draws.normal(scale=0.4, size=500)
    leaf = torch.tensor(now, requires_grad=True)
    loss = clipped_loss(leaf, torch.tensor(drawn), torch.tensor(advantages), 0.2, 0.28)
    loss.backward()
    ratio = np.exp(now - drawn)
    inside = np.where(advantages > 0, ratio < 1.28, ratio > 0.8)
    expected = np.where(inside, ratio * advantages, np.where(advantages > 0, 1.28, 0.8) * advantages)
    assert 0.1 < inside.mean() < 0.95, "both cases occur"
    np.testing.assert_allclose(loss.item(), -expected.mean(), rtol=1e-12)
    np.testing.assert_allclose(leaf.grad.numpy(), np.where(inside, -ratio * advantages / 500, 0), rtol=1e-10)


def test_log_probabilities_of_drawn_actions_are_those_of_scipy():
    with seeded(1):
        head = GMMHead(in_dim=4, action_dim=3, modes=3, hidden=8, min_std=0.02).double()
        params = head(torch.randn(20, 4, dtype=torch.float64))
    actions = head.sample(params, generator(2))
    found = head.log_prob(params, actions)
    means, deviations, logits = (params[name].detach().numpy() for name in ("means", "stds", "logits"))
    each = stats.norm.logpdf(actions.detach().numpy()[:, None], means, deviations).sum(-1)
    expected = special.logsumexp(special.log_softmax(logits, -1) + each, axis=-1)
    np.testing.assert_allclose(found.detach().numpy(), expected, atol=1e-4)


def test_a_bandit_is_solved(tmp_path):
    context = bandit_context(tmp_path, GRPO(starts=8, episodes=8, processes=1))
    context = replace(
        context, fit=replace(context.fit, epochs=25, batch_size=64), eval=replace(context.eval, every=25)
    )
    with context.envs:
        learn(context)
        told = {
            "language": context.languages[0],
            "task": 0,
            "horizon": 2,
            "settle_steps": 0,
            "precision": "fp32",
        }
        done = collect(context.policy, Bandit(0, 200), range(200), draws=generator(3), **told)
    iterations = context.directory.log.read().of(CollectionRecord)
    assert [one.epoch for one in iterations] == list(range(1, 26))
    assert iterations[0].successes < 32 and done.rewards.mean() > 0.9
    assert iterations[-1].entropy < iterations[0].entropy
    (row,) = collection_table(context.directory.log.read().collections(), ["reach"]).rows
    assert row[1:4] == ["reach", quantity(25 * 64), quantity(25 * 64)], "an episode has one step"
    assert row[4] == f"{100 * iterations[0].successes / 64:.0f} %"


def test_actions_are_drawn_by_the_policy_that_learns(tmp_path, monkeypatch):
    """Before the first step of an iteration all ratios are 1."""
    ratios, plain = [], module.clipped_loss

    def watched(now, drawn, *rest):
        ratios.append((now - drawn).detach().abs().max().item())
        return plain(now, drawn, *rest)

    monkeypatch.setattr(module, "clipped_loss", watched)
    context = bandit_context(tmp_path, GRPO(starts=4, episodes=8, processes=1))
    with context.envs:
        learn(context)
    assert max(ratios[::4]) < 1e-4 < min(ratios[1::4])


def test_episodes_in_other_processes_are_the_same(tmp_path):
    found = []
    for name in ("others", "here"):
        context = bandit_context(tmp_path / name, GRPO(starts=4, episodes=4, processes=2, kl=0.1))
        if name == "here":  # weights with hooks do not leave their process
            context.policy.register_forward_hook(lambda *_: None)
        with context.envs:
            learn(context)
        found.append(outcome(tmp_path / name, context.directory.log, 0))
    for here, elsewhere in zip(*found, strict=True):
        assert_same(here, elsewhere)


@pytest.mark.parametrize(
    ("what", "moment"),
    [("collect", 1), ("collect", 2), ("collect", 3), ("loss", 2), ("loss", 7), ("loss", 11)],
)
def test_a_killed_run_ends_in_the_same_bits(tmp_path, monkeypatch, what, moment):
    learner = GRPO(starts=4, episodes=8, processes=1, kl=0.1)
    for name in ("whole", "killed"):
        folder, calls = tmp_path / name, [0]
        context = bandit_context(folder, learner)
        with monkeypatch.context() as patch, context.envs:
            if name == "killed":
                owner, attribute = (module, "collect") if what == "collect" else (module, "clipped_loss")
                plain = getattr(owner, attribute)

                def counted(*args, plain=plain, calls=calls, **options):
                    calls[0] += 1
                    if calls[0] == moment:
                        raise Killed
                    return plain(*args, **options)

                patch.setattr(owner, attribute, counted)
                with pytest.raises(Killed):
                    learn(context)
            else:
                learn(context)
    context = bandit_context(tmp_path / "killed", learner)
    with context.envs:
        learn(context)
    ends = [
        outcome(folder, RunDirectory(folder).log, 0) for folder in (tmp_path / "whole", tmp_path / "killed")
    ]
    for whole, killed in zip(*ends, strict=True):
        assert_same(whole, killed)


def test_what_is_replayed_is_learned_beside_it(tmp_path):
    context = bandit_context(tmp_path, GRPO(starts=4, episodes=8, processes=1, replay=1.0))
    algorithm = ER(memory=ReplayMemory(12))
    algorithm.end_task(1, make_windows(1, SPEC), context.policy, generator(0))
    context = replace(context, algorithm=algorithm, policy=context.policy)
    before = copy_weights(context.policy)
    with context.envs:
        learn(context)
    assert any((before[name] != value).any() for name, value in copy_weights(context.policy).items())


@pytest.mark.parametrize("algorithm", [LwF, AGEM, PackNet])
def test_algorithms_without_windows_of_their_own_learn_from_reward(tmp_path, algorithm):
    own = {"memory": ReplayMemory(12)} if algorithm is AGEM else {}
    learner = GRPO(starts=4, episodes=8, processes=1)
    context = bandit_context(tmp_path, learner, algorithm=algorithm(**own))
    learner.check(context)
    with context.envs:
        learn(context)
    results = context.directory.log.read()
    epochs = [record.epoch for record in results.of(CollectionRecord)]
    assert epochs == [record.epoch for record in results.of(LossRecord)] == [*range(1, len(epochs) + 1)]
    told = sum(record.groups > 0 for record in results.of(CollectionRecord))
    assert results.costs(0)["updates"] == 4 * told


def test_iterations_that_tell_nothing_make_no_update(tmp_path):
    class Hopeless(Bandit):
        def step(self, actions):
            return super().step(np.zeros_like(actions))

    learner = GRPO(starts=4, episodes=2, processes=1)
    context = bandit_context(tmp_path, learner, envs=EnvPool(lambda key: Hopeless(*key[:2]), 8))
    before = copy_weights(context.policy)
    with context.envs:
        learn(context)
    assert_same(before, copy_weights(context.policy))
    results = context.directory.log.read()
    assert results.costs(0)["updates"] == 0 and np.isnan([r.loss for r in results.of(LossRecord)]).all()


def test_experience_is_joined_where_it_lies():
    frames = make_windows(0, SPEC).batch(torch.arange(2))
    own = {name: torch.zeros(2) for name in ("log_probs", "advantages")}
    elsewhere = Experience(**vars(frames), **own).to("meta")
    assert elsewhere.join(frames).actions.device.type == "meta"


@pytest.mark.parametrize(
    ("changes", "learner", "words"),
    [
        ({}, {"replay": 1.0}, "learner.replay"),
        ({"algorithm": ER(memory=ReplayMemory(12))}, {}, "replay"),
        ({"algorithm": MIR(memory=ReplayMemory(12))}, {"replay": 1.0}, "MIR needs windows of demonstrations"),
        ({"algorithm": IsCiL(rank=2)}, {"kl": 0.1}, "IsCiL acts with experts"),
        ({"algorithm": LwF()}, {"replay": 1.0}, "LwF adds no windows"),
        ({"fit": FitSettings(steps_per_epoch=4, precision="bf16")}, {}, "eval.precision=fp32"),
        ({"policy": small_mlp(SPEC, "deterministic")}, {}, "policy/head=gmm"),
        ({"policy": small_mlp(replace(SPEC, seq_len=3))}, {}, "data.seq_len=1"),
        (
            {
                "fit": FitSettings(steps_per_epoch=4, accumulate=2, precision="fp32"),
                "algorithm": ER(memory=ReplayMemory(12)),
            },
            {"replay": 1.0},
            "train.accumulate=1",
        ),
        ({"stream": StreamSettings(blur=0.1)}, {}, "stream.blur mixes demonstrations"),
        ({}, {"starts": 10**6, "episodes": 10**4}, "learner.starts=1000000"),
    ],
)
def test_what_cannot_be_learned_so_is_refused(tmp_path, changes, learner, words):
    learner = GRPO(**({"starts": 2, "episodes": 2} | learner))
    with pytest.raises(ConfigError, match=words):
        learner.check(bandit_context(tmp_path, learner, **changes))
