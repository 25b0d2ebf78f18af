"""The training loop: exact when resumed, without side effects on generators, with errors that name the remedy."""

import copy
import os

import pytest
import torch
from torch import nn
from torch.utils._pytree import tree_map

from lifelong.algorithms import ER, EWC, SLCA, Sequential
from lifelong.data import fake_batch
from lifelong.data.memory import ReplayMemory
from lifelong.errors import ConfigError, TrainingError
from lifelong.seeding import generator
from lifelong.training.distributed import Ranks
from lifelong.training.fit import fit, learning_rate
from lifelong.training.precision import check_compiler, deterministic
from lifelong.training.settings import FitSettings
from lifelong.training.step import Step
from lifelong.types import Batch, PolicySpec
from tests.harness import ranks_worker as worker
from tests.harness.algorithms import learn_frames, make_policy
from tests.harness.fakes import DeepPolicy, LinearPolicy, Windows
from tests.harness.policies import small_rnn, small_transformer, small_vilt

pytestmark = pytest.mark.usefixtures("uncounted")
SETTINGS = FitSettings(epochs=5, batch_size=8, lr=1e-2, warmup_steps=3, precision="fp32")


def trained(policy, **kwargs):
    fit(policy, Windows(), kwargs.pop("algorithm", Sequential()), settings=SETTINGS, seed=(1, 2), **kwargs)
    return policy.state_dict()


def test_the_learning_rate_of_an_epoch_is_that_of_torchs_cosine():
    settings = FitSettings(epochs=5, batch_size=8, lr=1e-2, lr_min=1e-3, lr_every="epoch")
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=settings.lr)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, T_max=5, eta_min=settings.lr_min)
    rates = []

    def step(batch, draws, lr):
        rates.append(lr)
        return torch.zeros(()), torch.zeros(())

    fit(LinearPolicy(), Windows(), Sequential(), settings=settings, seed=(0,), step=step)
    for epoch in range(5):
        expected = optimizer.param_groups[0]["lr"]
        assert rates[3 * epoch : 3 * epoch + 3] == pytest.approx([expected] * 3, rel=1e-12)
        optimizer.step()
        schedule.step()
    warm = FitSettings(epochs=5, warmup_steps=4, lr=1e-2, lr_every="epoch")
    assert learning_rate(1, 50, warm, 0) == 5e-3 and learning_rate(6, 50, warm, 0) == 1e-2


@pytest.mark.parametrize(
    ("given", "sizes"),
    [
        ({"last_batch": "short"}, [8, 8, 4]),
        ({"last_batch": "filled"}, [8] * 3),
        ({"steps_per_epoch": 7}, [8] * 7),
    ],
)
def test_an_epoch_sees_every_window_once_and_its_last_batch_is_filled_or_short(given, sizes):
    seen = []

    def step(batch, draws, lr):
        seen.append(batch.window_ids)
        return torch.zeros(()), torch.zeros(())

    settings = FitSettings(epochs=1, batch_size=8, **given)
    fit(LinearPolicy(), Windows(), Sequential(), settings=settings, seed=(0,), step=step)
    assert [len(ids) for ids in seen] == sizes
    assert sorted(torch.cat(seen)[:20].tolist()) == list(range(20))


@pytest.mark.parametrize("on", [True, False])
def test_statistics_adapt_to_a_task_before_its_first_step_and_nothing_else_does(on):
    """In training mode, once over all windows, with the augmentation; a resumed run does not do it again."""
    torch.manual_seed(0)
    policy, at_start = DeepPolicy(), []
    before = copy.deepcopy(policy.state_dict())
    settings = FitSettings(epochs=1, batch_size=8, statistics_first=on, precision="fp32")

    def keep(end):
        at_start.append(copy.deepcopy(end.state()))

    fit(policy, Windows(), Sequential(), settings=settings, seed=(0,), on_epoch=keep)
    first = at_start[0]["policy"]
    changed = {name for name, value in before.items() if not torch.equal(value, first[name])}
    statistics = {"norm.running_mean", "norm.running_var", "norm.num_batches_tracked"}
    assert changed == (statistics if on else set())
    assert first["norm.num_batches_tracked"] == (3 if on else 0)
    again = DeepPolicy()
    fit(again, Windows(), Sequential(), settings=settings, seed=(0,), resume=copy.deepcopy(at_start[0]))
    for name, value in policy.state_dict().items():
        assert torch.equal(value, again.state_dict()[name]), name


def test_a_run_repeats_to_the_bit_and_leaves_the_global_generator_alone():
    fresh = DeepPolicy()
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first = copy.deepcopy(trained(copy.deepcopy(fresh)))
    assert torch.equal(torch.rand(3), expected)
    second = trained(copy.deepcopy(fresh))
    assert all(torch.equal(v, second[n]) for n, v in first.items())


