"""Texture files in the `textures` folder of the original."""

import os

from libero_env.errors import require_known

_FILES = """
Beige_Plaster_1=meeka-beige-plaster Blue_Wall_1=dark_blue_wall Blue_Wall_2=canvas_sky_blue
Blue_Wall_3=light_blue_wall Brown_Ceramic_Tile_1=brown_ceramic_tile Ceramic_1=ceramic Cream_Plaster_1=cream-plaster
Dark_Floor_1=dark_floor_texture Gray_Ceramic_Tile_1=gray_ceramic_tile Gray_Floor_1=gray_floor
Gray_Floor_2=dapper_gray_floor Gray_Plaster_1=gray_plaster Gray_Plaster_2=new_light_gray_plaster
Gray_Plaster_3=light-gray-plaster Gray_Plaster_4=dark_gray_plaster Gray_Plaster_5=smooth_light_gray_plaster
Gray_Plaster_6=light_gray_plaster Gray_Plaster_7=light_grey_plaster Gray_Wall_1=gray_wall
Green_Plaster_Wall_1=dark_green_plaster_wall Kona_Gotham_1=kona_gotham Light_Floor_1=light_floor
Light_Gray_Floor_1=light-gray-floor-tile Marble_Floor_1=marble_floor Porcelain_Floor_1=grigia_caldera_porcelain_floor
Porcelain_Floor_2=tile_grigia_caldera_porcelain_floor Rustic_Floor_1=rustic_floor Sky_Image_1=capriccio_sky
Stucco_Wall_1=stucco_wall White_Marble_Floor_1=white_marble_floor White_Wall_1=white_wall
Wood_Floor_1=seamless_wood_planks_floor Wood_Table_1=martin_novak_wood_table Wood_Table_2=table_light_wood
Yellow_Linen_Wall_Texture_1=yellow_linen_wall_texture
"""
TEXTURE_MAPPING = {name: f"{file}.png" for name, file in (pair.split("=") for pair in _FILES.split())}
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
