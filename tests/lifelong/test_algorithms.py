"""What each algorithm promises, as properties."""

import copy
import doctest

import pytest
import torch

from lifelong import checkpoints
from lifelong.algorithms import AGEM, ER, EWC, MAS, SI, Algorithm, DERpp, LwF, Multitask, PackNet, SingleTask
from lifelong.algorithms.agem import project
from lifelong.algorithms.anchor import WeightedDistance
from lifelong.algorithms.importance import SampleFisher
from lifelong.data.memory import ReplayMemory
from lifelong.policies.base import Policy
from lifelong.seeding import generator
from lifelong.sequence.stages import training_phases
from lifelong.streams import StageData, StreamSettings
from lifelong.training.fit import fit
from lifelong.training.settings import FitSettings
from tests.harness import sequences
from tests.harness.algorithms import SETTINGS, by_hand, learn, outputs
from tests.harness.fakes import DeepPolicy, LinearPolicy, Windows
from tests.harness.sequences import dataset as frames


class Distilled:
    """What a policy's base class derives from `predict` for algorithms that distil."""

    answers, divergence = Policy.answers, Policy.divergence


class Linear(Distilled, LinearPolicy):
    """A linear policy that also says what it would do; it listens to the instruction."""

    def __init__(self):
        super().__init__()
        self.unused = torch.nn.Parameter(torch.ones(2))

    def predict(self, batch):
        return self.linear(batch.observation.proprio["x"]) + batch.observation.language[:, None]


class Deep(Distilled, DeepPolicy):
    def predict(self, batch):
        return self.forward(batch.observation.proprio["x"])


def everything(task: int, size: int = 20):
    return Windows(task, size=size).batch(torch.arange(size))


@pytest.mark.parametrize("documented", [Algorithm, Policy], ids=lambda documented: documented.__name__)
def test_the_example_in_the_docstring_runs(documented):
    module = __import__(documented.__module__, fromlist=["_"])
    finder = doctest.DocTestFinder(recurse=False)
    (example,) = finder.find(documented, documented.__name__, globs=vars(module) | {"__name__": "example"})
    assert len(example.examples) > 3
    report: list[str] = []
    result = doctest.DocTestRunner().run(example, out=report.append)
    assert result.failed == 0, "".join(report)


def test_what_an_algorithm_computes_has_the_precision_of_the_loss():
    seen = []

    class Spy(Algorithm):
        def penalty(self, policy):
            seen.append(torch.is_autocast_enabled("cpu"))

        def after_backward(self, policy):
            seen.append(torch.is_autocast_enabled("cpu"))

    class Bias(torch.nn.Module):  # without a product, which some processors cannot take in bf16
        def __init__(self):
            super().__init__()
            self.bias = torch.nn.Parameter(torch.zeros(2))

        def loss(self, batch):
            return (batch.actions - self.bias).square().mean()

    for precision, expected in (("bf16", True), ("fp32", False)):
        seen.clear()
        settings = FitSettings(epochs=1, batch_size=20, precision=precision)
        fit(Bias(), Windows(0), Spy(), settings=settings, seed=(0,))
        assert seen == [expected, expected]


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


@pytest.mark.parametrize("stages", [(0, 1), (2, 3)], ids=["tasks", "after a stage of several"])
def test_packnet_trains_norms_and_biases_with_the_first_stage_only(stages):
    policy, algorithm = DeepPolicy(), PackNet()
    fresh = copy.deepcopy(policy.state_dict())
    learn(algorithm, policy, stages[0])
    first = copy.deepcopy(policy.state_dict())
    learn(algorithm, policy, stages[1])
    second = policy.state_dict()
    for name in ("norm.running_mean", "norm.weight", "head.bias", "memory.bias_hh_l0"):
        assert not torch.equal(first[name], fresh[name])
        assert torch.equal(first[name], second[name])
    assert not torch.equal(first["head.weight"], second["head.weight"])


# --- SingleTask


