"""Tableware: two bowls, a plate, a ramekin, and a set of cutlery on its cloth."""

from libero_env.objects.builtin.assemble import Appearance
from libero_env.objects.builtin.mesh import Mesh, box, merge, sweep
from libero_env.objects.builtin.paint import Canvas
from libero_env.objects.builtin.vessels import FLOOR_V, INNER_V, RIM_V, vessel

FLUTES = 14  # number on each half


def akita_black_bowl() -> Appearance:
    """Return the akita black bowl: black glazed bowl with a worn rim and brush strokes inside."""
    canvas = Canvas((22, 22, 25), (128, 128))
    canvas.gradient(0.15, RIM_V, (16, 16, 18), (46, 46, 51))
    canvas.gradient(INNER_V, FLOOR_V, (40, 40, 44), (16, 16, 18))
    for u, v in ((0.10, 0.50), (0.55, 0.50), (0.30, 0.56), (0.75, 0.58), (0.05, 0.64), (0.50, 0.66)):
        canvas.line([(u, v), (u + 0.16, v + 0.03), (u + 0.28, v + 0.10)], 0.016, (62, 62, 66))
    canvas.band(RIM_V - 0.012, INNER_V + 0.006, (92, 84, 76))
    outside = [
        (0.0, 0.0016),
        (0.0230, 0.0016),
        (0.0245, 0.0032),
        (0.0345, 0.0085),
        (0.0430, 0.0140),
        (0.0475, 0.0215),
        (0.0510, 0.0360),
        (0.0542, 0.0505),
        (0.0546, 0.0518),
    ]
    inside = [
        (0.0515, 0.0520),
        (0.0505, 0.0500),
        (0.0475, 0.0360),
        (0.0440, 0.0220),
        (0.0400, 0.0160),
        (0.0245, 0.0070),
        (0.0, 0.0066),
    ]
    return Appearance(vessel(outside, inside), canvas.png(), specular=0.7, shininess=0.7)


def white_bowl() -> Appearance:
    """Return the white bowl: small white bowl."""
    canvas = Canvas((240, 239, 234), (64, 128))
    canvas.gradient(INNER_V, FLOOR_V, (240, 239, 234), (206, 204, 198))
    canvas.gradient(0.0, 0.25, (188, 186, 180), (240, 239, 234))
    canvas.band(RIM_V - 0.01, INNER_V + 0.01, (252, 252, 250))
    outside = [
        (0.0, 0.0005),
        (0.0170, 0.0005),
        (0.0180, 0.0022),
        (0.0255, 0.0060),
        (0.0325, 0.0105),
        (0.0362, 0.0165),
        (0.0388, 0.0255),
        (0.0406, 0.0340),
        (0.0409, 0.0348),
    ]
    inside = [
        (0.0390, 0.0351),
        (0.0382, 0.0335),
        (0.0362, 0.0255),
        (0.0338, 0.0172),
        (0.0305, 0.0122),
        (0.0180, 0.0049),
        (0.0, 0.0044),
    ]
    return Appearance(vessel(outside, inside), canvas.png(), specular=0.5, shininess=0.6)


def plate() -> Appearance:
    """Return the plate: white dinner plate with a red-brown rim and a fine line inside it."""
    canvas = Canvas((244, 242, 236), (64, 256))
    canvas.gradient(0.0, 0.28, (206, 204, 198), (244, 242, 236))
    rim = INNER_V - 0.01
    canvas.band(RIM_V - 0.02, rim + 0.078, (146, 42, 34))
    canvas.band(rim + 0.094, rim + 0.106, (146, 42, 34))
    canvas.gradient(0.66, 0.74, (244, 242, 236), (228, 225, 218))
    canvas.gradient(0.74, 0.78, (228, 225, 218), (244, 242, 236))
    outside = [
        (0.0, 0.0004),
        (0.0425, 0.0),
        (0.0445, 0.0010),
        (0.0560, 0.0058),
        (0.0640, 0.0105),
        (0.0684, 0.0148),
        (0.0686, 0.0158),
    ]
    inside = [
        (0.0675, 0.0164),
        (0.0655, 0.0152),
        (0.0580, 0.0112),
        (0.0480, 0.0078),
        (0.0400, 0.0054),
        (0.0320, 0.0045),
        (0.0, 0.0045),
    ]
    return Appearance(vessel(outside, inside, segments=32), canvas.png(), specular=0.4, shininess=0.6)


