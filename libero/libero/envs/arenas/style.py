"""Styles of floors and walls by name."""

from libero._adapters.lookup import lookup
from libero_env.assets.original_arena import TEXTURES

STYLE_KINDS = ("floor", "wall")
STYLE_MAPPING = {kind: dict(TEXTURES[kind]) for kind in STYLE_KINDS}
FLOOR_STYLE, WALL_STYLE = STYLE_MAPPING["floor"], STYLE_MAPPING["wall"]


def get_texture_filename(type: str, style: str) -> str:
    """Return the texture file of a style in the original; raise an UnknownNameError if there is none."""
    return lookup(lookup(STYLE_MAPPING, "kind of style", type), f"{type} style", style)
