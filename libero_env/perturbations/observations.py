"""Kinds that change what is observed: noise, blur, what hides the picture, late and lost pictures, a biased sensor."""

from dataclasses import dataclass

import numpy as np

from libero_env.perturbations.channels import ObservationChannel, ObservationFilter
from libero_env.perturbations.drawing import DrawKey
from libero_env.perturbations.kind import Kind

RGB = "_rgb"


@dataclass(frozen=True)
class PixelNoise(ObservationFilter):
    """Independent normal noise of each pixel and colour, new in each picture.

    Attributes:
        deviation: Standard deviation, [grey levels of 255].
    """

    deviation: float

    def open(self, key: DrawKey) -> ObservationChannel:
        """Return the channel of an episode."""
        return _NoiseChannel(self, key)


class _NoiseChannel(ObservationChannel):
    def __init__(self, noise: PixelNoise, key: DrawKey):
        self._noise, self._key = noise, key

    def image(self, name: str, image: np.ndarray, step: int) -> np.ndarray:
        if not name.endswith(RGB):
            return image
        rng = self._key.generator(name, step)
        noise = self._noise.deviation * rng.standard_normal(image.shape, np.float32)
        return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


KINDS = (
    Kind(
        "noise",
        "observation",
        "grey levels",
        50.0,
        "normal noise on each pixel of all cameras, with this standard deviation of 255 levels",
        lambda levels, rng: PixelNoise(levels),
    ),
)
