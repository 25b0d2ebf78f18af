"""Packets: butter, cream cheese, pudding powder, cookies, popcorn (lying) and macaroni (standing)."""

import numpy as np

from libero_env.objects.builtin.assemble import Appearance
from libero_env.objects.builtin.mesh import box
from libero_env.objects.builtin.paint import Canvas

# Parts of the texture: the large faces, the long sides, the short ends.
CELLS = {
    "top": (0.0, 0.0, 0.5, 1.0),
    "bottom": (0.0, 0.0, 0.5, 1.0),
    "left": (0.5, 0.8, 1.0, 1.0),
    "right": (0.5, 0.8, 1.0, 1.0),
    "front": (0.5, 0.5, 1.0, 0.75),
    "back": (0.5, 0.5, 1.0, 0.75),
}
UPRIGHT = {  # of a standing packet: the large faces, the sides, the lid
    "front": (0.0, 0.0, 0.5, 1.0),
    "back": (0.0, 0.0, 0.5, 1.0),
    "left": (0.5, 0.0, 0.7, 1.0),
    "right": (0.5, 0.0, 0.7, 1.0),
    "top": (0.7, 0.8, 1.0, 1.0),
    "bottom": (0.7, 0.0, 1.0, 0.2),
}
WHITE = (255, 252, 244)


def butter() -> Appearance:
    """Return the butter: yellow packet, red ends, a pat of butter."""
    canvas = Canvas((250, 214, 70), (128, 128))
    canvas.rect(0.0, 0.0, 0.5, 0.30, (204, 40, 30))
    canvas.rect(0.0, 0.30, 0.5, 0.34, (255, 250, 235))
    canvas.text("BUTTER", (0.10, 0.38, 0.40, 0.97), (196, 34, 26), turn=90)
    canvas.polygon([(0.10, 0.08), (0.34, 0.08), (0.34, 0.18), (0.10, 0.18)], (255, 236, 130))
    canvas.polygon([(0.10, 0.18), (0.34, 0.18), (0.42, 0.24), (0.18, 0.24)], (255, 246, 180))
    canvas.polygon([(0.34, 0.08), (0.42, 0.14), (0.42, 0.24), (0.34, 0.18)], (232, 196, 80))
    canvas.rect(0.5, 0.5, 1.0, 0.75, (204, 40, 30))
    canvas.text("BUTTER", (0.55, 0.55, 0.95, 0.70), (255, 240, 170))
    canvas.text("BUTTER", (0.58, 0.83, 0.92, 0.97), (196, 34, 26))
    return Appearance(box((0.0384, 0.0197, 0.0088), (0, 0, 0), CELLS), canvas.png(), specular=0.15)


def cream_cheese() -> Appearance:
    """Return the cream cheese: pale silver-blue packet with a blue oval."""
    canvas = Canvas((206, 216, 236), (128, 128))
    for v in (0.04, 0.92):
        canvas.rect(0.0, v, 0.5, v + 0.04, (120, 146, 206))
    canvas.disc(0.25, 0.5, 0.20, 0.36, (250, 250, 252))
    canvas.disc(0.25, 0.5, 0.175, 0.325, (52, 76, 176))
    canvas.text("CREAM", (0.125, 0.28, 0.235, 0.72), (255, 255, 255), turn=90)
    canvas.text("CHEESE", (0.265, 0.28, 0.375, 0.72), (255, 255, 255), turn=90)
    canvas.disc(0.75, 0.625, 0.18, 0.10, (52, 76, 176))
    canvas.text("CREAM", (0.63, 0.585, 0.87, 0.665), (255, 255, 255))
    canvas.text("CREAM CHEESE", (0.54, 0.84, 0.96, 0.96), (52, 76, 176))
    return Appearance(box((0.0410, 0.0213, 0.0092), (0, 0, 0), CELLS), canvas.png(), specular=0.4)


