"""Saliency maps against a policy whose input is known."""

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from libero_eval.requests import SaliencyRequest
from libero_eval.saliency import (
    SaliencySettings,
    _batch,
    contact_sheet,
    draw_saliency,
    frames_used,
    overlay,
    saliency,
    window_at,
)
from lifelong.data import fake_batch
from lifelong.errors import ConfigError, PolicyError
from lifelong.policies.base import Policy
from lifelong.seeding import generator
from lifelong.types import Batch, PolicySpec
from tests.harness.algorithms import frame
from tests.harness.policies import small_rnn

SPEC = PolicySpec(image_size=(64, 96), proprio={"x": 2}, language_dim=3, seq_len=2)
PATCH = (slice(20, 28), slice(60, 70))  # of the second camera


class OnePatch(Policy):
    """Returns the mean of one patch of one camera."""

    def window_losses(self, batch: Batch) -> Tensor:
        return (self.predict(batch) - batch.actions).square().mean((1, 2))

    def predict(self, batch: Batch) -> Tensor:
        assert not self.training
        patch = batch.observation.images[:, :, 1, *PATCH].float().mean((2, 3, 4)) / 255
        return patch[..., None].expand(-1, -1, 7)

    def reset(self, num_envs: int) -> None: ...

    def _act(self, observation, generators):
        raise AssertionError("saliency does not act")


def window() -> Batch:
    """Noise to one side of the patch's middle, black to the other, so that blurring changes the patch's mean."""
    batch = fake_batch(SPEC, 1, generator(0))
    batch.observation.images[..., PATCH[0], 65:, :] = 255
    batch.observation.images[..., PATCH[0], :60, :] = 0
    return batch


def test_saliency_is_high_at_the_used_patch_and_zero_elsewhere():
    policy = OnePatch(SPEC).train()
    settings = SaliencySettings(stride=8, sigma=4, blur=6)
    heat = saliency(policy, window(), settings)
    assert policy.training, "the mode stays"
    assert heat.shape == (2, 64, 96) and heat.dtype == torch.float32 and (heat >= 0).all()
    assert (heat[0] == 0).all(), "the other camera does not matter"
    reach = 3 * 4 * 64 / 128 + 2 * 8 * 64 / 128  # of the mask, and of interpolation
    ys, xs = torch.meshgrid(torch.arange(64), torch.arange(96), indexing="ij")
    far = (ys < 20 - reach) | (ys > 27 + reach) | (xs < 60 - reach) | (xs > 69 + reach)
    assert (heat[1][far] == 0).all() and far.float().mean() > 0.7
    y, x = divmod(int(heat[1].argmax()), 96)
    assert 18 <= y <= 29 and 56 <= x <= 73
    assert heat[1].max() > 1e-5


def test_a_blurred_place_is_half_the_squared_difference_of_actions():
    """Eq. 1 and 2 at one place, by hand in NumPy."""
    policy, batch = OnePatch(SPEC).eval(), window()
    settings = SaliencySettings(stride=128, sigma=40, blur=6)  # one place: the middle of the image
    heat = saliency(policy, batch, settings)
    image = batch.observation.images[0, -1, 1].numpy().astype(float)
    sigma, blur = 20.0, 3.0
    kernel = np.exp(-(np.arange(-9, 10) ** 2) / (2 * blur**2))
    kernel /= kernel.sum()
    padded = np.pad(image, ((9, 9), (9, 9), (0, 0)), mode="edge")
    blurred = np.zeros_like(image)
    for dy in range(19):
        for dx in range(19):
            blurred += kernel[dy] * kernel[dx] * padded[dy : dy + 64, dx : dx + 96]
    centres = [(31.5, 23.5), (31.5, 71.5)]  # 96 wide: two places side by side
    for (cy, cx), column in zip(centres, (0, 95), strict=True):
        squares = (np.arange(64)[:, None] - cy) ** 2 + (np.arange(96) - cx) ** 2
        mask = np.where(squares <= (3 * sigma) ** 2, np.exp(-squares / (2 * sigma**2)), 0)[..., None]
        changed = np.round(image * (1 - mask) + blurred * mask)
        difference = (image[PATCH].mean() - changed[PATCH].mean()) / 255
        assert heat[1, 0, column].item() == pytest.approx(0.5 * 7 * difference**2, rel=1e-3)


