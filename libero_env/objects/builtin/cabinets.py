"""Cabinets: two of drawers with bar handles, a low one, and one with a sliding door. All open towards -y."""

from collections.abc import Sequence

from libero_env.objects.builtin.assemble import Appearance
from libero_env.objects.builtin.joinery import Cell, Palette, bar, block, in_body
from libero_env.objects.builtin.mesh import Mesh, merge
from libero_env.objects.builtin.surfaces import brushed, edged, panelled, plain, wood

DRAWERS = {
    "cabinet_top": 0.0698,
    "cabinet_middle": 0.0,
    "cabinet_bottom": -0.0686,
}  # body -> [m] height above the middle drawer
HANDLES = {"cabinet_top": 0.1839, "cabinet_middle": 0.1104, "cabinet_bottom": 0.0411}
SHORT_DRAWERS = {"drawer_top": 0.0460, "drawer_middle": 0.0, "drawer_bottom": -0.0473}


def wooden_cabinet() -> dict[str, Appearance]:
    """Return the wooden cabinet: dark walnut, steel bars."""
    board = wood((100, 69, 48), seed=3, depth=0.38)
    tiles = {
        "outside": board,
        "side": wood((92, 63, 43), seed=4, depth=0.38, upright=True),
        "front": edged(wood((108, 74, 50), seed=5, depth=0.42), width=4),
        "inside": wood((158, 118, 80), seed=6, depth=0.2),
        "metal": brushed((186, 188, 192), seed=7, upright=True),
    }
    return _chest("wooden_cabinet", Palette(tiles), specular=0.15)


def white_cabinet() -> dict[str, Appearance]:
    """Return the white cabinet: white paint with sunken panels, dark grey bars."""
    paint = wood((232, 231, 226), seed=8, depth=0.04)
    tiles = {
        "outside": paint,
        "side": panelled(paint.transpose(1, 0, 2), (0.10, 0.08), shade=0.88),
        "front": edged(panelled(paint, (0.055, 0.16), shade=0.80), width=3, shade=0.8),
        "inside": plain((206, 204, 198)),
        "metal": brushed((92, 94, 98), seed=9, upright=True),
    }
    return _chest("white_cabinet", Palette(tiles), specular=0.25)


def short_cabinet() -> dict[str, Appearance]:
    """Return the short cabinet: low chest of rosewood with three flat drawers and bent handles."""
    tiles = {
        "outside": wood((112, 66, 46), seed=13, depth=0.42),
        "side": wood((104, 55, 37), seed=14, depth=0.42),
        "front": edged(wood((121, 73, 50), seed=15, depth=0.45), width=5),
        "inside": wood((164, 112, 80), seed=16, depth=0.2),
        "metal": brushed((204, 178, 120), seed=17),
    }
    palette = Palette(tiles)
    parts = {"base": _short_base(palette)}
    parts |= {body: _short_drawer(palette, shift) for body, shift in SHORT_DRAWERS.items()}
    return _appearances("short_cabinet", palette, parts, specular=0.2)


def slide_cabinet() -> dict[str, Appearance]:
    """Return the slide cabinet: blue-grey cupboard: one half closed, a sliding door with a bar before the other."""
    paint = brushed((122, 138, 164), seed=20, depth=0.008)
    tiles = {
        "outside": paint,
        "door": edged(panelled(paint, (0.12, 0.12), shade=0.8), width=3, shade=0.85),
        "front": edged(paint, width=3, shade=0.85),
        "inside": plain((196, 205, 218)),
        "metal": brushed((200, 202, 206), seed=21, upright=True),
    }
    palette = Palette(tiles)
    parts = {"main": _slide_base(palette), "slidelink": _slide_door(palette)}
    return _appearances("slide_cabinet", palette, parts, specular=0.25)


APPEARANCES = {
    "short_cabinet": short_cabinet,
    "slide_cabinet": slide_cabinet,
    "white_cabinet": white_cabinet,
    "wooden_cabinet": wooden_cabinet,
}


def _appearances(
    category: str, palette: Palette, parts: dict[str, Mesh], *, specular: float
) -> dict[str, Appearance]:
    texture = palette.png()
    return {
        body: Appearance(in_body(mesh, category, body), texture, specular=specular, frame="body")
        for body, mesh in parts.items()
    }


def _chest(category: str, palette: Palette, *, specular: float) -> dict[str, Appearance]:
    parts = {"base": _chest_base(palette)}
    parts |= {body: _chest_drawer(palette, shift, HANDLES[body]) for body, shift in DRAWERS.items()}
    return _appearances(category, palette, parts, specular=specular)


def _chest_base(palette: Palette) -> Mesh:
    outside, side, inside = palette["outside"], palette["side"], palette["inside"]
    boards = [
        block((-0.1079, -0.0709, z - 0.0012), (0.1158, 0.1082, z + 0.0012), inside) for z in (0.0793, 0.1494)
    ]
    return merge(
        [
            block(
                (-0.1173, -0.0792, 0.0080), (-0.1070, 0.1117, 0.2190), side, faces={"x+": inside}, bevel=0.001
            ),
            block(
                (0.1138, -0.0792, 0.0080), (0.1241, 0.1117, 0.2190), side, faces={"x-": inside}, bevel=0.001
            ),
            block((-0.1175, 0.1071, 0.0084), (0.1215, 0.1117, 0.2190), outside, faces={"y-": inside}),
            block((-0.1189, -0.0735, 0.0046), (0.1270, 0.1062, 0.0102), outside, faces={"z+": inside}),
            block((-0.1245, -0.0799, 0.2177), (0.1316, 0.1117, 0.2226), outside, bevel=0.0012),
            *boards,
        ]
    )


