"""Numbers worked out in the test, without the code under test: metrics of a run, the GMM loss, ResNet with FiLM."""

import math

import numpy as np
import pytest
import torch
from numpy.lib.stride_tricks import sliding_window_view
from torch import distributions, nn

from lifelong.nn import GMMHead, ResNetFiLMEncoder
from lifelong.results.records import TaskEndRecord
from lifelong.results.results import Results
from lifelong.results.summary import summarize
from tests.harness.records import evaluation, run_start


def test_metrics_of_three_tasks_from_their_records():
    """Successes out of 20, after 0, 5 and 10 epochs; the best epochs are 5, 10 and 5."""
    curves = [(0, 16, 12), (2, 8, 10), (0, 12, 12)]
    rows = [(16,), (10, 10), (4, 7, 12)]
    names = [f"task_{k}" for k in range(3)]
    records = [run_start(names)]
    for task, (curve, row) in enumerate(zip(curves, rows, strict=True)):
        records += [evaluation("curve", task, 5 * i, task, wins, 20) for i, wins in enumerate(curve)]
        best = (5, 10, 5)[task]
        records += [evaluation("matrix", task, best, other, wins, 20) for other, wins in enumerate(row)]
        records.append(TaskEndRecord(task=task, best_epoch=best, seconds=1.0))
    metrics = summarize(Results(tuple(records)))["metrics"]
    # FWT_k: c[k,k,e] averaged over e, after the best held: (0 + .8 + .8)/3, (.1 + .4 + .5)/3, (0 + .6 + .6)/3
    fwt = [1.6 / 3, 1.0 / 3, 0.4]
    # NBT_k: c[k,k] - c[t,k] averaged over t > k: (.8-.5 + .8-.2)/2, .5-.35; nothing follows the last, which counts as 0
    nbt = [0.45, 0.15, 0.0]
    # AUC_k: FWT_k and c[t,k] for t > k averaged: (.5333 + .5 + .2)/3, (.3333 + .35)/2, .4
    auc = [(1.6 / 3 + 0.7) / 3, (1.0 / 3 + 0.35) / 2, 0.4]
    for name, by_task in (("fwt", fwt), ("nbt", nbt), ("auc", auc)):
        assert metrics["by_task"][name] == pytest.approx(by_task), name
        assert metrics[name]["value"] == pytest.approx(sum(by_task) / 3), name
    assert metrics["final_success"]["value"] == pytest.approx((0.2 + 0.35 + 0.6) / 3)
    assert metrics["just_learned"]["value"] == pytest.approx((0.8 + 0.5 + 0.6) / 3)


def test_the_loss_of_a_mixture_is_that_of_torchs_own_distribution():
    torch.manual_seed(0)
    head = GMMHead(in_dim=6, action_dim=7, modes=5, hidden=16, layers=2, min_std=1e-4).double()
    latent, actions = torch.randn(3, 4, 6).double(), 2 * torch.rand(3, 4, 7).double() - 1
    h = latent
    for layer in head.trunk:
        h = layer(h) if not isinstance(layer, nn.ReLU) else h.clamp_min(0)
    shape = (3, 4, 5, 7)
    means = torch.tanh(head.means(h)).view(shape)
    stds = torch.log1p(torch.exp(head.stds(h))).view(shape) + 1e-4
    components = distributions.Independent(distributions.Normal(means, stds), 1)
    mixture = distributions.MixtureSameFamily(distributions.Categorical(logits=head.logits(h)), components)
    losses = head.losses(head(latent), actions)
    torch.testing.assert_close(losses.double(), -mixture.log_prob(actions), rtol=1e-4, atol=1e-4)


def convolve(x: np.ndarray, conv: nn.Conv2d) -> np.ndarray:
    """(C, H, W) -> (C', H', W'), zeros around."""
    weight, (p, _), (s, _) = conv.weight.detach().numpy().astype(float), conv.padding, conv.stride
    size = weight.shape[-1]
    windows = sliding_window_view(np.pad(x, ((0, 0), (p, p), (p, p))), (size, size), axis=(1, 2))[:, ::s, ::s]
    return np.einsum("chwij,dcij->dhw", windows, weight)


def normalise(x: np.ndarray, norm: nn.GroupNorm) -> np.ndarray:
    groups = x.reshape(norm.num_groups, -1)
    groups = (groups - groups.mean(1, keepdims=True)) / np.sqrt(groups.var(1, keepdims=True) + norm.eps)
    weight, bias = (p.detach().numpy()[:, None, None] for p in (norm.weight, norm.bias))
    return groups.reshape(x.shape) * weight + bias


def linear(x: np.ndarray, layer: nn.Linear) -> np.ndarray:
    return layer.weight.detach().numpy().astype(float) @ x + layer.bias.detach().numpy()


def pooled(x: np.ndarray) -> np.ndarray:
    """The largest of every 3x3 window, every other one."""
    padded = np.pad(x, ((0, 0), (1, 1), (1, 1)), constant_values=-math.inf)
    return sliding_window_view(padded, (3, 3), axis=(1, 2))[:, ::2, ::2].max((-1, -2))


def test_resnet_with_film_against_numpy():
    """He et al. 2016, blocks of two convolutions; after each (1 + γ) h + β; expected positions; one linear map."""
    torch.manual_seed(0)
    encoder = ResNetFiLMEncoder(
        image_size=(32, 40),
        language_dim=6,
        latent_dim=8,
        width=8,
        stage_blocks=(1, 1),
        stem_stride=1,
        keypoints=5,
    ).eval()
    for parameter in encoder.parameters():  # norms and FiLM start as the identity
        nn.init.normal_(parameter, std=0.3)
    images = torch.randint(0, 256, (1, 32, 40, 3), dtype=torch.uint8)
    language = torch.randn(1, 6)

    h = images[0].numpy().transpose(2, 0, 1) * (2 / 255) - 1
    h = pooled(np.maximum(normalise(convolve(h, encoder.stem[0]), encoder.stem[1]), 0))
    for block, film in zip(encoder.blocks, encoder.films, strict=True):
        inner = np.maximum(normalise(convolve(h, block.conv1), block.norm1), 0)
        inner = normalise(convolve(inner, block.conv2), block.norm2)
        if isinstance(block.shortcut, nn.Sequential):
            h = normalise(convolve(h, block.shortcut[0]), block.shortcut[1])
        h = np.maximum(inner + h, 0)
        gamma, beta = np.split(linear(language[0].numpy(), film.project), 2)
        h = (1 + gamma)[:, None, None] * h + beta[:, None, None]
    heat = np.stack([linear(place, encoder.readout.heat) for place in h.reshape(len(h), -1).T], axis=1)
    weights = np.exp(heat - heat.max(1, keepdims=True))
    weights = (weights / weights.sum(1, keepdims=True)).reshape(5, *h.shape[1:])
    x, y = np.linspace(-1, 1, h.shape[2]), np.linspace(-1, 1, h.shape[1])
    positions = np.stack([(weights.sum(1) * x).sum(1), (weights.sum(2) * y).sum(1)], axis=1).ravel()
    expected = linear(positions, encoder.project)

    with torch.no_grad():
        found = encoder(images, language)[0]
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-3, atol=1e-3)
