"""Kitchen pieces larger than a cup: moka pot, frying pan, wine bottle, bowl drainer."""

import numpy as np

from libero_env.objects.builtin.assemble import Appearance
from libero_env.objects.builtin.mesh import Mesh, Ring, faceted, loft, merge, sweep
from libero_env.objects.builtin.paint import Canvas
from libero_env.objects.builtin.vessels import FLOOR_V, INNER_V, RIM_V, SPARE, vessel

ACROSS = (1.0, 0.0, 0.0)  # normal of the planes of the handles
BLACK = (0.0, 0.0, 1.0, 0.03)  # parts of the moka pot's texture, below the metal
BRASS = (0.0, 0.04, 1.0, 0.06)
BOTTLE_TOP = 0.1586
BIN_CENTER = (-0.003, -0.0054)


def moka_pot() -> Appearance:
    """Return the moka pot: octagonal steel pot, spout to +y, black handle and knob."""
    canvas = Canvas((196, 199, 204), (128, 256))
    canvas.gradient(0.08, 0.45, (160, 163, 169), (206, 209, 213))
    canvas.band(0.45, 0.52, (120, 123, 130))
    canvas.gradient(0.52, 0.90, (196, 199, 204), (222, 224, 228))
    canvas.band(0.885, 0.90, (112, 114, 120))
    canvas.band(0.0, 0.035, (26, 26, 28))
    canvas.band(0.035, 0.07, (186, 148, 72))
    knob = [
        (0.0, 0.0670),
        (0.0045, 0.0670),
        (0.0052, 0.0750),
        (0.0074, 0.0830),
        (0.0070, 0.0868),
        (0.0, 0.0871),
    ]
    parts = [
        _moka_body(),
        _spout(),
        loft([Ring(z, r, r, 0.015) for r, z in knob], segments=10),
        _moka_handle(),
        sweep([(0.0, -0.0310, -0.0215), (0.0, -0.0405, -0.0215)], [(0.0045, 0.0045)] * 2, ACROSS, 8, BRASS),
    ]
    return Appearance(merge(parts), canvas.png(), specular=0.9, shininess=0.5)


def chefmate_8_frypan() -> Appearance:
    """Return the chefmate 8 frypan: black pan with a grey floor; its handle points to +y."""
    canvas = Canvas((24, 24, 26), (64, 128))
    canvas.gradient(INNER_V, 0.60, (34, 34, 37), (44, 44, 47))
    canvas.gradient(0.60, FLOOR_V, (58, 58, 61), (74, 74, 77))
    canvas.band(RIM_V - 0.008, INNER_V + 0.004, (92, 92, 96))
    canvas.rect(0.0, 0.94, 1.0, 1.0, (22, 22, 24))
    canvas.rect(0.0, 0.945, 1.0, 0.95, (120, 120, 124))
    outside = [
        (0.0, 0.0005),
        (0.0690, 0.0),
        (0.0745, 0.0035),
        (0.0835, 0.0110),
        (0.0905, 0.0220),
        (0.0960, 0.0330),
        (0.1005, 0.0405),
        (0.1012, 0.0418),
    ]
    inside = [
        (0.0985, 0.0422),
        (0.0930, 0.0340),
        (0.0870, 0.0225),
        (0.0810, 0.0140),
        (0.0740, 0.0118),
        (0.0, 0.0115),
    ]
    handle = [  # y, z, half width, half thickness
        (0.0960, 0.0200, 0.0115, 0.0085),
        (0.1060, 0.0205, 0.0110, 0.0085),
        (0.1180, 0.0240, 0.0100, 0.0075),
        (0.1290, 0.0310, 0.0095, 0.0065),
        (0.1420, 0.0370, 0.0110, 0.0062),
        (0.1700, 0.0410, 0.0130, 0.0062),
        (0.2100, 0.0460, 0.0118, 0.0060),
        (0.2420, 0.0500, 0.0130, 0.0058),
        (0.2560, 0.0515, 0.0110, 0.0050),
        (0.2605, 0.0522, 0.0060, 0.0030),
    ]
    grip = sweep(
        [(0.0, y, z) for y, z, _, _ in handle], [(w, t) for _, _, w, t in handle], ACROSS, 10, SPARE, 2.8
    )
    pan = vessel(outside, inside, segments=24, center=(0.0, 0.0075))
    return Appearance(merge([pan, grip]), canvas.png(), specular=0.5, shininess=0.5)


def wine_bottle() -> Appearance:
    """Return the wine bottle: dark green bottle with a cork and a pale label on both sides."""
    canvas = Canvas((14, 44, 24), (256, 256))
    canvas.gradient(0.0, 0.40, (10, 32, 18), (16, 54, 30))
    for u in (0.0, 0.5, 1.0):
        canvas.rect(u - 0.19, 0.085, u + 0.19, 0.335, (238, 228, 200))
        canvas.rect(u - 0.19, 0.31, u + 0.19, 0.322, (176, 140, 60))
        canvas.rect(u - 0.19, 0.098, u + 0.19, 0.11, (176, 140, 60))
        canvas.text("WINE", (u - 0.13, 0.215, u + 0.13, 0.29), (120, 20, 32))
        canvas.disc(u, 0.16, 0.05, 0.032, (120, 20, 32))
    canvas.band(0.905, 1.0, (206, 158, 100))
    profile = [
        (0.0, 0.0030),
        (0.0150, 0.0),
        (0.0200, 0.0005),
        (0.0214, 0.0040),
        (0.0214, 0.0560),
        (0.0203, 0.0660),
        (0.0176, 0.0760),
        (0.0138, 0.0860),
        (0.0106, 0.0960),
        (0.0086, 0.1060),
        (0.0074, 0.1180),
        (0.0070, 0.1340),
        (0.0080, 0.1350),
        (0.0080, 0.1425),
        (0.0072, 0.1440),
        (0.0066, 0.1445),
        (0.0068, 0.1575),
        (0.0060, BOTTLE_TOP),
        (0.0, BOTTLE_TOP),
    ]
    rings = [Ring(z, r, r, z / BOTTLE_TOP, crease=r in (0.0080, 0.0066)) for r, z in profile]
    return Appearance(loft(rings, segments=20), canvas.png(), specular=0.8, shininess=0.8)


