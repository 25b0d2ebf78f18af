"""Texture files in the `textures` folder of the original."""

import os

from libero_env.errors import require_known
from libero_env.storage import read_yaml

TEXTURE_MAPPING: dict[str, str] = {**read_yaml("assets/original.yaml")["texture_names"]}
_KINDS = ("floor", "table", "wall")


def get_texture_file_list(type: str, texture_path: str | os.PathLike = "../") -> list[tuple[str, str]]:
    """Return name and path, `<texture_path>/textures/<file>`, of the textures that a kind can have.

    These are those that are named after it, and those that are named after no kind. An UnknownNameError is raised if
    there is no such kind.
    """
    require_known("kind of texture", type.lower(), _KINDS)
    others = [kind for kind in _KINDS if kind != type.lower()]
    return [
        (name, os.path.join(texture_path, "textures", file))
        for name, file in TEXTURE_MAPPING.items()
        if type.lower() in name.lower() or not any(other in name.lower() for other in others)
    ]