def test_single_task_begins_every_task_with_the_same_weights_and_acts_with_its_own():
    policy, algorithm = Deep(), SingleTask()
    first, kept = copy.deepcopy(policy.state_dict()), {}
    for task in range(3):
        algorithm.begin_task(task, Windows(task), policy)
        assert all(torch.equal(v, first[n]) for n, v in policy.state_dict().items())
        learn(algorithm, policy, task)
        kept[task] = copy.deepcopy(policy.state_dict())
    for task, weights in kept.items():
        with algorithm.policy_for(task, policy) as acting:
            assert all(torch.equal(v, weights[n]) for n, v in acting.state_dict().items())
        assert all(torch.equal(v, kept[2][n]) for n, v in policy.state_dict().items())


# --- Multitask


def test_fixed_steps_are_counted_for_each_of_the_tasks_learned_together(tmp_path):
    p = sequences.run_context(tmp_path, Multitask)
    object.__setattr__(p, "fit", FitSettings(epochs=2, steps_per_epoch=3, precision="fp32"))
    assert [phase.steps_per_epoch for phase in training_phases(p, (0, 1, 2))] == [9]
    assert [phase.steps_per_epoch for phase in training_phases(p, (1,))] == [3]


# --- A-GEM


def gradients(values) -> list[torch.Tensor]:
    """Parameters with these gradients; None: without one."""
    params = []
    for value in values:
        params.append(torch.zeros(3, dtype=torch.float64))
        params[-1].grad = None if value is None else torch.tensor(value, dtype=torch.float64)
    return params


def test_agem_counts_missing_gradients_as_zero():
    reference = (torch.tensor([1.0, 0, 0]).double(), torch.tensor([0, 2.0, 0]).double(), None)
    params = gradients([[-5.0, 1, 1], None, [1.0, 1, 1]])
    project(params, reference)  # share: -5 / (1 + 4)
    assert params[0].grad.tolist() == [-4, 1, 1]
    assert params[1].grad.tolist() == [0, 2, 0]
    assert params[2].grad.tolist() == [1, 1, 1]
    agreeing = gradients([[5.0, 0, 0], None, None])
    project(agreeing, reference)
    assert [None if p.grad is None else p.grad.tolist() for p in agreeing] == [[5, 0, 0], None, None]
    nothing = gradients([None, None])
    project(nothing, (None, None))
    assert all(p.grad is None for p in nothing)


def test_agem_steps_do_not_raise_the_loss_on_the_reference_to_first_order():
    policy, algorithm, draws = Linear(), AGEM(memory=ReplayMemory(20)), generator(0)
    torch.nn.init.zeros_(policy.linear.weight)
    torch.nn.init.zeros_(policy.linear.bias)
    algorithm.end_task(0, Windows(0), policy, draws)
    batch = Windows(0).batch(torch.arange(20))
    batch.actions.neg_().add_(0.3)  # nearly the contrary of what the memory says
    assert algorithm.mix(batch, draws) is batch
    policy.loss(batch).backward()
    old = torch.autograd.grad(policy.loss(everything(0)), [policy.linear.weight, policy.linear.bias])
    product = lambda: sum(  # noqa: E731
        (p.grad * r).sum() for p, r in zip(policy.linear.parameters(), old, strict=True)
    )
    assert product() < 0
    algorithm.after_backward(policy)
    assert product().item() == pytest.approx(0, abs=1e-5)
    assert policy.linear.bias.grad.abs().max() > 0
    assert policy.unused.grad is None


# --- DER++


def test_derpp_stores_the_outputs_at_the_end_of_each_task():
    torch.manual_seed(0)
    policy, algorithm = Deep(), DERpp(budget=25)
    answers = {}
    for task in range(4):
        learn(algorithm, policy, task)
        with torch.no_grad():
            answers[task] = policy.eval().predict(everything(task))
        assert len(algorithm.memory) <= 25
        batch = algorithm.memory.sample(100, generator(task))
        then = torch.stack(
            [answers[t][w] for t, w in zip(batch.task_ids.tolist(), batch.window_ids, strict=True)]
        )
        torch.testing.assert_close(algorithm.stored_outputs(batch), {"mean": then})
    assert sum(len(z["mean"]) for z in algorithm.state_dict()["outputs"].values()) == len(algorithm.memory)


