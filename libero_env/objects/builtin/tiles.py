"""Tiles of wood, metal and paint that furniture shows: (TILE, TILE, 3) uint8, first row on top."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from libero_env.objects.builtin.paint import Canvas, Cell, Color
from libero_env.objects.builtin.solids import outline_of

TILE = 128  # [pixels] side of a tile


def make_tiles(tiles: Mapping[str, Mapping[str, Any]]) -> tuple[np.ndarray, dict[str, Cell]]:
    """Return the image of all tiles side by side, and name -> bounds of a tile, inset so that neighbours do not show.

    Args:
        tiles: Name -> a surface of this module with its arguments (`{wood: [color, seed], depth: 0.2}`) or a picture;
            then `panelled` and `edged`, each with its arguments, change it.
    """
    count, margin = len(tiles), 3.0 / TILE
    cells: dict[str, Cell] = {
        name: ((index + margin) / count, margin, (index + 1 - margin) / count, 1.0 - margin)
        for index, name in enumerate(tiles)
    }
    return np.concatenate([_tile(tile) for tile in tiles.values()], axis=1), cells


def _tile(recipe: Mapping[str, Any]) -> np.ndarray:
    options = dict(recipe)
    panelled, edged = options.pop("panelled", None), options.pop("edged", None)
    if "draw" in options:
        tile = Canvas(**options).pixels()
    else:
        name = next(iter(options))
        tile = _SURFACES[name](*options.pop(name), **options)
    tile = tile if panelled is None else _panelled(tile, **panelled)
    return tile if edged is None else _edged(tile, **edged)


def _plain(color: Color) -> np.ndarray:
    return np.broadcast_to(np.array(color, np.uint8), (TILE, TILE, 3))


def _wood(color: Color, seed: int, *, depth: float, upright: bool = False) -> np.ndarray:
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
    tile = _shaded(color, 1.0 - depth * grain**1.5 + fibre)
    return tile.transpose(1, 0, 2) if upright else tile


def _brushed(color: Color, seed: int, *, depth: float = 0.06, upright: bool = False) -> np.ndarray:
    """Return metal with fine scratches to the right, or upwards."""
    rng = np.random.default_rng(seed)
    lines = rng.normal(0.0, depth, (TILE, 1)) + np.repeat(rng.normal(0.0, depth / 3, (TILE, 4)), TILE // 4, 1)
    tile = _shaded(color, 1.0 + np.clip(lines, -2 * depth, 2 * depth))
    return tile.transpose(1, 0, 2) if upright else tile


def _chrome(color: Color) -> np.ndarray:
    """Return polished metal: bright and dark bands, like reflections of a room."""
    u = (np.arange(TILE) + 0.5) / TILE
    bands = 0.80 + 0.16 * np.cos(4 * np.pi * u) + 0.10 * np.cos(12 * np.pi * u + 1.0)
    return _shaded(color, np.broadcast_to(bands, (TILE, TILE)))


def _paper(color: Color) -> np.ndarray:
    """Return the edges of a book's pages: fine lines with some gaps."""
    rng = np.random.default_rng(7)
    lines = 1.0 - 0.16 * rng.random(TILE // 2).repeat(2) - 0.25 * (rng.random(TILE // 2) > 0.88).repeat(2)
    return _shaded(color, np.broadcast_to(lines, (TILE, TILE)))


def _enamel(
    profile: Sequence[Sequence[float]], heights: Sequence[float], peak: Color, valley: Color
) -> np.ndarray:
    """Return a tile for a turned profile (height, radius) that is bright at the upper of two heights, [m]."""
    points, way = outline_of(profile)
    height = np.interp((np.arange(TILE)[::-1] + 0.5) / TILE, way, points[:, 0])  # first row on top
    share = np.clip((height - heights[0]) / (heights[1] - heights[0]), 0.0, 1.0) ** 3
    rows = np.add(np.multiply.outer(1 - share, valley), np.multiply.outer(share, peak))
    return np.repeat(rows[:, None], TILE, axis=1).astype(np.uint8)


def _edged(tile: np.ndarray, *, width: int = 5, shade: float = 0.72) -> np.ndarray:
    """Return a tile with a darker rim, the shadow between neighbouring fronts."""
    y, x = np.mgrid[:TILE, :TILE]
    rim = np.clip(np.minimum.reduce([x, y, TILE - 1 - x, TILE - 1 - y]) / width, 0.0, 1.0)
    return (tile * (shade + (1.0 - shade) * rim)[..., None]).astype(np.uint8)


def _panelled(tile: np.ndarray, *, inset: Sequence[float], shade: float) -> np.ndarray:
    """Return a tile with a painted sunken panel; `inset` is its distance from the rim in u and v."""
    y, x = np.mgrid[:TILE, :TILE] / TILE
    du, dv = np.minimum(x, 1 - x) - inset[0], np.minimum(y, 1 - y) - inset[1]
    line = np.minimum(du / inset[0], dv / inset[1])
    upper = (y < 0.5) | (x < 0.5)
    factor = np.where(np.abs(line) < 0.12, np.where(upper, shade, 1.0 + 0.3 * (1 - shade)), 1.0)
    factor = np.where(line > 0.12, 0.5 * (1.0 + shade) + 0.03, factor)
    return np.clip(tile * factor[..., None], 0, 255).astype(np.uint8)


def _shaded(color: Color, shade: np.ndarray) -> np.ndarray:
    return np.clip(np.multiply.outer(shade, np.array(color, float)), 0, 255).astype(np.uint8)


_SURFACES: dict[str, Callable[..., np.ndarray]] = {
    "brushed": _brushed,
    "chrome": _chrome,
    "enamel": _enamel,
    "paper": _paper,
    "plain": _plain,
    "wood": _wood,
}
