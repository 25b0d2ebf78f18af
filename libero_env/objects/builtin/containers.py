"""Containers: the tray of slats, the white storage box, the desk caddy."""

from libero_env.objects.builtin.assemble import Appearance
from libero_env.objects.builtin.joinery import Palette, block, prism
from libero_env.objects.builtin.mesh import merge
from libero_env.objects.builtin.surfaces import edged, plain, wood

BIRCH = (222, 196, 160)


def wooden_tray() -> Appearance:
    """Return the wooden tray: crate of pale boards: a floor of slats, corner posts, a grip at each end (x)."""
    palette = _birch(seed=50)
    side, post, grip = palette["side"], palette["post"], palette["grip"]
    parts = [
        block((-0.1400, y0, -0.0006), (0.1548, y1, 0.0080), palette["slat"], bevel=0.0008)
        for y0, y1 in ((-0.0835, -0.0433), (-0.0302, 0.0191), (0.0330, 0.0735))
    ]
    parts += [
        block((-0.1380, y0, z0), (0.1535, y1, z1), side, bevel=0.0008, faces={"z+": grip})
        for y0, y1, z0, z1 in ((-0.0872, -0.0818, 0.0030, 0.0620), (0.0730, 0.0782, 0.0028, 0.0602))
    ]
    for x0, x1 in ((-0.1364, -0.1256), (0.1417, 0.1526)):
        parts.append(block((x0, -0.0818, 0.0001), (x1, 0.0734, 0.0051), palette["post"]))
    for x0, x1 in ((-0.1412, -0.1364), (0.1507, 0.1556)):
        parts.append(block((x0, -0.0845, 0.0045), (x1, 0.0760, 0.0545), palette["end"], bevel=0.0008))
    for x0, x1 in ((-0.1383, -0.1259), (0.1391, 0.1515)):
        for y0, y1 in ((-0.0835, -0.0730), (0.0630, 0.0738)):
            parts.append(block((x0, y0, 0.0017), (x1, y1, 0.0785), post))
    for x0, x1 in ((-0.1402, -0.1262), (0.1390, 0.1534)):
        parts.append(block((x0, -0.0850, 0.0762), (x1, 0.0750, 0.0812), grip, bevel=0.0012))
    return Appearance(merge(parts), palette.png(), specular=0.1, frame="body")


def white_storage_box() -> Appearance:
    """Return the white storage box: white cube with rounded edges along y, open at both ends."""
    palette = Palette({"paint": plain((240, 240, 236))})
    left, right, low, high, wall, cut = -0.0699, 0.0701, 0.0012, 0.1420, 0.0125, 0.0060
    parts = []
    # Outlines (x, z): outer corners are cut, inner ones meet.
    inner = [
        (left + wall, low + wall),
        (right - wall, low + wall),
        (right - wall, high - wall),
        (left + wall, high - wall),
    ]
    outer = [
        ((left + cut, low), (right - cut, low)),
        ((right, low + cut), (right, high - cut)),
        ((right - cut, high), (left + cut, high)),
        ((left, high - cut), (left, low + cut)),
    ]
    for index, (one, two) in enumerate(outer):
        a, b = inner[index], inner[(index + 1) % 4]
        parts.append(prism([one, two, b, a], -0.0588, 0.0590, palette["paint"]))
        parts.append(prism([two, outer[(index + 1) % 4][0], b], -0.0588, 0.0590, palette["paint"]))
    return Appearance(merge(parts), palette.png(), specular=0.35, shininess=0.6, frame="body")


def desk_caddy() -> Appearance:
    """Return the desk caddy: pale organiser: a tall cell at -y, two in the middle, a sloping one at +y, low at -x."""
    palette = _birch(seed=55)
    side, end = palette["side"], palette["end"]
    parts = [
        block((-0.0785, -0.2192, 0.0), (0.0785, 0.2192, 0.0138), palette["slat"], bevel=0.0015),
        block((0.0630, -0.2120, 0.0130), (0.0708, 0.2120, 0.1683), side, bevel=0.0008),
        block((-0.0709, -0.0650, 0.0130), (-0.0630, 0.2120, 0.0741), side, bevel=0.0008),
        block((-0.0709, -0.2156, 0.0130), (-0.0630, -0.0618, 0.1673), end, bevel=0.0008),
        block((-0.0640, -0.2156, 0.0130), (0.0640, -0.2040, 0.1673), end, bevel=0.0008),
        block((-0.0640, -0.0742, 0.0130), (0.0640, -0.0620, 0.1673), end, bevel=0.0008),
        block((-0.0056, -0.0630, 0.0130), (0.0025, 0.0680, 0.0986), palette["post"], bevel=0.0008),
    ]
    slope = [(-0.0690, 0.0130), (0.0690, 0.0130), (0.0690, 0.1675), (-0.0690, 0.0722)]
    parts += [prism(slope, y0, y1, end) for y0, y1 in ((0.0671, 0.0742), (0.2046, 0.2119))]
    return Appearance(merge(parts), palette.png(), specular=0.1, frame="body")


APPEARANCES = {"desk_caddy": desk_caddy, "white_storage_box": white_storage_box, "wooden_tray": wooden_tray}


def _birch(seed: int) -> Palette:
    return Palette(
        {
            "side": edged(wood(BIRCH, seed, depth=0.22), width=3, shade=0.85),
            "end": edged(wood((214, 187, 150), seed + 1, depth=0.22, upright=True), width=3, shade=0.85),
            "slat": edged(wood((217, 190, 153), seed + 2, depth=0.22), width=4, shade=0.8),
            "post": wood((198, 167, 126), seed + 3, depth=0.22, upright=True),
            "grip": wood((234, 210, 176), seed + 4, depth=0.15),
        }
    )
