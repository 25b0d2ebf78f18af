"""Tiles of wood, metal and paint for `joinery.Palette`: (TILE, TILE, 3) uint8, first row on top."""

import io

import numpy as np
from PIL import Image

from libero_env.objects.builtin.joinery import TILE
from libero_env.objects.builtin.paint import Canvas, Color


def plain(color: Color) -> np.ndarray:
    """Return a tile of one colour."""
    return np.broadcast_to(np.array(color, np.uint8), (TILE, TILE, 3)).copy()


def wood(color: Color, seed: int, *, depth: float = 0.25, upright: bool = False) -> np.ndarray:
    """Return wood whose grain runs to the right, or upwards; `depth` is the relative darkness of its lines."""
    rng = np.random.default_rng(seed)
    v, u = np.meshgrid(*[(np.arange(TILE) + 0.5) / TILE] * 2, indexing="ij")
    bend = 0.03 * np.sin(2 * np.pi * (u + rng.uniform())) + 0.02 * np.sin(2 * np.pi * (3 * u + 2 * v))
    grain = np.zeros_like(u)
    for frequency in (3, 5, 8, 13, 21, 34):
        wave = np.sin(2 * np.pi * (frequency * (v + bend * rng.uniform(0.4, 1.0)) + rng.uniform()))
        grain += wave * rng.uniform(0.5, 1.0) / np.sqrt(frequency)
    grain = (grain - grain.min()) / np.ptp(grain)
    fibre = np.repeat(rng.normal(0.0, 0.02, (TILE, TILE // 16)), 16, axis=1)
    shade = 1.0 - depth * grain**1.5 + fibre
    tile = _shaded(color, shade)
    return tile.transpose(1, 0, 2) if upright else tile


def brushed(color: Color, seed: int, *, depth: float = 0.06, upright: bool = False) -> np.ndarray:
    """Return metal with fine scratches to the right, or upwards."""
    rng = np.random.default_rng(seed)
    lines = rng.normal(0.0, depth, (TILE, 1)) + np.repeat(rng.normal(0.0, depth / 3, (TILE, 4)), TILE // 4, 1)
    tile = _shaded(color, 1.0 + np.clip(lines, -2 * depth, 2 * depth))
    return tile.transpose(1, 0, 2) if upright else tile


def chrome(color: Color) -> np.ndarray:
    """Return polished metal: bright and dark bands, like reflections of a room."""
    u = (np.arange(TILE) + 0.5) / TILE
    bands = 0.80 + 0.16 * np.cos(4 * np.pi * u) + 0.10 * np.cos(12 * np.pi * u + 1.0)
    return _shaded(color, np.broadcast_to(bands, (TILE, TILE)))


def edged(tile: np.ndarray, *, width: int = 5, shade: float = 0.72) -> np.ndarray:
    """Return a tile with a darker rim, the shadow between neighbouring fronts."""
    y, x = np.mgrid[:TILE, :TILE]
    rim = np.clip(np.minimum.reduce([x, y, TILE - 1 - x, TILE - 1 - y]) / width, 0.0, 1.0)
    return (tile * (shade + (1.0 - shade) * rim)[..., None]).astype(np.uint8)


def panelled(tile: np.ndarray, inset: tuple[float, float], *, shade: float = 0.84) -> np.ndarray:
    """Return a tile with a painted sunken panel; `inset` is its distance from the rim in u and v."""
    y, x = np.mgrid[:TILE, :TILE] / TILE
    du, dv = np.minimum(x, 1 - x) - inset[0], np.minimum(y, 1 - y) - inset[1]
    line = np.minimum(du / inset[0], dv / inset[1])
    upper = (y < 0.5) | (x < 0.5)
    factor = np.where(np.abs(line) < 0.12, np.where(upper, shade, 1.0 + 0.3 * (1 - shade)), 1.0)
    factor = np.where(line > 0.12, 0.5 * (1.0 + shade) + 0.03, factor)
    return np.clip(tile * factor[..., None], 0, 255).astype(np.uint8)


def painted(canvas: Canvas) -> np.ndarray:
    """Return the image of a canvas as a tile."""
    image = Image.open(io.BytesIO(canvas.png())).resize((TILE, TILE), Image.Resampling.BOX)
    return np.asarray(image)[::-1]


def _shaded(color: Color, shade: np.ndarray) -> np.ndarray:
    return np.clip(np.multiply.outer(shade, np.array(color, float)), 0, 255).astype(np.uint8)
