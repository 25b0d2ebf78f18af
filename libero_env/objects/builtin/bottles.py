"""Sauce bottles and a jar: lofts with a label on both sides and a coloured cap."""

from collections.abc import Sequence

from libero_env.objects.builtin.assemble import Appearance
from libero_env.objects.builtin.mesh import Mesh, Ring, loft
from libero_env.objects.builtin.paint import Canvas, Color

CAP = 0.80  # height in the texture that separates body and cap


def ketchup() -> Appearance:
    """Return the ketchup: red squeeze bottle, white cap, white shield with a tomato."""
    canvas = _bottle((196, 24, 16), cap=(240, 240, 236), groove=(198, 198, 196))
    for u in (0.0, 0.5, 1.0):
        canvas.disc(u, 0.36, 0.165, 0.24, (250, 246, 236))
        canvas.rect(u - 0.165, 0.37, u + 0.165, 0.48, (34, 122, 52))
        canvas.text("KETCHUP", (u - 0.15, 0.39, u + 0.15, 0.46), (255, 255, 255))
        canvas.disc(u, 0.25, 0.065, 0.085, (222, 40, 24))
        canvas.polygon([(u - 0.04, 0.345), (u, 0.30), (u + 0.04, 0.345)], (40, 130, 50))
    return Appearance(_ketchup_mesh(), canvas.png(), specular=0.5, shininess=0.6)


def salad_dressing() -> Appearance:
    """Return the salad dressing: white bottle with a waist, green cap, a leaf and the word RANCH."""
    canvas = _bottle((246, 244, 236), cap=(22, 128, 58), groove=(12, 92, 40))
    for u in (0.0, 0.5, 1.0):
        canvas.disc(u, 0.36, 0.165, 0.25, (112, 178, 60))
        canvas.disc(u, 0.36, 0.14, 0.21, (250, 250, 244))
        canvas.text("RANCH", (u - 0.125, 0.34, u + 0.125, 0.45), (60, 40, 130))
        canvas.disc(u - 0.04, 0.25, 0.045, 0.055, (240, 130, 36))
        canvas.disc(u + 0.045, 0.25, 0.05, 0.05, (60, 150, 56))
        canvas.disc(u, 0.50, 0.05, 0.03, (60, 150, 56))
    return Appearance(_salad_mesh(), canvas.png(), specular=0.4, shininess=0.5)


def bbq_sauce() -> Appearance:
    """Return the bbq sauce: brown bottle, orange cap, yellow label with flames."""
    canvas = _bottle((92, 36, 18), cap=(226, 84, 20), groove=(176, 56, 10))
    for u in (0.0, 0.5, 1.0):
        canvas.disc(u, 0.36, 0.165, 0.25, (250, 186, 44))
        canvas.disc(u, 0.36, 0.145, 0.215, (128, 26, 18))
        canvas.text("BBQ", (u - 0.12, 0.36, u + 0.12, 0.50), (255, 222, 90))
        for shift, height in ((-0.075, 0.10), (0.0, 0.15), (0.075, 0.10)):
            flame = [(u + shift - 0.035, 0.20), (u + shift + 0.035, 0.20), (u + shift, 0.20 + height)]
            canvas.polygon(flame, (250, 140, 30))
    return Appearance(_bbq_mesh(), canvas.png(), specular=0.5, shininess=0.6)


def new_salad_dressing() -> dict[str, Appearance]:
    """Return the new salad dressing: the same bottle, on a body that stands beside its root."""
    return {"sald_dressing_body": salad_dressing()}


def mayo() -> Appearance:
    """Return the mayo: glass jar of cream, blue lid, blue label with a yellow band."""
    canvas = _bottle((250, 243, 218), cap=(24, 66, 158), groove=(14, 44, 116))
    canvas.band(0.10, 0.58, (30, 84, 182))
    canvas.band(0.10, 0.13, (250, 204, 44))
    canvas.band(0.55, 0.58, (250, 204, 44))
    for u in (0.0, 0.5, 1.0):
        canvas.disc(u, 0.34, 0.19, 0.175, (250, 204, 44))
        canvas.disc(u, 0.34, 0.178, 0.155, (255, 252, 240))
        canvas.text("MAYO", (u - 0.135, 0.29, u + 0.135, 0.42), (24, 66, 158))
        canvas.disc(u, 0.235, 0.030, 0.032, (250, 190, 40))
    return Appearance(_jar_mesh(), canvas.png(), specular=0.6, shininess=0.7)


