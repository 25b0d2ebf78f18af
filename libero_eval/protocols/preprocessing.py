"""Chains that resize images, to the bit of the libraries that protocols use.

| `pixels.resize` | library | chain |
|---|---|---|
| `pil_bilinear_pad` | openpi_client 0.1.2, `image_tools.resize_with_pad` | Pillow's bilinear, the rest zero |
| `jpeg_lanczos3` | TensorFlow 2, `tf.image.encode_jpeg`, `tf.io.decode_image`, `tf.image.resize` | JPEG, Lanczos |
| `torch_bilinear` | PyTorch, `torch.nn.functional.interpolate` with antialiasing | bilinear, rounded |
"""

import ctypes.util
import io
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from PIL import Image

from libero_env.errors import require_package

Size = tuple[int, int]


def preprocess(image: np.ndarray, resize: str, size: Size | None, crop: float) -> np.ndarray:
    """Return an image after the chain of a protocol.

    Args:
        image: (H, W, 3) uint8.
        resize: Name of the chain, or `none`.
        size: Height and width after it; None keeps them.
        crop: Share of the area that is cut out of the middle and resized back; 1 for all of it.
    """
    if resize != "none":
        assert size is not None, "protocols with a chain have a size"
        image = RESIZES[resize](image, size)
    return crop_centre(image, crop) if crop < 1 else np.ascontiguousarray(image)


def pil_bilinear_pad(image: np.ndarray, size: Size) -> np.ndarray:
    """Resize an image within a size, its proportions kept, and fill the rest with zeros.

    Args:
        image: (H, W, 3) uint8.
        size: Height and width of the result.
    """
    height, width = image.shape[:2]
    if (height, width) == size:
        return image
    ratio = max(width / size[1], height / size[0])
    inner = int(height / ratio), int(width / ratio)
    resized = Image.fromarray(np.ascontiguousarray(image)).resize(
        (inner[1], inner[0]), Image.Resampling.BILINEAR
    )
    padded = np.zeros((*size, 3), np.uint8)
    top, left = int((size[0] - inner[0]) / 2), int((size[1] - inner[1]) / 2)
    padded[top : top + inner[0], left : left + inner[1]] = np.asarray(resized)
    return padded


def jpeg_lanczos3(image: np.ndarray, size: Size) -> np.ndarray:
    """Write and read an image as JPEG, and resize it with an antialiased Lanczos kernel of radius 3.

    Args:
        image: (H, W, 3) uint8.
        size: Height and width of the result.
    """
    resized = resize_lanczos3(jpeg_round_trip(image), size)
    return np.clip(np.rint(resized), 0, 255).astype(np.uint8)


def jpeg_round_trip(image: np.ndarray) -> np.ndarray:
    """Write and read an image as JPEG, as `tf.image.encode_jpeg` and `tf.io.decode_image` do by default.

    Quality is 95 and colours have half the resolution. TensorFlow reads with libjpeg's fast inverse DCT, which Pillow
    does not offer: with it two thirds of the values would differ.

    Args:
        image: (H, W, 3) uint8.

    Raises:
        MissingPackageError: simplejpeg is not installed.
    """
    require_package("simplejpeg")
    import simplejpeg

    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(file, "JPEG", quality=95, subsampling=2)
    return simplejpeg.decode_jpeg(file.getvalue(), fastdct=True, fastupsample=False)


def resize_lanczos3(image: np.ndarray, size: Size) -> np.ndarray:
    """Resize as TensorFlow's `scale_and_translate_op.cc`, in single precision: rows first, then columns.

    Args:
        image: (H, W, 3).
        size: Height and width of the result.

    Returns:
        (*size, 3) float32, not clipped.
    """
    if image.shape[:2] == size:
        return image.astype(np.float32)
    rows = _gather(image.astype(np.float32), *_lanczos_spans(image.shape[0], size[0]))
    columns = _gather(rows.swapaxes(0, 1), *_lanczos_spans(image.shape[1], size[1]))
    return columns.swapaxes(0, 1)