def test_a_batch_of_several_windows_is_refused():
    policy = OnePatch(SPEC)
    with pytest.raises(ConfigError, match="one window; this one has 2"):
        saliency(policy, fake_batch(SPEC, 2, generator(0)))


def test_overlays_are_grey_where_saliency_is_zero():
    draws = np.random.default_rng(0)
    image = draws.integers(0, 256, (8, 8, 3), np.uint8)
    heat = np.zeros((8, 8))
    heat[2, 3] = 2.0
    drawn = overlay(image, heat, strongest=2.0).astype(int)
    plain = overlay(image, np.zeros((8, 8)), strongest=0.0).astype(int)
    changed = np.abs(drawn - plain).sum(-1) > 0
    assert changed[2, 3] and changed.sum() == 1
    sheet = contact_sheet([image[None], image[None]], [heat[None], heat[None]], enlarge=3, gap=4)
    assert sheet.shape == (2 * (3 * 8 + 4), 2 * (3 * 8 + 4), 3)
    np.testing.assert_array_equal(sheet[2:26:3, 2:26:3], image)


@pytest.mark.parametrize("memory", ["reset", "window", "none"])
def test_the_explained_action_is_that_of_the_frames_that_it_was_taken_from(memory):
    spec = replace(SPEC, seq_len=3)
    torch.manual_seed(0)
    policy = small_rnn(spec, "deterministic", memory=memory).eval()
    seen = fake_batch(spec, 1, generator(1), steps=7).observation
    policy.reset(1)
    each = [frame(seen, step) for step in range(7)]
    frames = [{"images": one.images, **one.proprio} for one in each]
    for step, one in enumerate(each):
        acted = policy.act(one, [generator(0)])
        used = _batch(window_at(frames, step, frames_used(policy, step)), seen.language[0], policy)
        with torch.no_grad():
            explained = policy.predict(used)[:, -1]
        torch.testing.assert_close(explained.clamp(-1, 1), acted)


def test_a_policy_that_plans_several_actions_is_refused_by_name():
    policy = SimpleNamespace(chunk=5)
    with pytest.raises(PolicyError, match="this policy plans 5 actions at once"):
        frames_used(policy, 3)


def test_sheets_of_two_starts_stand_beside_each_other_and_name_them(tmp_path, monkeypatch, capsys):
    policy = OnePatch(SPEC).eval()
    run = SimpleNamespace(
        path=tmp_path,
        tasks=["task"],
        learned=1,
        device="cpu",
        eval=SimpleNamespace(horizon=200),
        learned_task=lambda task: SimpleNamespace(language="do it"),
        embed=lambda task: torch.zeros(3),
        acting=lambda task: nullcontext(policy),
    )
    seen = window().observation
    frames = [{"images": seen.images[:, :1], "x": seen.proprio["x"][:, :1]}] * 3
    monkeypatch.setattr("libero_eval.saliency.restore", lambda *_, **__: run)
    monkeypatch.setattr("libero_eval.saliency._run_episode", lambda *_: (frames, False))
    for start, moments in ((2, 6), (3, 3)):
        path = draw_saliency(SaliencyRequest(run=tmp_path, start=start, moments=moments, stride=64))
        assert path.name == f"task_00_after_01_start_0{start}.png" and path.is_file()
        caption = f"do it: failure, after learning 2 tasks; start {start}, steps 0, 1, 2\n"
        assert path.with_suffix(".txt").read_text() == caption
        assert capsys.readouterr().err.count("note: 3 moments, as the rollout has no more") == (moments > 3)


def test_what_is_written_into_a_run_follows_no_link_out_of_it(tmp_path, monkeypatch):
    run = SimpleNamespace(path=tmp_path / "run", tasks=["task"], learned=0, weights_digest="")
    run.path.mkdir()
    (run.path / "saliency").symlink_to(tmp_path)
    monkeypatch.setattr("libero_eval.saliency.restore", lambda *_, **__: run)
    with pytest.raises(ConfigError, match="saliency is a link, or is not a folder"):
        draw_saliency(SaliencyRequest(run=run.path))
