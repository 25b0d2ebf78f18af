"""Augmentation under the original's names: what is drawn and done is `lifelong.nn.augmentation`'s.

Pictures are (B, T, C, H, W) in [0, 1]; a window changes as a whole. In evaluation mode nothing changes.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from libero._adapters.lifelong.observations import uint8_image
from lifelong.nn.augmentation import Augmentation, ColorJitter, RandomShift

__all__ = [
    "BatchWiseImgColorJitterAug",
    "DataAugGroup",
    "IdentityAug",
    "ImgColorJitterAug",
    "ImgColorJitterGroupAug",
    "TranslationAug",
    "TranslationAugGroup",
]


class IdentityAug(nn.Module):
    """No augmentation."""

    def __init__(self, input_shape: Sequence[int] | None = None):
        super().__init__()

    def forward(self, x: Tensor) -> Tensor:
        """The pictures as they are."""
        return x

    def output_shape(self, input_shape: Sequence[int]) -> Sequence[int]:
        """Of the pictures, which keep theirs."""
        return input_shape


class _Aug(IdentityAug):
    """A change of a tensor of pictures, or the same change of a tuple of them.

    `together` says how far one draw goes: `window` (each one its own) or `batch` (all the same).
    """

    together = "window"

    def __init__(self, augmentation: Augmentation):
        super().__init__()
        self.augmentation = augmentation

    def forward(self, x: Tensor) -> Tensor:
        """(B, T, C, H, W) -> the same shape."""
        if not self.training:
            return x
        b, t = x.shape[:2]
        images = uint8_image(x)[:, :, None]  # (B, T, 1, H, W, C)
        if self.together == "batch":
            images = images.flatten(0, 1)[None]
        changed = self.augmentation.images(images).view(b, t, *images.shape[-3:])
        return changed.movedim(-1, -3).to(x.dtype) / 255


class TranslationAug(_Aug):
    """Shifts of up to half of `translation` pixels in each direction; the border is repeated."""

    def __init__(self, input_shape: Sequence[int] | None = None, translation: int = 8):
        super().__init__(RandomShift(translation // 2))


class _JitterAug(_Aug):
    """Brightness, contrast, saturation and hue; `epsilon` is the chance that nothing changes."""

    epsilon = 0.05

    def __init__(
        self,
        input_shape: Sequence[int] | None = None,
        brightness: float = 0.3,
        contrast: float = 0.3,
        saturation: float = 0.3,
        hue: float = 0.3,
        epsilon: float | None = None,
    ):
        keep = self.epsilon if epsilon is None else epsilon
        super().__init__(ColorJitter(brightness, contrast, saturation, hue, keep=keep))


class ImgColorJitterAug(_JitterAug):
    """One change of colours for the whole batch."""

    together = "batch"


class BatchWiseImgColorJitterAug(_JitterAug):
    """A change of colours for each window of the batch."""

    epsilon = 0.1


class _OfAllViews(nn.Module):
    """Changes pictures of several cameras alike: forward takes and gives a tuple of (B, T, C, H, W)."""

    def __init__(self, change: nn.Module):
        super().__init__()
        self.change = change

    def forward(self, x_groups: Sequence[Tensor]) -> tuple[Tensor, ...]:
        steps = [x.shape[1] for x in x_groups]
        return torch.split(self.change(torch.cat(list(x_groups), dim=1)), steps, dim=1)


class ImgColorJitterGroupAug(_OfAllViews):
    """A change of colours for each window, the same for all cameras; arguments as of `BatchWiseImgColorJitterAug`."""

    def __init__(self, input_shape: Sequence[int] | None = None, **limits: float):
        super().__init__(BatchWiseImgColorJitterAug(input_shape, **{"epsilon": 0.05, **limits}))


class TranslationAugGroup(_OfAllViews):
    """A shift for each window, the same for all cameras."""

    def __init__(self, input_shape: Sequence[int] | None = None, translation: int = 8):
        super().__init__(TranslationAug(input_shape, translation))


class DataAugGroup(nn.Module):
    """Several augmentations in order, of the pictures of several cameras: a tuple of (B, T, C, H, W) to another."""

    def __init__(self, aug_list: Sequence[nn.Module]):
        super().__init__()
        self.aug_layers = nn.ModuleList(aug_list)

    def forward(self, x_groups: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Pictures of each camera, changed."""
        for aug in self.aug_layers:
            x_groups = aug(x_groups) if isinstance(aug, _OfAllViews) else [aug(x) for x in x_groups]
        return tuple(x_groups)


AUGMENTATIONS = {
    kind.__name__: kind
    for kind in (
        BatchWiseImgColorJitterAug,
        IdentityAug,
        ImgColorJitterAug,
        ImgColorJitterGroupAug,
        TranslationAug,
        TranslationAugGroup,
    )
}