def chocolate_pudding() -> Appearance:
    """Return the chocolate pudding: dark brown packet, a cup of pudding with cream, cream-coloured letters."""
    canvas = Canvas((78, 40, 22), (128, 128))
    canvas.rect(0.0, 0.94, 0.5, 1.0, (214, 52, 34))
    canvas.text("PUDDING", (0.05, 0.36, 0.22, 0.92), (252, 224, 168), turn=90)
    canvas.text("CHOCOLATE", (0.28, 0.36, 0.40, 0.92), (240, 150, 90), turn=90)
    canvas.disc(0.25, 0.17, 0.19, 0.14, (246, 240, 226))
    canvas.disc(0.25, 0.17, 0.16, 0.115, (120, 64, 34))
    canvas.disc(0.25, 0.18, 0.08, 0.06, (255, 252, 240))
    canvas.rect(0.5, 0.5, 1.0, 0.53, (214, 52, 34))
    canvas.text("PUDDING", (0.55, 0.57, 0.95, 0.71), (252, 224, 168))
    canvas.text("PUDDING", (0.56, 0.83, 0.94, 0.97), (252, 224, 168))
    return Appearance(box((0.0412, 0.0238, 0.0141), (0.0, 0, 0.0006), CELLS), canvas.png(), specular=0.2)


def cookies() -> Appearance:
    """Return the cookies: red and white checks, a heap of cookies with raisins."""
    red, brown = (206, 34, 40), (84, 36, 44)
    canvas = Canvas(WHITE, (192, 192))
    canvas.rect(0.0, 0.12, 0.5, 0.62, (246, 214, 150))
    for v0, v1 in ((0.0, 0.12), (0.88, 1.0)):
        _checks(canvas, (0.0, v0, 0.5, v1), (6, 2), red)
    canvas.text("COOKIES", (0.03, 0.67, 0.47, 0.84), red)
    for u, v in ((0.13, 0.48), (0.37, 0.50), (0.12, 0.26), (0.38, 0.25), (0.25, 0.37)):
        _cookie(canvas, u, v, 0.125)
    for cell, text in (
        ((0.5, 0.8, 1.0, 1.0), (0.57, 0.83, 0.93, 0.97)),
        ((0.5, 0.5, 1.0, 0.75), (0.58, 0.54, 0.92, 0.71)),
    ):
        canvas.rect(*cell, red)
        canvas.text("COOKIES", text, WHITE)
    canvas.rect(0.5, 0.0, 1.0, 0.45, brown)
    return Appearance(box((0.0415, 0.0309, 0.0098), (0, 0, 0), CELLS), canvas.png(), specular=0.2)


def popcorn() -> Appearance:
    """Return the popcorn: blue packet, white puffs, red letters on a yellow burst."""
    blue, yellow, red = (32, 92, 190), (252, 216, 48), (210, 30, 34)
    canvas = Canvas(blue, (192, 192))
    _burst(canvas, 0.25, 0.58, 0.245, 0.32, yellow)
    canvas.rect(0.02, 0.49, 0.48, 0.68, WHITE)
    canvas.text("POPCORN", (0.04, 0.51, 0.46, 0.66), red)
    for u, v in (
        (0.07, 0.08),
        (0.21, 0.06),
        (0.36, 0.09),
        (0.45, 0.17),
        (0.13, 0.19),
        (0.29, 0.19),
        (0.06, 0.92),
        (0.44, 0.93),
    ):
        _puff(canvas, u, v)
    for v, height in ((0.90, 0.075), (0.625, 0.09)):
        canvas.rect(0.56, v - height, 0.94, v + height, yellow)
        canvas.text("POPCORN", (0.59, v - 0.7 * height, 0.91, v + 0.7 * height), red)
    return Appearance(box((0.0315, 0.0212, 0.0097), (0, 0, 0), CELLS), canvas.png(), specular=0.2)