APPEARANCES = {
    "bbq_sauce": bbq_sauce,
    "ketchup": ketchup,
    "mayo": mayo,
    "new_salad_dressing": new_salad_dressing,
    "salad_dressing": salad_dressing,
}


def _ketchup_mesh() -> Mesh:
    body = [  # height, depth, width
        (-0.0724, 0.0150, 0.0235),
        (-0.0690, 0.0185, 0.0285),
        (-0.0400, 0.0198, 0.0300),
        (-0.0050, 0.0196, 0.0272),
        (0.0250, 0.0178, 0.0190),
        (0.0360, 0.0150, 0.0155),
    ]
    cap = [(0.0360, 0.0165, 0.0165), (0.0700, 0.0152, 0.0152), (0.0732, 0.0130, 0.0130)]
    return _skin(body, cap, center=(0.0008, 0.0004))


def _salad_mesh() -> Mesh:
    body = [
        (-0.0727, 0.0145, 0.0180),
        (-0.0690, 0.0175, 0.0220),
        (-0.0400, 0.0198, 0.0298),
        (-0.0180, 0.0192, 0.0272),
        (0.0080, 0.0166, 0.0180),
        (0.0340, 0.0152, 0.0152),
    ]
    cap = [(0.0340, 0.0170, 0.0170), (0.0700, 0.0162, 0.0162), (0.0728, 0.0140, 0.0140)]
    return _skin(body, cap, center=(0.0002, -0.0005))


def _bbq_mesh() -> Mesh:
    body = [
        (-0.0546, 0.0120, 0.0195),
        (-0.0520, 0.0150, 0.0232),
        (-0.0250, 0.0158, 0.0240),
        (-0.0020, 0.0156, 0.0222),
        (0.0180, 0.0150, 0.0165),
        (0.0260, 0.0140, 0.0140),
    ]
    cap = [(0.0260, 0.0156, 0.0156), (0.0520, 0.0148, 0.0148), (0.0550, 0.0125, 0.0125)]
    return _skin(body, cap, center=(0.0, 0.0))


def _jar_mesh() -> Mesh:
    body = [
        (-0.0510, 0.0285, 0.0285),
        (-0.0490, 0.0312, 0.0312),
        (-0.0400, 0.0322, 0.0322),
        (0.0130, 0.0322, 0.0322),
        (0.0240, 0.0308, 0.0308),
        (0.0310, 0.0268, 0.0268),
    ]
    cap = [
        (0.0310, 0.0298, 0.0298),
        (0.0330, 0.0306, 0.0306),
        (0.0490, 0.0306, 0.0306),
        (0.0510, 0.0290, 0.0290),
    ]
    return _skin(body, cap, center=(0.0, 0.0))


Profile = Sequence[tuple[float, float, float]]


def _skin(body: Profile, cap: Profile, center: tuple[float, float]) -> Mesh:
    bottom, shoulder, top = body[0][0], body[-1][0], cap[-1][0]
    rings = [Ring(bottom, 0.0, 0.0, 0.0), Ring(*body[0], 0.01, round=2.4, crease=True)]
    for height, depth, width in body[1:]:
        v = (CAP - 0.01) * (height - bottom) / (shoulder - bottom)
        rings.append(Ring(height, depth, width, v, round=2.4))
    for height, depth, width in cap:
        v = CAP + 0.01 + 0.13 * (height - shoulder) / (top - shoulder)
        rings.append(Ring(height, depth, width, v, crease=True))
    rings.append(Ring(top, 0.0, 0.0, 0.96))
    return loft(rings, segments=16, center=center)


def _bottle(color: Color, *, cap: Color, groove: Color) -> Canvas:
    canvas = Canvas(color, (256, 128))
    canvas.band(CAP, 1.0, cap)
    canvas.band(CAP, CAP + 0.02, groove)
    canvas.band(CAP + 0.10, CAP + 0.115, groove)
    return canvas
