"""Arenas by class: a scene before it is compiled, with the interface of robosuite's arenas."""

from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import Any, ClassVar
from xml.etree.ElementTree import Element

from libero._adapters.lookup import alias_modules, lookup
from libero._adapters.models import facade_pack
from libero.libero.envs.base_object import class_name
from libero_env.assets.arena import load_workspace
from libero_env.assets.original_arena import TEXTURES
from libero_env.errors import InvalidInputError, LiberoError
from libero_env.mujoco_compat import mujoco
from libero_env.workspaces import BUILTIN_WORKSPACES

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


class WorkspaceArena(Arena):
    """The arena of one workspace.

    Args:
        floor_style, wall_style: Names in `FLOOR_STYLE` and `WALL_STYLE`.
        scene: Style of the whole scene, such as `warm`.

    Raises:
        InvalidInputError: Another argument of the original's classes is given, such as `table_full_size`.
    """

    category: ClassVar[str]

    def __init__(
        self,
        floor_style: str | None = None,
        wall_style: str | None = None,
        scene: str | None = None,
        **kwargs: Any,
    ):
        if kwargs:
            raise InvalidInputError(
                f"{', '.join(kwargs)}: not supported; the {self.category} is that of the benchmark"
            )
        spec = mujoco.MjSpec()
        styles = {"floor": floor_style, "wall": wall_style, "scene": scene}
        self.workspace = load_workspace(self.category)
        facade_pack().add_arena(spec, self.workspace, {k: v for k, v in styles.items() if v is not None})
        super().__init__(spec)

    table_offset = property(attrgetter("workspace.offset"), doc="Origin of the regions, (3,) m.")
    table_top_abs = property(attrgetter("workspace.offset"), doc="Position of the table top, (3,) m.")

    def configure_location(self) -> None:
        """Do nothing: tables have the sizes and places of the benchmark."""


for _category in BUILTIN_WORKSPACES:
    _name = "EmptyArena" if _category == "floor" else f"{class_name(_category)}Arena"
    globals()[_name] = type(_name, (WorkspaceArena,), {"__module__": __name__, "category": _category})

alias_modules(
    __name__,
    "base_arena coffee_table_arena empty_arena kitchen_arena living_room_arena study_arena table_arena style",
)