def _gather(values: np.ndarray, starts: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return weighted sums along the first axis, added in order in single precision."""
    total = np.zeros((len(starts), *values.shape[1:]), np.float32)
    for k in range(weights.shape[1]):
        rows = values[np.minimum(starts + k, len(values) - 1)]
        total = total + weights[:, k, None, None] * rows
    return total


@lru_cache(maxsize=32)
def _lanczos_spans(length: int, wanted: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the first source index (wanted,) and the weights (wanted, n) of each output, float32."""
    f = np.float32
    inverse = f(1) / (f(wanted) / f(length))
    stretch = max(inverse, f(1))
    reach = f(3) * stretch
    middle = (np.arange(wanted, dtype=f) + f(0.5)) * inverse
    starts = np.clip(np.ceil(middle - reach - f(0.5)).astype(int), 0, length - 1)
    ends = np.clip(np.floor(middle + reach - f(0.5)).astype(int), 0, length - 1) + 1
    sources = starts[:, None] + np.arange((ends - starts).max())
    weights = _lanczos3((sources.astype(f) + f(0.5) - middle[:, None]) * (f(1) / stretch))
    weights[sources >= ends[:, None]] = 0
    total = np.zeros(wanted, f)
    for k in range(weights.shape[1]):
        total = total + weights[:, k]
    return starts, weights * (f(1) / total)[:, None]


def _lanczos3(x: np.ndarray) -> np.ndarray:
    f = np.float32
    pi = f(np.pi)
    x = np.abs(x)
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = f(3) * _sin(pi * x) * _sin(pi * x / f(3)) / (pi * pi * x * x)
    return np.where(x > 3, f(0), np.where(x <= f(1e-3), f(1), inside)).astype(f)


def _sin(x: np.ndarray) -> np.ndarray:
    """Return the sine in single precision, of the C library as in TensorFlow; NumPy's may differ in the last bit."""
    name = ctypes.util.find_library("m")
    sinf = getattr(ctypes.CDLL(name), "sinf", None) if name else None
    if sinf is None:
        return np.sin(x.astype(np.float64)).astype(np.float32)
    sinf.restype, sinf.argtypes = ctypes.c_float, [ctypes.c_float]
    return np.array([sinf(value) for value in x.ravel().tolist()], np.float32).reshape(x.shape)


def crop_centre(image: np.ndarray, area: float) -> np.ndarray:
    """Cut a share of the area out of the middle and resize it back, as OpenVLA's `center_crop_image`.

    It is TensorFlow's `crop_and_resize`, bilinear in single precision, on values in [0, 1].

    Args:
        image: (H, W, 3) uint8.
        area: Share of the area.
    """
    f = np.float32
    height, width = image.shape[:2]
    side = np.clip(np.sqrt(f(area)), f(0), f(1))
    low = (f(1) - side) / f(2)
    high = low + side
    values = image.astype(f) * f(1 / 255)
    y, x = _crop_places(low, high, height), _crop_places(low, high, width)
    (top, bottom, dy), (left, right, dx) = y, x
    dx = dx[None, :, None]
    upper = values[top][:, left] + (values[top][:, right] - values[top][:, left]) * dx
    lower = values[bottom][:, left] + (values[bottom][:, right] - values[bottom][:, left]) * dx
    mixed = upper + (lower - upper) * dy[:, None, None]
    return (np.clip(mixed, f(0), f(1)) * f(255.5)).astype(np.uint8)


def _crop_places(low: np.float32, high: np.float32, length: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pixels before and after each place of the crop, and its distance from the first."""
    f = np.float32
    scale = (high - low) * f(length - 1) / f(length - 1)
    place = low * f(length - 1) + np.arange(length, dtype=f) * scale
    before = np.floor(place)
    return before.astype(int), np.ceil(place).astype(int), place - before


def torch_bilinear(image: np.ndarray, size: Size) -> np.ndarray:
    """Resize with PyTorch's antialiased bilinear interpolation, as torchvision's `resize` does with tensors.

    Args:
        image: (H, W, 3) uint8.
        size: Height and width of the result.
    """
    require_package("torch")
    import torch

    tensor = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None].float()
    resized = torch.nn.functional.interpolate(
        tensor, size, mode="bilinear", antialias=True, align_corners=False
    )
    return resized[0].round().clamp(0, 255).byte().permute(1, 2, 0).numpy()


RESIZES: dict[str, Callable[[np.ndarray, Size], np.ndarray]] = {
    "pil_bilinear_pad": pil_bilinear_pad,
    "jpeg_lanczos3": jpeg_lanczos3,
    "torch_bilinear": torch_bilinear,
}
