"""Hardcover books that stand upright: cover boards towards +x and -x, the spine towards +y."""

import numpy as np

from libero_env.objects.builtin.assemble import Appearance
from libero_env.objects.builtin.joinery import TILE, Palette, block
from libero_env.objects.builtin.mesh import Mesh, merge
from libero_env.objects.builtin.paint import Canvas, Color
from libero_env.objects.builtin.surfaces import painted, plain

BOARD, OVERHANG = 0.0022, 0.0030  # [m] thickness of the cover, and its overhang over the pages


def black_book() -> Appearance:
    """Return the black book: black cloth, a golden frame, moon and stars."""
    black, gold = (26, 26, 30), (222, 180, 84)
    cover = Canvas(black)
    _frame(cover, gold, 0.06)
    cover.disc(0.5, 0.40, 0.22, 0.18, gold)
    cover.disc(0.59, 0.44, 0.19, 0.155, black)
    for u, v, r in ((0.68, 0.50, 0.030), (0.76, 0.36, 0.022), (0.58, 0.33, 0.020), (0.30, 0.16, 0.020)):
        _star(cover, u, v, r, gold)
    cover.text("NIGHT", (0.16, 0.68, 0.84, 0.86), (240, 206, 120))
    spine = Canvas(black)
    for v in (0.08, 0.12, 0.86, 0.90):
        spine.band(v, v + 0.015, gold)
    spine.text("NIGHT", (0.28, 0.24, 0.76, 0.78), gold, turn=270)
    low, high = (-0.0152, -0.0686, 0.0006), (0.0143, 0.0445, 0.1378)
    return _book(low, high, cover, spine, black, pages=(232, 226, 210))


def yellow_book() -> Appearance:
    """Return the yellow book: yellow cover, a red sun over blue hills, a dark title."""
    yellow, ink, red = (247, 200, 38), (58, 44, 28), (214, 62, 40)
    cover = Canvas(yellow)
    cover.disc(0.5, 0.42, 0.24, 0.20, red)
    cover.polygon([(0.0, 0.10), (0.0, 0.26), (0.28, 0.40), (0.62, 0.18), (0.62, 0.10)], (46, 112, 150))
    cover.polygon([(0.30, 0.10), (0.72, 0.36), (1.0, 0.20), (1.0, 0.10)], (30, 78, 116))
    cover.band(0.0, 0.14, ink)
    cover.text("ATLAS", (0.12, 0.70, 0.88, 0.90), ink)
    cover.text("VOL. 2", (0.32, 0.05, 0.68, 0.115), yellow)
    spine = Canvas(yellow)
    spine.band(0.0, 0.11, ink)
    spine.disc(0.5, 0.20, 0.22, 0.05, red)
    spine.text("ATLAS", (0.26, 0.34, 0.78, 0.88), ink, turn=270)
    low, high = (-0.0106, -0.0512, 0.0004), (0.0150, 0.0500, 0.1236)
    return _book(low, high, cover, spine, yellow, pages=(246, 242, 232))


APPEARANCES = {"black_book": black_book, "yellow_book": yellow_book}


def _book(low, high, cover: Canvas, spine: Canvas, cloth: Color, *, pages: Color) -> Appearance:
    tiles = {
        "cover": painted(cover),
        "spine": painted(spine),
        "cloth": plain(cloth),
        "pages": _leaves(pages),
    }
    palette = Palette(tiles)
    return Appearance(_bound(low, high, palette), palette.png(), specular=0.25, shininess=0.5, frame="body")


def _bound(low, high, palette: Palette) -> Mesh:
    (x0, y0, z0), (x1, y1, z1) = low, high
    cloth, art = palette["cloth"], palette["cover"]
    return merge(
        [
            block((x0, y0, z0), (x0 + BOARD, y1 - 0.001, z1), cloth, bevel=0.0006, faces={"x-": art}),
            block((x1 - BOARD, y0, z0), (x1, y1 - 0.001, z1), cloth, bevel=0.0006, faces={"x+": art}),
            block(
                (x0 + 0.001, y1 - BOARD, z0),
                (x1 - 0.001, y1, z1),
                cloth,
                bevel=0.0008,
                faces={"y+": palette["spine"]},
            ),
            block(
                (x0 + BOARD, y0 + OVERHANG, z0 + OVERHANG),
                (x1 - BOARD, y1 - BOARD, z1 - OVERHANG),
                palette["pages"],
            ),
        ]
    )


def _leaves(color: Color) -> np.ndarray:
    """Return a tile of paper edges: fine lines with some gaps."""
    rng = np.random.default_rng(7)
    lines = 1.0 - 0.16 * rng.random(TILE // 2).repeat(2) - 0.25 * (rng.random(TILE // 2) > 0.88).repeat(2)
    shade = np.broadcast_to(lines, (TILE, TILE))[..., None]
    return np.clip(shade * color, 0, 255).astype(np.uint8)


def _frame(canvas: Canvas, color: Color, inset: float) -> None:
    corners = [(inset, inset), (1 - inset, inset), (1 - inset, 1 - inset), (inset, 1 - inset), (inset, inset)]
    canvas.line(corners, 0.018, color)


def _star(canvas: Canvas, u: float, v: float, radius: float, color: Color) -> None:
    angles = np.pi / 2 + np.arange(10) * np.pi / 5
    sizes = radius * np.where(np.arange(10) % 2, 0.4, 1.0)
    canvas.polygon(
        [(u + s * np.cos(a), v + s * np.sin(a)) for a, s in zip(angles, sizes, strict=True)], color
    )
