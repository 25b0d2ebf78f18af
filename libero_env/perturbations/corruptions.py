"""Corruptions of images at ten severities, as LIBERO-Plus applies them (arXiv 2510.13626).

They are those of ImageNet-C (Hendrycks and Dietterich, arXiv 1903.12261) with other constants, for images of 256 x 256
pixels. Each takes an image (H, W, 3) uint8 and returns one; it draws from the given generator in the order in which
LIBERO-Plus' code draws from NumPy's global one, so that both return the same bits with the same random numbers. Two
properties of that code are kept:

- `glass` copies neighbours of pixels where it means to swap them: its two assignments are of views of one array.
- `glass` leaves out the last 32 rows and columns of 256: its loops end at 224, the side of ImageNet's images.

Images of other sizes, for which that code ends with an error, have fog of their size, and glass up to their sides.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from libero_env.compilation import compiled
from libero_env.errors import InvalidInputError, require_known
from libero_env.images import flip_rows
from libero_env.perturbations.kinds import Episode, ObservationFilter

CAMERA = "agentview"  # the only camera that LIBERO-Plus changes
_PICTURE = f"{CAMERA}_rgb"
SEVERITIES = 10
_MOTION = ((5, 2), (8, 3), (10, 4), (12, 5), (15, 6), (18, 8), (20, 10), (25, 12), (30, 15), (35, 20))
_MOTION_DEGREES = 45.0
_GAUSSIAN = tuple(range(1, 11))  # [pixels]
_TRUNCATE = 4.0  # radius of a Gaussian kernel, [standard deviations]
_ZOOM = (  # largest factor before its step, step
    *((1.11, 0.01), (1.16, 0.01), (1.21, 0.02), (1.26, 0.02), (1.31, 0.03)),
    *((1.36, 0.01), (1.41, 0.01), (1.46, 0.02), (1.51, 0.02), (1.56, 0.03)),
)
_FOG = (  # weight, decay of the map's roughness from scale to scale
    *((0.5, 3.0), (1.0, 2.8), (1.5, 2.5), (2.0, 2.2), (2.5, 2.0)),
    *((3.0, 1.8), (3.5, 1.6), (4.0, 1.5), (4.5, 1.4), (5.0, 1.3)),
)
_FOG_ROUGHNESS = 100.0
_GLASS = (  # standard deviation [pixels], largest shift [pixels], rounds
    *((0.5, 1, 3), (0.7, 1, 3), (0.9, 2, 3), (1.0, 2, 2), (1.1, 3, 2)),
    *((1.3, 3, 2), (1.5, 4, 2), (1.8, 4, 2), (2.2, 5, 1), (2.5, 5, 1)),
)
_SIDE, _GLASS_SIDE = 256, 224  # [pixels]
_DEEP = 257.0  # a grey level of 8 bits in 16 bits


def corrupt(image: np.ndarray, kind: str, severity: int, rng: np.random.Generator) -> np.ndarray:
    """Return an image with noise.

    Args:
        image: Image (H, W, 3) uint8; LIBERO-Plus' images have their bottom row first.
        kind: `motion`, `gaussian`, `zoom`, `fog` or `glass`.
        severity: Severity, 1 to 10.

    Raises:
        UnknownNameError: There is no such kind.
        InvalidInputError: There is no such severity, or the image has another shape or type.
    """
    require_known("corruption", kind, CORRUPTIONS)
    if not 1 <= severity <= SEVERITIES:
        raise InvalidInputError(f"{kind}: severity {severity}; expected 1 to {SEVERITIES}")
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise InvalidInputError(f"an image {image.shape} {image.dtype}; expected (H, W, 3) uint8")
    return CORRUPTIONS[kind](image, severity - 1, rng)


def _motion(image: np.ndarray, level: int, rng: np.random.Generator) -> np.ndarray:
    """Return an image blurred along a line, as ImageMagick 6 does it in 16 bits: half a Gaussian, to one side."""
    radius, sigma = _MOTION[level]
    angle = np.deg2rad(rng.uniform(-_MOTION_DEGREES, _MOTION_DEGREES))
    along = np.arange(2 * radius + 1.0)
    weights = np.exp(-(along**2) / (2.0 * sigma**2))
    weights /= weights.sum()
    columns, rows = (np.ceil(along * part - 0.5).astype(int) for part in (np.cos(angle), np.sin(angle)))
    edge, (height, width) = 2 * radius + 1, image.shape[:2]
    wide = np.pad(image, ((edge, edge), (edge, edge), (0, 0)), "edge").astype(float) * _DEEP
    total = np.zeros(image.shape)
    for weight, row, column in zip(weights, edge + rows, edge + columns, strict=True):
        total += weight * wide[row : row + height, column : column + width]
    return (np.floor(total + 0.5) // _DEEP).astype(np.uint8)


def _gaussian(image: np.ndarray, level: int, rng: np.random.Generator) -> np.ndarray:
    return _levels(_blurred(image / 255.0, _GAUSSIAN[level]))


def _zoom(image: np.ndarray, level: int, rng: np.random.Generator) -> np.ndarray:
    """Return the mean of an image and of enlarged ones."""
    last, step = _ZOOM[level]
    own = (image / 255.0).astype(np.float32)
    total, factors = np.zeros_like(own), np.arange(1, last, step)
    for factor in factors:
        total += _enlarged(own, float(factor))
    return _levels((own + total) / (len(factors) + 1))


def _fog(image: np.ndarray, level: int, rng: np.random.Generator) -> np.ndarray:
    """Return an image with a map of fog added, darkened such that its brightest level stays."""
    weight, decay = _FOG[level]
    height, width = image.shape[:2]
    side = max(_SIDE, 1 << (max(height, width) - 1).bit_length())
    own = image / 255.0
    brightest = own.max()
    foggy = own + weight * _plasma(side, decay, rng)[:height, :width, None]
    return _levels(foggy * brightest / (brightest + weight))


def _glass(image: np.ndarray, level: int, rng: np.random.Generator) -> np.ndarray:
    """Return an image whose pixels are mixed with their neighbours' between two blurs."""
    sigma, reach, rounds = _GLASS[level]
    mixed = (_blurred(image / 255.0, sigma) * 255).astype(np.uint8)
    square = min(image.shape[:2])
    side = _GLASS_SIDE if image.shape[:2] == (_SIDE, _SIDE) else square
    for _ in range(rounds):
        shifts = _small_integers(rng, 2 * reach, (side - 2 * reach) ** 2 * 2) - reach
        _copy_neighbours(mixed, shifts.reshape(-1, 2), side, reach)
    return _levels(_blurred(mixed / 255.0, sigma))


