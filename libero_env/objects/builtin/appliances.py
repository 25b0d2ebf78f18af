"""Kitchen appliances: microwave, small fridge, and the stove with one burner."""

import numpy as np

from libero_env.objects.builtin.assemble import Appearance
from libero_env.objects.builtin.joinery import (
    TILE,
    Palette,
    bar,
    block,
    capsule,
    in_body,
    outline_of,
    prism,
    turned,
)
from libero_env.objects.builtin.mesh import Mesh, merge
from libero_env.objects.builtin.paint import Canvas, Color
from libero_env.objects.builtin.surfaces import brushed, edged, painted, plain

BURNER = (0.15, 0.0)  # axis of the burner, root frame
RIDGES = (0.008, 0.021, 0.034, 0.047, 0.060)  # [m] radii of the burner's ridges; it glows between them
GLOW_HEIGHT, RIDGE_HEIGHT = 0.0205, 0.0255  # [m] the glowing disc lies between these heights


def microwave() -> dict[str, Appearance | tuple[Appearance, ...]]:
    """Return the microwave: charcoal box, steel handle, tinted window, keypad with a green clock."""
    tiles = {
        "shell": brushed((74, 76, 82), seed=30, depth=0.03),
        "door": brushed((58, 60, 66), seed=31, depth=0.03),
        "inside": plain((202, 200, 192)),
        "floor": painted(_turntable()),
        "keys": painted(_keypad()),
        "metal": brushed((196, 198, 202), seed=32, depth=0.04, upright=True),
        "rubber": plain((32, 32, 34)),
    }
    palette = Palette(tiles)
    glass = Palette({"glass": plain((18, 22, 28))})
    pane = block((-0.1310, -0.1050, 0.0336), (0.0448, -0.0960, 0.1581), glass["glass"])
    door, pane = (in_body(mesh, "microwave", "microdoorroot") for mesh in (_microwave_door(palette), pane))
    texture = palette.png()
    return {
        "main": Appearance(_microwave_shell(palette), texture, specular=0.5, shininess=0.6, frame="body"),
        "microdoorroot": (
            Appearance(door, texture, specular=0.5, shininess=0.6, frame="body"),
            Appearance(pane, glass.png(), specular=0.9, shininess=0.9, alpha=0.55, frame="body"),
        ),
    }


def short_fridge() -> dict[str, Appearance]:
    """Return the short fridge: brushed silver, white inside, a steel rail as handle."""
    tiles = {
        "shell": brushed((172, 176, 182), seed=40, depth=0.03, upright=True),
        "door": edged(brushed((196, 200, 206), seed=41, depth=0.03, upright=True), width=3, shade=0.85),
        "inside": plain((236, 239, 242)),
        "shelf": plain((196, 214, 226)),
        "metal": brushed((122, 126, 132), seed=42, depth=0.03, upright=True),
        "rubber": plain((48, 48, 52)),
        "lamp": plain((255, 244, 205)),
    }
    palette = Palette(tiles)
    parts = {"base": _fridge_body(palette), "door": _fridge_door(palette)}
    texture = palette.png()
    return {
        body: Appearance(in_body(mesh, "short_fridge", body), texture, specular=0.4, frame="body")
        for body, mesh in parts.items()
    }


def flat_stove() -> dict[str, Appearance]:
    """Return the flat stove: steel plate with a black ridged burner, and a black knob beside it."""
    tiles = {
        "steel": brushed((186, 189, 194), seed=50, depth=0.03),
        "burner": _enamel((74, 74, 80), (14, 14, 16)),
        "knob": plain((40, 41, 46)),
        "grip": plain((58, 59, 66)),
        "mark": plain((240, 240, 236)),
    }
    palette, low, high = Palette(tiles), (0.055, -0.095, -0.02), (0.245, 0.095, 0.02)
    parts = {
        "burner": block(low, high, palette["steel"], bevel=0.003),
        "burner_plate": _burner_plate(palette),
        "button": _knob(palette),
    }
    texture = palette.png()
    return {
        body: Appearance(
            in_body(mesh, "flat_stove", body), texture, specular=0.5, shininess=0.5, frame="body"
        )
        for body, mesh in parts.items()
    }


APPEARANCES = {"flat_stove": flat_stove, "microwave": microwave, "short_fridge": short_fridge}


