"""Network parts have the properties their names promise."""

import platform
import subprocess
import sys
from contextlib import nullcontext
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from lifelong.data import fake_batch
from lifelong.errors import ConfigError, PolicyError
from lifelong.nn import (
    ColorJitter,
    Compose,
    DeterministicHead,
    FlowHead,
    GMMHead,
    ProprioTokens,
    RandomShift,
    ResNetFiLMEncoder,
    SpatialSoftmax,
)
from lifelong.nn.augmentation import jitter
from lifelong.nn.experts import matching
from lifelong.nn.tokens import standardise
from lifelong.nn.transformer import TransformerLayer, attend
from lifelong.nn.vision import FlatReadout, make_norm, to_network
from lifelong.training.precision import check_precision
from lifelong.types import PolicySpec

SPEC = PolicySpec(image_size=(16, 20), language_dim=6, seq_len=4)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def randn(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=generator())


def small_encoder(**changes) -> ResNetFiLMEncoder:
    sizes = {"image_size": (32, 32), "language_dim": 6, "latent_dim": 8, "width": 8, "stem_pool": False}
    return ResNetFiLMEncoder(**(sizes | changes))


def test_a_low_temperature_lets_untrained_keypoints_follow_the_image() -> None:
    h, spread = randn(20, 8, 6, 6), {}
    for temperature in (1.0, 0.1):
        layer = SpatialSoftmax(channels=8, size=(6, 6), keypoints=16, temperature=temperature)
        nn.init.normal_(layer.heat.weight, std=0.1, generator=generator())
        spread[temperature] = layer(h).std(0).mean()
    assert spread[0.1] > 4 * spread[1.0]


def test_flat_readout_reads_every_place_of_the_map() -> None:
    layer = FlatReadout(channels=3, size=(4, 5), features=6)
    h = randn(2, 3, 4, 5).requires_grad_()
    layer(h).sum().backward()
    assert layer(h).shape == (2, 6)
    assert (h.grad.abs().sum(1) > 0).all()


