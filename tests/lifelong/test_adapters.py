"""What LoRA and DMPEL promise, as properties; and what all algorithms with adapters do."""

import copy
import dataclasses

import pytest
import torch
from torch import nn
from torch.nn import functional
from torch.utils.flop_counter import FlopCounterMode

from lifelong import checkpoints
from lifelong.algorithms import CLARE, DMPEL, OMLA, IsCiL, LoRA
from lifelong.data.windows import WindowSubset, of_episodes
from lifelong.errors import ConfigError, PolicyError
from lifelong.nn.experts import expert_output
from lifelong.nn.routing import SigmoidRouter
from lifelong.seeding import generator
from lifelong.sequence.stages import TrainingPhase
from lifelong.streams import StageWindows
from lifelong.training.costs import count_flops
from lifelong.training.fit import fit
from tests.harness import sequences
from tests.harness.algorithms import (
    MIXING,
    SMALL,
    everything,
    frame,
    learn,
    learn_frames,
    make_policy,
    outputs,
    predict,
)
from tests.harness.fakes import DeepPolicy, Windows

ALL = {name: sequences.EVERY[name] for name in ("lora", "dmpel", "iscil", "clare")}


def answers(algorithm, policy, task: int) -> torch.Tensor:
    """What the policy of a task would do on its windows."""
    return predict(algorithm, policy, everything(task), task)


def loss_on(algorithm, policy, task: int) -> float:
    with torch.no_grad(), algorithm.policy_for(task, policy) as acting:
        return acting.eval().loss(sequences.dataset(task).batch(torch.arange(20))).item()


# --- all


@pytest.mark.parametrize("make", ALL.values(), ids=ALL)
def test_the_weights_kept_are_those_of_the_best_epoch(tmp_path, make, monkeypatch):
    """Success falls to nothing after the second task's first epoch: its adapter must be the first epoch's."""
    kept = {}
    p = sequences.run_context(tmp_path, make)
    p.algorithm.recall_steps = 0  # recall changes the router after the task
    sequence = sequences.sequence(p)
    evaluate = sequence.evaluator.evaluate

    def present() -> torch.Tensor:
        if isinstance(p.algorithm, CLARE):  # which chooses differently once the task has autoencoders
            return torch.cat([weight.detach().flatten() for weight in p.algorithm.library.parameters(1)])
        return answers(p.algorithm, p.policy, 1)

    def staged(phase, learned, task, epoch):
        if phase == "curve" and learned == 1 and epoch == 1:
            kept["then"] = present()
        record = evaluate(phase, learned, task, epoch)
        if phase == "matrix" and learned == 1 and task == 1:
            kept["end"] = present()
        return record

    monkeypatch.setattr(sequence.evaluator, "evaluate", staged)
    monkeypatch.setattr(TrainingPhase, "best_epoch", lambda self, results, until: min(until, 1))
    sequence.run()
    assert torch.equal(kept["then"], kept["end"])


@pytest.mark.parametrize("make", ALL.values(), ids=ALL)
@pytest.mark.parametrize("kind", MIXING)
def test_later_tasks_are_learned_on_a_frozen_base(make, kind):
    policy, algorithm = make_policy(kind), make()
    learn_frames(algorithm, policy, 0)
    base = copy.deepcopy(policy.state_dict())
    before = loss_on(algorithm, policy, 1)
    learn_frames(algorithm, policy, 1, settings=dataclasses.replace(SMALL, epochs=10))
    assert loss_on(algorithm, policy, 1) < before - 0.02
    with algorithm.policy_for(0, policy):
        sequences.assert_same(dict(policy.state_dict()), dict(base))


# --- LoRA