class _Contiguous(Sequential):
    """Leaves gradients whose memory format is not that of the weights."""

    def after_backward(self, policy):
        for p in policy.parameters():
            p.grad = p.grad.clone(memory_format=torch.contiguous_format)


@pytest.mark.parametrize("algorithm", [Sequential, _Contiguous])
def test_the_fused_optimiser_moves_weights_as_the_plain_one_from_any_memory_format(algorithm):
    """Resumed from what a checkpoint holds, contiguous tensors, it goes on to the same bits."""
    spec = PolicySpec(image_size=(16, 16), language_dim=8, seq_len=1)
    batch, states = fake_batch(spec, 8, generator(0)), []

    def make():
        torch.manual_seed(0)
        return small_transformer(spec)

    class Data(Windows):
        def batch(self, indices):
            return batch.rows(indices % 8)

    def learn(policy, step=None, resume=None):
        keep = [].append if resume else lambda end: states.append(stored(end.state()))
        fit(
            policy, Data(), algorithm(), settings=SETTINGS, seed=(1,), on_epoch=keep, step=step, resume=resume
        )
        return policy.state_dict()

    def stored(state):
        def contiguous(value):
            return value.clone(memory_format=torch.contiguous_format) if torch.is_tensor(value) else value

        return tree_map(contiguous, copy.deepcopy(state))

    policy, plain = make(), make()
    assert any(
        p.is_contiguous(memory_format=torch.channels_last) and p.dim() == 4 for p in policy.parameters()
    )
    slow = Step(plain, Sequential(), torch.optim.AdamW(plain.parameters(), weight_decay=1e-4), SETTINGS)
    expected, found = learn(plain, slow), learn(policy)
    for name, value in found.items():
        assert torch.allclose(value, expected[name], rtol=0, atol=1e-3), name  # a step is 1e-2
    again = learn(make(), resume=states[-4])
    assert all(torch.equal(value, again[name]) for name, value in found.items())


def test_user_defined_step_and_loader_run_in_the_same_loop():
    """Use another optimiser with its own learning rate, and batches that are read elsewhere."""
    data, policy, twin = Windows(size=16), LinearPolicy(), LinearPolicy()
    twin.load_state_dict(policy.state_dict())
    settings, sizes = FitSettings(epochs=2, batch_size=8, grad_clip=0, precision="fp32"), []
    rates = []

    def load(order):
        sizes.append([len(indices) for indices in order])
        return (data.batch(indices) for indices in order)

    def own_step(one, scale):
        optimizer = torch.optim.SGD(one.parameters(), lr=0.1 / scale)
        step = Step(one, Sequential(), optimizer, settings, loss_scale=scale)

        def call(batch, draws, lr):
            rates.append(lr)
            return step(batch, draws)

        return call

    fit(policy, data, Sequential(), settings=settings, seed=(0,), step=own_step(policy, 1.0), load=load)
    fit(twin, data, Sequential(), settings=settings, seed=(0,), step=own_step(twin, 4.0))
    assert sizes == [[8, 8]] * 2 and rates[:4] == rates[4:] and rates[0] == settings.lr
    for a, b in zip(policy.parameters(), twin.parameters(), strict=True):
        assert torch.allclose(a, b, atol=1e-6), "four times the gradient, a quarter of the rate"


def test_augmentation_sees_the_mixed_batch():
    sizes, algorithm = [], ER(memory=ReplayMemory(4))
    algorithm.end_task(0, Windows(), LinearPolicy(), torch.Generator())

    def augment(batch, generator):
        sizes.append(len(batch))
        return batch

    trained(LinearPolicy(), algorithm=algorithm, augment=augment)
    assert set(sizes) == {16}


def test_the_penalty_is_reported_apart_from_the_loss():
    policy, algorithm, data = LinearPolicy(), EWC(strength=10.0), Windows()
    algorithm.end_task(0, data, policy, torch.Generator())
    ends = []
    trained(policy, algorithm=algorithm, on_epoch=ends.append)
    assert ends[-1].penalty > 0


def test_learning_rate_rises_then_falls_to_its_end():
    rates = [learning_rate(k, 100, SETTINGS) for k in range(101)]
    assert [rates[0], max(rates), rates[100]] == pytest.approx(
        [SETTINGS.lr / 3, SETTINGS.lr, SETTINGS.lr_min]
    )
    assert rates[3:] == sorted(rates[3:], reverse=True)


def test_an_infinite_loss_is_an_error_with_a_remedy():
    class Broken(LinearPolicy):
        def loss(self, batch):
            return super().loss(batch) * float("inf")

    with pytest.raises(TrainingError, match=r"lower train\.lr"):
        trained(Broken())


def test_an_empty_dataset_is_an_error():
    with pytest.raises(TrainingError, match="no windows"):
        fit(LinearPolicy(), Windows(size=0), Sequential(), settings=SETTINGS, seed=(0,))


