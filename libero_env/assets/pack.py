"""Which models a scene is built from: the builtin pack, or the original's files where the user has them."""

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

from libero_env.assets import published
from libero_env.assets.arena import Workspace, add_arena, load_workspace
from libero_env.assets.downloads import broken_files, default_folder, read_manifest
from libero_env.assets.original import LIBERO_PRO, OriginalPack, is_original
from libero_env.assets.robot import robot_assets
from libero_env.errors import LiberoError, MissingPackageError
from libero_env.mujoco_compat import mujoco
from libero_env.objects import ObjectModel, get_object, object_names
from libero_env.paths import config_file, read_config
from libero_env.workspaces import WORKSPACES

BUILTIN = "builtin"
ORIGINAL = "original"  # the original's models, wherever they are installed
VARIABLE = "LIBERO_ASSETS"
_SOURCES = ("objects", "assets/arena.py", "assets/furnishing.py")


@dataclass(frozen=True)
class BuiltinPack:
    """The pack that is generated in code: nothing to download. Packs are hashable: scenes are cached by them."""

    @property
    def name(self) -> str:
        """Name of the pack in results and messages: `builtin`."""
        return BUILTIN

    @property
    def digest(self) -> str:
        """16 hexadecimal digits that change with the code and the parameters that models are generated from."""
        return _builtin_digest()

    def build(self, category: str) -> ObjectModel:
        """Return a new model of a category at each call: the caller may change its spec.

        Raises:
            UnknownNameError: No object has this name.
            LiberoError: This pack has no model of it.
        """
        if category in LIBERO_PRO and category not in object_names():
            raise LiberoError(
                f"the builtin pack has no model of {category}, which LIBERO-PRO adds; the original's distributions do: "
                "`libero assets install`, then --assets original"
            )
        return get_object(category)

    def categories(self) -> tuple[str, ...]:
        """Return all categories that `build` knows, sorted."""
        return object_names()

    def add_arena(
        self, spec: mujoco.MjSpec, workspace: Workspace, scene_properties: Mapping[str, str]
    ) -> None:
        """Add floor, walls, table, lights and cameras to a scene.

        Raises:
            UnknownNameError: A property names a style that does not exist.
        """
        add_arena(spec, workspace, scene_properties)


Pack = BuiltinPack | OriginalPack
"""Source of the models of objects and rooms."""


class Choice(NamedTuple):
    """A pack and why it is used.

    Attributes:
        value: `builtin`, `original`, or a folder.
        reason: Where the choice was made.
    """

    value: str
    reason: str


def chosen_assets(assets: str | os.PathLike | None = None) -> Choice:
    """Return the choice of `select_pack`: the argument, `LIBERO_ASSETS`, the configured `assets`, or `builtin`.

    An installed package does not change it: the same program has the same results with and without.
    """
    if assets is not None:
        return Choice(os.fspath(assets), "requested by the caller")
    if value := os.environ.get(VARIABLE):
        return Choice(value, f"${VARIABLE}")
    if value := read_config().get("assets"):
        return Choice(str(value), str(config_file()))
    return Choice(BUILTIN, "the default")


def facade_assets() -> Choice:
    """Return the choice for code that was written for the original: as `chosen_assets`, with another default.

    That default is the original's models where they are installed as packages, which was then done for their sake.
    """
    choice = chosen_assets()
    ignored = choice.reason == str(config_file()) and _is_absent(choice.value)
    if (choice.reason == "the default" or ignored) and published.installed_folder() is not None:
        return Choice(
            ORIGINAL, "the default of the facade where the original's models are installed as packages"
        )
    return choice


def select_pack(assets: Pack | str | os.PathLike | None = None, lod: int | None = None) -> Pack:
    """Return the pack to build scenes from.

    Args:
        assets: A pack, which is returned as it is; `builtin`; `original` for the original's models where they are
            installed as packages or downloaded; or the folder of the original's files. Default: `$LIBERO_ASSETS`, then
            the key `assets` of `$LIBERO_CONFIG_PATH/config.yaml`, then `builtin`.
        lod: Largest number of triangles of a visual mesh of the original; None keeps all triangles.

    Raises:
        MissingPackageError: `original` was requested, and is not installed.
        ChangedAssetsError: Files are missing or damaged.
        LiberoError: The folder does not hold the original's files.
    """
    if assets is None or isinstance(assets, str | os.PathLike):
        return pack_of(chosen_assets(assets), lod)
    return assets


def pack_of(choice: Choice, lod: int | None = None) -> Pack:
    """Return the pack of a choice; see `select_pack`."""
    value, reason = choice
    if value == BUILTIN or (reason == str(config_file()) and _is_absent(value)):
        return BuiltinPack()  # the original writes this key whether there are files or not
    root = original_folder() if value == ORIGINAL else Path(value).expanduser().absolute()
    if not is_original(root):
        raise LiberoError(
            f"{root} ({reason}) does not hold the original assets: a folder with articulated_objects, scenes, "
            f"stable_hope_objects, ... is expected. `libero assets install` and `libero assets download` bring them; "
            f"{VARIABLE}={BUILTIN} selects the builtin pack, which needs none"
        )
    if value != ORIGINAL:
        published.require_undamaged(root)
    return OriginalPack(str(root), lod)


def original_folder() -> Path:
    """Return the folder of the original's models: of the installed packages, or else of `libero assets download`.

    Raises:
        MissingPackageError: There is neither.
        ChangedAssetsError: Files are missing or have changed.
    """
    if folder := published.installed_folder():
        published.require_published(folder, published.REMEDY)
        return folder
    if is_original(folder := default_folder()):
        published.require_undamaged(folder)
        return folder
    raise MissingPackageError(
        "the original's models are not installed", f"{published.EXTRA}, or libero assets install"
    )


def problems(pack: Pack) -> list[str]:
    """Return a line for each object or room that does not compile and each file that is missing or has changed."""
    lines = []
    try:
        robot_assets()
    except MissingPackageError as error:
        lines.append(f"robot: {error}")

    def room(name: str) -> mujoco.MjSpec:
        spec = mujoco.MjSpec()
        pack.add_arena(spec, load_workspace(name), {})
        return spec

    makers = dict.fromkeys(pack.categories(), lambda name: pack.build(name).spec)
    for name, make in {**makers, **dict.fromkeys(WORKSPACES, room)}.items():
        try:
            make(name).compile()
        except (LiberoError, ValueError) as error:  # MuJoCo raises ValueError for a broken mesh or texture
            lines.append(f"{name}: {error}")
    if not isinstance(pack, OriginalPack):
        return lines
    root = Path(pack.root)
    if record := read_manifest(root):  # as the Hub listed the files
        return lines + [f"{name}: missing or changed" for name in broken_files(root, record[1])]
    published.check_folder.cache_clear()
    return lines + list(published.check_folder(root).differences)


def _is_absent(value: str) -> bool:
    """Return whether a folder does not exist or is empty."""
    folder = Path(value).expanduser()
    is_empty = folder.is_dir() and not any(folder.iterdir())
    return value not in (BUILTIN, ORIGINAL) and (is_empty or not folder.exists())


@cache
def _builtin_digest() -> str:
    package = Path(__file__).parents[1]
    paths = (path for name in _SOURCES for path in (package / name, *(package / name).rglob("*")))
    files = sorted(path for path in paths if path.suffix in (".py", ".yaml") and path.is_file())
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]
