"""Tins: a cylinder with metal rims and a printed label."""

from libero_env.objects.builtin.assemble import Look
from libero_env.objects.builtin.mesh import Ring, loft
from libero_env.objects.builtin.paint import Canvas, Color

STEEL, DARK_STEEL, BRIGHT_STEEL = (168, 172, 178), (118, 122, 128), (212, 216, 220)
LABEL = (0.10, 0.80)  # part of the texture's height that the label takes


def alphabet_soup() -> Look:
    """Blue label, a bowl of orange soup with letters in it."""
    canvas = _tin((28, 78, 176))
    canvas.band(0.10, 0.22, (247, 190, 40))
    canvas.band(0.76, 0.80, (247, 190, 40))
    for u in (0.0, 0.5, 1.0):
        canvas.text("ABC", (u - 0.16, 0.52, u + 0.16, 0.73), (255, 255, 255))
        canvas.disc(u, 0.36, 0.15, 0.13, (250, 250, 245))
        canvas.disc(u, 0.38, 0.125, 0.095, (240, 120, 30))
        canvas.text("SOUP", (u - 0.10, 0.33, u + 0.10, 0.44), (255, 240, 190))
    return Look(_can(), canvas.png(), specular=0.5, shininess=0.6)


def tomato_sauce() -> Look:
    """Red label, a green band with the name, tomatoes on white."""
    canvas = _tin((198, 28, 24))
    canvas.band(0.10, 0.36, (245, 240, 228))
    canvas.band(0.40, 0.60, (30, 130, 56))
    for u in (0.0, 0.5, 1.0):
        canvas.text("SAUCE", (u - 0.13, 0.43, u + 0.13, 0.57), (255, 255, 255))
        canvas.text("TOMATO", (u - 0.16, 0.63, u + 0.16, 0.77), (255, 232, 150))
        for shift in (-0.12, 0.0, 0.12):
            _tomato(canvas, u + shift, 0.22, 0.055, 0.095)
    return Look(_can(), canvas.png(), specular=0.5, shininess=0.6)


LOOKS = {"alphabet_soup": alphabet_soup, "tomato_sauce": tomato_sauce}


def _can():
    bottom, top, radius = -0.0390, 0.0410, 0.0308
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
