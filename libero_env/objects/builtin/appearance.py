"""What the builtin objects look like: the recipes of `appearance/*.yaml`, drawn.

A category has one picture and the meshes that show it:

- `picture`: what `paint.Canvas` draws; its meshes are drawn as the object rests, z up and the front towards +x.
  Or `tiles`, see `_make_tiles`; their meshes are in the frame of the root body with the joints at zero.
- `mesh`: shapes of the root body, or of the one that `body` names; or `bodies`: name of a body -> shapes.
- `cells`: name -> bounds (u0, v0, u1, v1) of a part of the picture, as an argument of shapes.
- `specular`, `shininess`, `alpha`: of the material, see `Appearance`.
- `like`: a category whose keys this one shares, but for those that it has itself.
- `more`: the same keys again, for parts with another surface, such as glass.

A shape is a function of `SHAPES` with its arguments, `{block: [low, high, tile], bevel: 0.001}`, or a `group` of such.
`turn_x` rotates it about x, [deg], `at` draws it moved to each of several places, `faceted` gives it flat shading.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from libero_env.objects.builtin import mesh, solids
from libero_env.objects.builtin.mesh import Mesh, Ring, loft, merge
from libero_env.objects.builtin.paint import Canvas, Cell, Color, png, weave
from libero_env.objects.builtin.physics import load_physics, read_section
from libero_env.objects.builtin.solids import outline_of
from libero_env.objects.model import ROOT_BODY, rest_quat

_CONJUGATE = (1.0, -1.0, -1.0, -1.0)
TILE = 128  # [pixels] side of a tile: wood, metal or paint that furniture shows


@dataclass(frozen=True)
class Appearance:
    """Visual of a body: a mesh and its texture.

    Attributes:
        mesh: Triangles in the frame of the body, [m].
        image: Texture as PNG bytes; the first row of the file is v = 0.
        specular: Strength of highlights, in [0, 1].
        shininess: Sharpness of highlights, in [0, 1].
        alpha: Opacity, in [0, 1]; 1 is opaque.
    """

    mesh: Mesh
    image: bytes
    specular: float = 0.25
    shininess: float = 0.4
    alpha: float = 1.0


@cache
def appearance_of(category: str) -> Mapping[str, Sequence[Appearance]]:
    """Return body -> what is seen of it, drawn on the first call."""
    recipe = read_section("appearance", category)
    if "like" in recipe:
        recipe = read_section("appearance", recipe["like"]) | recipe
    seen: dict[str, list[Appearance]] = {}
    for look in (recipe, recipe["more"]) if "more" in recipe else (recipe,):
        if "tiles" in look:
            pixels, cells = _make_tiles(look["tiles"])
        else:
            picture, cells = look["picture"], look.get("cells", {})
            pixels = weave(*picture["weave"]) if "weave" in picture else Canvas(**picture).pixels()
        image = png(pixels)
        surface = {key: look[key] for key in ("specular", "shininess", "alpha") if key in look}
        bodies = look["bodies"] if "bodies" in look else {look.get("body", ROOT_BODY): look["mesh"]}
        for body, shapes in bodies.items():
            drawn = _in_body(merge(_shapes(shapes, cells)), category, body, at_rest="picture" in look)
            seen.setdefault(body, []).append(Appearance(drawn, image, **surface))
    return seen


def _in_body(drawn: Mesh, category: str, body: str, *, at_rest: bool) -> Mesh:
    physics = load_physics(category)
    if at_rest:
        return drawn.rotated(rest_quat(physics.rotation) * _CONJUGATE)
    chain = []
    while body != ROOT_BODY:
        chain.append(physics.bodies[body])
        body = chain[-1]["parent"]
    for part in reversed(chain):
        drawn = drawn.moved(np.negative(part.get("pos", (0.0, 0.0, 0.0))))
        drawn = drawn.rotated(np.multiply(part.get("quat", (1.0, 0.0, 0.0, 0.0)), _CONJUGATE))
    return drawn


def _shapes(recipes: Sequence[Mapping[str, Any]], cells: Mapping[str, Cell]) -> list[Mesh]:
    drawn = []
    for recipe in recipes:
        options = dict(recipe)
        places, turn, flat = (options.pop(key, None) for key in ("at", "turn_x", "faceted"))
        name = next(iter(options))
        values = options.pop(name)
        if name == "group":
            shape = merge(_shapes(values, cells))
        else:
            shape = SHAPES[name](*_named(values, cells), **_named(options, cells))
        if flat:
            shape = mesh.faceted(shape)
        if turn is not None:
            shape = shape.rotated([np.cos(np.radians(turn) / 2), np.sin(np.radians(turn) / 2), 0.0, 0.0])
        drawn += [shape] if places is None else [shape.moved(place) for place in places]
    return drawn


def _named(value: Any, cells: Mapping[str, Cell]) -> Any:
    """Return arguments of a shape with the cells in place of their names."""
    if isinstance(value, dict):
        return {key: _named(item, cells) for key, item in value.items()}
    if isinstance(value, list):
        return [_named(item, cells) for item in value]
    return cells[value] if isinstance(value, str) else value


def _loft(
    *sections: Sequence[float],
    segments: int,
    round: float = 2.0,
    center: Sequence[float] = (0.0, 0.0),
    creases: Sequence[int] = (),
    v_of_height: Sequence[Sequence[float]] = (),
) -> Mesh:
    """Return a loft through sections (height, half depth, half width, v); `creases` are the indices of sharp ones.

    Without v in the sections, `v_of_height` is two lists: heights, and v at each, linear in between.
    """
    rings = []
    for index, (z, depth, width, *v) in enumerate(sections):
        at = v[0] if v else float(np.interp(z, v_of_height[0], v_of_height[1]))
        rings.append(Ring(z, depth, width, at, round=round, crease=index in creases))
    return loft(rings, segments, center)


_SOLIDS = (solids.arch, solids.bar, solids.block, solids.capsule, solids.prism, solids.turned)
_MESHES = (mesh.bottle, mesh.box, mesh.packet, mesh.quad, mesh.sweep, mesh.tin, mesh.vessel)
SHAPES: dict[str, Callable[..., Mesh]] = {
    "loft": _loft,
    "triangles": lambda *arrays: Mesh(*map(np.array, arrays)),
    **{shape.__name__: shape for shape in (*_SOLIDS, *_MESHES)},
}


def _make_tiles(tiles: Mapping[str, Mapping[str, Any]]) -> tuple[np.ndarray, dict[str, Cell]]:
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
    surface.__name__.removeprefix("_"): surface
    for surface in (_brushed, _chrome, _enamel, _paper, _plain, _wood)
}
