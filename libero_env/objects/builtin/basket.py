"""The wicker basket: an open box with flaring woven walls."""

import numpy as np

from libero_env.objects.builtin.assemble import Appearance
from libero_env.objects.builtin.mesh import Mesh, Ring, loft
from libero_env.objects.builtin.paint import png

COLUMNS, ROWS = 28, 14  # strands of the weave along the width and the height of the texture
RIM_V = 0.88  # lower edge of the braided rim in the texture


def basket() -> Appearance:
    """Return the basket: brown basket whose walls are where the collision boxes are."""
    return Appearance(_basket_mesh(), png(_weave()), specular=0.05, shininess=0.1)


APPEARANCES = {"basket": basket}


def _basket_mesh() -> Mesh:
    rings = [  # height, depth (half), width (half), v
        (0.0046, 0.0, 0.0, 0.00, False),
        (0.0046, 0.0700, 0.0730, 0.25, True),
        (0.1330, 0.0775, 0.0835, RIM_V, True),
        (0.1345, 0.0800, 0.0860, 0.90, False),
        (0.1440, 0.0800, 0.0860, 0.97, True),
        (0.1440, 0.0650, 0.0715, 0.90, True),
        (0.0216, 0.0590, 0.0640, 0.25, True),
        (0.0216, 0.0, 0.0, 0.00, False),
    ]
    sections = [Ring(z, depth, width, v, round=7.0, crease=crease) for z, depth, width, v, crease in rings]
    return loft(sections, segments=24, center=(0.0, 0.0008))


def _weave() -> np.ndarray:
    """Return the texture of the weave, strands bright in the middle and dark at crossings, (128, 256, 3) uint8."""
    height, width = 128, 256
    v = (np.arange(height)[::-1, None] + 0.5) / height  # first row on top
    u = (np.arange(width)[None] + 0.5) / width
    v, u = np.broadcast_arrays(v, u)
    row, column = v * ROWS, u * COLUMNS
    over = (np.floor(row) + np.floor(column)) % 2 == 0
    across = np.where(over, row, column) % 1.0 - 0.5
    along = np.where(over, column, row) % 1.0 - 0.5
    shade = np.cos(np.pi * across) * (0.55 + 0.45 * np.cos(np.pi * along))
    shade *= np.where(over, 1.0, 0.80)
    braid = 0.55 + 0.45 * np.abs(np.sin(np.pi * (column + 4.0 * (v - RIM_V) / (1.0 - RIM_V))))
    shade = np.where(v > RIM_V, braid * 1.05, 0.35 + 0.65 * shade)
    return np.clip(shade[..., None] * (196.0, 140.0, 78.0), 0, 255).astype(np.uint8)