@pytest.mark.parametrize("norm", ["group", "batch", "none"])
def test_encoder_frames_of_a_window_share_its_language(norm: str) -> None:
    encoder = small_encoder(norm=norm).eval()
    for film in encoder.films:
        nn.init.normal_(film.project.weight, generator=generator())
    images = torch.randint(0, 256, (6, 32, 32, 3), generator=generator(), dtype=torch.uint8)
    language = randn(2, 6)
    together = encoder(images, language)
    each = torch.cat([encoder(images[i : i + 1], language[i // 3 : i // 3 + 1]) for i in range(6)])
    torch.testing.assert_close(together, each, atol=1e-5, rtol=1e-5)
    assert not torch.allclose(encoder(images, language.flip(0)), together)


@pytest.mark.parametrize("stem_film", [False, True])
def test_the_instruction_modulates_a_stem_without_blocks_where_it_is_asked_to(stem_film: bool) -> None:
    encoder = ResNetFiLMEncoder(
        image_size=(16, 16), language_dim=6, stage_blocks=(0,), width=8, stem_pool=False, stem_film=stem_film
    )
    for name, weight in encoder.named_parameters():
        if "film" in name:
            nn.init.normal_(weight)
    images = torch.randint(0, 256, (2, 16, 16, 3), dtype=torch.uint8)
    one, other = encoder(images, torch.randn(2, 6)), encoder(images, torch.randn(2, 6))
    assert torch.equal(one, other) == (not stem_film)


def test_encoder_refuses_images_that_are_too_small() -> None:
    with pytest.raises(PolicyError, match="too small to localise"):
        small_encoder(stage_blocks=(1, 1, 1, 1), stem_pool=True)


@pytest.mark.parametrize("head", [GMMHead, DeterministicHead, FlowHead])
def test_heads_compute_in_float32_under_autocast(head) -> None:
    """Means in bfloat16 are 0.0014 RMS from those in float32, where a mixture's smallest deviation is 1e-4."""
    torch.manual_seed(0)
    head, latent = head(in_dim=16, action_dim=7, hidden=64).eval(), randn(32, 4, 16)
    actions, exact = randn(32, 4, 7).tanh(), head(latent)
    with torch.autocast("cpu", torch.bfloat16, enabled=True):
        low = head(latent)
        found = head.losses(low, actions), head.mean(low)
    assert all(torch.equal(low[name], value) for name, value in exact.items())
    assert torch.equal(found[0], head.losses(exact, actions)) and torch.equal(found[1], head.mean(exact))


def test_pixels_of_the_original_are_its_range_and_its_first_row() -> None:
    images = torch.randint(0, 256, (2, 4, 5, 3), dtype=torch.uint8, generator=generator())
    kept = images.clone()
    ours, theirs = to_network(images, "centred"), to_network(images, "libero")
    assert torch.equal(images, kept)
    assert ours.shape == theirs.shape == (2, 3, 4, 5)
    torch.testing.assert_close(ours[0, 1], images[0, :, :, 1] / 127.5 - 1)
    torch.testing.assert_close(theirs[0, 1], images[0, :, :, 1].flipud() / 255)


def test_initial_weights_of_the_original_are_those_of_torchvisions_resnet() -> None:
    """A normal distribution of variance 2 / (9 channels out); FiLM is not the identity."""
    torch.manual_seed(0)
    ours, theirs = small_encoder(width=64), small_encoder(width=64, init="libero", norm="batch")
    weight = theirs.blocks[0].conv1.weight
    assert weight.std().item() == pytest.approx((2 / (9 * 64)) ** 0.5, rel=0.02)
    assert weight.abs().max() > 3.5 * weight.std() > 2 * ours.blocks[0].conv1.weight.abs().max()
    assert theirs.films[0].project.weight.any() and not ours.films[0].project.weight.any()


def test_drop_path_skips_whole_feed_forward_networks_and_nothing_in_evaluation() -> None:
    layer = TransformerLayer(
        dim=8, heads=2, head_dim=4, mlp_dim=16, dropout=0.0, attention_dropout=0.0, drop_path=0.3
    )
    x = randn(2000, 3, 8)
    plain = layer.eval()(x)
    mixed = x + layer.out(attend(layer.qkv(layer.attention_norm(x)), 2))
    torch.manual_seed(0)
    dropped = layer.train()(x)
    skipped = (dropped - mixed).abs().amax((1, 2)) < 1e-6
    assert skipped.float().mean().item() == pytest.approx(0.3, abs=0.03)
    torch.testing.assert_close((dropped - mixed)[~skipped] * 0.7, (plain - mixed)[~skipped])


def test_a_mixture_acts_by_its_heaviest_component_its_mean_or_samples() -> None:
    head = GMMHead(in_dim=4, action_dim=1, modes=2, hidden=8, low_eval_noise=True)
    params = {
        "means": torch.tensor([[-0.5], [0.5]]).expand(20_000, 2, 1),
        "stds": torch.tensor([[0.05], [0.1]]).expand(20_000, 2, 1),
        "logits": torch.tensor([0.25, 0.75]).log().expand(20_000, 2),
    }
    assert (head.greedy(params) == 0.5).all()
    head.acts = "mean"
    torch.testing.assert_close(head.greedy(params), torch.full((20_000, 1), 0.25))
    drawn = head.sample(params, generator())[:, 0]
    right = drawn[drawn > 0]
    assert len(right) / len(drawn) == pytest.approx(0.75, abs=0.02)
    assert right.std().item() == pytest.approx(0.1, rel=0.05)
    assert head.eval().sample(params, generator())[:, 0].abs().std() < 1e-3  # low_eval_noise
    assert torch.equal(head.sample(params, generator(3)), head.sample(params, generator(3)))


def test_deterministic_head_loss_is_absolute_error() -> None:
    head = DeterministicHead(in_dim=4, action_dim=3, hidden=8)
    params, actions = head(randn(5, 4)), randn(5, 3)
    torch.testing.assert_close(head.losses(params, actions), (params["means"] - actions).abs().mean(-1))
    assert torch.equal(head.greedy(params), head.sample(params, None))


def mixture(seed: int, modes: int = 3, rows: int = 5) -> dict[str, torch.Tensor]:
    draws = generator(seed)
    return {
        "means": torch.randn(rows, modes, 2, generator=draws).tanh(),
        "stds": 0.1 + torch.rand(rows, modes, 2, generator=draws),
        "logits": torch.randn(rows, modes, generator=draws),
    }


def gmm(modes: int = 3) -> GMMHead:
    return GMMHead(in_dim=4, action_dim=2, modes=modes, hidden=8)


def test_mixture_divergence_is_zero_and_least_exactly_where_the_student_is_the_teacher() -> None:
    head, teacher = gmm(), mixture(0)
    student = {name: value.clone().requires_grad_() for name, value in teacher.items()}
    divergence = head.divergence(head.answers(teacher), student)
    assert divergence.shape == (5,) and not divergence.any()
    for grad in torch.autograd.grad(divergence.sum(), list(student.values())):
        assert grad.abs().max() < 1e-6
    for name in teacher:  # every parameter counts
        change = torch.linspace(0.1, 0.5, teacher[name].numel()).view_as(teacher[name])
        moved = {**teacher, name: teacher[name] + change}
        assert (head.divergence(teacher, moved) > 1e-5).all(), name
    shifted = {**teacher, "logits": teacher["logits"] + 3}  # the same weights
    assert head.divergence(teacher, shifted).abs().max() < 1e-6


def test_mixture_divergence_bounds_that_of_the_actions_and_is_exact_for_one_gaussian() -> None:
    for modes in (1, 3):
        head, teacher, student = gmm(modes), mixture(1, modes, rows=1), mixture(2, modes, rows=1)
        many = {name: value.expand(40_000, *value.shape[1:]) for name, value in teacher.items()}
        actions = head.sample(many, generator())
        other = {name: value.expand(40_000, *value.shape[1:]) for name, value in student.items()}
        gaps = head.log_prob(many, actions) - head.log_prob(other, actions)
        estimate, error = gaps.mean().item(), gaps.std().item() / 200
        bound = head.divergence(teacher, student).item()
        assert bound > estimate - 4 * error
        if modes == 1:
            assert bound == pytest.approx(estimate, abs=4 * error)


def test_deterministic_divergence_is_the_squared_distance_of_the_actions() -> None:
    head = DeterministicHead(in_dim=4, action_dim=3, hidden=8)
    teacher, student = head(randn(2, 5, 4)), head(randn(2, 5, 4) + 1)
    expected = (student["means"] - teacher["means"]).square().sum(-1)
    assert torch.equal(head.divergence(head.answers(teacher), student), expected)


def test_proprio_is_of_order_one_and_dropout_takes_whole_windows() -> None:
    tokens = ProprioTokens(proprio={"gripper_states": 2}, dim=2, dropout=0.5)
    nn.init.eye_(tokens.linears["gripper_states"].weight)
    nn.init.zeros_(tokens.linears["gripper_states"].bias)
    opened = torch.tensor([0.04, -0.04]).expand(64, 3, 2)
    torch.testing.assert_close(tokens.eval()({"gripper_states": opened})[0][0, 0], torch.tensor([1.0, -1.0]))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        kept = tokens.train()({"gripper_states": opened})[0].abs().sum(-1) > 0
    assert (kept.all(1) | ~kept.any(1)).all()
    assert kept.any() and not kept.all()


def test_standardised_language_has_unit_variance() -> None:
    out = standardise(0.05 * randn(3, 100) + 1)
    torch.testing.assert_close(out.var(-1, unbiased=False), torch.ones(3), atol=0.01, rtol=0)


@pytest.mark.parametrize("augmentation", [RandomShift(3), ColorJitter(keep=0.0), Compose([RandomShift(2)])])
def test_augmentation_is_the_same_for_all_frames_of_a_window_and_leaves_its_input(augmentation) -> None:
    batch = fake_batch(SPEC, 8, generator())
    batch.observation.images.copy_(batch.observation.images[:, :1].clone())  # all frames alike
    before = batch.observation.images.clone()
    global_state = torch.random.get_rng_state()
    changed = augmentation(batch, generator(1)).observation.images
    assert torch.equal(batch.observation.images, before)
    assert torch.equal(global_state, torch.random.get_rng_state())
    assert torch.equal(changed, changed[:, :1].expand_as(changed))
    assert torch.equal(changed, augmentation(batch, generator(1)).observation.images)
    assert changed.dtype == torch.uint8
    same = [torch.equal(a, b) for a, b in zip(changed, before, strict=True)]
    assert not all(same)


def test_shift_equals_a_naive_reference() -> None:
    images = fake_batch(SPEC, 5, generator()).observation.images
    moved = RandomShift(3).images(images, generator(7))
    shifts = torch.randint(0, 7, (5, 2, 2), generator=generator(7))
    padded = np.pad(images.numpy(), [(0, 0)] * 3 + [(3, 3), (3, 3), (0, 0)], mode="edge")
    for b in range(5):
        for v in range(2):
            y, x = shifts[b, v].tolist()
            np.testing.assert_array_equal(moved[b, :, v], padded[b, :, v, y : y + 16, x : x + 20])


def test_jitter_of_nothing_changes_nothing_and_gray_stays_gray() -> None:
    images = fake_batch(SPEC, 4, generator()).observation.images
    assert torch.equal(ColorJitter(0, 0, 0, 0, keep=0.0).images(images, generator()), images)
    assert torch.equal(ColorJitter(keep=1.0).images(images, generator()), images)
    gray = images[..., :1].expand_as(images)
    turned = ColorJitter(0, 0, 0.3, 0.3, keep=0.0).images(gray, generator()).int()
    assert (turned - gray.int()).abs().max() <= 1


def test_brightness_scales() -> None:
    images = torch.full((3, 1, 2, 4, 4, 3), 100, dtype=torch.uint8)
    changed = ColorJitter(0.3, 0, 0, 0, keep=0.0).images(images, generator()).float()
    assert ((changed >= 70) & (changed <= 130)).all()
    assert len(changed.unique()) > 3  # each window its own


def test_windows_are_jittered_together_as_one_by_one() -> None:
    pictures = torch.rand(9, 2, 1, 5, 4, 3, generator=generator())
    amounts = torch.rand(9, 4, generator=generator(1), dtype=torch.float64) - 0.5
    orders = torch.stack([torch.randperm(4, generator=generator(k)) for k in range(9)])
    alone = [jitter(pictures[k : k + 1], amounts[k : k + 1], orders[k : k + 1]) for k in range(9)]
    assert torch.equal(jitter(pictures.clone(), amounts, orders), torch.cat(alone))


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="resident memory is read from /proc")
def test_freed_memory_is_kept():
    """A process that asked for it holds a freed tensor's pages; another gives them back."""
    code = """
import os, sys, torch
from lifelong.training.precision import keep_freed_memory
resident = lambda: int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
kept = sys.argv[1] == "keep" and keep_freed_memory()
before = resident()
del (block := [torch.ones(2**25)])[:]
print(int(kept), resident() - before)
"""
    runs = [
        subprocess.run([sys.executable, "-c", code, how], capture_output=True, text=True, check=True)
        for how in ("keep", "leave")
    ]
    (kept, held), (_, left) = (map(int, run.stdout.split()) for run in runs)
    if kept:  # glibc
        assert left < 2**26 < held
    else:
        assert platform.libc_ver()[0] != "glibc"


def test_norms_are_learned_behind_a_frozen_convolution():
    """Where PyTorch's own is killed: on a CPU, with channels last and an input that needs no gradient."""
    x, grads = torch.randn(2, 8, 6, 6, generator=generator(0)), []
    norm = make_norm("group", 8)
    for frozen in (x.contiguous(memory_format=torch.channels_last), x):
        norm.zero_grad()
        norm(frozen).square().sum().backward()
        grads.append([p.grad.clone() for p in norm.parameters()])
    for a, b in zip(*grads, strict=True):
        torch.testing.assert_close(a, b)


def test_bf16_of_recurrent_layers_is_refused_where_the_processor_has_none(monkeypatch):
    for runs, layer, asked in product((True, False), (nn.LSTM(2, 2), nn.Linear(2, 2)), ("bf16", "auto")):
        monkeypatch.setattr("lifelong.training.precision.bf16_runs_on_cpu", lambda runs=runs: runs)
        refused = not runs and asked == "bf16" and isinstance(layer, nn.LSTM)
        with pytest.raises(ConfigError, match="eval.precision=bf16: this") if refused else nullcontext():
            check_precision(layer, torch.device("cpu"), {"train.precision": "fp32", "eval.precision": asked})


def test_every_pattern_of_names_has_to_match():
    assert matching(["a.x", "b.x"], ["a.*", "b.*"], "weight") == ["a.x", "b.x"]
    for patterns, idle in ((["a.*", "heed.*"], r"\['heed.*'\]"), ([], r"\[\]")):
        with pytest.raises(ConfigError, match=f"algo.adapted={idle} matches no weight"):
            matching(["a.x", "b.x"], patterns, "weight")