CORRUPTIONS: Mapping[str, Callable[[np.ndarray, int, np.random.Generator], np.ndarray]] = {
    "motion": _motion,
    "gaussian": _gaussian,
    "zoom": _zoom,
    "fog": _fog,
    "glass": _glass,
}


def _levels(image: np.ndarray) -> np.ndarray:
    """Return an image of numbers from 0 to 1 as grey levels, rounded down."""
    return (np.clip(image, 0, 1) * 255).astype(np.uint8)


def _blurred(image: np.ndarray, sigma: float) -> np.ndarray:
    """Return an image (H, W, 3) float64 after a Gaussian filter whose edges repeat."""
    from scipy import ndimage  # a second to import

    return ndimage.gaussian_filter(image, (sigma, sigma, 0), mode="nearest", truncate=_TRUNCATE)


def _enlarged(image: np.ndarray, factor: float) -> np.ndarray:
    """Return the middle of an image (H, W, 3), enlarged to its size."""
    from scipy import ndimage

    sides = np.array(image.shape[:2])
    inner = np.ceil(sides / factor).astype(int)
    (top, left), (height, width) = (sides - inner) // 2, inner
    large = ndimage.zoom(image[top : top + height, left : left + width], (factor, factor, 1), order=1)
    (top, left), (height, width) = (large.shape[:2] - sides) // 2, sides
    return large[top : top + height, left : left + width]


def _plasma(side: int, decay: float, rng: np.random.Generator) -> np.ndarray:
    """Return a map of fog, (side, side) from 0 to 1, by the diamond-square algorithm on a torus.

    Args:
        side: Side, a power of two.
        decay: Ratio of the roughness of a scale to that of the next finer one.
    """
    field = np.zeros((side, side))
    step, roughness = side, _FOG_ROUGHNESS
    while step >= 2:
        half = step // 2
        corners = field[::step, ::step]
        square = corners + np.roll(corners, -1, 0)
        field[half::step, half::step] = _around(square + np.roll(square, -1, 1), roughness, rng)
        centres = field[half::step, half::step]
        left = (centres + np.roll(centres, 1, 0)) + (corners + np.roll(corners, -1, 1))
        field[::step, half::step] = _around(left, roughness, rng)
        top = (centres + np.roll(centres, 1, 1)) + (corners + np.roll(corners, -1, 0))
        field[half::step, ::step] = _around(top, roughness, rng)
        step, roughness = half, roughness / decay
    field -= field.min()
    return field / field.max()


def _around(sums: np.ndarray, roughness: float, rng: np.random.Generator) -> np.ndarray:
    return sums / 4 + roughness * rng.uniform(-roughness, roughness, sums.shape)


def _small_integers(rng: np.random.Generator, below: int, count: int) -> np.ndarray:
    """Return integers from 0, as `RandomState.randint` draws them: words whose low bits are too large are left out."""
    mask = (1 << (below - 1).bit_length()) - 1
    accepted, missing = [], count
    while missing:
        words = rng.integers(1 << 32, size=missing, dtype=np.uint32) & mask
        accepted.append(words[words < below])
        missing -= len(accepted[-1])
    return np.concatenate(accepted).astype(np.int64)


@compiled
def _copy_neighbours(image: np.ndarray, shifts: np.ndarray, side: int, reach: int) -> None:
    """Copy to each pixel, from the last row and column on, one nearby; the shifts are (columns, rows)."""
    k = 0
    for row in range(side - reach, reach, -1):
        for column in range(side - reach, reach, -1):
            for channel in range(image.shape[2]):
                image[row, column, channel] = image[row + shifts[k, 1], column + shifts[k, 0], channel]
            k += 1


@dataclass(frozen=True)
class Corruption(ObservationFilter):
    """Noise on the pictures of `agentview`, sampled anew for each.

    LIBERO-Plus' code leaves the first picture after an initial state is set without noise; here it has it too.

    Attributes:
        kind: `motion`, `gaussian`, `zoom`, `fog` or `glass`.
        severity: Severity, 1 to 10.
    """

    only_rgb = True
    kind: str
    severity: int

    def image(self, name: str, image: np.ndarray, episode: Episode) -> np.ndarray:
        """Return the picture with noise."""
        if name != _PICTURE:
            return image
        rng = episode.key.generator(episode.step)
        return flip_rows(corrupt(flip_rows(image), self.kind, self.severity, rng))  # theirs are upside down
