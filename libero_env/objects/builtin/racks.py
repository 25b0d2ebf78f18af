"""Racks: two tilted shelves of slats for bottles, and pegs on a block for dishes."""

import numpy as np

from libero_env.objects.builtin.assemble import Appearance
from libero_env.objects.builtin.joinery import Palette, block, prism, turned
from libero_env.objects.builtin.mesh import Mesh, merge
from libero_env.objects.builtin.surfaces import edged, plain, wood

SHELVES = (  # centre (y, z) [m] and slope of the planes that bottles lie on
    ((-0.0061, 0.25118), np.radians(31.28)),
    ((-0.04273, 0.12727), np.radians(31.28)),
)
SHELF_HALF = (0.1344, 0.0789, 0.0045)
SLATS = 7
ARCH = (0.1320, 0.0245, 0.0080)  # half length, height, thickness of the bent foot
PEGS_X, PEGS_Y = (-0.0438, 0.0311), (-0.1012, -0.0694, -0.0358, 0.0, 0.0309, 0.0598, 0.0930)
PEG = [(0.0165, 0.0039), (0.1034, 0.0036)]


def wine_rack() -> Appearance:
    """Return the wine rack: mahogany post on an arched foot; it carries two shelves of oak slats, tilted towards -y."""
    tiles = {
        "foot": wood((96, 38, 22), seed=40, depth=0.45, upright=True),
        "post": wood((88, 34, 20), seed=41, depth=0.4, upright=True),
        "even": edged(wood((196, 150, 100), seed=42, depth=0.30, upright=True), width=4, shade=0.8),
        "odd": edged(wood((178, 132, 84), seed=43, depth=0.32, upright=True), width=4, shade=0.8),
        "batten": wood((128, 62, 36), seed=44, depth=0.35),
    }
    palette = Palette(tiles)
    post = block((-0.0090, -0.0100, -0.1600), (0.0090, 0.0100, 0.1590), palette["post"], bevel=0.0015)
    stretcher = block((-0.0665, -0.0930, 0.0021), (0.0665, 0.0930, 0.0111), palette["post"])
    parts = [_arch(palette), stretcher, _rotate_and_move(post, (0.00886, 0.17026), -np.arcsin(0.273))]
    parts += [_rotate_and_move(_slatted(palette), center, slope) for center, slope in SHELVES]
    return Appearance(merge(parts), palette.png(), specular=0.25, shininess=0.5, frame="body")


def rack() -> Appearance:
    """Return the rack: white block with two rows of steel-grey pegs."""
    palette = Palette(
        {"block": edged(plain((232, 232, 228)), width=2, shade=0.9), "peg": plain((196, 200, 206))}
    )
    parts = [block((-0.07, -0.1390, -0.0173), (0.07, 0.1390, 0.0173), palette["block"], bevel=0.002)]
    for x in PEGS_X:
        # The lower ends of the pegs are inside the block.
        parts += [turned(PEG, palette["peg"], base=(x, y, 0.0), segments=6) for y in PEGS_Y]
    return Appearance(merge(parts), palette.png(), specular=0.3, frame="body")


APPEARANCES = {"rack": rack, "wine_rack": wine_rack}


def _slatted(palette: Palette) -> Mesh:
    """Return a horizontal shelf around its centre: slats on two battens, a lip at the lower end."""
    x, y, z = SHELF_HALF
    pitch = 2 * x / SLATS
    parts = []
    for index in range(SLATS):
        x0 = -x + index * pitch
        cell = palette["odd" if index % 2 else "even"]
        parts.append(block((x0 + 0.0015, -y, -0.0035), (x0 + pitch - 0.0015, y, z), cell))
    for at in (-0.052, 0.052):
        parts.append(block((-x, at - 0.009, -z), (x, at + 0.009, 0.0), palette["batten"]))
    parts.append(block((-x, -y + 0.0028, -z), (x, -y + 0.0068, 0.0178), palette["batten"], bevel=0.0008))
    return merge(parts)


def _rotate_and_move(mesh: Mesh, center: tuple[float, float], angle: float) -> Mesh:
    """Return a mesh rotated about x by an angle and moved to (y, z)."""
    turned = mesh.rotated(np.array([np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0]))
    return Mesh(turned.vertices + (0.0, *center), turned.faces, turned.texcoords)


def _arch(palette: Palette) -> Mesh:
    """Return a bent board along y whose ends are on the floor."""
    length, height, thickness = ARCH
    y = np.linspace(-length, length, 9)
    top = height - (height - thickness) * np.abs(y / length) ** 1.5
    pieces = []
    for i in range(len(y) - 1):
        outline = [
            (y[i], top[i] - thickness),
            (y[i + 1], top[i + 1] - thickness),
            (y[i + 1], top[i + 1]),
            (y[i], top[i]),
        ]
        pieces.append(prism(outline, -0.0900, 0.0900, palette["foot"]))
    mesh = merge(pieces)
    quarter = np.sqrt(0.5) * np.array([1.0, 0.0, 0.0, 1.0])  # the outline's x becomes y
    return mesh.rotated(quarter)
