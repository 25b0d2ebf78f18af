"""Which models a scene is built from: the builtin pack, or the original's files where the user has them."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import mujoco

from libero_env.assets.arena import Workspace, add_arena
from libero_env.assets.original import OriginalPack, is_original
from libero_env.errors import LiberoError
from libero_env.objects import ObjectModel, get_object, object_names
from libero_env.paths import config_file, read_config

BUILTIN = "builtin"
VARIABLE = "LIBERO_ASSETS"


class Pack(Protocol):
    """Source of the models of objects and rooms. It is hashable: scenes are cached by it."""

    def __hash__(self) -> int: ...

    @property
    def name(self) -> str:
        """Name of the pack in results and messages."""
        ...

    def build(self, category: str) -> ObjectModel:
        """Return a new model of a category at each call: the caller may change its spec.

        Raises:
            UnknownNameError: No object has this name.
            LiberoError: This pack has no model of it.
        """
        ...

    def categories(self) -> tuple[str, ...]:
        """Return all categories that `build` knows, sorted."""
        ...

    def add_arena(
        self, spec: mujoco.MjSpec, workspace: Workspace, scene_properties: Mapping[str, str]
    ) -> None:
        """Add floor, walls, table, lights and cameras to a scene.

        Raises:
            UnknownNameError: A property names a style that does not exist.
        """
        ...


@dataclass(frozen=True)
class BuiltinPack:
    """The pack that is generated in code: nothing to download."""

    @property
    def name(self) -> str:
        """Name of the pack: `builtin`."""
        return BUILTIN

    def build(self, category: str) -> ObjectModel:
        """Return a new model of a category; see `Pack`."""
        return get_object(category)

    def categories(self) -> tuple[str, ...]:
        """Return all categories; see `Pack`."""
        return object_names()

    def add_arena(
        self, spec: mujoco.MjSpec, workspace: Workspace, scene_properties: Mapping[str, str]
    ) -> None:
        """Add the arena of a workspace; see `Pack`."""
        add_arena(spec, workspace, scene_properties)


class Choice(NamedTuple):
    """A pack and why it is used.

    Attributes:
        value: `builtin`, or a folder.
        reason: Where the choice was made.
    """

    value: str
    reason: str


def chosen_assets(assets: str | os.PathLike | None = None) -> Choice:
    """Return the choice of `select_pack`: the argument, `LIBERO_ASSETS`, the configured `assets`, or the default."""
    if assets is not None:
        return Choice(os.fspath(assets), "requested by the caller")
    if value := os.environ.get(VARIABLE):
        return Choice(value, f"${VARIABLE}")
    if value := read_config().get("assets"):
        return Choice(str(value), str(config_file()))
    return Choice(BUILTIN, "the default")


def select_pack(assets: str | os.PathLike | None = None, lod: int | None = None) -> Pack:
    """Return the pack to build scenes from.

    Args:
        assets: `builtin`, or the folder of the original's files. Default: `$LIBERO_ASSETS`, then the key `assets` of
            `$LIBERO_CONFIG_PATH/config.yaml`, then `builtin`.
        lod: Largest number of triangles of a visual mesh of the original; None keeps all triangles.

    Raises:
        LiberoError: The folder does not hold the original's files.
    """
    value, reason = chosen_assets(assets)
    if value == BUILTIN:
        return BuiltinPack()

    root = Path(value).expanduser().absolute()
    if is_original(root):
        return OriginalPack(str(root), lod)
    if reason == str(config_file()) and not root.exists():
        return BuiltinPack()  # the original writes this key whether there are files or not
    raise LiberoError(
        f"{root} ({reason}) does not hold the original assets: a folder with articulated_objects, scenes, "
        f"stable_hope_objects, ... is expected. `libero assets download` downloads them; {VARIABLE}={BUILTIN} "
        "selects the builtin pack, which needs none"
    )
