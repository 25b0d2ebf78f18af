"""The training loop: exact when resumed, silent about randomness, loud about what cannot work."""

import copy

import pytest
import torch

from lifelong import checkpoints
from lifelong.algorithms import ER, EWC, Sequential
from lifelong.errors import ConfigError, TrainingError
from lifelong.training import FitSettings, fit, learning_rate
from tests.lifelong.fakes import DeepPolicy, LinearPolicy, Windows

SETTINGS = FitSettings(epochs=5, batch_size=8, lr=1e-2, warmup_steps=3, precision="fp32")


def trained(policy, **kwargs):
    fit(policy, Windows(), kwargs.pop("algorithm", Sequential()), settings=SETTINGS, seed=(1, 2), **kwargs)
    return policy.state_dict()


@pytest.mark.parametrize("stop", [0, 1, 4, 5])
def test_killed_and_resumed_equals_uninterrupted(tmp_path, stop):
    torch.manual_seed(0)
    fresh = DeepPolicy()
    path = tmp_path / "state"
    epochs = []

    def keep(end):
        epochs.append((end.epoch, end.loss, end.penalty))
        if end.epoch == stop:
            checkpoints.save(path, end.state())

    reference = trained(copy.deepcopy(fresh), on_epoch=keep)
    again = []
    resumed = trained(
        DeepPolicy(),
        resume=checkpoints.load(path),
        on_epoch=lambda e: again.append((e.epoch, e.loss, e.penalty)),
    )
    for name, value in reference.items():
        assert torch.equal(value, resumed[name]), name
    assert str(again) == str(epochs[stop:])


def test_a_run_repeats_to_the_bit_and_leaves_the_global_generator_alone():
    fresh = DeepPolicy()
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first = copy.deepcopy(trained(copy.deepcopy(fresh)))
    assert torch.equal(torch.rand(3), expected)
    second = trained(copy.deepcopy(fresh))
    assert all(torch.equal(v, second[n]) for n, v in first.items())


def test_the_loss_falls():
    losses = []
    trained(LinearPolicy(), on_epoch=lambda e: losses.append(e.loss))
    assert losses[-1] < losses[1]


def test_every_window_is_seen_once_an_epoch_and_steps_can_be_fixed():
    seen = []

    class Spy(Windows):
        def batch(self, indices):
            seen.append(indices.clone())
            return super().batch(indices)

    fit(LinearPolicy(), Spy(size=16), Sequential(), settings=FitSettings(epochs=1, batch_size=8), seed=(0,))
    assert sorted(torch.cat(seen).tolist()) == list(range(16))
    seen.clear()
    settings = FitSettings(epochs=1, batch_size=8, steps_per_epoch=7)
    fit(LinearPolicy(), Spy(size=16), Sequential(), settings=settings, seed=(0,))
    assert [len(s) for s in seen] == [8] * 7
    assert sorted(torch.cat(seen[:2]).tolist()) == list(range(16))


def test_augmentation_sees_the_mixed_batch():
    sizes, algorithm = [], ER(budget=4)
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
    assert rates[0] == pytest.approx(SETTINGS.lr / 3)
    assert max(rates) == pytest.approx(SETTINGS.lr) and rates[100] == pytest.approx(SETTINGS.lr_min)
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


@pytest.mark.parametrize(("key", "value"), [("epochs", 0), ("batch_size", 0), ("precision", "fp8")])
def test_settings_that_cannot_work_are_named(key, value):
    with pytest.raises(ConfigError, match=key):
        FitSettings(**{key: value})