@pytest.mark.parametrize(
    ("kind", "head", "base_tasks"),
    [
        *((kind, head, 1) for kind in MIXING for head in ("gmm", "deterministic", "flow")),
        ("bc_transformer", "gmm", 0),  # adapters of a given base from the first task on
    ],
)
def test_lora_old_outputs_stay_bit_identical(kind, head, base_tasks, tmp_path):
    policy, algorithm = make_policy(kind, head), LoRA(rank=2, base_tasks=base_tasks)
    kept = {}
    for task in range(3):
        learn_frames(algorithm, policy, task)
        for old, value in kept.items():
            assert torch.equal(answers(algorithm, policy, old), value), f"task {old} moved with task {task}"
        kept[task] = answers(algorithm, policy, task)
        assert all(not torch.equal(kept[task], other) for t, other in kept.items() if t != task)

    checkpoints.save(tmp_path / "s", {"policy": policy.state_dict(), "algorithm": algorithm.state_dict()})
    state = checkpoints.load(tmp_path / "s")
    later_policy, later = make_policy(kind, head), LoRA(rank=2, base_tasks=base_tasks)
    later_policy.load_state_dict(state["policy"])
    later.load_state_dict(state["algorithm"], {})
    for old, value in kept.items():
        assert torch.equal(answers(later, later_policy, old), value)
    learn_frames(later, later_policy, 3)
    for old, value in kept.items():
        assert torch.equal(answers(later, later_policy, old), value)


def test_one_adapter_learns_through_the_stream_and_one_policy_acts():
    policy, algorithm, alone = make_policy(), LoRA(rank=2, alpha=4.0, adapters="shared"), make_policy()
    learn_frames(algorithm, policy, 0, 1)
    learn_frames(LoRA(rank=2, alpha=4.0), alone, 0, 1)
    sequences.assert_same(dict(policy.state_dict()), dict(alone.state_dict()))  # the first adapter is LoRA's
    learn_frames(algorithm, policy, 2)
    assert list(algorithm.library) == [1] and not algorithm.kept
    now, base = {n: p.detach().clone() for n, p in policy.named_parameters()}, algorithm.base
    for name, pair in algorithm.library[1].items():
        low = (now[name] - base[name]).flatten(1)
        torch.testing.assert_close(low, 2.0 * pair["b"] @ pair["a"], rtol=1e-4, atol=1e-5)
    for task in range(3):
        with algorithm.policy_for(task, policy) as acting:
            assert all(torch.equal(p, now[n]) for n, p in acting.named_parameters())


@pytest.mark.parametrize("base_tasks", [0, 1])
def test_the_average_of_adapters_acts_on_all_tasks(base_tasks):
    policy, algorithm = make_policy(), LoRA(rank=2, alpha=4.0, adapters="averaged", base_tasks=base_tasks)
    alone, separate = make_policy(), LoRA(rank=2, alpha=4.0, base_tasks=base_tasks)
    learn_frames(algorithm, policy, 0, 1, 2)
    learn_frames(separate, alone, 0, 1, 2)
    found = []
    for task in range(3):
        with separate.policy_for(task, alone):
            found.append({n: p.detach().clone() for n, p in alone.named_parameters()})
    expected = {name: torch.stack([one[name] for one in found]).mean(0) for name in found[0]}
    for task in range(4):  # the last is a task to come
        with algorithm.policy_for(task, policy):
            torch.testing.assert_close(dict(policy.named_parameters()), expected, rtol=1e-5, atol=1e-6)


def test_lora_covers_every_kind_of_layer_and_running_statistics():
    torch.manual_seed(0)
    policy, algorithm = DeepPolicy(), LoRA(rank=1)
    kept = {}
    for task in range(3):
        learn(algorithm, policy, task)
        for old, value in kept.items():
            assert torch.equal(outputs(algorithm, policy, old), value)
        kept[task] = outputs(algorithm, policy, task)
    adapted = set(algorithm.state_dict()["library"][1])
    assert adapted == {n for n, p in policy.named_parameters() if p.dim() > 1}


