"""Shelves of dark oak, open towards -y: one with three compartments, one with two layers."""

from libero_env.objects.builtin.assemble import Appearance
from libero_env.objects.builtin.joinery import Palette, block
from libero_env.objects.builtin.mesh import Mesh, merge
from libero_env.objects.builtin.surfaces import edged, wood

OAK, OAK_LIGHT = (98, 70, 50), (150, 112, 78)


def wooden_shelf() -> Appearance:
    """Return the wooden shelf: carcase under an overhanging top; two boards make three compartments."""
    palette = _oak(seed=30)
    boards = [
        ((-0.1081, -0.0700, z0), (0.1159, 0.1080, z1)) for z0, z1 in ((0.0774, 0.0808), (0.1476, 0.1511))
    ]
    parts = [
        _sheet(palette, (-0.1246, -0.0790, 0.2160), (0.1318, 0.1117, 0.2216), "top", bevel=0.0015),
        *(_sheet(palette, low, high, "board") for low, high in boards),
        _sheet(palette, (-0.1081, -0.0735, 0.0046), (0.1159, 0.1080, 0.0106), "board"),
        _side(palette, (-0.1173, -0.0785, 0.0046), (-0.1072, 0.1110, 0.2162)),
        _side(palette, (0.1140, -0.0785, 0.0046), (0.1241, 0.1110, 0.2162)),
        block((-0.1081, 0.1072, 0.0084), (0.1159, 0.1112, 0.2162), palette["inside"], faces=_outer(palette)),
    ]
    return Appearance(merge(parts), palette.png(), specular=0.15, frame="body")


def wooden_two_layer_shelf() -> Appearance:
    """Return the wooden two layer shelf: wide and without a floor: a board halfway, an overhanging top."""
    palette = _oak(seed=35)
    parts = [
        _sheet(palette, (-0.1708, -0.0790, 0.2055), (0.1807, 0.1117, 0.2100), "top", bevel=0.0015),
        _sheet(palette, (-0.1480, -0.0705, 0.0678), (0.1572, 0.1080, 0.0716), "board"),
        _side(palette, (-0.1609, -0.0785, 0.0002), (-0.1470, 0.1110, 0.2058)),
        _side(palette, (0.1562, -0.0785, 0.0002), (0.1701, 0.1110, 0.2058)),
        block((-0.1480, 0.1072, 0.0004), (0.1572, 0.1112, 0.2058), palette["inside"], faces=_outer(palette)),
    ]
    return Appearance(merge(parts), palette.png(), specular=0.15, frame="body")


APPEARANCES = {"wooden_shelf": wooden_shelf, "wooden_two_layer_shelf": wooden_two_layer_shelf}


def _oak(seed: int) -> Palette:
    return Palette(
        {
            "top": edged(wood(OAK, seed, depth=0.42), width=3, shade=0.85),
            "side": edged(wood((90, 64, 46), seed + 1, depth=0.42, upright=True), width=3, shade=0.85),
            "edge": wood(OAK_LIGHT, seed + 2, depth=0.25),
            "upright": wood(OAK_LIGHT, seed + 2, depth=0.25, upright=True),
            "board": wood((112, 82, 58), seed + 3, depth=0.35),
            "inside": wood((72, 51, 37), seed + 4, depth=0.35),
        }
    )


def _sheet(palette: Palette, low, high, name: str, *, bevel: float = 0.0) -> Mesh:
    # The front edge is paler, so that the layers can be distinguished.
    return block(low, high, palette[name], bevel=bevel, faces={"y-": palette["edge"]})


def _side(palette: Palette, low, high) -> Mesh:
    return block(low, high, palette["side"], bevel=0.001, faces={"y-": palette["upright"]})


def _outer(palette: Palette) -> dict:
    return {"y+": palette["top"]}
