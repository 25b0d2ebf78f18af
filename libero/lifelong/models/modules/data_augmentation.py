"""Image augmentation under the original's names; `lifelong.nn.augmentation` draws and applies it.

Images are (B, T, C, H, W) in [0, 1]; all frames of a window change alike. In evaluation mode nothing changes.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from libero._adapters.batches import uint8_image
from lifelong.nn.augmentation import Augmentation, ColorJitter, RandomShift


class IdentityAug(nn.Module):
    """No augmentation."""

    def __init__(self, input_shape: Sequence[int] | None = None):
        super().__init__()

    def forward(self, x: Tensor) -> Tensor:
        """Return the images unchanged."""
        return x

    def output_shape(self, input_shape: Sequence[int]) -> Sequence[int]:
        """Return the shape of the images, which does not change."""
        return input_shape


class _Aug(IdentityAug):
    """Applies a native augmentation; with `whole_batch` one draw is for all windows, else each has its own."""

    whole_batch = False

    def __init__(self, augmentation: Augmentation):
        super().__init__()
        self.augmentation = augmentation

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, T, C, H, W) to the same shape."""
        if not self.training:
            return x
        b, t = x.shape[:2]
        images = uint8_image(x)[:, :, None]  # (B, T, 1, H, W, C)
        if self.whole_batch:
            images = images.flatten(0, 1)[None]
        changed = self.augmentation.images(images).view(b, t, *images.shape[-3:])
        return changed.movedim(-1, -3).to(x.dtype) / 255


class TranslationAug(_Aug):
    """Shifts of up to half of `translation` pixels in each direction; the border is repeated."""

    def __init__(self, input_shape: Sequence[int] | None = None, translation: int = 8):
        super().__init__(RandomShift(translation // 2))


class BatchWiseImgColorJitterAug(_Aug):
    """Brightness, contrast, saturation and hue of each window; `epsilon` is the probability of no change."""

    epsilon = 0.1

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


class ImgColorJitterAug(BatchWiseImgColorJitterAug):
    """The same change of colours for the whole batch."""

    epsilon, whole_batch = 0.05, True


class ImgColorJitterGroupAug(BatchWiseImgColorJitterAug):
    """`BatchWiseImgColorJitterAug` with another `epsilon`."""

    epsilon = 0.05


class TranslationAugGroup(TranslationAug):
    """`TranslationAug`, as a configuration of the original calls it."""


class DataAugGroup(nn.Module):
    """Several augmentations in order; the images of all cameras change alike."""

    def __init__(self, aug_list: Sequence[nn.Module]):
        super().__init__()
        self.aug_layer = nn.Sequential(*aug_list)

    def forward(self, x_groups: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Map a tuple of (B, T, C, H, W), one for each camera, to another."""
        if not self.training:
            return tuple(x_groups)
        changed = self.aug_layer(torch.cat(list(x_groups), dim=1))
        return torch.split(changed, [x.shape[1] for x in x_groups], dim=1)


_EACH_VIEW = (BatchWiseImgColorJitterAug, IdentityAug, ImgColorJitterAug, TranslationAug)
AUGMENTATIONS = {kind.__name__: kind for kind in (*_EACH_VIEW, ImgColorJitterGroupAug, TranslationAugGroup)}
