"""Where a policy looks: how much its answer changes when a place of the picture is blurred.

Greydanus et al., "Visualizing and understanding Atari agents" (ICML 2018). Around a place (i, j) the image I is mixed
with a blurred copy A of it by a Gaussian mask M centred there,
    I' = I (1 - M) + A M                                   (eq. 1),
so that what is to be seen there is lost without an edge or colour that is new. Saliency is the change of the answer,
    S(i, j) = 1/2 |π(I) - π(I')|²                          (eq. 2).

A place is blurred in every frame of the window. Blurred pixels are whole numbers, as the policy takes them: where
blurring changes nothing (a plain surface), there is no saliency.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from lifelong.errors import ConfigError
from lifelong.policies.base import Policy
from lifelong.types import Batch

_CHUNK = 32  # windows that the policy answers at once
_CUT = 3.0  # deviations beyond which a mask is zero


@dataclass(frozen=True)
class SaliencySettings:
    """How finely is looked; lengths in pixels of an image 128 high, and in proportion for others.

    Attributes:
        stride: Between two places (5 in the paper, for images of 80).
        sigma: Deviation of the mask (the paper's is 5).
        blur: Deviation of the blur (3 in the paper).
    """

    stride: float = 8.0
    sigma: float = 6.0
    blur: float = 5.0

    def __post_init__(self) -> None:
        for name in ("stride", "sigma", "blur"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"saliency: {name} is {getattr(self, name)}; it must be above 0")


@torch.no_grad()
def saliency(
    policy: Policy,
    batch: Batch,
    settings: SaliencySettings = SaliencySettings(),  # noqa: B008 - frozen
    *,
    measure: Literal["action", "loss"] = "action",
) -> Tensor:
    """Maps of how much each place of each picture matters to a policy's answer on one window.

    Args:
        policy: Any policy with `predict`, or with `window_losses` for `measure="loss"`. Its mode stays.
        batch: One window (B = 1), on the policy's device.
        settings: How finely is looked.
        measure: `action`: of the answer at the last step, eq. 2. `loss`: the absolute change of the window's loss,
            which needs the demonstrated actions.

    Returns:
        (V, H, W) float32, at least 0: values at the places, interpolated between them.

    Raises:
        ConfigError: Another number of windows, or another measure.
        PolicyError: The policy has no `predict`.
    """
    if len(batch) != 1:
        raise ConfigError(f"saliency is of one window; the batch has {len(batch)}")
    if measure not in ("action", "loss"):
        raise ConfigError(f"saliency: measure is {measure!r}; valid: action, loss")
    images = batch.observation.images  # (1, T, V, H, W, 3)
    height, width = images.shape[3:5]
    scale = height / 128
    rows, cols = (_places(n, settings.stride * scale) for n in (height, width))
    blurred = _blur(images, settings.blur * scale)
    with _evaluating(policy):
        usual = _answer(policy, batch, measure)
        maps = []
        for view in range(images.shape[2]):
            changes = []
            for some in torch.cartesian_prod(rows, cols).split(_CHUNK):
                masks = _masks(some, (height, width), settings.sigma * scale).to(images.device)
                answers = _answer(policy, _perturbed(batch, blurred, masks, view), measure)
                difference = answers - usual
                changes.append(
                    0.5 * difference.square().sum(-1) if measure == "action" else difference.abs()[:, 0]
                )
            maps.append(torch.cat(changes).view(1, 1, len(rows), len(cols)))
    return _spread(torch.cat(maps, dim=1).float(), rows, cols, (height, width))[0]


def overlay(image: np.ndarray, heat: np.ndarray, strongest: float) -> np.ndarray:
    """A picture with its saliency: grey where nothing matters, from blue to yellow where something does.

    Args:
        image: (H, W, 3) uint8.
        heat: (H, W), at least 0.
        strongest: The saliency that is drawn in full; the same for pictures that are compared.

    Returns:
        (H, W, 3) uint8.
    """
    from matplotlib import colormaps  # here, as only pictures need it

    share = np.clip(heat / strongest, 0, 1) if strongest > 0 else np.zeros_like(heat)
    grey = np.repeat(image.mean(-1, keepdims=True), 3, axis=-1)
    colour = 255 * np.asarray(colormaps["plasma"](share))[..., :3]
    weight = 0.75 * np.sqrt(share)[..., None]
    return (
        np.clip((1 - weight) * (0.35 * image + 0.65 * grey) + weight * colour, 0, 255)
        .round()
        .astype(np.uint8)
    )


def contact_sheet(
    pictures: Sequence[np.ndarray], heats: Sequence[np.ndarray], enlarge: int = 1, gap: int = 4
) -> np.ndarray:
    """Pictures of several moments and what mattered in them: a column for each, two rows for each camera.

    Args:
        pictures: At each moment (V, H, W, 3) uint8.
        heats: At each moment (V, H, W).
        enlarge: Whole factor of size.
        gap: White pixels between pictures.

    Returns:
        (height, width, 3) uint8. In a camera's second row all moments share one scale.
    """
    views = range(len(pictures[0]))
    rows = []
    for view in views:
        strongest = max(float(heat[view].max()) for heat in heats)
        drawn = [overlay(p[view], h[view], strongest) for p, h in zip(pictures, heats, strict=True)]
        rows += [[p[view] for p in pictures], drawn]
    frame = ((gap // 2, gap - gap // 2), (gap // 2, gap - gap // 2), (0, 0))
    enlarged = [[np.kron(p, np.ones((enlarge, enlarge, 1), np.uint8)) for p in row] for row in rows]
    return np.concatenate(
        [np.concatenate([np.pad(p, frame, constant_values=255) for p in row], axis=1) for row in enlarged]
    )


def window_at(frames: Sequence[Mapping[str, Tensor]], step: int, length: int) -> dict[str, Tensor]:
    """The frames a policy saw until a step, at most `length`, joined on the time axis.

    Args:
        frames: By step, (1, 1, ...) tensors by name.
        step: The last of them.
        length: `seq_len`.
    """
    seen = frames[max(0, step + 1 - length) : step + 1]
    return {name: torch.cat([frame[name] for frame in seen], dim=1) for name in seen[0]}


def _places(size: int, stride: float) -> Tensor:
    """Centres about a stride apart, evenly over the image, as far from its edge as half of their distance."""
    count = max(1, round(size / stride))
    return (torch.arange(count) + 0.5) * (size / count) - 0.5


def _masks(places: Tensor, size: tuple[int, int], sigma: float) -> Tensor:
    """M of places (N, 2), (N, H, W): 1 at its centre, 0 beyond three deviations."""
    ys, xs = torch.arange(size[0]), torch.arange(size[1])
    squares = (ys - places[:, :1])[:, :, None].square() + (xs - places[:, 1:])[:, None].square()
    return torch.where(squares <= (_CUT * sigma) ** 2, (-squares / (2 * sigma**2)).exp(), 0.0)


def _blur(images: Tensor, sigma: float) -> Tensor:
    """A of images (..., H, W, 3), float32; edges are continued."""
    radius = min(math.ceil(_CUT * sigma), min(images.shape[-3:-1]) - 1)
    line = torch.arange(-radius, radius + 1, device=images.device)
    weights = (-line.square() / (2 * sigma**2)).exp()
    weights = weights / weights.sum()
    flat = images.flatten(0, -4).movedim(-1, 1).float()  # (N, 3, H, W)
    flat = functional.pad(flat.flatten(0, 1)[:, None], (radius,) * 4, mode="replicate")
    flat = functional.conv2d(functional.conv2d(flat, weights.view(1, 1, -1, 1)), weights.view(1, 1, 1, -1))
    return flat.view(-1, 3, *images.shape[-3:-1]).movedim(1, -1).reshape(images.shape)


def _perturbed(batch: Batch, blurred: Tensor, masks: Tensor, view: int) -> Batch:
    """The window as often as there are masks (N, H, W), each with its place blurred in a view."""
    count, obs = len(masks), batch.observation
    repeat = lambda x: x.expand(count, *x.shape[1:])  # noqa: E731
    images = repeat(obs.images).clone()
    seen, weight = obs.images[:, :, view].float(), masks[:, None, :, :, None]
    images[:, :, view] = torch.lerp(seen, blurred[:, :, view], weight).round().to(torch.uint8)
    proprio = {name: repeat(value) for name, value in obs.proprio.items()}
    return replace(
        batch,
        observation=replace(obs, images=images, proprio=proprio, language=repeat(obs.language)),
        actions=repeat(batch.actions),
        task_ids=repeat(batch.task_ids),
        window_ids=repeat(batch.window_ids),
    )


def _answer(policy: Policy, batch: Batch, measure: str) -> Tensor:
    """(B, A) actions at the last step, or (B, 1) losses."""
    return policy.predict(batch)[:, -1] if measure == "action" else policy.window_losses(batch)[:, None]


def _spread(values: Tensor, rows: Tensor, cols: Tensor, size: tuple[int, int]) -> Tensor:
    """Values at places (1, V, R, C) interpolated to (1, V, H, W); places are cell centres of an even grid."""
    if (len(rows), len(cols)) == size:
        return values
    return functional.interpolate(values, size=size, mode="bilinear", align_corners=False)


@contextmanager
def _evaluating(policy: Policy) -> Iterator[None]:
    was_training = policy.training
    policy.eval()
    try:
        yield
    finally:
        policy.train(was_training)
