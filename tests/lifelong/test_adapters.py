"""What LoRA and DMPEL promise, as properties."""

import copy
import dataclasses

import pytest
import torch

from lifelong import checkpoints
from lifelong.algorithms import LoRA
from lifelong.errors import ConfigError
from lifelong.policies import BCRNN, BCTransformer, BCViLT
from lifelong.records import LossRecord
from lifelong.sequence import TaskSequence
from lifelong.training import FitSettings, fit, generator, seeded
from tests.lifelong import test_sequence as walk
from tests.lifelong.fakes import DeepPolicy, Windows
from tests.lifelong.test_algorithms import SETTINGS, learn, outputs
from tests.lifelong.test_algorithms_more import killed_again_and_again

ALL = {"lora": lambda: LoRA(rank=2, alpha=4.0)}
_CONV = {"image_width": 8, "stage_blocks": [1], "stem_pool": False}
_HEAD = {"head_hidden": 8, "head_layers": 1, "modes": 2, "min_std": 0.05, "chunk": 2, "execute": 1, "flow_steps": 2}
_TIME = {"embed_dim": 8, "layers": 1, "heads": 2, "head_dim": 4, "mlp_dim": 8}
_PATCH = {"patch_embed": 8, "patch_width": 8, "stem_kernel": 3, "stem_stride": 1, "patch": 4}
_SPACE = {"spatial_layers": 1, "spatial_heads": 2, "spatial_head_dim": 4, "spatial_mlp_dim": 8}
POLICIES = {
    "bc_transformer": (BCTransformer, _CONV | _TIME),
    "bc_rnn": (BCRNN, _CONV | {"image_embed": 8, "text_embed": 4, "rnn_hidden": 8}),
    "bc_vilt": (BCViLT, _PATCH | _SPACE | _TIME),
}
SMALL = FitSettings(epochs=2, batch_size=8, lr=1e-2, precision="fp32")


def make_policy(kind: str = "bc_transformer", head: str = "gmm"):
    cls, sizes = POLICIES[kind]
    with seeded(3):
        return cls(spec=walk.SPEC, **sizes, **_HEAD, head=head)


def learn_small(algorithm, policy, task: int, settings=SMALL) -> None:
    """A task of the fake demonstrations from its beginning to its end."""
    dataset = walk.dataset(task)
    algorithm.begin_task(task, dataset, policy)
    for number, phase in enumerate(algorithm.phases()):
        algorithm.begin_phase(phase, policy)
        fit(policy, dataset, algorithm, settings=settings, seed=(task, number))
        algorithm.end_phase(phase, policy)
    algorithm.end_task(task, dataset, policy, generator(task))


def answers(algorithm, policy, task: int) -> torch.Tensor:
    """What the policy of a task would do on its windows."""
    with torch.no_grad(), algorithm.policy_for(task, policy) as acting:
        return acting.eval().predict(walk.dataset(task).batch(torch.arange(20)))


def loss_on(algorithm, policy, task: int) -> float:
    with torch.no_grad(), algorithm.policy_for(task, policy) as acting:
        return acting.eval().loss(walk.dataset(task).batch(torch.arange(20))).item()


# --- both


@pytest.fixture
def walks(monkeypatch):
    monkeypatch.setattr(walk, "ALGORITHMS", ALL)
    return walk


@pytest.mark.parametrize("algo", ALL)
def test_killed_and_resumed_equals_uninterrupted(walks, tmp_path, algo, monkeypatch):
    TaskSequence(p := walks.parts(tmp_path / "whole", algo)).run()
    records, state = walks.outcome(tmp_path / "whole", p.directory.log)
    starts, p = killed_again_and_again(tmp_path / "killed", algo, monkeypatch)
    assert starts > 2
    again, end = walks.outcome(tmp_path / "killed", p.directory.log)
    assert again == records
    walks.assert_same(end, state)


@pytest.mark.parametrize("make", ALL.values(), ids=ALL)
def test_a_state_taken_up_between_tasks_changes_nothing(make, tmp_path):
    policy, algorithm = make_policy(), make()
    for task in (0, 1):
        learn_small(algorithm, policy, task)
    checkpoints.save(tmp_path / "s", {"policy": policy.state_dict(), "algorithm": algorithm.state_dict()})
    learn_small(algorithm, policy, 2)

    state = checkpoints.load(tmp_path / "s")
    other_policy, other = make_policy(), make()
    other_policy.load_state_dict(state["policy"])
    other.load_state_dict(state["algorithm"], {t: walk.dataset(t) for t in (0, 1)})
    learn_small(other, other_policy, 2)
    walk.assert_same(dict(other_policy.state_dict()), dict(policy.state_dict()))
    walk.assert_same(other.state_dict(), algorithm.state_dict())