def glazed_rim_porcelain_ramekin() -> Appearance:
    """Return the glazed rim porcelain ramekin: white fluted ramekin with a smooth glazed rim."""
    canvas = Canvas((246, 246, 246), (256, 128))
    canvas.gradient(INNER_V + 0.02, FLOOR_V, (236, 237, 240), (206, 208, 214))
    for index in range(FLUTES):
        u = (index + 0.5) / FLUTES
        for share, color in ((0.32, (222, 224, 229)), (0.22, (204, 207, 214)), (0.11, (190, 194, 202))):
            canvas.rect(
                u - share / FLUTES, 0.235 - 0.02 * share, u + share / FLUTES, 0.375 + 0.02 * share, color
            )
    canvas.band(0.385, 0.392, (206, 208, 214))
    canvas.band(RIM_V - 0.018, INNER_V + 0.014, (222, 206, 176))
    outside = [
        (0.0, 0.0004),
        (0.0360, 0.0004),
        (0.0378, 0.0014),
        (0.0400, 0.0120),
        (0.0416, 0.0315),
        (0.0438, 0.0350),
        (0.0443, 0.0395),
        (0.0437, 0.0425),
    ]
    inside = [
        (0.0420, 0.0433),
        (0.0400, 0.0415),
        (0.0375, 0.0370),
        (0.0360, 0.0310),
        (0.0342, 0.0110),
        (0.0320, 0.0080),
        (0.0, 0.0073),
    ]
    return Appearance(vessel(outside, inside, segments=28), canvas.png(), specular=0.5, shininess=0.7)


def dining_set_group() -> Appearance:
    """Return the dining set group: fork and knife, two spoons, and the linen cloth below."""
    canvas = Canvas((236, 232, 222), (128, 128))
    for u0, v0, u1, v1 in ((0.03, 0.05, 0.97, 0.08), (0.03, 0.92, 0.97, 0.95)):
        canvas.rect(u0, v0, u1, v1, (92, 116, 160))
    for u in (0.03, 0.955):
        canvas.rect(u, 0.05, u + 0.015, 0.95, (92, 116, 160))
    canvas.rect(*STEEL, (150, 153, 158))
    cloth = box((0.14, 0.08, 0.0005), (0.0, 0.0, -0.0175), dict.fromkeys(_FACES, (0.02, 0.03, 0.98, 0.97)))
    pieces = [_fork(0.0865), _knife(0.1122), *_spoons()]
    return Appearance(merge([cloth, *pieces]), canvas.png(), specular=0.6, shininess=0.6)


APPEARANCES = {
    "akita_black_bowl": akita_black_bowl,
    "dining_set_group": dining_set_group,
    "glazed_rim_porcelain_ramekin": glazed_rim_porcelain_ramekin,
    "plate": plate,
    "white_bowl": white_bowl,
}

STEEL = (0.0, 0.0, 1.0, 0.02)  # part of the cutlery's texture
_FACES = ("front", "back", "left", "right", "top", "bottom")
_HANDLE = [(0.050, 0.0008), (0.030, 0.0016), (0.010, 0.0024), (-0.012, 0.0032), (-0.030, 0.0032)]
_HANDLE_WIDTH = [0.0040, 0.0046, 0.0034, 0.0018, 0.0018]


def _strip(x: float, line: list[tuple[float, float]], width: list[float], thick: float = 0.0009) -> Mesh:
    # flat metal along y, given by (y, z) points and half widths
    path = [(x, y, z) for y, z in line]
    return sweep(path, [(w, thick) for w in width], (1.0, 0.0, 0.0), 6, STEEL)


def _spoons() -> list[Mesh]:
    short = [(0.050, 0.0006), (0.030, 0.0014), (0.014, 0.0024), (0.0, 0.0028)]
    return [
        _spoon(-0.0836, _HANDLE, _HANDLE_WIDTH, 1.0, end=-0.0725),
        _spoon(-0.1099, short, [0.0026, 0.0030, 0.0014, 0.0013], 0.7, end=-0.033),
    ]


def _spoon(x: float, line: list[tuple[float, float]], width: list[float], size: float, end: float) -> Mesh:
    bowl = [  # from the tip, height, half width
        (0.0405, 0.0022, 0.0040),
        (0.0320, 0.0018, 0.0086),
        (0.0200, 0.0030, 0.0122),
        (0.0080, 0.0081, 0.0098),
        (0.0020, 0.0121, 0.0058),
        (0.0, 0.0138, 0.0010),
    ]
    line = [*line, *((end + away * size, height * size) for away, height, _ in bowl)]
    return _strip(x, line, [*width, *(half * size for _, _, half in bowl)])


def _fork(x: float) -> Mesh:
    head = _strip(x, [*_HANDLE, (-0.040, 0.0020), (-0.050, 0.0028)], [*_HANDLE_WIDTH, 0.0060, 0.0076])
    tines = [
        _strip(x + shift, [(-0.048, 0.0026), (-0.060, 0.0062), (-0.072, 0.0130)], [0.0012, 0.0012, 0.0005])
        for shift in (-0.0060, -0.0020, 0.0020, 0.0060)
    ]
    return merge([head, *tines])


def _knife(x: float) -> Mesh:
    blade = [(-0.024, 0.0036), (-0.045, 0.0050), (-0.064, 0.0044), (-0.073, 0.0008)]  # y, half width
    line = [(0.050, 0.0010), (0.030, 0.0014), (-0.020, 0.0016), *((y, 0.0018) for y, _ in blade)]
    return _strip(x, line, [0.0040, 0.0046, 0.0028, *(half for _, half in blade)], 0.0010)