def test_derpp_has_no_penalty_while_the_outputs_are_the_same():
    policy, algorithm, draws = Linear(), DERpp(budget=25, alpha=2.0), generator(0)
    batch = everything(1, 8)
    assert algorithm.mix(batch, draws) is batch and algorithm.penalty(policy) is None
    learn(algorithm, policy, 0)
    mixed = algorithm.mix(batch, draws)
    assert len(mixed) == 16 and set(mixed.task_ids[8:].tolist()) == {0}
    assert algorithm.penalty(policy).item() == pytest.approx(0, abs=1e-10)
    with torch.no_grad():
        policy.linear.bias += torch.tensor([0.5, 0.0])
    algorithm.mix(batch, draws)
    assert algorithm.penalty(policy).item() == pytest.approx(2.0 * 0.25)
    assert algorithm.penalty(policy) is None  # the draw of one step is not used in another


# --- LwF


def test_lwf_keeps_the_outputs_for_old_instructions_on_new_windows():
    policy, algorithm, draws = Linear(), LwF(strength=3.0), generator(0)
    batch = everything(1)
    batch.observation.language.fill_(7.0)
    assert algorithm.mix(batch, draws) is batch and algorithm.penalty(policy) is None
    for task in (0, 1):
        learn(algorithm, policy, task)
    assert algorithm.mix(batch, draws) is batch
    assert algorithm.distilled.observation.language.abs().max() == 0  # those of the fake tasks
    assert torch.equal(algorithm.distilled.observation.proprio["x"], batch.observation.proprio["x"])
    assert algorithm.penalty(policy).item() == 0
    with torch.no_grad():
        policy.linear.bias += torch.tensor([0.5, 0.0])
    algorithm.mix(batch, draws)
    policy.zero_grad()
    penalty = algorithm.penalty(policy)
    assert penalty.item() == pytest.approx(3.0 * 0.25)
    penalty.backward()
    assert policy.linear.bias.grad.tolist() == pytest.approx([3.0, 0.0])


def test_self_distillation_asks_with_the_windows_own_instruction():
    policy, algorithm, draws = Linear(), LwF(strength=3.0, instruction="own"), generator(0)
    batch = everything(1)
    batch.observation.language.fill_(7.0)
    learn(algorithm, policy, 0)
    assert algorithm.mix(batch, draws) is batch and algorithm.distilled is batch
    with torch.no_grad():
        policy.linear.bias += torch.tensor([0.5, 0.0])
    assert algorithm.penalty(policy).item() == pytest.approx(3.0 * 0.25)


def test_lwf_asks_with_all_instructions_of_a_stage_and_none_of_its_neighbours():
    stages, spec = [(0, 1), (2,)], StreamSettings(blur=0.2)
    windows = {task: frames(task) for task in range(3)}
    texts = [windows[task].batch(torch.tensor([0])).observation.language for task in range(3)]
    for settings in (StreamSettings(), spec):
        data, algorithm = StageData(windows, stages, settings, 1), LwF()
        for last in data:
            algorithm.end_task(last, data[last], Linear(), generator(0))
        found = [algorithm.languages[last] for last in (1, 2)]
        assert torch.equal(found[0], torch.cat(texts[:2]).unique(dim=0)) and torch.equal(found[1], texts[2])


def test_lwf_teacher_is_constant_while_the_policy_learns():
    torch.manual_seed(0)
    policy, algorithm = Deep(), LwF()
    learn(algorithm, policy, 0)
    with torch.no_grad():
        before = algorithm.teacher.like(policy).predict(everything(0))
    fit(policy, Windows(1), algorithm, settings=SETTINGS, seed=(1, 0))
    teacher = algorithm.teacher.like(policy)
    assert not teacher.training and not any(p.requires_grad for p in teacher.parameters())
    assert all(p.requires_grad for p in policy.parameters())
    with torch.no_grad():  # some processors have other kernels for it
        assert torch.equal(teacher.predict(everything(0)), before)


# --- SI


