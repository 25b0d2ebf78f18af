"""The original benchmark's objects and rooms, read from its own files.

Collision geometry, masses, joints and contact parameters are those of the files, so that the original's
initial states are valid. How an object rests and when it counts as open is not in the files: it is the builtin pack's.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from libero_env.assets.arena import Workspace, add_arena, add_cameras_and_lights
from libero_env.assets.original_arena import arena_spec, restore_drawing, scene_file
from libero_env.assets.original_mjcf import object_xml, read_spec
from libero_env.assets.published import check_folder
from libero_env.assets.simplify import simplify_visuals
from libero_env.errors import LiberoError, UnknownNameError
from libero_env.mujoco_compat import mujoco
from libero_env.objects.builtin.physics import load_physics
from libero_env.objects.catalog import get_object, user_defined_names
from libero_env.objects.model import ObjectModel
from libero_env.storage import read_yaml

_NAMES = read_yaml("assets/original.yaml")
# Folder -> its categories; each has one file.
FAMILIES: Mapping[str, Sequence[str]] = _NAMES["families"]
# Category that LIBERO-PRO adds -> category that it recolours or enlarges, and by how much.
LIBERO_PRO: Mapping[str, tuple[str, float]] = _NAMES["libero_pro"]
_OFFSETS = ("bottom_offset", "top_offset", "horizontal_radius")  # fields that grow with an object
_STEMS = {"rack": "simple_rack"}
_ROOM = "room_"
_NAMED_ONLY = ("cherries", "corn", "mayo")  # categories of the original whose files were never published


@dataclass(frozen=True)
class OriginalPack:
    """Models that are read from the original's asset folder.

    Attributes:
        root: Folder that contains `articulated_objects`, `scenes`, ...
        lod: Largest number of triangles of a visual mesh; None keeps all triangles.
    """

    root: str
    lod: int | None = None

    @property
    def name(self) -> str:
        """Name of the pack: `original`, or such as `original-lod500` with a level of detail."""
        return "original" if self.lod is None else f"original-lod{self.lod}"

    @property
    def digest(self) -> str:
        """Digest of the files, that of the published ones or `modified-...`; see `libero_env.assets.published`."""
        return check_folder(Path(self.root)).digest

    def categories(self) -> tuple[str, ...]:
        """Return all categories of the files that are there, those that users registered included, sorted."""
        pro = (name for name in LIBERO_PRO if self.file(name).is_file())
        return tuple(
            sorted({*user_defined_names(), *pro, *(c for group in FAMILIES.values() for c in group)})
        )

    def build(self, category: str) -> ObjectModel:
        """Return a new model of a category at each call; a category that users registered takes precedence.

        Raises:
            UnknownNameError: No object has this name.
            LiberoError: The pack has no model of this category, or its files are missing.
        """
        if category in user_defined_names():
            return get_object(category)
        if category in _NAMED_ONLY:
            raise LiberoError(
                f"the original assets contain no model of {category!r}, only its name; add one with "
                "libero_env.objects.register_object, or use the builtin pack where it has one (LIBERO_ASSETS=builtin)"
            )
        file = self.file(category)
        if category in LIBERO_PRO and not file.is_file():
            raise LiberoError(
                f"{file} does not exist: LIBERO-PRO adds {category}, and only its distributions have it "
                "(`libero assets install`, then --assets original)"
            )
        spec = read_spec(object_xml(file, category, Path(self.root)), file)
        self._simplify(spec)
        base, scale = LIBERO_PRO.get(category, (category, 1.0))
        fields = load_physics(base).of_model
        if scale != 1.0:
            fields |= {name: _scaled(fields[name], scale) for name in _OFFSETS}
        return ObjectModel(category, spec, **fields)

    def file(self, category: str) -> Path:
        """Return the MJCF file of a category.

        Raises:
            UnknownNameError: No object has this name.
        """
        alike, _ = LIBERO_PRO.get(category, (category, 1.0))
        folder = next((name for name, group in FAMILIES.items() if alike in group), None)
        if folder is None:
            raise UnknownNameError("object category", category, self.categories())
        stem = _STEMS.get(category, category)
        flat = Path(self.root) / folder / f"{stem}.xml"
        return flat if folder == "articulated_objects" else flat.with_suffix("") / flat.name

    def add_arena(
        self, spec: mujoco.MjSpec, workspace: Workspace, scene_properties: Mapping[str, str]
    ) -> None:
        """Attach the original's room, with its cameras and lights; or that of a user's workspace.

        Raises:
            UnknownNameError: A property names a style that does not exist.
            LiberoError: Files are missing.
        """
        if workspace.own:
            add_arena(spec, workspace, scene_properties)
            return
        room = arena_spec(Path(self.root), workspace, scene_properties)
        self._simplify(room)
        spec.attach(room, prefix=_ROOM, frame=spec.worldbody.add_frame())
        for item in (*spec.bodies, *spec.geoms, *spec.sites):
            # MuJoCo warns about an empty prefix; assets keep their names
            item.name = item.name.removeprefix(_ROOM)
        add_cameras_and_lights(spec, workspace)

    def restore_drawing(
        self, spec: mujoco.MjSpec, workspace: Workspace, scene_properties: Mapping[str, str]
    ) -> None:
        """Make a complete scene of this pack look as the original's own, see `libero_env.assets.original_arena`.

        Raises:
            LiberoError: The pack is simplified, or a file is missing.
        """
        if self.lod is not None:
            raise LiberoError(
                f"drawing: a pack whose meshes are simplified to {self.lod} triangles cannot be drawn faithfully; "
                "leave out lod, or draw it fast"
            )
        style = scene_properties.get("scene", "base")
        scene = None if workspace.own else scene_file(Path(self.root), workspace.name, style)
        restore_drawing(spec, Path(self.root), workspace, scene)

    def _simplify(self, spec: mujoco.MjSpec) -> None:
        if self.lod is not None:
            simplify_visuals(spec, self.lod)


def _scaled(value: float | tuple[float, ...], scale: float) -> float | tuple[float, ...]:
    return tuple(scale * x for x in value) if isinstance(value, tuple) else scale * value


def is_original(root: str | os.PathLike) -> bool:
    """Return whether a folder looks like the original's assets."""
    return all((Path(root) / folder).is_dir() for folder in (*FAMILIES, "scenes"))
