"""Tins: a cylinder with metal rims and a printed label."""

import numpy as np

from libero_env.objects.builtin.assemble import Appearance
from libero_env.objects.builtin.mesh import Mesh, Ring, loft
from libero_env.objects.builtin.paint import Canvas, Color

STEEL, DARK_STEEL, BRIGHT_STEEL = (168, 172, 178), (118, 122, 128), (212, 216, 220)
LABEL = (0.10, 0.80)  # part of the texture's height that the label takes


def alphabet_soup() -> Appearance:
    """Return the alphabet soup: blue label, a bowl of orange soup with letters in it."""
    canvas = _tin((28, 78, 176))
    canvas.band(0.10, 0.22, (247, 190, 40))
    canvas.band(0.76, 0.80, (247, 190, 40))
    for u in (0.0, 0.5, 1.0):
        canvas.text("ABC", (u - 0.16, 0.52, u + 0.16, 0.73), (255, 255, 255))
        canvas.disc(u, 0.36, 0.15, 0.13, (250, 250, 245))
        canvas.disc(u, 0.38, 0.125, 0.095, (240, 120, 30))
        canvas.text("SOUP", (u - 0.10, 0.33, u + 0.10, 0.44), (255, 240, 190))
    return Appearance(_can(), canvas.png(), specular=0.5, shininess=0.6)


def tomato_sauce() -> Appearance:
    """Return the tomato sauce: red label, a green band with the name, tomatoes on white."""
    canvas = _tin((198, 28, 24))
    canvas.band(0.10, 0.36, (245, 240, 228))
    canvas.band(0.40, 0.60, (30, 130, 56))
    for u in (0.0, 0.5, 1.0):
        canvas.text("SAUCE", (u - 0.13, 0.43, u + 0.13, 0.57), (255, 255, 255))
        canvas.text("TOMATO", (u - 0.16, 0.63, u + 0.16, 0.77), (255, 232, 150))
        for shift in (-0.12, 0.0, 0.12):
            _tomato(canvas, u + shift, 0.22, 0.055, 0.095)
    return Appearance(_can(), canvas.png(), specular=0.5, shininess=0.6)


def cherries() -> Appearance:
    """Return the cherries: wide pink tin, cherries on a white oval, dark letters."""
    canvas = _tin((244, 176, 194))
    canvas.band(0.10, 0.16, (142, 16, 56))
    canvas.band(0.56, 0.76, (142, 16, 56))
    for u in (0.0, 0.5, 1.0):
        canvas.text("CHERRIES", (u - 0.15, 0.59, u + 0.15, 0.73), (255, 255, 255))
        canvas.disc(u, 0.35, 0.150, 0.175, (255, 250, 246))
        for shift, lower in ((-0.050, 0.0), (0.055, -0.03)):
            stalk = [(u + shift, 0.33 + lower), (u + 0.02, 0.49)]
            canvas.line(stalk, 0.008, (74, 122, 44))
            canvas.disc(u + shift, 0.29 + lower, 0.046, 0.080, (172, 14, 42))
            canvas.disc(u + shift - 0.016, 0.32 + lower, 0.012, 0.020, (244, 150, 164))
        canvas.polygon(
            [(u + 0.02, 0.49), (u + 0.06, 0.505), (u + 0.105, 0.46), (u + 0.06, 0.455)], (74, 150, 54)
        )
    return Appearance(_can(-0.0402, 0.0400, 0.0325), canvas.png(), specular=0.5, shininess=0.6)


def corn() -> Appearance:
    """Return the corn: tall green tin, an ear of corn on cream, yellow letters."""
    canvas = _tin((34, 124, 60))
    canvas.band(0.10, 0.14, (250, 206, 40))
    canvas.band(0.14, 0.50, (252, 244, 214))
    canvas.band(0.50, 0.53, (250, 206, 40))
    for u in (0.0, 0.5, 1.0):
        canvas.text("CORN", (u - 0.15, 0.57, u + 0.15, 0.76), (255, 222, 60))
        _ear(canvas, u, 0.32)
    return Appearance(_can(-0.0440, 0.0440, 0.0315), canvas.png(), specular=0.5, shininess=0.6)


APPEARANCES = {
    "alphabet_soup": alphabet_soup,
    "cherries": cherries,
    "corn": corn,
    "tomato_sauce": tomato_sauce,
}


def _can(bottom: float = -0.0390, top: float = 0.0410, radius: float = 0.0308) -> Mesh:
    profile = [  # height, radius, v, sharp edge
        (bottom + 0.001, 0.0, 0.00, False),
        (bottom, radius - 0.001, 0.02, True),
        (bottom + 0.001, radius + 0.0008, 0.04, False),
        (bottom + 0.004, radius, LABEL[0], True),
        (top - 0.004, radius, LABEL[1], True),
        (top - 0.001, radius + 0.0010, 0.84, False),
        (top, radius, 0.88, True),
        (top - 0.0025, radius - 0.0030, 0.91, True),
        (top - 0.0020, 0.0, 0.98, False),
    ]
    return loft([Ring(z, r, r, v, crease=crease) for z, r, v, crease in profile], segments=18)


def _tin(label: Color) -> Canvas:
    canvas = Canvas(STEEL, (256, 128))
    canvas.band(0.0, 0.04, DARK_STEEL)
    canvas.band(*LABEL, label)
    canvas.band(0.84, 0.88, BRIGHT_STEEL)
    canvas.band(0.88, 0.91, DARK_STEEL)
    canvas.band(0.945, 0.955, BRIGHT_STEEL)
    return canvas


def _tomato(canvas: Canvas, u: float, v: float, ru: float, rv: float) -> None:
    canvas.disc(u, v, ru, rv, (214, 38, 26))
    canvas.disc(u - ru * 0.35, v + rv * 0.3, ru * 0.22, rv * 0.2, (245, 130, 110))
    leaf = [(u - ru * 0.6, v + rv), (u, v + rv * 0.45), (u + ru * 0.6, v + rv), (u, v + rv * 0.8)]
    canvas.polygon(leaf, (40, 130, 50))


def _ear(canvas: Canvas, u: float, v: float) -> None:
    """Draw an ear of corn along u: kernels in rows, husks on the left."""
    canvas.disc(u, v, 0.130, 0.105, (238, 176, 24))
    for row in (-2, -1, 0, 1, 2):
        reach = 0.115 * np.sqrt(1.0 - (row / 2.9) ** 2)
        for at in np.arange(-reach, reach + 0.001, 0.026):
            canvas.disc(u + at + 0.006 * (row % 2), v + 0.038 * row, 0.0115, 0.017, (255, 222, 84))
    for tip in (-0.06, 0.0, 0.06):
        husk = [
            (u - 0.165, v + 0.3 * tip),
            (u - 0.05, v + 1.9 * tip + 0.02),
            (u - 0.01, v + 1.6 * tip - 0.02),
        ]
        canvas.polygon([*husk, (u - 0.13, v + 0.3 * tip - 0.045)], (96, 164, 60) if tip else (70, 138, 50))
