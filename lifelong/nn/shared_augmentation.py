"""Image augmentation as the original's: one random change per window, the same for all of its frames and views.

Shape legend: B batch, T time, V views, H W C image. Images are (B, T, V, H, W, C), uint8 in 0..255.
"""

from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from lifelong.nn.augmentation import Augmentation, RandomShift
from lifelong.types import NonNegative, Share

_GRAY = (0.2989, 0.587, 0.114)


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
        """Return changed images; see `Augmentation`."""
        windows = []
        for window in images:
            changed = window
            if torch.rand((), generator=generator) >= self.keep:
                order = torch.randperm(4, generator=generator).tolist()
                drawn = (2 * torch.rand(4, generator=generator) - 1).tolist()
                amounts = [limit * share for limit, share in zip(self.limits, drawn, strict=True)]
                x = jitter(window.to(torch.float32).div_(255.0), amounts, order)
                changed = x.mul_(255.0).round_().to(images.dtype)
            windows.append(changed)
        return torch.stack(windows)


def jitter(x: Tensor, amounts: list[float], order: list[int]) -> Tensor:
    """Change the colours of pictures.

    Args:
        x: Pictures (..., H, W, 3) float32 in [0, 1].
        amounts: Relative change of brightness, of contrast and of saturation, and the turn of hue.
        order: Order of the four changes, by their positions in `amounts`.

    Returns:
        Pictures of the same shape, in [0, 1].
    """
    for change in order:
        amount, factor = amounts[change], 1 + amounts[change]
        if change == 0:
            x = (x * factor).clamp(0, 1)
        elif change == 1:
            x = (x * factor + (1 - factor) * _gray(x).mean((-3, -2, -1), keepdim=True)).clamp(0, 1)
        elif change == 2:
            x = (x * factor + (1 - factor) * _gray(x)).clamp(0, 1)
        else:
            x = _turn_hue(x, amount)
    return x


def _gray(x: Tensor) -> Tensor:
    """Return the grey level of pixels, (..., 3) -> (..., 1)."""
    return (x * x.new_tensor(_GRAY)).sum(-1, keepdim=True)


def _turn_hue(x: Tensor, turn: float) -> Tensor:
    """Turn the hue of HSV of pixels (..., 3) by a fraction of the circle; value and saturation stay.

    The channel with offset n (red 5, green 3, blue 1) is V - C max(0, min(k, 4 - k, 1)) with k = n + 6 H mod 6, where
    C is the chroma: Alvy Ray Smith's HSV (1978), written without cases.
    """
    value, low = x.amax(-1), x.amin(-1)
    chroma = value - low
    r, g, b = ((value[..., None] - x) / torch.where(chroma > 0, chroma, 1.0)[..., None]).unbind(-1)
    red, green = x[..., 0] == value, x[..., 1] == value
    sixth = torch.where(red, b - g, torch.where(green, 2 + r - b, 4 + g - r))  # 6 H
    offsets = x.new_tensor([5.0, 3.0, 1.0])
    k = (offsets + (sixth + 6 * turn)[..., None]) % 6
    ramp = torch.minimum(k, 4 - k).clamp(0, 1)
    return (value[..., None] - chroma[..., None] * ramp).clamp(0, 1)
