"""Pictures of objects, drawn in (u, v) coordinates, v upwards, as the meshes use them."""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

Color = Sequence[int]
Cell = Sequence[float]  # u0, v0, u1, v1

_OVERSAMPLE = 4  # drawn pixels per pixel, along a side
_AROUND = ((0.0, 0.0), (0.5, 0.0), (1.0, 0.0))  # back, front, and back again
_CAP_V = 0.80  # height that separates the body of a bottle and its cap
_STEEL, _DARK_STEEL, _BRIGHT_STEEL = (168, 172, 178), (118, 122, 128), (212, 216, 220)


class Canvas:
    """An image to draw on, antialiased by oversampling.

    Args:
        color: Background, RGB in [0, 255].
        size: Width and height, [pixels].
        draw: Steps as `draw` takes them.
    """

    def __init__(
        self, color: Color, size: Sequence[int] = (128, 128), draw: Sequence[Mapping[str, Any]] = ()
    ):
        self._size = (size[0], size[1])
        self._origin = (0.0, 0.0)
        self._image = Image.new("RGB", (size[0] * _OVERSAMPLE, size[1] * _OVERSAMPLE), tuple(color))
        self._draw = ImageDraw.Draw(self._image)
        self.draw(draw)

    def draw(self, steps: Sequence[Mapping[str, Any]]) -> None:
        """Draw each step: a method of this class and its arguments, or steps that are repeated.

        Args:
            steps: `{disc: [u, v, ru, rv, color]}`; `{at: [[u, v], ...], draw: steps}` repeats steps at other origins,
                `{around: steps}` at u = 0, 0.5 and 1.
        """
        for step in steps:
            if "around" in step:
                step = {"at": _AROUND, "draw": step["around"]}
            if "at" in step:
                before = self._origin
                for u, v in step["at"]:
                    self._origin = (before[0] + u, before[1] + v)
                    self.draw(step["draw"])
                self._origin = before
            else:
                ((name, values),) = step.items()
                getattr(self, name)(*values)

    def rect(self, u0: float, v0: float, u1: float, v1: float, color: Color) -> None:
        """Fill a rectangle."""
        (x0, y1), (x1, y0) = self._pixel(u0, v0), self._pixel(u1, v1)
        self._draw.rectangle((x0, y0, x1 - 1, y1 - 1), fill=tuple(color))

    def band(self, v0: float, v1: float, color: Color) -> None:
        """Fill a band over the whole width."""
        self.rect(0.0, v0, 1.0, v1, color)

    def gradient(self, v0: float, v1: float, low: Color, high: Color) -> None:
        """Fill a band over the whole width, from one color at v0 to another at v1."""
        (_, y1), (x1, y0) = self._pixel(0.0, v0), self._pixel(1.0, v1)
        for y in range(round(y0), round(y1)):
            share = (y1 - y) / (y1 - y0)
            color = tuple(round(a + share * (b - a)) for a, b in zip(low, high, strict=True))
            self._draw.line((0, y, x1, y), fill=color)

    def disc(self, u: float, v: float, ru: float, rv: float, color: Color) -> None:
        """Fill an ellipse with half axes (ru, rv)."""
        (x0, y1), (x1, y0) = self._pixel(u, v, -ru, -rv), self._pixel(u, v, ru, rv)
        self._draw.ellipse((x0, y0, x1, y1), fill=tuple(color))

    def polygon(self, points: Sequence[Sequence[float]], color: Color) -> None:
        """Fill a polygon of (u, v) points."""
        self._draw.polygon([self._pixel(u, v) for u, v in points], fill=tuple(color))

    def line(self, points: Sequence[Sequence[float]], width: float, color: Color) -> None:
        """Draw a line; `width` is a share of the image's width."""
        pixels = max(1, round(width * self._image.width))
        self._draw.line(
            [self._pixel(u, v) for u, v in points], fill=tuple(color), width=pixels, joint="curve"
        )

    def text(self, text: str, cell: Cell, color: Color, turn: int = 0) -> None:
        """Write text stretched to fill a cell; `turn` rotates it left by 0, 90, 180 or 270 deg."""
        font = ImageFont.load_default(64)
        box = font.getbbox(text, stroke_width=2)
        mask = Image.new("L", (round(box[2] - box[0]), round(box[3] - box[1])), 0)
        ImageDraw.Draw(mask).text((-box[0], -box[1]), text, fill=255, font=font, stroke_width=2)
        (x0, y1), (x1, y0) = self._pixel(cell[0], cell[1]), self._pixel(cell[2], cell[3])
        mask = mask.rotate(turn, expand=True)
        mask = mask.resize((max(1, round(x1 - x0)), max(1, round(y1 - y0))), Image.Resampling.BILINEAR)
        self._image.paste(tuple(color), (round(x0), round(y0)), mask)

    def bottle_cap(self, cap: Color, groove: Color) -> None:
        """Paint the cap of a bottle (`mesh.bottle`) and its two grooves."""
        self.band(_CAP_V, 1.0, cap)
        self.band(_CAP_V, _CAP_V + 0.02, groove)
        self.band(_CAP_V + 0.10, _CAP_V + 0.115, groove)

    def tin_label(self, color: Color) -> None:
        """Paint the label of a tin (`mesh.tin`), and the shades of its rims and lid."""
        self.band(0.0, 0.04, _DARK_STEEL)
        self.band(0.10, 0.80, color)
        self.band(0.84, 0.88, _BRIGHT_STEEL)
        self.band(0.88, 0.91, _DARK_STEEL)
        self.band(0.945, 0.955, _BRIGHT_STEEL)

    def star(
        self, u: float, v: float, radii: Sequence[float], points: int, valley: float, color: Color
    ) -> None:
        """Fill a star; `valley` is the radius between its points as a share of `radii`, those in u and v."""
        first = np.pi / 2 if points % 2 else 0.0
        angles = first + np.arange(2 * points) * np.pi / points
        sizes = np.where(np.arange(2 * points) % 2, valley, 1.0)
        corners = zip(
            u + sizes * radii[0] * np.cos(angles), v + sizes * radii[1] * np.sin(angles), strict=True
        )
        self.polygon(list(corners), color)

    def checks(self, cell: Cell, count: Sequence[int], color: Color) -> None:
        """Fill every other one of the checks of a cell; `count` is their number along u and v."""
        u0, v0, u1, v1 = cell
        du, dv = (u1 - u0) / count[0], (v1 - v0) / count[1]
        for i, j in np.ndindex(*count):
            if (i + j) % 2:
                self.rect(u0 + i * du, v0 + j * dv, u0 + (i + 1) * du, v0 + (j + 1) * dv, color)

    def flutes(self, count: int, share: float, height: Sequence[float], color: Color) -> None:
        """Fill upright stripes between two heights; `share` is half the part of the width that they take."""
        for index in range(count):
            u = (index + 0.5) / count
            self.rect(u - share / count, height[0], u + share / count, height[1], color)

    def keypad(self, labels: str, columns: int, first: Sequence[float], pitch: Sequence[float]) -> None:
        """Draw keys row by row downwards; `first` is the lower left corner of the first, `pitch` their distance."""
        for index, label in enumerate(labels):
            row, column = divmod(index, columns)
            u, v = first[0] + pitch[0] * column, first[1] - pitch[1] * row
            self.rect(u, v, u + 0.22, v + 0.09, (176, 178, 184))
            self.text(label, (u + 0.075, v + 0.018, u + 0.145, v + 0.072), (40, 42, 48))

    def orange_slice(self, u: float, v: float, radius: float) -> None:
        """Draw a slice of an orange on a picture that is twice as wide as high."""
        for share, color in ((1.0, (236, 110, 10)), (0.88, (255, 226, 160)), (0.78, (248, 146, 26))):
            self.disc(u, v, radius * share, 1.7 * radius * share, color)
        for angle in np.arange(4) * np.pi / 4:
            du, dv = radius * 0.76 * np.cos(angle), 1.7 * radius * 0.76 * np.sin(angle)
            self.line([(u - du, v - dv), (u + du, v + dv)], 0.006, (255, 226, 160))

    def ear_of_corn(self, u: float, v: float) -> None:
        """Draw an ear of corn along u: kernels in rows, husks on the left."""
        self.disc(u, v, 0.130, 0.105, (238, 176, 24))
        for row in (-2, -1, 0, 1, 2):
            reach = 0.115 * np.sqrt(1.0 - (row / 2.9) ** 2)
            for at in np.arange(-reach, reach + 0.001, 0.026):
                self.disc(u + at + 0.006 * (row % 2), v + 0.038 * row, 0.0115, 0.017, (255, 222, 84))
        for tip, color in ((-0.06, (96, 164, 60)), (0.0, (70, 138, 50)), (0.06, (96, 164, 60))):
            husk = [
                (u - 0.165, v + 0.3 * tip),
                (u - 0.05, v + 1.9 * tip + 0.02),
                (u - 0.01, v + 1.6 * tip - 0.02),
                (u - 0.13, v + 0.3 * tip - 0.045),
            ]
            self.polygon(husk, color)

    def macaroni(self, u: float, v: float) -> None:
        """Draw a heap of macaroni around a point."""
        rng = np.random.default_rng(5)
        for _ in range(26):
            way, reach = rng.uniform(0, 2 * np.pi), np.sqrt(rng.uniform(0, 0.8))
            center = (u + 0.165 * reach * np.cos(way), v + 0.09 * reach * np.sin(way))
            arc = rng.uniform(0, 2 * np.pi) + np.linspace(0.0, 2.2, 6)
            points = [(center[0] + 0.026 * np.cos(a), center[1] + 0.026 * np.sin(a)) for a in arc]
            self.line(points, 0.022, (206, 116, 16))
            self.line(points, 0.014, (255, 212, 84))

    def pixels(self) -> np.ndarray:
        """Return the image, (height, width, 3) uint8, first row on top."""
        return np.asarray(self._image.resize(self._size, Image.Resampling.BOX))

    def _pixel(self, u: float, v: float, du: float = 0.0, dv: float = 0.0) -> tuple[float, float]:
        u, v = self._origin[0] + u + du, self._origin[1] + v + dv
        return u * self._image.width, (1.0 - v) * self._image.height