def test_an_unquoted_off_in_yaml_means_off():
    assert FitSettings(compile=False).compile == "off"


# --- cut into micro-batches


@pytest.mark.parametrize(("algo", "parts"), [("er", 3), ("derpp", 2), ("agem", 2)])
def test_micro_batches_learn_as_the_whole_batch_does(algo, parts, tmp_path):
    whole, _ = worker.learn(algo, tmp_path / "whole", Ranks(), epochs=4)
    cut, _ = worker.learn(algo, tmp_path / "cut", Ranks(), epochs=4, accumulate=parts)
    assert cut == pytest.approx(whole, rel=1e-5)


@pytest.mark.parametrize(("parts", "expected"), [(1, [10]), (4, [2, 3, 2, 3]), (100, [1] * 10)])
def test_micro_batches_have_at_most_the_requested_size(parts, expected):
    sizes = []

    class Spy(LinearPolicy):
        def loss(self, batch: Batch):
            sizes.append(len(batch))
            return super().loss(batch)

    settings = FitSettings(epochs=1, batch_size=10, steps_per_epoch=2, accumulate=parts, precision="fp32")
    fit(Spy(), Windows(), Sequential(), settings=settings, seed=(0,))
    assert sizes == expected * 2


def test_batch_norm_forbids_dividing_the_batch():
    learned, told = (DeepPolicy(), Windows(), Sequential()), "norm takes its statistics over the batch"
    with pytest.raises(ConfigError, match=rf"{told}.*policy\.encoder\.norm=group"):
        fit(*learned, settings=FitSettings(epochs=1, accumulate=2), seed=(0,))
    with pytest.raises(ConfigError, match="several processes"):
        fit(*learned, settings=FitSettings(epochs=1), seed=(0,), ranks=Ranks(0, 2))


# --- compiled


@pytest.fixture
def traced(monkeypatch):
    """Trace with torch.compile but run eagerly; one graph except for recurrent layers."""
    real, functions = torch.compile, []

    def trace(function, mode=None):
        functions.append((function, mode))
        recurrent = any(isinstance(m, nn.RNNBase) for m in function.__self__.modules())
        return real(function, backend="eager", fullgraph=not recurrent)

    monkeypatch.setattr(torch, "compile", trace)
    yield functions
    torch.compiler.reset()


SMALL = PolicySpec(image_size=(32, 32), language_dim=8, seq_len=2)
POLICIES = {
    "bc_transformer": lambda: small_transformer(SMALL, dropout=0.0),
    "bc_rnn": lambda: small_rnn(SMALL),
    "bc_vilt": lambda: small_vilt(SMALL, dropout=0.0),
}


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor")  # torch hides it, unless it is an error
@pytest.mark.parametrize("name", POLICIES)
def test_a_policys_loss_can_be_compiled_and_is_the_same(name, traced):
    torch.manual_seed(0)
    policy = POLICIES[name]().train()
    batch = fake_batch(SMALL, 3, generator(0))
    assert torch.equal(torch.compile(policy.loss)(batch), policy.loss(batch))


def test_compiled_training_keeps_names_and_numbers(traced):
    torch.manual_seed(0)
    fresh = LinearPolicy()
    results = []
    for mode in ("off", "reduce-overhead"):
        policy = copy.deepcopy(fresh)
        settings = FitSettings(epochs=2, batch_size=8, lr=1e-2, precision="fp32", compile=mode)
        fit(policy, Windows(), Sequential(), settings=settings, seed=(1,))
        results.append(policy.state_dict())
    assert results[0].keys() == results[1].keys()
    assert all(torch.equal(value, results[1][name]) for name, value in results[0].items())
    assert [mode for _, mode in traced] == ["reduce-overhead"]


def test_a_missing_compiler_is_reported_with_the_remedy(monkeypatch):
    def fail(*args, **kwargs):
        raise RuntimeError("No working C++ compiler found")

    monkeypatch.setattr(torch, "compile", fail)
    with pytest.raises(ConfigError, match=r"No working C\+\+ compiler found.*train\.compile=off"):
        check_compiler(torch.device("cpu"))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.filterwarnings("ignore")  # of the compiler about itself
@pytest.mark.parametrize("mode", ["default", "reduce-overhead"])
@pytest.mark.parametrize("parts", [1, 3])
def test_compiled_training_on_a_gpu(mode, parts):
    losses = []
    for compile, accumulate in (("off", 1), (mode, parts)):
        torch.manual_seed(0)
        policy, ends = POLICIES["bc_transformer"]().cuda(), []
        settings = FitSettings(
            epochs=12, batch_size=6, lr=1e-3, precision="fp32", compile=compile, accumulate=accumulate
        )
        fit(policy, Pictures(), Sequential(), settings=settings, seed=(1,), on_epoch=ends.append)
        losses.append([end.loss for end in ends[1:]])
    assert losses[1] == pytest.approx(losses[0], rel=1e-3)