def test_si_accumulates_the_descent_of_the_loss_along_the_path():
    """Under small plain steps the sum of omega is what the loss fell by (Zenke et al., eq. 1 to 3)."""
    policy, algorithm, batch = Linear(), SI(damping=0.5), everything(0)
    algorithm.begin_task(0, Windows(0), policy)
    start = copy.deepcopy(policy.state_dict())
    first = policy.loss(batch).item()
    for _ in range(400):
        policy.zero_grad()
        policy.loss(batch).backward()
        algorithm.after_backward(policy)
        with torch.no_grad():
            for p in policy.linear.parameters():
                p -= 1e-3 * p.grad
        algorithm.after_step(policy)
    omega = algorithm.state_dict()["omega"]
    fallen = first - policy.loss(batch).item()
    assert sum(v.sum().item() for v in omega.values()) == pytest.approx(fallen, rel=0.02)
    assert "unused" not in omega
    algorithm.end_task(0, Windows(0), policy, generator(0))
    way = policy.linear.weight.detach() - start["linear.weight"]
    expected = omega["linear.weight"].clamp_min(0) / (way.square() + 0.5)
    torch.testing.assert_close(algorithm.importance["linear.weight"], expected, rtol=1e-3, atol=1e-6)


def test_si_omega_excludes_the_gradient_of_the_penalty():
    torch.manual_seed(0)
    policy, algorithm = Linear(), SI(strength=5.0)
    learn(algorithm, policy, 0)
    with torch.no_grad():
        policy.linear.weight += 0.3
    loss, penalty = policy.loss(everything(1)), algorithm.penalty(policy)
    alone = torch.autograd.grad(loss, policy.linear.weight, retain_graph=True)[0]
    policy.zero_grad()
    (loss + penalty).backward()
    assert not torch.allclose(policy.linear.weight.grad, alone)
    algorithm.after_backward(policy)
    with torch.no_grad():
        policy.linear.weight += 1
    algorithm.after_step(policy)
    omega = algorithm.state_dict()["omega"]["linear.weight"]
    torch.testing.assert_close(omega, -alone, rtol=1e-4, atol=1e-5)


# --- MAS


def test_mas_squared_importance_is_the_mean_size_of_single_windows_gradients():
    policy, data = Linear(), Windows(size=7)
    policy.train()
    importance = MAS(windows=0, of="squared").estimator.estimate(data, policy, generator(0))
    out = data.features @ policy.linear.weight.T + policy.linear.bias  # (N, A); |out|^2 by W: 2 out x^T
    by_hand = 2 * (out[:, :, None] * data.features[:, None, :]).abs().mean(0)
    torch.testing.assert_close(importance["linear.weight"], by_hand)
    torch.testing.assert_close(importance["linear.bias"], 2 * out.abs().mean(0))
    assert not importance["unused"].any()
    assert policy.training and all(p.grad is None for p in policy.parameters())


@pytest.mark.parametrize(("of", "counted"), [("squared", 0.0), ("projected", (2 / torch.pi) ** 0.5)])
def test_mas_counts_weights_of_actions_near_zero_by_their_effect(of, counted):
    """An output that is always zero depends on its weights as any other: E|r . dh/dtheta| is sqrt(2/pi) |dh/dtheta|."""
    policy, data = Linear(), Windows(size=500)
    with torch.no_grad():
        policy.linear.weight[0].zero_()
        policy.linear.bias[0].zero_()
    importance = MAS(windows=0, of=of).estimator.estimate(data, policy, generator(0))
    effect = data.features.abs().mean(0)  # |d h_0 / d W_0|
    torch.testing.assert_close(importance["linear.weight"][0], counted * effect, rtol=0.15, atol=1e-6)
    assert importance["linear.bias"][0].item() == pytest.approx(counted, rel=0.15)
    assert importance["linear.weight"][1].min() > 0
    again = MAS(windows=0, of=of).estimator.estimate(data, policy, generator(0))
    assert torch.equal(again["linear.weight"], importance["linear.weight"]), "the generator alone draws"


@pytest.mark.parametrize("make", [SI, MAS])
def test_importance_adds_up_and_the_penalty_is_zero_at_the_anchor_only(make):
    torch.manual_seed(0)
    policy, algorithm = Linear(), make()
    assert algorithm.penalty(policy) is None
    older = None
    for task in range(3):
        learn(algorithm, policy, task)
        assert algorithm.penalty(policy).item() == 0
        now = algorithm.importance["linear.weight"]
        assert (now >= (0 if older is None else older)).all() and now.max() > 0
        older = now
    with torch.no_grad():
        policy.linear.weight += 0.1
    expected = algorithm.strength * (older * 0.01).sum().item()
    assert algorithm.penalty(policy).item() == pytest.approx(expected, rel=1e-4)
