"""Completeness of a pack: every object and room can be built, every downloaded file is unchanged."""

from pathlib import Path

import mujoco

from libero_env.assets.arena import WORKSPACES, load_workspace
from libero_env.assets.download import read_manifest
from libero_env.assets.hub import broken_files
from libero_env.assets.original import OriginalPack
from libero_env.assets.pack import Pack
from libero_env.assets.published import check_folder
from libero_env.assets.robot import robosuite_assets
from libero_env.errors import LiberoError, MissingPackageError


def problems(pack: Pack) -> list[str]:
    """Return a line for each object or room that does not compile and each file that is missing or has changed."""
    found = _robot_problems()
    found += [f"{what}: {error}" for what in pack.categories() if (error := _build_error(pack, what))]
    found += [f"{what}: {error}" for what in WORKSPACES if (error := _arena_error(pack, what))]
    if isinstance(pack, OriginalPack):
        found += _file_problems(Path(pack.root))
    return found


def _file_problems(root: Path) -> list[str]:
    """Return a line for each file that is not as the Hub listed it or, where it did not, as published."""
    if record := read_manifest(root):
        return [f"{name}: missing or changed" for name in broken_files(root, record[1])]
    check_folder.cache_clear()
    return list(check_folder(root).differences)


def _robot_problems() -> list[str]:
    try:
        robosuite_assets()
    except MissingPackageError as error:
        return [f"robot: {error}"]
    return []


def _build_error(pack: Pack, category: str) -> str | None:
    try:
        pack.build(category).spec.compile()
    except (LiberoError, ValueError) as error:  # MuJoCo raises ValueError for a broken mesh or texture
        return str(error)
    return None


def _arena_error(pack: Pack, workspace: str) -> str | None:
    spec = mujoco.MjSpec()
    try:
        pack.add_arena(spec, load_workspace(workspace), {})
        spec.compile()
    except (LiberoError, ValueError) as error:
        return str(error)
    return None
