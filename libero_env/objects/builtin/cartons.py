"""Drink cartons: a square body, a gabled roof with a fin on top."""

import numpy as np

from libero_env.objects.builtin.assemble import Appearance
from libero_env.objects.builtin.mesh import Mesh, box, merge, quad
from libero_env.objects.builtin.paint import Canvas

HALF, BOTTOM, EAVES, RIDGE, TOP = 0.0266, -0.0698, 0.0370, 0.0600, 0.0705
EAVES_V, RIDGE_V = 0.66, 0.86  # heights in the texture, whose four equal columns are left, front, right, back
FRONTS = (0.375, 0.875)
SIDES = (0.125, 0.625)


def milk() -> Appearance:
    """Return the milk: red and white, the word MILK, a cow on green grass."""
    canvas = Canvas((206, 30, 34), (256, 128))
    canvas.band(0.0, 0.40, (196, 226, 246))
    canvas.band(0.0, 0.08, (60, 150, 60))
    canvas.band(RIDGE_V, 1.0, (244, 244, 240))
    for u in FRONTS:
        canvas.polygon([(u - 0.125, 0.34), (u + 0.125, 0.42), (u + 0.125, 0.34)], (206, 30, 34))
        canvas.text("MILK", (u - 0.105, 0.43, u + 0.105, 0.62), (255, 255, 255))
        canvas.text("MILK", (u - 0.085, 0.69, u + 0.085, 0.82), (255, 255, 255))
        _cow(canvas, u)
    for u in SIDES:
        canvas.rect(u - 0.09, 0.14, u + 0.09, 0.34, (250, 250, 250))
        for v in (0.18, 0.23, 0.28):
            canvas.rect(u - 0.07, v, u + 0.07, v + 0.02, (120, 140, 170))
        canvas.text("MILK", (u - 0.07, 0.45, u + 0.07, 0.58), (255, 255, 255))
    return Appearance(_carton(), canvas.png(), specular=0.2)


def orange_juice() -> Appearance:
    """Return the orange juice: yellow with a sliced orange and the word JUICE."""
    canvas = Canvas((252, 208, 40), (256, 128))
    canvas.band(0.60, EAVES_V, (240, 120, 20))
    canvas.band(EAVES_V, RIDGE_V, (244, 136, 24))
    canvas.band(RIDGE_V, 1.0, (244, 244, 240))
    canvas.band(0.0, 0.04, (40, 130, 50))
    for u in FRONTS:
        canvas.text("JUICE", (u - 0.105, 0.43, u + 0.105, 0.57), (30, 100, 40))
        canvas.text("ORANGE", (u - 0.10, 0.70, u + 0.10, 0.81), (255, 250, 220))
        _orange_slice(canvas, u, 0.23, 0.098)
    for u in SIDES:
        _orange_slice(canvas, u, 0.23, 0.070)
        canvas.text("OJ", (u - 0.05, 0.43, u + 0.05, 0.57), (30, 100, 40))
    return Appearance(_carton(), canvas.png(), specular=0.2)


APPEARANCES = {"milk": milk, "orange_juice": orange_juice}


def _carton() -> Mesh:
    names = ("left", "front", "right", "back")
    cells = {name: (0.25 * i, 0.005, 0.25 * (i + 1), EAVES_V) for i, name in enumerate(names)}
    white, inside = (0.1, 0.93, 0.12, 0.95), (0.1, 0.97, 0.12, 0.99)
    center, half = 0.5 * (BOTTOM + EAVES), 0.5 * (EAVES - BOTTOM)
    body = box((HALF, HALF, half), (0, 0, center), {**cells, "top": inside, "bottom": white})
    fin_cells = dict.fromkeys(("left", "right", "top", "bottom"), white)
    fin_cells |= {"front": (0.25, 0.88, 0.5, 0.99), "back": (0.75, 0.88, 1.0, 0.99)}
    fin = box((0.0012, HALF, 0.5 * (TOP - RIDGE)), (0, 0, 0.5 * (TOP + RIDGE)), fin_cells)
    return merge([body, fin, *_roof()])


def _roof() -> list[Mesh]:
    h, e, r = HALF, EAVES, RIDGE
    front = [(h, -h, e), (h, h, e), (0, h, r), (0, -h, r)]
    back = [(-x, -y, z) for x, y, z in front]
    slopes = [
        quad(front, (0.25, EAVES_V, 0.5, RIDGE_V)),
        quad(back, (0.75, EAVES_V, 1.0, RIDGE_V)),
    ]
    return [*slopes, *(_gable(side) for side in (-1, 1))]


def _gable(side: int) -> Mesh:
    # The folded side leans inwards under the fin.
    u = 0.0 if side < 0 else 0.5
    corners = np.array([(-HALF, HALF, EAVES), (HALF, HALF, EAVES), (0, HALF - 0.004, RIDGE)]) * (1, side, 1)
    faces = np.array([(0, 2, 1)]) if side > 0 else np.array([(0, 1, 2)])
    return Mesh(corners, faces, np.array([(u, EAVES_V), (u + 0.25, EAVES_V), (u + 0.125, RIDGE_V)]))


def _cow(canvas: Canvas, u: float) -> None:
    black, white = (30, 30, 34), (250, 250, 250)
    for leg in (-0.055, -0.03, 0.025, 0.05):
        canvas.rect(u + leg, 0.06, u + leg + 0.014, 0.16, white)
    canvas.rect(u - 0.06, 0.13, u + 0.065, 0.25, white)
    canvas.rect(u - 0.105, 0.20, u - 0.05, 0.30, white)
    canvas.disc(u - 0.01, 0.21, 0.028, 0.045, black)
    canvas.disc(u + 0.045, 0.18, 0.020, 0.05, black)
    canvas.rect(u - 0.105, 0.19, u - 0.085, 0.23, (240, 160, 170))
    canvas.rect(u - 0.075, 0.26, u - 0.05, 0.31, black)


def _orange_slice(canvas: Canvas, u: float, v: float, radius: float) -> None:
    # The texture is twice as wide as high.
    for share, color in ((1.0, (236, 110, 10)), (0.88, (255, 226, 160)), (0.78, (248, 146, 26))):
        canvas.disc(u, v, radius * share, 1.7 * radius * share, color)
    for angle in np.arange(4) * np.pi / 4:
        du, dv = radius * 0.76 * np.cos(angle), 1.7 * radius * 0.76 * np.sin(angle)
        canvas.line([(u - du, v - dv), (u + du, v + dv)], 0.006, (255, 226, 160))