def _microwave_shell(palette: Palette) -> Mesh:
    shell, inside = palette["shell"], palette["inside"]
    feet = [
        turned([(0.0, 0.012), (0.006, 0.014)], palette["rubber"], base=(x, y, 0.0), segments=8)
        for x in (-0.145, 0.145)
        for y in (-0.058, 0.078)
    ]
    return merge(
        [
            block((-0.1723, -0.0880, 0.0050), (-0.1435, 0.1105, 0.1867), shell, faces={"x+": inside}),
            block((0.0635, -0.0880, 0.0050), (0.1723, 0.1105, 0.1867), shell, faces={"x-": inside}),
            block((-0.1435, 0.0805, 0.0050), (0.0635, 0.1105, 0.1867), shell, faces={"y-": inside}),
            block((-0.1435, -0.0880, 0.1680), (0.0635, 0.0805, 0.1867), shell, faces={"z-": inside}),
            block(
                (-0.1435, -0.0880, 0.0050), (0.0635, 0.0805, 0.0240), shell, faces={"z+": palette["floor"]}
            ),
            block(
                (0.0875, -0.1105, 0.0050),
                (0.1723, -0.0865, 0.1867),
                shell,
                bevel=0.0015,
                faces={"y-": palette["keys"]},
            ),
            *feet,
        ]
    )


def _microwave_door(palette: Palette) -> Mesh:
    door, metal = palette["door"], palette["metal"]
    y0, y1 = -0.1104, -0.0904
    (x0, x1), (z0, z1) = (-0.1723, 0.0861), (0.0050, 0.1867)
    (u0, u1), (w0, w1) = (-0.1300, 0.0438), (0.0346, 0.1571)  # bounds of the window
    rim = 0.0022
    return merge(
        [
            block((x0, y0, z0), (u0, y1, z1), door, bevel=0.001),
            block((u1, y0, z0), (x1, y1, z1), door, bevel=0.001),
            block((u0 - 0.001, y0, z0), (u1 + 0.001, y1, w0), door, bevel=0.001),
            block((u0 - 0.001, y0, w1), (u1 + 0.001, y1, z1), door, bevel=0.001),
            block((u0, y0 - 0.0004, w0), (u1, y0 + 0.004, w0 + rim), metal),
            block((u0, y0 - 0.0004, w1 - rim), (u1, y0 + 0.004, w1), metal),
            block((u0, y0 - 0.0004, w0), (u0 + rim, y0 + 0.004, w1), metal),
            block((u1 - rim, y0 - 0.0004, w0), (u1, y0 + 0.004, w1), metal),
            capsule((0.065, -0.142, 0.031), (0.065, -0.142, 0.161), 0.0100, metal),
            *(bar((0.065, -0.1400, z), (0.065, -0.1100, z), 0.0095, metal) for z in (0.031, 0.161)),
        ]
    )


def _turntable() -> Canvas:
    canvas = Canvas((188, 186, 178))
    for radius, color in ((0.46, (150, 156, 160)), (0.44, (214, 222, 226)), (0.16, (176, 184, 190))):
        canvas.disc(0.5, 0.5, radius * 0.82, radius, color)
    canvas.disc(0.5, 0.5, 0.12, 0.145, (220, 228, 232))
    return canvas


def _keypad() -> Canvas:
    canvas = Canvas((44, 45, 50))
    canvas.rect(0.10, 0.82, 0.90, 0.95, (8, 20, 14))
    canvas.text("12:00", (0.20, 0.845, 0.80, 0.925), (96, 240, 150))
    for row in range(4):
        for column in range(3):
            u, v = 0.12 + 0.27 * column, 0.66 - 0.125 * row
            canvas.rect(u, v, u + 0.22, v + 0.09, (176, 178, 184))
            label = "123456789C0S"[3 * row + column]
            canvas.text(label, (u + 0.075, v + 0.018, u + 0.145, v + 0.072), (40, 42, 48))
    canvas.rect(0.10, 0.05, 0.90, 0.17, (205, 207, 211))
    canvas.text("OPEN", (0.30, 0.08, 0.70, 0.14), (44, 46, 52))
    return canvas