def bowl_drainer() -> Appearance:
    """Return the bowl drainer: white bin with two compartments and handle slots in its walls."""
    canvas = Canvas((240, 240, 240), (1024, 128))
    canvas.gradient(0.0, 0.44, (206, 207, 210), (244, 244, 244))
    canvas.gradient(0.52, 0.92, (240, 240, 240), (188, 190, 194))
    for u in (0.0, 0.25, 0.5, 0.75, 1.0):
        for v, color in ((0.335, (70, 72, 78)), (0.625, (96, 98, 104))):  # outside, inside
            canvas.rect(u - 0.010, v - 0.02, u + 0.010, v + 0.02, color)
            for side in (-1, 1):
                canvas.disc(u + 0.010 * side, v, 0.0035, 0.02, color)
        for index in range(-3, 4):
            x = u + 0.0085 * index
            canvas.rect(x - 0.0022, 0.13, x + 0.0022, 0.19, (150, 153, 160))
    canvas.rect(0.0, 0.94, 1.0, 1.0, (238, 238, 238))
    walls = [  # height, half depth, half width, v, crease
        (0.0002, 0.0, 0.0, 0.0, False),
        (0.0002, 0.0800, 0.0960, 0.02, True),
        (0.0060, 0.0860, 0.1015, 0.05, False),
        (0.0300, 0.0895, 0.1045, 0.12, False),
        (0.1280, 0.0995, 0.1130, 0.42, True),
        (0.1290, 0.1034, 0.1160, 0.43, True),
        (0.1360, 0.1037, 0.1162, 0.45, True),
        (0.1360, 0.0950, 0.1085, 0.50, True),
        (0.0300, 0.0840, 0.0990, 0.80, False),
        (0.0110, 0.0800, 0.0955, 0.86, False),
        (0.0095, 0.0760, 0.0915, 0.88, False),
        (0.0095, 0.0, 0.0, 0.92, False),
    ]
    shell = [Ring(z, depth, width, v, round=9.0, crease=crease) for z, depth, width, v, crease in walls]
    x, y = BIN_CENTER
    divider = sweep(  # as wide as the walls leave it
        [(x, y, 0.0080), (x, y, 0.0300), (x, y, 0.1340)],
        [(0.0790, 0.0037), (0.0865, 0.0037), (0.0970, 0.0037)],
        ACROSS,
        8,
        SPARE,
        12.0,
    )
    return Appearance(
        merge([loft(shell, segments=28, center=BIN_CENTER), faceted(divider)]), canvas.png(), specular=0.3
    )


APPEARANCES = {
    "bowl_drainer": bowl_drainer,
    "chefmate_8_frypan": chefmate_8_frypan,
    "moka_pot": moka_pot,
    "wine_bottle": wine_bottle,
}


def _moka_body() -> Mesh:
    profile = [
        (0.0, -0.0668),
        (0.0345, -0.0668),
        (0.0366, -0.0640),
        (0.0332, -0.0170),
        (0.0300, -0.0080),
        (0.0300, 0.0010),
        (0.0322, 0.0090),
        (0.0350, 0.0120),
        (0.0388, 0.0600),
        (0.0394, 0.0605),
        (0.0394, 0.0640),
        (0.0060, 0.0705),
        (0.0, 0.0705),
    ]
    v = np.interp([z for _, z in profile], [-0.0668, 0.0010, 0.0640, 0.0705], [0.08, 0.515, 0.895, 0.94])
    return faceted(loft([Ring(z, r, r, at) for (r, z), at in zip(profile, v, strict=True)], segments=8))


def _spout() -> Mesh:
    corners = np.array(
        [
            (-0.0160, 0.0330, 0.0630),
            (0.0160, 0.0330, 0.0630),
            (0.0, 0.0350, 0.0190),
            (-0.0045, 0.0590, 0.0590),
            (0.0045, 0.0590, 0.0590),
        ]
    )
    faces = np.array([(0, 3, 4), (0, 4, 1), (0, 2, 3), (1, 4, 2), (2, 4, 3), (0, 1, 2)])
    return faceted(Mesh(corners, faces, np.full((len(corners), 2), (0.5, 0.80))))


def _moka_handle() -> Mesh:
    line = [
        (-0.0340, 0.0600),
        (-0.0520, 0.0605),
        (-0.0660, 0.0590),
        (-0.0755, 0.0530),
        (-0.0778, 0.0440),
        (-0.0755, 0.0320),
        (-0.0710, 0.0190),
        (-0.0655, 0.0070),
        (-0.0580, -0.0030),
        (-0.0560, -0.0080),
    ]
    half = [(0.0060, 0.0055)] * 2 + [(0.0066, 0.0062)] * 6 + [(0.0060, 0.0056), (0.0040, 0.0036)]
    return sweep([(0.0, y, z) for y, z in line], half, ACROSS, 8, BLACK, 3.0)
