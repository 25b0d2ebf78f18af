"""Mugs: turned cups with a handle on one side."""

from libero_env.objects.builtin.assemble import Appearance
from libero_env.objects.builtin.mesh import Mesh, merge, sweep
from libero_env.objects.builtin.paint import Canvas, Color
from libero_env.objects.builtin.vessels import FLOOR_V, INNER_V, RIM_V, SPARE, Profile, vessel

SEGMENTS = 22


def red_coffee_mug() -> Appearance:
    """Return the red coffee mug: tall red mug, lighter inside."""
    canvas = _glaze((186, 22, 20), inside=(206, 44, 36), depth=(112, 12, 12))
    outside = [
        (0.0, 0.0010),
        (0.0345, 0.0),
        (0.0360, 0.0030),
        (0.0378, 0.0440),
        (0.0392, 0.0760),
        (0.0405, 0.1080),
        (0.0416, 0.1240),
        (0.0434, 0.1310),
        (0.0436, 0.1330),
    ]
    inside = [
        (0.0418, 0.1342),
        (0.0395, 0.1310),
        (0.0374, 0.1220),
        (0.0352, 0.1000),
        (0.0322, 0.0400),
        (0.0308, 0.0140),
        (0.0275, 0.0092),
        (0.0, 0.0085),
    ]
    path = [
        (-0.0195, 0.1090),
        (-0.0390, 0.1125),
        (-0.0505, 0.1095),
        (-0.0560, 0.0990),
        (-0.0572, 0.0840),
        (-0.0530, 0.0690),
        (-0.0370, 0.0500),
        (-0.0155, 0.0290),
    ]
    body = vessel(outside, inside, segments=SEGMENTS, center=(-0.001, 0.0178))
    return Appearance(
        merge([body, _handle(path, (0.0070, 0.0032))]), canvas.png(), specular=0.5, shininess=0.6
    )


def porcelain_mug() -> Appearance:
    """Return the porcelain mug: white mug with a round belly."""
    canvas = _glaze((243, 242, 240), inside=(240, 239, 236), depth=(186, 184, 180))
    canvas.gradient(0.04, 0.20, (206, 204, 200), (243, 242, 240))
    outside = [
        (0.0, 0.0010),
        (0.0260, 0.0),
        (0.0300, 0.0022),
        (0.0365, 0.0145),
        (0.0415, 0.0330),
        (0.0447, 0.0560),
        (0.0460, 0.0800),
        (0.0462, 0.1080),
        (0.0456, 0.1105),
    ]
    inside = [
        (0.0440, 0.1115),
        (0.0424, 0.1090),
        (0.0404, 0.0980),
        (0.0403, 0.0650),
        (0.0385, 0.0440),
        (0.0350, 0.0280),
        (0.0265, 0.0140),
        (0.0, 0.0120),
    ]
    path = [
        (0.0250, 0.0960),
        (0.0440, 0.0870),
        (0.0560, 0.0760),
        (0.0602, 0.0640),
        (0.0600, 0.0500),
        (0.0545, 0.0370),
        (0.0420, 0.0285),
        (0.0205, 0.0180),
    ]
    body = vessel(outside, inside, segments=SEGMENTS, center=(-0.0016, -0.0162))
    return Appearance(
        merge([body, _handle(path, (0.0080, 0.0042))]), canvas.png(), specular=0.5, shininess=0.7
    )


def white_yellow_mug() -> Appearance:
    """Return the white yellow mug: mug that is white above and yellow below and inside, with a yellow handle."""
    white, yellow = (244, 242, 236), (240, 184, 36)
    canvas = _glaze(white, inside=yellow, depth=(176, 128, 20))
    canvas.band(0.0, 0.265, yellow)
    canvas.band(RIM_V - 0.012, INNER_V + 0.01, white)
    canvas.band(FLOOR_V + 0.01, 1.0, yellow)
    outside = [
        (0.0, 0.0010),
        (0.0255, 0.0),
        (0.0345, 0.0085),
        (0.0385, 0.0180),
        (0.0412, 0.0360),
        (0.0442, 0.0590),
        (0.0478, 0.0860),
        (0.0500, 0.1020),
        (0.0495, 0.1035),
    ]
    inside = [
        (0.0465, 0.1044),
        (0.0445, 0.1010),
        (0.0405, 0.0840),
        (0.0368, 0.0440),
        (0.0335, 0.0200),
        (0.0275, 0.0095),
        (0.0, 0.0060),
    ]
    path = [
        (-0.0265, 0.0775),
        (-0.0480, 0.0797),
        (-0.0595, 0.0795),
        (-0.0640, 0.0735),
        (-0.0642, 0.0550),
        (-0.0640, 0.0375),
        (-0.0590, 0.0308),
        (-0.0450, 0.0274),
        (-0.0180, 0.0218),
    ]
    body = vessel(outside, inside, segments=SEGMENTS, center=(-0.0008, 0.0180))
    handle = _handle(path, (0.0086, 0.0041), round=3.5)
    return Appearance(merge([body, handle]), canvas.png(), specular=0.5, shininess=0.7)


APPEARANCES = {
    "porcelain_mug": porcelain_mug,
    "red_coffee_mug": red_coffee_mug,
    "white_yellow_mug": white_yellow_mug,
}


def _glaze(color: Color, *, inside: Color, depth: Color) -> Canvas:
    # The inside darkens towards the floor.
    canvas = Canvas(color, (64, 256))
    canvas.band(INNER_V, 0.92, inside)
    canvas.gradient(INNER_V + 0.04, FLOOR_V, inside, depth)
    return canvas


def _handle(path: Profile, half: tuple[float, float], round: float = 2.6) -> Mesh:
    # Its ends, points (y, z), lie inside the wall.
    points = [(0.0, y, z) for y, z in path]
    return sweep(points, [half] * len(points), (1.0, 0.0, 0.0), 8, SPARE, round)