@pytest.mark.parametrize("make", ALL.values(), ids=ALL)
def test_the_base_is_learned_as_by_fine_tuning(make):
    plain, policy, algorithm = make_policy(), make_policy(), make()
    fit(plain, walk.dataset(0), walk.Sequential(), settings=SMALL, seed=(0, 0))
    learn_small(algorithm, policy, 0)
    walk.assert_same(dict(policy.state_dict()), dict(plain.state_dict()))


@pytest.mark.parametrize("make", ALL.values(), ids=ALL)
def test_the_weights_kept_are_those_of_the_best_epoch(walks, tmp_path, make, monkeypatch):
    """Success falls to nothing after the second task's first epoch: its adapter must be the first epoch's."""
    kept = {}
    monkeypatch.setitem(walk.ALGORITHMS, "this", make)
    p = walks.parts(tmp_path, "this")
    sequence = TaskSequence(p)
    evaluate = sequence._evaluate

    def staged(phase, learned, task, epoch):
        if phase == "curve" and learned == 1 and epoch == 1:
            kept["then"] = answers(p.algorithm, p.policy, 1)
        record = evaluate(phase, learned, task, epoch)
        if phase == "matrix" and learned == 1 and task == 1:
            kept["end"] = answers(p.algorithm, p.policy, 1)
        return record

    monkeypatch.setattr(sequence, "_evaluate", staged)
    monkeypatch.setattr(sequence, "_best_epoch", lambda stretch, until: min(until, 1))
    sequence.run()
    assert torch.equal(kept["then"], kept["end"])


@pytest.mark.parametrize("make", ALL.values(), ids=ALL)
@pytest.mark.parametrize("kind", POLICIES)
def test_later_tasks_are_learned_on_a_frozen_base(make, kind):
    policy, algorithm = make_policy(kind), make()
    learn_small(algorithm, policy, 0)
    base = copy.deepcopy(policy.state_dict())
    before = loss_on(algorithm, policy, 1)
    learn_small(algorithm, policy, 1, dataclasses.replace(SMALL, epochs=10))
    assert loss_on(algorithm, policy, 1) < before - 0.02
    with algorithm.policy_for(0, policy):
        walk.assert_same(dict(policy.state_dict()), dict(base))


@pytest.mark.parametrize("make", ALL.values(), ids=ALL)
def test_adapters_grow_by_the_same_number_with_each_task(make):
    policy, algorithm = make_policy(), make()
    for task in range(4):
        learn_small(algorithm, policy, task)
        assert list(algorithm.sizes()) == list(range(1, task + 1))
    assert len(set(algorithm.sizes().values())) == 1
    assert 0 < algorithm.sizes()[1] < sum(p.numel() for p in policy.parameters())


@pytest.mark.parametrize("make", ALL.values(), ids=ALL)
def test_patterns_that_fit_nothing_are_named(make):
    algorithm = make()
    algorithm.adapted, policy = ("wings.*",), make_policy()
    learn_small(algorithm, policy, 0)
    with pytest.raises(ConfigError, match=r"wings.*which has encoders"):
        algorithm.begin_task(1, walk.dataset(1), policy)


# --- LoRA


@pytest.mark.parametrize("kind", POLICIES)
@pytest.mark.parametrize("head", ["gmm", "deterministic", "flow"])
def test_lora_old_outputs_stay_bit_identical(kind, head, tmp_path):
    policy, algorithm = make_policy(kind, head), LoRA(rank=2)
    kept = {}
    for task in range(3):
        learn_small(algorithm, policy, task)
        for old, value in kept.items():
            assert torch.equal(answers(algorithm, policy, old), value), f"task {old} moved with task {task}"
        kept[task] = answers(algorithm, policy, task)
        assert all(not torch.equal(kept[task], other) for t, other in kept.items() if t != task)

    checkpoints.save(tmp_path / "s", {"policy": policy.state_dict(), "algorithm": algorithm.state_dict()})
    state = checkpoints.load(tmp_path / "s")
    later_policy, later = make_policy(kind, head), LoRA(rank=2)
    later_policy.load_state_dict(state["policy"])
    later.load_state_dict(state["algorithm"], {})
    for old, value in kept.items():
        assert torch.equal(answers(later, later_policy, old), value)
    learn_small(later, later_policy, 3)
    for old, value in kept.items():
        assert torch.equal(answers(later, later_policy, old), value)