def _fridge_body(palette: Palette) -> Mesh:
    shell, inside, shelf = palette["shell"], palette["inside"], palette["shelf"]
    feet = [
        turned([(0.0, 0.0115), (0.016, 0.0125)], palette["rubber"], base=(x, y, 0.0105), segments=8)
        for x in (-0.0799, 0.0794)
        for y in (-0.0732, 0.0771)
    ]
    return merge(
        [
            block((-0.0975, 0.0733, 0.0242), (0.0995, 0.0988, 0.2690), shell, faces={"y-": inside}),
            block((0.0882, -0.0903, 0.0242), (0.0995, 0.0734, 0.2690), shell, faces={"x-": inside}),
            block((-0.0975, -0.0903, 0.0242), (-0.0860, 0.0734, 0.2690), shell, faces={"x+": inside}),
            block((-0.0860, -0.0900, 0.2603), (0.0882, 0.0734, 0.2690), shell, faces={"z-": inside}),
            block((-0.0860, -0.0900, 0.0242), (0.0882, 0.0734, 0.0385), shell, faces={"z+": inside}),
            block((-0.0860, -0.0820, 0.1781), (0.0882, 0.0733, 0.1856), shelf),
            block((-0.0860, -0.0844, 0.0825), (0.0882, 0.0733, 0.0900), shelf),
            block((0.0528, -0.0346, 0.2388), (0.0870, 0.0640, 0.2523), palette["lamp"], bevel=0.002),
            *feet,
        ]
    )


def _fridge_door(palette: Palette) -> Mesh:
    door, metal = palette["door"], palette["metal"]
    x, y = -0.0935, -0.1285  # position of the rail
    return merge(
        [
            block(
                (-0.1010, -0.1240, 0.0301),
                (0.0985, -0.1000, 0.2690),
                palette["shell"],
                bevel=0.003,
                faces={"y-": door, "y+": palette["rubber"]},
            ),
            block((-0.0850, -0.1005, 0.0470), (0.0743, -0.0916, 0.2520), palette["inside"], bevel=0.003),
            block((x - 0.0045, y - 0.0045, 0.0310), (x + 0.0045, y + 0.0045, 0.2680), metal, bevel=0.002),
            block((0.0100, -0.1246, 0.2440), (0.0700, -0.1235, 0.2540), metal),
        ]
    )


def _burner_plate(palette: Palette) -> Mesh:
    return turned(_ripples(), palette["burner"], base=(*BURNER, 0.0), segments=24)


def _ripples() -> list[tuple[float, float]]:
    """Return the profile of the burner: a rim, and ridges with flat tops."""
    rim, half = 0.0650, 0.0035
    profile = [(0.0195, rim), (RIDGE_HEIGHT - 0.0005, rim), (RIDGE_HEIGHT, rim - 0.001)]
    for index, radius in enumerate(reversed(RIDGES)):
        if index:
            profile += [(GLOW_HEIGHT, radius + half), (RIDGE_HEIGHT, radius + 0.4 * half)]
        profile += [(RIDGE_HEIGHT, radius - 0.4 * half), (GLOW_HEIGHT, radius - half)]
    return profile


def _enamel(peak: Color, valley: Color) -> np.ndarray:
    """Return a tile that is bright on the ridges; its height is the distance along the profile."""
    points, way = outline_of(_ripples())
    height = np.interp((np.arange(TILE)[::-1] + 0.5) / TILE, way, points[:, 0])  # first row on top
    share = np.clip((height - GLOW_HEIGHT) / (RIDGE_HEIGHT - GLOW_HEIGHT), 0.0, 1.0) ** 3
    rows = np.add(np.multiply.outer(1 - share, valley), np.multiply.outer(share, peak))
    return np.repeat(rows[:, None], TILE, axis=1).astype(np.uint8)


def _knob(palette: Palette) -> Mesh:
    center, outline = (-0.0045, 0.0012, 0.0), [(0.0, 0.0475), (0.0095, 0.0475), (0.0128, 0.0440)]
    grip = [
        (-0.0480, 0.0020),
        (0.0390, 0.0020),
        (0.0390, 0.0310),
        (0.0270, 0.0425),
        (0.0100, 0.0500),
        (-0.0480, 0.0500),
    ]
    mark = [(0.0100, 0.0495), (0.0270, 0.0420), (0.0280, 0.0429), (0.0110, 0.0503)]
    return merge(
        [
            turned(outline, palette["knob"], base=center, segments=28),
            prism(grip, -0.0108, 0.0132, palette["grip"]),
            prism(mark, -0.0008, 0.0032, palette["mark"]),
        ]
    )
