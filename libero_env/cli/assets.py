"""`libero assets`: install or download the original's models, report which models are used, check them."""

from pathlib import Path
from typing import Literal

from libero_env.cli.options import FilePath, Positional
from libero_env.errors import LiberoError


def install(
    what: Positional[Literal["original", "robot"]] = "original", *, dest: FilePath | None = None
) -> None:
    """Install the original's models (340 MB) with pip, the pinned version, and verify them; or fetch the robot's.

    Args:
        what: original, or robot: the arm's files (190 MB, of which 42 are kept in the cache), unless they are there.
        dest: Folder of the original's models (default: the running environment).
    """
    if what == "robot":
        from libero_env.assets.robot import robot_assets

        if dest is not None:
            raise LiberoError("the robot's files are kept in the cache; set LIBERO_CACHE in place of --dest")
        print(f"{robot_assets()}: complete")
        return
    from libero_env.assets.pack import ORIGINAL
    from libero_env.assets.published import install as install_models

    folder = install_models(dest)
    print(f"{folder}: complete; all files are the published ones")
    _print_use(ORIGINAL if dest is None else str(folder))


def download(*, dest: FilePath | None = None, revision: str | None = None) -> None:
    """Download the original's models from the Hugging Face Hub (420 MB); resumes where it was stopped.

    Args:
        dest: Folder (default: assets in the cache).
        revision: Commit, tag or branch of the data set (default: a pinned commit).
    """
    from libero_env.assets.downloads import REVISION
    from libero_env.assets.downloads import download as download_models

    folder = download_models(dest, revision or REVISION)
    print(f"{folder}: complete; all files have the digests that the server lists")
    _print_use(str(folder))


def info() -> None:
    """Print the models in use, the setting that chose them, and what is installed."""
    from libero_env.assets.downloads import default_folder, read_manifest
    from libero_env.assets.pack import chosen_assets, facade_assets, pack_of
    from libero_env.assets.published import VERSION, ChangedAssetsError, check_folder, installed_folder

    choice = chosen_assets()
    pack = pack_of(choice)
    root = getattr(pack, "root", None)
    print(f"models:  {pack.name}" + (f" in {root}" if root else ""))
    print(f"because: {choice.reason} is {choice.value}")
    if root is None and choice.value != pack.name:
        print("         which does not exist")
    print(f"digest:  {pack.digest}" + (f", {check_folder(Path(root)).summary}" if root else ""))
    try:
        facade = facade_assets()
        print(f"facade:  {pack_of(facade).name}" + (f": {facade.reason}" if facade != choice else ""))
        if folder := installed_folder():
            print(f"installed: {folder}, version {VERSION}")
    except ChangedAssetsError as error:
        print(f"facade:  {error}")
    if record := read_manifest(Path(root or default_folder())):
        print(f"downloaded: {root or default_folder()}, revision {record[0]}")


def check(folder: Positional[FilePath | None] = None) -> int:
    """Print a line for each model that cannot be built and each changed file; return 1 if there are any.

    Args:
        folder: Folder to check (default: the models in use).
    """
    from libero_env.assets.original import OriginalPack, is_original
    from libero_env.assets.pack import problems, select_pack

    named = folder is not None and is_original(folder)  # then damaged files are listed, not refused
    pack = OriginalPack(str(folder.expanduser().absolute())) if folder and named else select_pack(folder)
    lines = problems(pack)
    for line in lines:
        print(f"FAIL  {line}")
    print(f"{pack.name}: {len(pack.categories())} objects, {len(lines)} problems")
    return int(bool(lines))


def _print_use(value: str) -> None:
    from libero_env.assets.pack import VARIABLE
    from libero_env.paths import config_file

    print(f"use it:      export {VARIABLE}={value}")
    print(f"or for good: the line `assets: {value}` in {config_file()}")
