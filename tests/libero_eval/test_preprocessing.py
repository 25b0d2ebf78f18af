"""Resizing chains, to the bit of the libraries that they come from.

The digests were made by openpi-client 0.1.2 (with Pillow 13) and TensorFlow 2.21 (tensorflow-cpu), in an environment of
their own, from the pictures of `picture`, as OpenVLA-OFT's `resize_image_for_policy` and `center_crop_image` do.
"""

import hashlib

import numpy as np
import pytest

from libero_eval.protocols.preprocessing import (
    crop_centre,
    jpeg_lanczos3,
    jpeg_round_trip,
    pil_bilinear_pad,
    preprocess,
    resize_lanczos3,
    torch_bilinear,
)

EXPECTED = {
    "pad 256x256": "0dec61788a1ab793", "pad 360x256": "b91e2fb16fa60d34", "jpeg": "52f544cb92c3f887",
    "lanczos": "0e0153f57274daf2", "resized": "aa0b17aa6d4882e1", "crop": "c23e98bc5ba96d25"
}  # fmt: skip


def picture(height: int = 256, width: int = 256) -> np.ndarray:
    """A picture with edges, gradients and noise, of integer arithmetic alone."""
    y, x = np.mgrid[:height, :width].astype(np.int64)
    waves = np.stack([(x * y) // 97, (x * x + 3 * y) // 53, 255 - (2 * x + y) % 256], -1) % 256
    noise = (y[..., None] * 1103515245 + x[..., None] * 12345 + np.arange(3) * 777) // 65536 % 32
    waves[(x // 16 + y // 24) % 3 == 0] //= 3
    return ((waves * 7 + noise * 8) // 8).clip(0, 255).astype(np.uint8)


def digest(values: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest()[:16]


@pytest.mark.parametrize("shape", [(256, 256), (360, 256)])
def test_bilinear_with_padding_is_openpis(shape):
    assert digest(pil_bilinear_pad(picture(*shape), (224, 224))) == EXPECTED[f"pad {shape[0]}x{shape[1]}"]


def test_jpeg_lanczos_and_crop_are_tensorflows():
    pytest.importorskip("simplejpeg")
    image = picture()
    assert digest(jpeg_round_trip(image)) == EXPECTED["jpeg"]
    assert digest(resize_lanczos3(jpeg_round_trip(image), (224, 224))) == EXPECTED["lanczos"], "float32"
    resized = jpeg_lanczos3(image, (224, 224))
    assert digest(resized) == EXPECTED["resized"]
    assert digest(crop_centre(resized, 0.9)) == EXPECTED["crop"]
    assert digest(preprocess(image, "jpeg_lanczos3", (224, 224), 0.9)) == EXPECTED["crop"]


def test_an_image_of_the_right_size_stays_as_it_is():
    image = picture(224, 224)
    np.testing.assert_array_equal(pil_bilinear_pad(image, (224, 224)), image)
    np.testing.assert_array_equal(preprocess(image, "none", None, 1.0), image)


def test_padding_is_black_and_centred():
    found = pil_bilinear_pad(np.full((100, 200, 3), 255, np.uint8), (224, 224))
    assert (found[56:168] == 255).all() and not found[:56].any() and not found[168:].any()


def test_bilinear_of_pytorch():
    found = torch_bilinear(picture(), (224, 224))
    assert found.shape == (224, 224, 3) and found.dtype == np.uint8
    flat = np.full((64, 64, 3), 130, np.uint8)
    assert (torch_bilinear(flat, (32, 48)) == 130).all()
