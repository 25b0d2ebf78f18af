"""Styles of floors and walls by name."""

from libero_env.assets.original_arena import TEXTURES
from libero_env.assets.styles import load_styles
from libero_env.errors import UnknownNameError

STYLE_KINDS = ("floor", "wall")
STYLE_MAPPING = {kind: dict(TEXTURES[kind]) for kind in STYLE_KINDS}


def get_texture_filename(type: str, style: str) -> str:
    """Return the texture file of a style in the `textures` folder of the original.

    Raises:
        UnknownNameError: The kind or style does not exist.
    """
    if type not in STYLE_MAPPING:
        raise UnknownNameError("kind of style", type, STYLE_MAPPING)
    if style not in STYLE_MAPPING[type]:
        raise UnknownNameError(f"{type} style", style, load_styles()[type])
    return STYLE_MAPPING[type][style]