def test_lora_gradients_are_those_of_the_factors():
    """The chain rule by hand against autograd through W + s B A."""
    policy, algorithm = DeepPolicy(), LoRA(rank=2, alpha=6.0)
    policy.dropout.p = 0.0
    for task in (0, 1):
        learn(algorithm, policy, task)
    pair = algorithm.library[1]["head.weight"]
    a, b = (pair[k].detach().clone().requires_grad_() for k in "ab")
    policy.eval()
    hidden = []
    policy.head.register_forward_hook(lambda module, args, out: hidden.append(args[0].detach()))
    batch = Windows(1).batch(torch.arange(8))
    policy.zero_grad()
    policy.loss(batch).backward()
    algorithm.after_backward(policy)
    weight = algorithm.base["head.weight"] + 3.0 * b @ a
    loss = (hidden[0] @ weight.T + policy.head.bias.detach() - batch.actions).square().mean()
    for expected, p in zip(torch.autograd.grad(loss, (a, b)), (pair["a"], pair["b"]), strict=True):
        torch.testing.assert_close(p.grad, expected)
    assert policy.head.weight.grad is None


def test_lora_patterns_say_what_is_adapted_and_what_is_own():
    policy = make_policy()
    algorithm = LoRA(rank=2, adapted=("transformer.*", "head.trunk.*"), own=("head.means.*",))
    learn_frames(algorithm, policy, 0)
    before = copy.deepcopy(policy.state_dict())
    learn_frames(algorithm, policy, 1)
    moved = {n for n, v in policy.state_dict().items() if not torch.equal(v, before[n])}
    assert moved == {
        "transformer.layers.0.qkv.weight", "transformer.layers.0.out.weight", "transformer.layers.0.mlp.0.weight",
        "transformer.layers.0.mlp.3.weight", "head.trunk.0.weight", "head.trunk.2.weight", "head.means.weight",
        "head.means.bias"
    }  # fmt: skip
    assert not any(p.requires_grad for n, p in policy.named_parameters() if n.startswith("encoders"))


def test_lora_tasks_learned_together_share_an_adapter():
    policy, algorithm = make_policy(), LoRA(rank=2)
    for last in (1, 3, 5):
        learn_frames(algorithm, policy, last)
    for first, last in ((0, 1), (2, 3), (4, 5)):
        with algorithm.policy_for(first, policy):
            one = copy.deepcopy(policy.state_dict())
        with algorithm.policy_for(last, policy):
            sequences.assert_same(dict(policy.state_dict()), dict(one))


# --- DMPEL