class Pictures:
    """Twelve random windows."""

    whole = fake_batch(SMALL, 12, generator(0))

    def __len__(self):
        return 12

    def batch(self, indices):
        return self.whole.rows(indices)


# --- deterministic


def test_deterministic_kernels_are_enabled_and_the_setting_restored(monkeypatch):
    monkeypatch.delenv("CUBLAS_WORKSPACE_CONFIG", raising=False)
    with deterministic(False):
        assert not torch.are_deterministic_algorithms_enabled()
    with deterministic(True):
        assert torch.are_deterministic_algorithms_enabled()
        assert os.environ["CUBLAS_WORKSPACE_CONFIG"] == ":4096:8"
    assert not torch.are_deterministic_algorithms_enabled()
    assert "CUBLAS_WORKSPACE_CONFIG" not in os.environ


def test_an_operation_without_deterministic_kernel_is_reported_with_the_remedy():
    with pytest.raises(TrainingError, match="some_backward_cuda.*deterministic=false"), deterministic(True):
        raise RuntimeError("some_backward_cuda does not have a deterministic implementation, but you set it.")
    assert not torch.are_deterministic_algorithms_enabled()


def test_on_a_cpu_deterministic_changes_no_bits(tmp_path):
    results = []
    for on in (False, True):
        with deterministic(on):
            results.append(worker.learn("ewc", tmp_path / str(on), Ranks(), epochs=2))
    (losses, weights), (losses_again, weights_again) = results
    assert losses == losses_again
    assert all(torch.equal(value, weights_again[name]) for name, value in weights.items())


def test_parts_of_a_policy_learn_at_a_factor_of_the_rate():
    policy = small_transformer(spec := PolicySpec(image_size=(32, 32), seq_len=2))
    policy.rate_factors = lambda: {"encoders": 0.0}
    before = copy.deepcopy(policy.state_dict())
    settings = FitSettings(epochs=1, batch_size=2, lr=1e-2, weight_decay=0.0)

    class Fixed:
        def __len__(self):
            return 2

        def batch(self, indices):
            return fake_batch(spec, len(indices), generator(0))

    fit(policy, Fixed(), Sequential(), settings=settings, seed=(0,))
    moved = {name for name, value in policy.state_dict().items() if not torch.equal(value, before[name])}
    assert moved and not any(name.startswith("encoders") for name in moved)
    assert any(name.startswith("encoders") for name in before)


def test_slca_moves_the_representation_slowly_after_the_first_task():
    algorithm, policy = SLCA(factor=0.5), make_policy()
    learn_frames(algorithm, policy, 0)
    assert not algorithm.rate_factors(policy) and algorithm.state_dict() == {"base_left": 1}
    policy.rate_factors = lambda: {"encoders.agentview_rgb.stem": 0.1, "head": 2.0}
    algorithm.begin_task(1, None, policy)
    factors = algorithm.rate_factors(policy)
    slow = [name for name, _ in policy.named_parameters() if name.startswith("encoders")]
    assert slow and all(
        factors[name] == pytest.approx(0.05 if name.startswith("encoders.agentview_rgb.stem") else 0.5)
        for name in slow
    )
    assert set(factors) - set(slow) == {"encoders.agentview_rgb.stem", "head"}
    frozen, policy = SLCA(factor=0.0, base_tasks=0), make_policy()
    before = copy.deepcopy(policy.state_dict())
    learn_frames(frozen, policy, 0)
    moved = {name for name, value in policy.state_dict().items() if not torch.equal(value, before[name])}
    assert moved and not any(name.startswith("encoders") for name in moved)
    with pytest.raises(ConfigError, match=r"algo\.slow=\['wings'\] matches no parameter"):
        SLCA(slow=["wings"]).begin_task(0, None, policy)


@pytest.mark.parametrize(("precision", "tf32"), [("fp32", True), ("fp32_strict", False)])
def test_only_strict_steps_have_no_tf32(precision, tf32, monkeypatch):
    seen = []
    monkeypatch.setattr(Step, "__call__", lambda *_: seen.append(_allowed()) or (torch.zeros(()),) * 2)
    before, ends = _allowed(), []
    settings = FitSettings(epochs=1, batch_size=8, precision=precision)
    learned = LinearPolicy(), Windows(), Sequential()
    fit(*learned, settings=settings, seed=(1,), on_epoch=lambda _: ends.append(_allowed()))
    assert set(seen) == {(tf32 and before[0], tf32 and before[1])} != {(False, True)}
    assert ends[-1] == _allowed() == before and before[0]


def _allowed():
    return torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32
