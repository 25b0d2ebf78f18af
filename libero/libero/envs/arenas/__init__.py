"""A scene before it is compiled, with the interface of robosuite's arenas, and the styles of rooms."""

from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import Any
from xml.etree.ElementTree import Element

from libero._adapters.lookup import alias_modules, lookup
from libero_env.assets.original_arena import TEXTURES
from libero_env.errors import LiberoError
from libero_env.mujoco_compat import mujoco

STYLE_KINDS = ("floor", "wall")
STYLE_MAPPING = {kind: dict(TEXTURES[kind]) for kind in STYLE_KINDS}
FLOOR_STYLE, WALL_STYLE = STYLE_MAPPING["floor"], STYLE_MAPPING["wall"]


def get_texture_filename(type: str, style: str) -> str:
    """Return the texture file of a style in the original; raise an UnknownNameError if there is none."""
    return lookup(lookup(STYLE_MAPPING, "kind of style", type), f"{type} style", style)


class Arena:
    """Floor, walls, table, cameras and lights as an editable model.

    Attributes:
        spec: The model.
    """

    def __init__(self, spec: mujoco.MjSpec):
        self.spec = spec

    worldbody = property(attrgetter("spec.worldbody"), doc="The world body.")
    floor_body = table_body = coffee_table_body = living_room_table_body = property(lambda self: self)

    def append(self, element: Element) -> None:
        """Accept the site of a region, which the scene has; raise a LiberoError for anything else."""
        if element.tag != "site" or self.spec.site(element.get("name", "")) is None:
            what = f"<{element.tag} name={element.get('name')!r}>"
            raise LiberoError(
                f"{what} cannot be appended to the arena: add it to its `spec`, a mujoco.MjSpec"
            )

    def set_camera(
        self,
        camera_name: str,
        pos: Sequence[float],
        quat: Sequence[float],
        camera_attribs: Mapping[str, Any] | None = None,
    ) -> None:
        """Set the pose of a camera, or add one; of `camera_attribs`, `fovy` has an effect."""
        camera = self.spec.camera(camera_name)
        camera = self.spec.worldbody.add_camera(name=camera_name) if camera is None else camera
        camera.pos, camera.quat = pos, quat
        if camera_attribs and "fovy" in camera_attribs:
            camera.fovy = float(camera_attribs["fovy"])

    def get_xml(self) -> str:
        """Return the model as MJCF."""
        return self.spec.to_xml()


alias_modules(__name__, "base_arena style")
