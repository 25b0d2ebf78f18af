"""Texture files in the `textures` folder of the original."""

import os
from pathlib import Path

from libero_env.errors import require_known

_FILES = """
brown_ceramic_tile.png canvas_sky_blue.png capriccio_sky.png ceramic.png cream-plaster.png dapper_gray_floor.png
dark_blue_wall.png dark_floor_texture.png dark_gray_plaster.png dark_green_plaster_wall.png gray_ceramic_tile.png
gray_floor.png gray_plaster.png gray_wall.png grigia_caldera_porcelain_floor.png kona_gotham.png
light-gray-floor-tile.png light-gray-plaster.png light_blue_wall.png light_floor.png light_gray_plaster.png
light_grey_plaster.png marble_floor.png martin_novak_wood_table.png meeka-beige-plaster.png
new_light_gray_plaster.png rustic_floor.png seamless_wood_planks_floor.png smooth_light_gray_plaster.png
stucco_wall.png table_light_wood.png tile_grigia_caldera_porcelain_floor.png white_marble_floor.png white_wall.png
yellow_linen_wall_texture.png
"""
TEXTURE_MAPPING = {Path(name).stem: name for name in _FILES.split()}
_WORDS = {"floor": "floor tile ceramic", "wall": "wall plaster ceramic", "table": "table", "sky": "sky"}


def get_texture_file_list(type: str, texture_path: str | os.PathLike) -> list[tuple[str, str]]:
    """Return name and path of the textures of a kind; raise an UnknownNameError if there is no such kind."""
    require_known("kind of texture", type, _WORDS)
    names = [name for name in TEXTURE_MAPPING if any(word in name for word in _WORDS[type].split())]
    return [(name, os.path.join(texture_path, TEXTURE_MAPPING[name])) for name in names]