def test_lora_covers_every_kind_of_layer_and_running_statistics():
    torch.manual_seed(0)
    policy, algorithm = DeepPolicy(), LoRA(rank=1)
    kept = {}
    for task in range(3):
        learn(algorithm, policy, task)
        for old, value in kept.items():
            assert torch.equal(outputs(algorithm, policy, old), value)
        kept[task] = outputs(algorithm, policy, task)
    adapted = set(algorithm.state_dict()["pairs"][1])
    assert adapted == {n for n, p in policy.named_parameters() if p.dim() > 1}


def test_lora_changes_weights_by_matrices_of_its_rank():
    policy, algorithm = make_policy("bc_rnn"), LoRA(rank=2, own=())
    learn_small(algorithm, policy, 0)
    base = copy.deepcopy(policy.state_dict())
    learn_small(algorithm, policy, 1)
    for name, weight in policy.state_dict().items():
        change = (weight - base[name]).flatten(1) if weight.dim() > 1 else weight - base[name]
        if weight.dim() > 1:
            assert 0 < torch.linalg.matrix_rank(change, rtol=1e-4) <= 2, name
        else:
            assert not change.any(), name


def test_lora_gradients_are_those_of_the_factors():
    """The chain rule by hand against autograd through W + s B A."""
    policy, algorithm = DeepPolicy(), LoRA(rank=2, alpha=6.0)
    policy.dropout.p = 0.0
    for task in (0, 1):
        learn(algorithm, policy, task)
    pair = algorithm._pairs[1]["head.weight"]
    a, b = (pair[k].detach().clone().requires_grad_() for k in "ab")
    policy.eval()
    hidden = []
    policy.head.register_forward_hook(lambda module, args, out: hidden.append(args[0].detach()))
    batch = Windows(1).batch(torch.arange(8))
    policy.zero_grad()
    policy.loss(batch).backward()
    algorithm.after_backward(policy)
    weight = algorithm._base["head.weight"] + 3.0 * b @ a
    loss = (hidden[0] @ weight.T + policy.head.bias.detach() - batch.actions).square().mean()
    for expected, p in zip(torch.autograd.grad(loss, (a, b)), (pair["a"], pair["b"]), strict=True):
        torch.testing.assert_close(p.grad, expected)
    assert policy.head.weight.grad is None


def test_lora_patterns_say_what_is_adapted_and_what_is_own():
    policy = make_policy()
    algorithm = LoRA(rank=2, adapted=("transformer.*", "head.trunk.*"), own=("head.means.*",))
    learn_small(algorithm, policy, 0)
    before = copy.deepcopy(policy.state_dict())
    learn_small(algorithm, policy, 1)
    moved = {n for n, v in policy.state_dict().items() if not torch.equal(v, before[n])}
    assert moved == {
        "transformer.layers.0.qkv.weight", "transformer.layers.0.out.weight", "transformer.layers.0.mlp.0.weight",
        "transformer.layers.0.mlp.3.weight", "head.trunk.0.weight", "head.trunk.2.weight", "head.means.weight",
        "head.means.bias",
    }  # fmt: skip
    assert not any(p.requires_grad for n, p in policy.named_parameters() if n.startswith("encoders"))


def test_lora_adapts_a_given_base_from_the_first_task_on():
    policy, algorithm = make_policy(), LoRA(rank=2, base_tasks=0)
    given = copy.deepcopy(policy.state_dict())
    learn_small(algorithm, policy, 0)
    walk.assert_same(algorithm.state_dict()["base"]["head.means.weight"], given["head.means.weight"])
    kept = answers(algorithm, policy, 0)
    learn_small(algorithm, policy, 1)
    assert torch.equal(answers(algorithm, policy, 0), kept)


def test_lora_tasks_learned_together_share_an_adapter():
    policy, algorithm = make_policy(), LoRA(rank=2)
    for last in (1, 3, 5):
        learn_small(algorithm, policy, last)
    for first, last in ((0, 1), (2, 3), (4, 5)):
        with algorithm.policy_for(first, policy):
            one = copy.deepcopy(policy.state_dict())
        with algorithm.policy_for(last, policy):
            walk.assert_same(dict(policy.state_dict()), dict(one))


@pytest.mark.parametrize("change", [{"rank": 0}, {"base_tasks": -1}])
def test_lora_settings_that_cannot_work_are_named(change):
    with pytest.raises(ConfigError, match="at least 1"):
        LoRA(**change)