def _chest_drawer(palette: Palette, shift: float, handle: float) -> Mesh:
    front, inside, metal = palette["front"], palette["inside"], palette["metal"]
    low, high = 0.0822 + shift, 0.1455 + shift
    return merge(
        [
            block(
                (-0.1060, -0.0780, 0.0791 + shift),
                (0.1127, -0.0650, 0.1476 + shift),
                front,
                bevel=0.0012,
                faces={"y+": inside, "z+": palette["outside"]},
            ),
            *_tray((-0.1046, -0.0704, low), (0.1116, 0.0943, high), 0.0054, 0.0072, inside),
            bar((-0.0472, -0.1019, handle), (0.0417, -0.1019, handle), 0.0081, metal),
            *(
                bar((x, -0.1000, handle), (x, -0.0775, handle), 0.0053, metal, segments=8)
                for x in (-0.0356, 0.0292)
            ),
        ]
    )


def _tray(low: Sequence[float], high: Sequence[float], wall: float, floor: float, cell: Cell) -> list[Mesh]:
    """Return the sides, back and floor of a drawer without its front."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    return [
        block((x0, y0, z0), (x0 + wall, y1, z1), cell),
        block((x1 - wall, y0, z0), (x1, y1, z1), cell),
        block((x0, y1 - wall, z0), (x1, y1, z1 + 0.0004), cell),
        block((x0 + 0.001, y0, z0 + 0.0002), (x1 - 0.001, y1 - 0.001, z0 + floor), cell),
    ]


def _short_base(palette: Palette) -> Mesh:
    outside, side, inside = palette["outside"], palette["side"], palette["inside"]
    boards = [
        block((-0.0987, -0.0935, z - 0.001), (0.0987, 0.0935, z + 0.001), inside) for z in (0.0746, 0.1217)
    ]
    return merge(
        [
            block((0.0980, -0.0935, 0.0280), (0.1012, 0.0935, 0.1718), side, faces={"x-": inside}),
            block((-0.1012, -0.0935, 0.0280), (-0.0980, 0.0935, 0.1718), side, faces={"x+": inside}),
            block((-0.1012, -0.0950, 0.1684), (0.1012, 0.0935, 0.1724), outside, bevel=0.001),
            block(
                (-0.1008, 0.0924, 0.0283),
                (0.1008, 0.0960, 0.1830),
                outside,
                bevel=0.001,
                faces={"y-": outside},
            ),
            *boards,
        ]
    )


def _short_drawer(palette: Palette, shift: float) -> Mesh:
    front, inside, metal, z = palette["front"], palette["inside"], palette["metal"], 0.1020 + shift
    bend = [(-0.0212, -0.0940), (-0.0105, -0.1016), (0.0105, -0.1016), (0.0212, -0.0940)]
    return merge(
        [
            block(
                (-0.0965, -0.0936, 0.0782 + shift),
                (0.0965, -0.0830, 0.1196 + shift),
                front,
                bevel=0.001,
                faces={"y+": inside, "z+": inside},
            ),
            *_tray(
                (-0.0964, -0.0836, 0.0790 + shift), (0.0964, 0.0905, 0.1184 + shift), 0.0072, 0.0069, inside
            ),
            *(
                bar((*one, z), (*two, z), 0.0021, metal, segments=8)
                for one, two in zip(bend[:-1], bend[1:], strict=True)
            ),
        ]
    )


def _slide_base(palette: Palette) -> Mesh:
    outside, inside, front = palette["outside"], palette["inside"], palette["front"]
    return merge(
        [
            block((-0.2290, -0.15, -0.10), (0.0, 0.15, -0.08), outside, faces={"z+": inside}),
            block((-0.2290, -0.15, 0.08), (0.0, 0.15, 0.10), outside, faces={"z-": inside}),
            block((-0.2290, -0.15, -0.08), (-0.2020, 0.15, 0.08), outside, faces={"x+": inside}),
            block((-0.2020, 0.126, -0.08), (0.0, 0.15, 0.08), outside, faces={"y-": inside}),
            block(
                (-0.001, -0.15, -0.10),
                (0.2250, 0.15, 0.10),
                outside,
                bevel=0.002,
                faces={"x-": inside, "y-": front},
            ),
        ]
    )


def _slide_door(palette: Palette) -> Mesh:
    metal = palette["metal"]
    return merge(
        [
            block(
                (-0.2350, -0.1850, -0.0975),
                (-0.0100, -0.1550, 0.0975),
                palette["outside"],
                bevel=0.002,
                faces={"y-": palette["door"]},
            ),
            bar((-0.2140, -0.2215, -0.0795), (-0.2140, -0.2215, 0.0795), 0.0110, metal, segments=12),
            *(bar((-0.2140, -0.2200, z), (-0.2140, -0.1840, z), 0.0090, metal) for z in (-0.057, 0.057)),
        ]
    )
