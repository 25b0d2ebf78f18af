"""Image augmentation of batches: one random change per window, and view or not, the same for all of its frames.

`RandomShift` and `ColorJitter` draw for each view, `SharedShift` and `SharedJitter` once for all views.

Shape legend: B batch, T time, V views, H W C image. Images are (B, T, V, H, W, C), uint8 in 0..255.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from lifelong.types import Batch, NonNegative, Share, to_device


class Augmentation(ABC):
    """Random change of a batch's images; the given batch is not modified."""

    @abstractmethod
    def images(self, images: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return changed images, of the same shape and dtype.

        Args:
            images: Images (B, T, V, H, W, C) uint8.
            generator: CPU generator; None draws from torch's default one, as dropout does.
        """

    def __call__(self, batch: Batch, generator: torch.Generator | None = None) -> Batch:
        """Return the batch with changed images."""
        images = self.images(batch.observation.images, generator)
        return replace(batch, observation=replace(batch.observation, images=images))


class Compose(Augmentation):
    """Several augmentations in order.

    Args:
        augmentations: Augmentations to apply, the first one first.
    """

    def __init__(self, augmentations: Sequence[Augmentation]) -> None:
        self.augmentations = tuple(augmentations)

    def images(self, images: Tensor, generator: torch.Generator | None = None) -> Tensor:
        for augmentation in self.augmentations:
            images = augmentation.images(images, generator)
        return images


class RandomShift(Augmentation):
    """Random shift that repeats the border (Kostrikov et al., DrQ, ICLR 2021).

    Args:
        pixels: Largest shift in each direction.
    """

    def __init__(self, pixels: Annotated[int, Field(ge=0, le=10_000)] = 4) -> None:
        self.pixels = pixels

    def images(self, images: Tensor, generator: torch.Generator | None = None) -> Tensor:
        b, _, v, h, w, _ = images.shape
        padded, moved = repeat_border(images, self.pixels), torch.empty_like(images)
        # NumPy slices in a fifth of PyTorch's time
        source, target = (x.numpy() if x.device.type == "cpu" else x for x in (padded, moved))
        for row, per_view in enumerate(self._corners(b, v, generator).tolist()):
            for view, (y, x) in enumerate(per_view):
                target[row, :, view] = source[row, :, view, y : y + h, x : x + w]
        return moved

    def _corners(self, windows: int, views: int, generator: torch.Generator | None) -> Tensor:
        """Draw the first row and column of each window's crop of the padded images, (windows, views, 2) int64."""
        return torch.randint(0, 2 * self.pixels + 1, (windows, views, 2), generator=generator)


def repeat_border(images: Tensor, pixels: int) -> Tensor:
    """Pad images (..., H, W, C) to (..., H + 2 pixels, W + 2 pixels, C)."""
    if not pixels:
        return images
    *lead, h, w, c = images.shape
    padded = images.new_empty(*lead, h + 2 * pixels, w + 2 * pixels, c)
    rows = slice(pixels, pixels + h)
    padded[..., rows, pixels : pixels + w, :] = images
    padded[..., rows, :pixels, :] = images[..., :1, :]
    padded[..., rows, pixels + w :, :] = images[..., -1:, :]
    padded[..., :pixels, :, :] = padded[..., pixels : pixels + 1, :, :]
    padded[..., pixels + h :, :, :] = padded[..., pixels + h - 1 : pixels + h, :, :]
    return padded


class ColorJitter(Augmentation):
    """Brightness, contrast, saturation and hue, each drawn uniformly around no change.

    All four are affine in RGB (hue as a rotation of the chroma plane of YIQ), so one 3x3 matrix and offset
    per window does it. Applied in the order hue, saturation, contrast, brightness.

    Args:
        brightness: Largest relative change of brightness.
        contrast: Largest relative change of contrast.
        saturation: Largest relative change of saturation.
        hue: Largest rotation of hue, as a fraction of the colour circle.
        keep: Chance that a window stays unchanged.
    """

    def __init__(
        self,
        brightness: NonNegative = 0.3,
        contrast: NonNegative = 0.3,
        saturation: NonNegative = 0.3,
        hue: NonNegative = 0.3,
        keep: Share = 0.1,
    ) -> None:
        self.limits = (brightness, contrast, saturation, 2 * math.pi * hue)
        self.keep = keep

    def images(self, images: Tensor, generator: torch.Generator | None = None) -> Tensor:
        b, t, v, h, w, c = images.shape
        matrix, contrast, brightness = self._draw(b * v, generator)
        x = images.to(torch.float32).transpose(1, 2).reshape(b * v, t * h * w, c)
        matrix, contrast, brightness = (to_device(a, x.device) for a in (matrix, contrast, brightness))
        gray = (x.mean(1) @ _constant(_GRAY, x.device))[:, None, None]  # one level per window
        changed = torch.baddbmm(gray * (1 - contrast) * brightness, x, matrix * (contrast * brightness))
        changed = changed.round_().clamp_(0, 255).to(images.dtype)
        return changed.view(b, v, t, h, w, c).transpose(1, 2).contiguous()

    def _draw(self, n: int, generator: torch.Generator | None) -> tuple[Tensor, Tensor, Tensor]:
        """Draw colour matrices (n, 3, 3) to multiply from the right, contrast and brightness factors (n, 1, 1)."""
        uniform = torch.rand(5, n, 1, 1, generator=generator)
        drawn = torch.where(uniform[4] < self.keep, torch.zeros(4, n, 1, 1), 2 * uniform[:4] - 1)
        brightness, contrast, saturation, angle = drawn * torch.tensor(self.limits)[:, None, None, None]
        cos, sin, zero = angle.cos(), angle.sin(), torch.zeros_like(angle)
        turn = torch.cat([zero + 1, zero, zero, zero, cos, -sin, zero, sin, cos], dim=-1).view(n, 3, 3)
        hue = torch.linalg.inv(_YIQ) @ turn @ _YIQ
        to_gray = torch.tensor(_GRAY).expand(3, 3)
        colour = (to_gray * -saturation + torch.eye(3) * (1 + saturation)) @ hue
        return colour.transpose(1, 2), 1 + contrast, 1 + brightness


@cache
def _constant(values: tuple[float, ...], device: torch.device) -> Tensor:
    """Return values on a device, float32; they are copied there once."""
    return torch.tensor(values, device=device)


_GRAY = (0.299, 0.587, 0.114)
_YIQ = torch.tensor([[0.299, 0.587, 0.114], [0.596, -0.274, -0.322], [0.211, -0.523, 0.312]])
_GRAY_HSV = (0.2989, 0.587, 0.114)  # of the original's jitter


class SharedShift(RandomShift):
    """Random shift that repeats the border, by -pixels to pixels - 1 in each direction of a bottom-up picture.

    The original pads by `pixels` and crops at floor(2 pixels u) with u uniform in [0, 1), which never is 2 pixels; its
    pictures have the bottom row first.

    Args:
        pixels: Largest shift.
    """

    def _corners(self, windows: int, views: int, generator: torch.Generator | None) -> Tensor:
        up, x = torch.randint(0, max(1, 2 * self.pixels), (windows, 2), generator=generator).unbind(1)
        return torch.stack([2 * self.pixels - up, x], dim=1)[:, None].expand(-1, views, -1)


class SharedJitter(Augmentation):
    """Brightness, contrast, saturation and hue of a window, in random order: torchvision's ColorJitter.

    Factors are uniform in [1 - limit, 1 + limit], the hue's turn in [-limit, limit] of the colour circle of HSV. After
    each change values are clipped; contrast is relative to the mean grey level of each picture. The result is rounded
    to whole levels, which the original's is not.

    Args:
        brightness: Largest relative change of brightness.
        contrast: Largest relative change of contrast.
        saturation: Largest relative change of saturation.
        hue: Largest turn of hue, as a fraction of the colour circle.
        keep: Chance that a window stays unchanged.
    """

    def __init__(
        self,
        brightness: NonNegative = 0.3,
        contrast: NonNegative = 0.3,
        saturation: NonNegative = 0.3,
        hue: Annotated[float, Field(ge=0, le=0.5)] = 0.3,
        keep: Share = 0.1,
    ) -> None:
        self.limits = (brightness, contrast, saturation, hue)
        self.keep = keep

    def images(self, images: Tensor, generator: torch.Generator | None = None) -> Tensor:
        windows, orders, drawn = [], [], []
        for window in range(len(images)):
            if torch.rand((), generator=generator) >= self.keep:
                windows.append(window)
                orders.append(torch.randperm(4, generator=generator))
                drawn.append(2 * torch.rand(4, generator=generator) - 1)
        if not windows:
            return images
        amounts = torch.stack(drawn).double() * torch.tensor(self.limits, dtype=torch.float64)
        order, changed = torch.stack(orders), images.clone()
        # a CPU is faster while pictures fit into its cache, a GPU with few launches
        for part in torch.arange(len(windows)).split(len(windows) if images.is_cuda else 1):
            rows = to_device(torch.tensor(windows)[part], images.device)
            x = jitter(images[rows].to(torch.float32).div_(255.0), amounts[part], order[part])
            changed[rows] = x.mul_(255.0).round_().to(images.dtype)
        return changed


def jitter(x: Tensor, amounts: Tensor, orders: Tensor) -> Tensor:
    """Change the colours of windows: at each place in their orders, all that have the same change together.

    Args:
        x: Pictures (N, T, V, H, W, 3) float32 in [0, 1].
        amounts: Relative change of brightness, contrast and saturation, and the turn of hue, (N, 4) float64 on the CPU.
        orders: Order of the four changes of each window, by their positions in `amounts`, (N, 4) int64 on the CPU.

    Returns:
        The pictures, in [0, 1].
    """
    factors = 1 + amounts
    terms = to_device(torch.stack([factors, 1 - factors, 6 * amounts]).float(), x.device)
    by_change = to_device(orders.T.argsort(dim=1, stable=True), x.device)
    for rows, changes in zip(by_change, orders.T, strict=True):
        counts = changes.bincount(minlength=4).tolist()
        for change, chosen in enumerate(rows.split(counts)):
            own = terms[:, chosen, change, None, None, None, None, None]
            if len(chosen) == len(x):
                x = _change(x, change, *own)
            elif len(chosen):
                x[chosen] = _change(x[chosen], change, *own)
    return x


def _change(x: Tensor, change: int, factor: Tensor, rest: Tensor, sixths: Tensor) -> Tensor:
    """Make one of the changes of `jitter` to pictures (n, T, V, H, W, 3); the terms are (n, 1, 1, 1, 1, 1)."""
    if change == 0:
        return (x * factor).clamp(0, 1)
    if change == 1:
        return (x * factor + rest * _gray(x).mean((-3, -2, -1), keepdim=True)).clamp(0, 1)
    if change == 2:
        return (x * factor + rest * _gray(x)).clamp(0, 1)
    return _turn_hue(x, sixths)


def _gray(x: Tensor) -> Tensor:
    """Return the grey level of pixels, (..., 3) -> (..., 1)."""
    return (x * _constant(_GRAY_HSV, x.device)).sum(-1, keepdim=True)


def _turn_hue(x: Tensor, sixths: Tensor) -> Tensor:
    """Turn the hue of HSV of pixels (..., 3) by sixths of the circle (..., 1); value and saturation stay.

    The channel with offset n (red 5, green 3, blue 1) is V - C max(0, min(k, 4 - k, 1)) with k = n + 6 H mod 6, where
    C is the chroma: Alvy Ray Smith's HSV (1978), written without cases.
    """
    value, low = x.amax(-1), x.amin(-1)
    chroma = value - low
    r, g, b = ((value[..., None] - x) / torch.where(chroma > 0, chroma, 1.0)[..., None]).unbind(-1)
    red, green = x[..., 0] == value, x[..., 1] == value
    sixth = torch.where(red, b - g, torch.where(green, 2 + r - b, 4 + g - r))  # 6 H
    k = (_constant((5.0, 3.0, 1.0), x.device) + (sixth[..., None] + sixths)) % 6
    ramp = torch.minimum(k, 4 - k).clamp(0, 1)
    return (value[..., None] - chroma[..., None] * ramp).clamp(0, 1)
