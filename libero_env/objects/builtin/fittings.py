"""Fittings of a house: a sliding window, and two taps."""

from libero_env.objects.builtin.assemble import Appearance
from libero_env.objects.builtin.joinery import Palette, bar, block, capsule, in_body, turned
from libero_env.objects.builtin.mesh import Mesh, merge
from libero_env.objects.builtin.surfaces import brushed, chrome, plain, wood

SASHES = {
    "windowb_a": ((-0.100, 0.0), -0.0065),
    "windowb_b": ((0.0, 0.100), 0.0065),
}  # body -> x from, to; y of centre


def window() -> dict[str, Appearance | tuple[Appearance, ...]]:
    """Return the window: brown wooden frame with a sill, two sashes with crossbars and bluish panes, a white handle."""
    tiles = {
        "frame": wood((142, 92, 70), seed=60, depth=0.25),
        "post": wood((142, 92, 70), seed=61, depth=0.25, upright=True),
        "sash": wood((168, 116, 88), seed=62, depth=0.22),
        "upright": wood((168, 116, 88), seed=63, depth=0.22, upright=True),
        "handle": plain((236, 236, 232)),
    }
    palette, glass = Palette(tiles), Palette({"glass": plain((150, 205, 225))})
    texture = palette.png()
    appearances: dict[str, Appearance | tuple[Appearance, ...]] = {
        "main": Appearance(_window_frame(palette), texture, specular=0.2, frame="body")
    }
    for body, ((x0, x1), y) in SASHES.items():
        sash = _sash(palette, x0, x1, y)
        if body == "windowb_a":
            sash = merge([sash, *_window_handle(palette)])
        pane = block((x0 + 0.008, y - 0.0030, -0.066), (x1 - 0.008, y - 0.0020, 0.066), glass["glass"])
        appearances[body] = (
            Appearance(in_body(sash, "window", body), texture, specular=0.2, frame="body"),
            Appearance(
                in_body(pane, "window", body),
                glass.png(),
                specular=1.0,
                shininess=0.9,
                alpha=0.32,
                frame="body",
            ),
        )
    return appearances


def faucet() -> dict[str, Appearance]:
    """Return the faucet: steel pillar whose red lever turns."""
    palette = Palette(
        {"chrome": chrome((206, 210, 218)), "red": plain((190, 30, 28)), "dark": plain((58, 60, 66))}
    )
    steel, texture = palette["chrome"], palette.png()
    pillar = [
        (0.0, 0.0445),
        (0.0015, 0.0455),
        (0.0160, 0.0455),
        (0.0178, 0.0430),
        (0.0178, 0.0205),
        (0.0240, 0.0170),
    ]
    lever = merge(
        [
            turned([(0.104, 0.030), (0.106, 0.032), (0.142, 0.032), (0.145, 0.029)], steel, segments=20),
            bar((0.0, -0.028, 0.125), (0.0, -0.071, 0.125), 0.0119, steel, segments=14),
            capsule((0.0, -0.065, 0.125), (0.0, -0.175, 0.125), 0.0170, palette["red"], segments=16),
            bar((0.0, 0.0, 0.1440), (0.0, 0.0, 0.1452), 0.0120, palette["dark"], tip=0.0),
        ]
    )
    return {
        "main": Appearance(
            turned([*pillar, (0.106, 0.0170)], steel, segments=20), texture, specular=0.8, frame="body"
        ),
        "faucet_link2": Appearance(
            in_body(lever, "faucet", "faucet_link2"), texture, specular=0.7, frame="body"
        ),
    }


def basin_faucet() -> dict[str, Appearance]:
    """Return the basin faucet: square mixer tap of polished steel; the lever on its top turns."""
    palette = Palette(
        {
            "steel": brushed((212, 215, 220), seed=70, depth=0.02),
            "hole": plain((40, 42, 46)),
            "blue": plain((54, 104, 196)),
            "red": plain((200, 44, 40)),
        }
    )
    steel, hole, texture = palette["steel"], palette["hole"], palette.png()
    stand = merge(
        [
            block((0.0141, -0.0212, -0.0541), (0.0568, 0.0212, -0.0486), steel, bevel=0.0015),
            block((0.0192, -0.0166, -0.0490), (0.0518, 0.0166, 0.0296), steel, bevel=0.0015),
            block((-0.0553, -0.0097, -0.0020), (0.0200, 0.0093, 0.0130), steel, bevel=0.0015),
            turned([(0.0, 0.0060), (0.004, 0.0066)], hole, base=(-0.0470, -0.0002, -0.0024), segments=12),
        ]
    )
    lever = merge(
        [
            block((0.0195, -0.0162, 0.0322), (0.0515, 0.0162, 0.0542), steel, bevel=0.0018),
            block((-0.0283, -0.0041, 0.0397), (0.0210, 0.0041, 0.0474), steel, bevel=0.0012),
            block((0.0212, -0.0166, 0.0352), (0.0300, -0.0160, 0.0392), palette["blue"]),
            block((0.0212, 0.0160, 0.0352), (0.0300, 0.0166, 0.0392), palette["red"]),
        ]
    )
    parts = {"base": stand, "movable": lever}
    return {
        body: Appearance(mesh, texture, specular=0.8, shininess=0.7, frame="body")
        for body, mesh in parts.items()
    }


APPEARANCES = {"basin_faucet": basin_faucet, "faucet": faucet, "window": window}


def _window_frame(palette: Palette) -> Mesh:
    frame, post = palette["frame"], palette["post"]
    return merge(
        [
            block((-0.1248, -0.0300, -0.1010), (0.1248, 0.0300, -0.0910), frame, bevel=0.0015),
            *(
                block((x - 0.0075, -0.0150, -0.0915), (x + 0.0075, 0.0150, 0.0905), post, bevel=0.001)
                for x in (-0.108, 0.108)
            ),
            block((-0.1010, -0.0150, -0.0915), (0.1010, 0.0150, -0.0755), frame),
            block((-0.1010, -0.0150, 0.0755), (0.1010, 0.0150, 0.0905), frame),
        ]
    )


def _sash(palette: Palette, x0: float, x1: float, y: float) -> Mesh:
    """Return the frame of one pane with its crossbar, centred at `y`, [m]."""
    rail, stile, near, far = palette["sash"], palette["upright"], y - 0.0060, y + 0.0060
    right = 0.014 if y < 0 else 0.010  # the handle stands on the broader stile
    return merge(
        [
            block((x0, near, -0.0750), (x0 + 0.010, far, 0.0750), stile, bevel=0.0008),
            block((x1 - right, near, -0.0750), (x1, far, 0.0750), stile, bevel=0.0008),
            *(
                block(
                    (x0 + 0.0095, near + 0.0005, z - 0.005),
                    (x1 - right + 0.0005, far - 0.0005, z + 0.005),
                    rail,
                )
                for z in (-0.070, 0.070)
            ),
            block((x0 + 0.0095, y - 0.0060, -0.0025), (x1 - right + 0.0005, y - 0.0030, 0.0025), rail),
        ]
    )


def _window_handle(palette: Palette) -> list[Mesh]:
    white, x, far = palette["handle"], -0.007, -0.0475
    pieces = [bar((x, -0.0123, z), (x, -0.0155, z), 0.0060, white) for z in (-0.0225, 0.0225)]
    pieces += [bar((x, -0.0150, z), (x, far, z), 0.0040, white, segments=8) for z in (-0.0225, 0.0225)]
    return [*pieces, capsule((x, far, -0.0225), (x, far, 0.0225), 0.0040, white, segments=8)]