@pytest.mark.parametrize(
    "layer", [nn.Linear(4, 6), nn.Conv2d(4, 6, 3, stride=2, padding=1)], ids=["linear", "conv"]
)
def test_dmpel_changes_each_sample_by_its_own_weights(layer):
    """Against one dense weight for each sample; three adjacent rows belong to a sample."""
    draws = generator(0)
    inputs = layer.weight[0].numel()
    tasks = [
        {"a": torch.randn(4, inputs, generator=draws), "b": torch.randn(6, 4, generator=draws)} for _ in "ab"
    ]
    c = torch.rand(2, 4, generator=draws)  # two samples; two experts of rank 2 for each of two tasks
    x = torch.randn(6, *((5, 4) if isinstance(layer, nn.Linear) else (4, 5, 5)), generator=draws)
    given = layer(x) + expert_output(layer, x, tasks, c.repeat_interleave(2, dim=1))
    for sample in range(2):
        dense, weight = copy.deepcopy(layer), layer.weight.detach().flatten(1)
        for expert in range(4):
            a, b = (tasks[expert // 2][k] for k in "ab")
            rows = slice(2 * (expert % 2), 2 * (expert % 2) + 2)
            weight = weight + c[sample, expert] * b[:, rows] @ a[rows]
        dense.weight.data = weight.view(layer.weight.shape)
        mine = slice(3 * sample, 3 * sample + 3)
        torch.testing.assert_close(given[mine], dense(x[mine]), rtol=1e-4, atol=1e-4)
    with pytest.raises(PolicyError, match="5 rows for 2 samples"):
        expert_output(layer, x[:5], tasks, c.repeat_interleave(2, dim=1))


def small_router(experts: int, top_k: int, seed: int = 1) -> SigmoidRouter:
    return SigmoidRouter.new(5, 8, 2, experts, top_k, generator(seed))


def test_dmpel_coefficients_are_those_of_the_best_experts_and_start_at_equal_shares():
    router, query = small_router(6, 3), torch.randn(10, 5, generator=generator(2))
    every, c = router.coefficients(query), router(query)
    assert c.shape == (10, 2, 6) and ((c > 0).sum(-1) == 3).all()
    assert torch.equal(c[c > 0], every[c > 0]) and (c.amin(-1) == 0).all()
    assert torch.equal(c.argmax(-1), every.argmax(-1))
    assert (every - 1 / 3).abs().max() < 0.1
    assert (small_router(1, 3)(query) - 1).abs().max() < 0.2, "a single expert starts at its whole weight"


def test_dmpel_experts_do_not_compete():
    """The coefficient of an expert does not depend on the logit of another, as it would in a softmax."""
    router, query = small_router(3, 0), torch.randn(10, 5, generator=generator(2))
    before = router(query)
    with torch.no_grad():
        router.bias[:, 0] += 5
    assert torch.equal(router(query)[..., 1:], before[..., 1:])
    assert (router(query)[..., 0] > before[..., 0]).all()


def test_dmpel_new_experts_start_at_zero_and_old_ones_never_change():
    policy, algorithm = make_policy(), DMPEL(rank=2, pool=2, recall_steps=20)
    learn_frames(algorithm, policy, 0)
    base, kept = copy.deepcopy(policy.state_dict()), {}
    begun = copy.deepcopy(algorithm)
    begun.begin_task(1, sequences.dataset(1), policy)
    with begun.policy_for(1, policy) as acting, torch.no_grad():
        begun_answers = acting.eval().predict(everything(1))
    assert torch.equal(begun_answers, policy.predict(everything(1)))
    for task in (1, 2, 3):
        learn_frames(algorithm, policy, task)
        library = algorithm.state_dict()["library"]
        for old, experts in kept.items():
            sequences.assert_same(library[old], experts)
        kept[task] = copy.deepcopy(library[task])
        assert all(pair["b"].any() for pair in library[task].values())
    sequences.assert_same(dict(policy.state_dict()), dict(base))


LONG = dataclasses.replace(SMALL, batch_size=4, epochs=1, steps_per_epoch=40, lr=4e-3)


def test_dmpel_recall_keeps_the_coefficients_of_earlier_tasks():
    drift = {}
    for steps in (0, 300):
        policy, algorithm = make_policy(head="deterministic"), DMPEL(rank=2, pool=2, recall_steps=steps)
        for task in range(3):
            learn_frames(algorithm, policy, task, settings=LONG)
        memory = algorithm.state_dict()["memory"]
        now = {t: algorithm.router(m["queries"]) for t, m in memory.items()}
        then = {t: m["coefficients"] for t, m in memory.items()}  # of the experts that there were
        then = {t: functional.pad(c, (0, 2 - c.shape[-1])) for t, c in then.items()}
        drift[steps] = max((then[t] - now[t]).abs().max().item() for t in memory)
    assert drift[300] < 0.1 < 0.3 < drift[0], drift


@pytest.mark.parametrize(("experts", "tasks"), [(1, 5), (2, 4)])
def test_dmpel_the_newest_experts_stay_alive(experts: int, tasks: int):
    """At the end of each task they still count, and their B still moves, also where more than `top_k` compete."""
    policy = make_policy(head="deterministic")
    algorithm = DMPEL(rank=2, pool=2, recall_steps=20, top_k=3, experts=experts)
    learn_frames(algorithm, policy, 0, settings=LONG)
    for task in range(1, tasks):
        dataset = sequences.dataset(task % 4)
        algorithm.begin_task(task, dataset, policy)
        fit(policy, dataset, algorithm, settings=LONG, seed=(task, 0))
        now = algorithm.router(algorithm.episodes["queries"], experts)
        assert now[..., -experts:].min() > 0.1
        assert ((now > 0).sum(-1) == min(3, experts * task)).all(), "no more than top_k count"
        policy.loss(algorithm.mix(everything(task % 4), generator(0))).backward()
        assert all(pair["b"].grad.abs().max() > 0 for pair in algorithm.library[task].values()), task
        assert all(pair["b"].abs().max() > 0 for pair in algorithm.library[task].values()), task
        policy.zero_grad()
        algorithm.end_phase("learn", policy)
        algorithm.end_task(task, dataset, policy, generator(task))


def test_dmpel_routes_by_the_first_frame_of_a_demonstration():
    policy, algorithm = make_policy(), DMPEL(rank=2, pool=2, recall_steps=20)
    learn_frames(algorithm, policy, 0, 1)
    algorithm.begin_task(2, sequences.dataset(2), policy)
    mixed = algorithm.mix(everything(2), generator(0))
    queries = mixed.observation.proprio["routing_query"][:, 0]
    first = algorithm.query(everything(2).observation)
    assert torch.equal(queries[:10], first[[0] * 10]) and torch.equal(queries[10:20], first[[10] * 10])
    assert not torch.equal(first[0], first[10])


def test_dmpel_finds_demonstrations_in_composed_datasets():
    algorithm, parts = DMPEL(pool=2), [sequences.dataset(t) for t in (0, 1)]
    some = WindowSubset(parts[1], torch.tensor([3, 12, 15]))
    read = lambda batch: algorithm.query(batch.observation)  # noqa: E731
    queries, of_window = of_episodes(StageWindows([parts[0], some], 1), read)
    expected = [0] * 10 + [1] * 10 + [2, 3, 3]
    assert of_window.tolist() == expected
    starts = [parts[k // 2].batch(torch.tensor([10 * (k % 2)])).observation for k in range(4)]
    assert torch.equal(queries, torch.cat([algorithm.query(o) for o in starts]))


def test_dmpel_stores_contexts_as_the_windows_of_their_demonstrations_weigh():
    policy, algorithm = make_policy(), DMPEL(pool=2, recall_steps=0)
    own, other = StageWindows([sequences.dataset(t) for t in range(4)], 3), sequences.dataset(4)
    few = WindowSubset(other, torch.tensor([0, 1, 10, 11]))
    for stage, most in (
        (own, 0),
        (StageWindows([own, few], 3), 1),
    ):  # 4 of 84 windows; of 10 demonstrations 2
        algorithm.begin_task(3, stage, policy)
        queries = algorithm.episodes["queries"]
        algorithm.end_task(3, stage, policy, generator(0))
        stored = algorithm.memory[3]["queries"]
        assert len(stored) == len(queries) and {*map(tuple, queries[:8].tolist())} <= {
            *map(tuple, stored.tolist())
        }
        assert sum(tuple(q) in {*map(tuple, queries[8:].tolist())} for q in stored.tolist()) <= most


@pytest.mark.parametrize("kind", [LoRA, OMLA, DMPEL, IsCiL, CLARE])
def test_adapters_learn_at_the_factor_of_their_layers(kind):
    policy, algorithm = make_policy(), kind(rank=2, base_tasks=0)
    policy.rate_factors = lambda: {"encoders": 0.0}
    learn_frames(algorithm, policy, 0)
    moved = {name for name, pair in algorithm.library[0].items() if pair["b"].any()}
    assert moved and not any(name.startswith("encoders") for name in moved)
    assert any(name.startswith("encoders") for name in algorithm.library[0])


def test_dmpel_copies_of_a_policy_in_training_mix_experts_of_their_own_weights():
    policy, algorithm = make_policy(), DMPEL(rank=2, pool=2, recall_steps=20)
    learn_frames(algorithm, policy, 0, 1)
    with algorithm.policy_for(1, policy) as acting, torch.no_grad():
        other = copy.deepcopy(acting).eval()
        assert torch.equal(other.predict(everything(1)), acting.eval().predict(everything(1)))
        for p in policy.parameters():
            p.zero_()
        assert not torch.equal(other.predict(everything(1)), acting.predict(everything(1)))


@pytest.mark.parametrize("kind", MIXING)
@pytest.mark.parametrize("head", ["gmm", "flow"])
def test_dmpel_acts_as_it_was_trained(kind, head):
    """The frames of a demonstration one by one give what its first window gives; and rows do not mix."""
    policy, algorithm = make_policy(kind, head), DMPEL(rank=2, pool=2, recall_steps=20)
    policy.stochastic = False
    learn_frames(algorithm, policy, 0, 1, 2)
    batch = sequences.dataset(2).batch(torch.tensor([0, 10]))
    steps = policy.memory_steps
    with algorithm.policy_for(2, policy) as acting, torch.no_grad():
        acting.eval()
        if head == "flow":  # only the last frame that it may look back to has a whole chunk ahead
            whole = acting.predict(batch)
        else:
            whole = policy.head.greedy(policy.distribution(batch.observation))
        whole = whole.clamp(-1, 1)  # as every action that is acted out
        acting.reset(2)
        for step in range(steps):
            action = acting.act(frame(batch.observation, step))
            if head == "gmm":
                torch.testing.assert_close(action, whole[:, step], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(action, whole[:, steps - 1], rtol=1e-4, atol=1e-5)
        alone = acting.predict(sequences.dataset(2).batch(torch.tensor([10])))
        torch.testing.assert_close(acting.predict(batch)[1:], alone, rtol=1e-4, atol=1e-5)


def test_dmpel_routes_once_in_an_episode():
    policy, algorithm = make_policy(), DMPEL(rank=2, pool=2, recall_steps=20)
    learn_frames(algorithm, policy, 0, 1)
    observation, seen = everything(1).rows(slice(0, 3)).observation, []
    spied = algorithm.coefficients
    algorithm.coefficients = lambda o: seen.append(o) or spied(o)
    with algorithm.policy_for(0, policy) as acting:
        acting.eval()
        for _ in range(2):
            acting.reset(3)
            for step in range(3):
                acting.act(frame(observation, step), [generator(i) for i in range(3)])
    assert len(seen) == 2


def test_dmpel_computes_the_experts_that_count_and_no_others():
    """A step costs as much with seven experts as with the three that count, and gives what all of them would."""
    policy, algorithm = make_policy(head="deterministic"), DMPEL(rank=2, pool=2, recall_steps=20, top_k=3)
    batch, flops = everything(1).rows(slice(0, 1)), {}
    for task in range(8):
        learn_frames(algorithm, policy, task)
        with algorithm.policy_for(task, policy) as acting, torch.no_grad(), count_flops() as counter:
            answer = acting.eval().predict(batch)
        router = FlopCounterMode(display=False)
        if algorithm.router is not None:
            with router:
                algorithm.coefficients(batch.observation)
        flops[task] = counter.get_total_flops() - router.get_total_flops()
    assert flops[0] < flops[1] < flops[2] < flops[3] == flops[7]
    dense = copy.copy(algorithm)
    dense.coefficients = lambda observation: algorithm.coefficients(observation).clamp(min=1e-30)
    with dense.policy_for(7, policy) as acting, torch.no_grad():
        torch.testing.assert_close(acting.eval().predict(batch), answer, rtol=1e-5, atol=1e-6)


def test_dmpel_refuses_more_experts_of_a_task_than_act():
    with pytest.raises(ConfigError, match=r"algo.top_k=3 experts cannot act while the 4 of a task"):
        DMPEL(experts=4)
    assert DMPEL(experts=4, top_k=0).experts == DMPEL(experts=4, top_k=4).experts == 4
