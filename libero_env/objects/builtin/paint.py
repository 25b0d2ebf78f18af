"""Textures: small images drawn in (u, v) coordinates, v upwards, as the meshes use them."""

import io
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

Color = tuple[int, int, int]

_OVERSAMPLE = 4  # drawn pixels per pixel, along a side


class Canvas:
    """An image to draw on, antialiased by oversampling.

    Args:
        color: Background, RGB in [0, 255].
        size: Width and height, [pixels].
    """

    def __init__(self, color: Color, size: tuple[int, int] = (128, 128)):
        self._size = size
        self._image = Image.new("RGB", (size[0] * _OVERSAMPLE, size[1] * _OVERSAMPLE), color)
        self._draw = ImageDraw.Draw(self._image)

    def rect(self, u0: float, v0: float, u1: float, v1: float, color: Color) -> None:
        """Fill a rectangle."""
        (x0, y1), (x1, y0) = self._at(u0, v0), self._at(u1, v1)
        self._draw.rectangle((x0, y0, x1 - 1, y1 - 1), fill=color)

    def band(self, v0: float, v1: float, color: Color) -> None:
        """Fill a band over the whole width."""
        self.rect(0.0, v0, 1.0, v1, color)

    def gradient(self, v0: float, v1: float, low: Color, high: Color) -> None:
        """Fill a band over the whole width, from one color at v0 to another at v1."""
        (_, y1), (x1, y0) = self._at(0.0, v0), self._at(1.0, v1)
        for y in range(round(y0), round(y1)):
            share = (y1 - y) / (y1 - y0)
            color = tuple(round(a + share * (b - a)) for a, b in zip(low, high, strict=True))
            self._draw.line((0, y, x1, y), fill=color)

    def disc(self, u: float, v: float, ru: float, rv: float, color: Color) -> None:
        """Fill an ellipse with half axes (ru, rv)."""
        (x0, y1), (x1, y0) = self._at(u - ru, v - rv), self._at(u + ru, v + rv)
        self._draw.ellipse((x0, y0, x1, y1), fill=color)

    def polygon(self, points: Sequence[tuple[float, float]], color: Color) -> None:
        """Fill a polygon of (u, v) points."""
        self._draw.polygon([self._at(u, v) for u, v in points], fill=color)

    def line(self, points: Sequence[tuple[float, float]], width: float, color: Color) -> None:
        """Draw a line; `width` is a share of the image's width."""
        pixels = max(1, round(width * self._image.width))
        self._draw.line([self._at(u, v) for u, v in points], fill=color, width=pixels, joint="curve")

    def text(self, text: str, cell: tuple[float, float, float, float], color: Color, turn: int = 0) -> None:
        """Write text stretched to fill (u0, v0, u1, v1); `turn` rotates it left by 0, 90, 180 or 270 deg."""
        font = ImageFont.load_default(64)
        box = font.getbbox(text, stroke_width=2)
        mask = Image.new("L", (round(box[2] - box[0]), round(box[3] - box[1])), 0)
        ImageDraw.Draw(mask).text((-box[0], -box[1]), text, fill=255, font=font, stroke_width=2)
        (x0, y1), (x1, y0) = self._at(*cell[:2]), self._at(*cell[2:])
        mask = mask.rotate(turn, expand=True)
        mask = mask.resize((max(1, round(x1 - x0)), max(1, round(y1 - y0))), Image.Resampling.BILINEAR)
        self._image.paste(color, (round(x0), round(y0)), mask)

    def png(self) -> bytes:
        """Return the image as PNG."""
        return png(np.asarray(self._image.resize(self._size, Image.Resampling.BOX)))

    def _at(self, u: float, v: float) -> tuple[float, float]:
        return u * self._image.width, (1.0 - v) * self._image.height


def png(pixels: np.ndarray) -> bytes:
    """Return an image (H, W, 3) uint8, first row on top, as PNG for MuJoCo, where the first row of a file is v = 0."""
    stream = io.BytesIO()
    Image.fromarray(pixels[::-1]).save(stream, "png", compress_level=1)
    return stream.getvalue()