def weave(columns: int, rows: int, rim: float = 0.88) -> np.ndarray:
    """Return wickerwork, (128, 256, 3) uint8, first row on top: strands bright in the middle and dark at crossings.

    Args:
        columns: Strands along the width.
        rows: Strands along the height.
        rim: Lower edge of the braided rim, v.
    """
    height, width = 128, 256
    v = (np.arange(height)[::-1, None] + 0.5) / height  # first row on top
    u = (np.arange(width)[None] + 0.5) / width
    v, u = np.broadcast_arrays(v, u)
    row, column = v * rows, u * columns
    over = (np.floor(row) + np.floor(column)) % 2 == 0
    across = np.where(over, row, column) % 1.0 - 0.5
    along = np.where(over, column, row) % 1.0 - 0.5
    shade = np.cos(np.pi * across) * (0.55 + 0.45 * np.cos(np.pi * along))
    shade *= np.where(over, 1.0, 0.80)
    braid = 0.55 + 0.45 * np.abs(np.sin(np.pi * (column + 4.0 * (v - rim) / (1.0 - rim))))
    shade = np.where(v > rim, braid * 1.05, 0.35 + 0.65 * shade)
    return np.clip(shade[..., None] * (196.0, 140.0, 78.0), 0, 255).astype(np.uint8)


def png(pixels: np.ndarray) -> bytes:
    """Return an image (H, W, 3) uint8, first row on top, as PNG for MuJoCo, where the first row of a file is v = 0."""
    stream = io.BytesIO()
    Image.fromarray(pixels[::-1]).save(stream, "png", compress_level=1)
    return stream.getvalue()