def macaroni_and_cheese() -> Appearance:
    """Return the macaroni and cheese: orange packet that stands, yellow letters, a blue bowl of macaroni."""
    orange, yellow, blue = (232, 104, 22), (255, 220, 70), (28, 74, 150)
    canvas = Canvas(orange, (192, 192))
    canvas.rect(0.0, 0.0, 0.5, 0.12, (180, 52, 16))
    canvas.text("MACARONI", (0.03, 0.80, 0.47, 0.94), yellow)
    canvas.text("AND CHEESE", (0.05, 0.66, 0.45, 0.77), WHITE)
    _bowl_of_macaroni(canvas, blue)
    canvas.text("CREAMY", (0.15, 0.025, 0.35, 0.095), yellow)
    canvas.rect(0.5, 0.0, 0.7, 1.0, (214, 84, 16))
    canvas.text("MAC AND CHEESE", (0.555, 0.10, 0.645, 0.90), yellow, turn=90)
    canvas.rect(0.7, 0.8, 1.0, 1.0, (180, 52, 16))
    canvas.text("MACARONI", (0.73, 0.85, 0.97, 0.95), yellow)
    return Appearance(box((0.0136, 0.0430, 0.0582), (0, 0, 0), UPRIGHT), canvas.png(), specular=0.2)


APPEARANCES = {
    "butter": butter,
    "chocolate_pudding": chocolate_pudding,
    "cookies": cookies,
    "cream_cheese": cream_cheese,
    "macaroni_and_cheese": macaroni_and_cheese,
    "popcorn": popcorn,
}


def _checks(canvas: Canvas, cell: tuple[float, float, float, float], count: tuple[int, int], color) -> None:
    u0, v0, u1, v1 = cell
    du, dv = (u1 - u0) / count[0], (v1 - v0) / count[1]
    for i, j in np.ndindex(*count):
        if (i + j) % 2:
            canvas.rect(u0 + i * du, v0 + j * dv, u0 + (i + 1) * du, v0 + (j + 1) * dv, color)


def _cookie(canvas: Canvas, u: float, v: float, radius: float) -> None:
    ru, rv = 0.82 * radius, 1.20 * radius
    canvas.disc(u, v - 0.012, ru, rv, (140, 88, 40))
    canvas.disc(u, v, ru, rv, (204, 148, 80))
    canvas.disc(u - 0.1 * ru, v + 0.1 * rv, 0.75 * ru, 0.75 * rv, (220, 170, 102))
    for du, dv in ((-0.5, 0.3), (0.1, 0.6), (0.5, 0.1), (-0.1, -0.1), (-0.4, -0.5), (0.35, -0.5)):
        canvas.disc(u + du * ru, v + dv * rv, 0.15 * ru, 0.15 * rv, (78, 40, 36))


def _puff(canvas: Canvas, u: float, v: float) -> None:
    for du, dv, shade in ((0.0, -0.014, 214), (-0.026, 0.0, 238), (0.026, 0.004, 238), (0.0, 0.024, 252)):
        canvas.disc(u + du, v + dv, 0.030, 0.026, (shade, shade, min(shade, 240)))
    canvas.disc(u, v, 0.010, 0.009, (244, 200, 90))


def _burst(canvas: Canvas, u: float, v: float, ru: float, rv: float, color) -> None:
    angles = np.arange(24) * np.pi / 12
    sizes = np.where(np.arange(24) % 2, 0.72, 1.0)
    points = [(u + s * ru * np.cos(a), v + s * rv * np.sin(a)) for a, s in zip(angles, sizes, strict=True)]
    canvas.polygon(points, color)


def _bowl_of_macaroni(canvas: Canvas, color) -> None:
    canvas.disc(0.25, 0.36, 0.22, 0.22, color)
    canvas.disc(0.25, 0.43, 0.22, 0.13, (250, 236, 200))
    canvas.disc(0.25, 0.43, 0.19, 0.105, (244, 164, 30))
    rng = np.random.default_rng(5)
    for _ in range(26):
        way, reach, turn = rng.uniform(0, 2 * np.pi), np.sqrt(rng.uniform(0, 0.8)), rng.uniform(0, 2 * np.pi)
        u, v = 0.25 + 0.165 * reach * np.cos(way), 0.445 + 0.09 * reach * np.sin(way)
        arc = turn + np.linspace(0.0, 2.2, 6)
        points = [(u + 0.026 * np.cos(a), v + 0.026 * np.sin(a)) for a in arc]
        canvas.line(points, 0.022, (206, 116, 16))
        canvas.line(points, 0.014, (255, 212, 84))
