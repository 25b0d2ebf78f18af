"""What the builtin objects look like: the recipes of `appearance/*.yaml`, drawn.

A category has one picture and the meshes that show it:

- `picture`: what `paint.Canvas` draws; its meshes are drawn as the object rests, z up and the front towards +x.
  Or `tiles`, see `tiles.make_tiles`; their meshes are in the frame of the root body with the joints at zero.
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
from libero_env.objects.builtin.paint import Canvas, Cell, png, weave
from libero_env.objects.builtin.physics import load_physics, read_section
from libero_env.objects.builtin.tiles import make_tiles
from libero_env.objects.model import ROOT_BODY, rest_quat

_CONJUGATE = (1.0, -1.0, -1.0, -1.0)


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
        image, cells = _texture(look)
        surface = {key: look[key] for key in ("specular", "shininess", "alpha") if key in look}
        bodies = look["bodies"] if "bodies" in look else {look.get("body", ROOT_BODY): look["mesh"]}
        for body, shapes in bodies.items():
            drawn = _in_body(merge(_shapes(shapes, cells)), category, body, at_rest="picture" in look)
            seen.setdefault(body, []).append(Appearance(drawn, image, **surface))
    return seen


def _texture(look: Mapping[str, Any]) -> tuple[bytes, Mapping[str, Cell]]:
    if "tiles" in look:
        pixels, cells = make_tiles(look["tiles"])
        return png(pixels), cells
    picture = look["picture"]
    pixels = weave(*picture["weave"]) if "weave" in picture else Canvas(**picture).pixels()
    return png(pixels), look.get("cells", {})


def _in_body(drawn: Mesh, category: str, body: str, *, at_rest: bool) -> Mesh:
    physics = load_physics(category)
    if at_rest:
        return drawn.rotated(rest_quat(physics.rotation) * _CONJUGATE)
    chain = []
    while body != ROOT_BODY:
        chain.append(physics.parts[body])
        body = chain[-1].parent
    for part in reversed(chain):
        drawn = drawn.moved(np.negative(part.pos)).rotated(np.multiply(part.quat, _CONJUGATE))
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


def _box(half: Sequence[float], center: Sequence[float], cells: Any) -> Mesh:
    """Return a box whose faces show cells of their own, or all the same one."""
    faces = ("front", "back", "left", "right", "top", "bottom")
    return mesh.box(half, center, cells if isinstance(cells, dict) else dict.fromkeys(faces, cells))


def _triangles(corners: Any, faces: Any, texcoords: Any) -> Mesh:
    return Mesh(np.array(corners, float), np.array(faces), np.array(texcoords, float))


SHAPES: dict[str, Callable[..., Mesh]] = {
    "arch": solids.arch,
    "bar": solids.bar,
    "block": solids.block,
    "bottle": mesh.bottle,
    "box": _box,
    "capsule": solids.capsule,
    "loft": _loft,
    "packet": mesh.packet,
    "prism": solids.prism,
    "quad": mesh.quad,
    "sweep": mesh.sweep,
    "tin": mesh.tin,
    "triangles": _triangles,
    "turned": solids.turned,
    "vessel": mesh.vessel,
}
