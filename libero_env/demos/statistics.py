"""Statistics that can be added over episodes: of numbers, and of the colours of images."""

from dataclasses import dataclass

import numpy as np

QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
_NAMES = tuple(f"q{round(100 * q):02d}" for q in QUANTILES)


@dataclass(frozen=True)
class NumberStatistics:
    """Statistics of numbers, over the first axis.

    Attributes:
        samples: The numbers, each array (N, D) float64.
    """

    samples: tuple[np.ndarray, ...]

    @classmethod
    def from_values(cls, values: np.ndarray) -> "NumberStatistics":
        """Return the statistics of values (N,) or (N, D)."""
        return cls((values.reshape(len(values), -1).astype(np.float64),))

    def __add__(self, other: "NumberStatistics") -> "NumberStatistics":
        return NumberStatistics(self.samples + other.samples)

    def summary(self) -> dict[str, list]:
        """Return each statistic as D numbers, by name; `count` is one number."""
        x = np.concatenate(self.samples)
        found = {"min": x.min(axis=0), "max": x.max(axis=0), "mean": x.mean(axis=0), "std": x.std(axis=0)}
        found |= dict(zip(_NAMES, np.quantile(x, QUANTILES, axis=0), strict=True))
        return {**{key: value.tolist() for key, value in found.items()}, "count": [len(x)]}


@dataclass(frozen=True)
class ImageStatistics:
    """Statistics of the colours of images, which follow exactly from the histograms of the channels.

    Attributes:
        counts: Number of pixels of each channel and value, (3, 256) int64.
        frames: Number of images.
    """

    counts: np.ndarray
    frames: int

    @classmethod
    def from_frames(cls, frames: np.ndarray) -> "ImageStatistics":
        """Return the statistics of frames (T, H, W, 3) uint8."""
        counts = [np.bincount(frames[..., channel].ravel(), minlength=256) for channel in range(3)]
        return cls(np.array(counts, np.int64), len(frames))

    def __add__(self, other: "ImageStatistics") -> "ImageStatistics":
        return ImageStatistics(self.counts + other.counts, self.frames + other.frames)

    def summary(self) -> dict[str, list]:
        """Return each statistic as nested lists (3, 1, 1) in [0, 1], by name; `count` is the number of frames."""
        levels, total = np.arange(256) / 255.0, self.counts.sum(axis=1)
        below = np.cumsum(self.counts, axis=1)
        mean = self.counts @ levels / total
        std = np.sqrt(np.maximum(self.counts @ levels**2 / total - mean**2, 0.0))
        found = {"min": levels[(self.counts > 0).argmax(axis=1)], "mean": mean, "std": std}
        found["max"] = levels[255 - (self.counts[:, ::-1] > 0).argmax(axis=1)]
        for name, q in zip(_NAMES, QUANTILES, strict=True):
            found[name] = levels[(below >= q * total[:, None]).argmax(axis=1)]
        return {
            **{key: value.reshape(3, 1, 1).tolist() for key, value in found.items()},
            "count": [self.frames],
        }
