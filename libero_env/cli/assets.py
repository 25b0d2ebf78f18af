"""`libero assets`: download the original's models, report which models are used, check that they are complete."""

import argparse
from pathlib import Path

from libero_env.cli.arguments import Subparsers


def register(subparsers: Subparsers) -> None:
    """Add the command `libero assets`."""
    parser = subparsers.add_parser("assets", help="download and check the original's models")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    download = commands.add_parser(
        "download", help="download the original's models (420 MB); resumes where it was stopped"
    )
    download.add_argument("--dest", type=Path, help="folder (default: assets in the cache)")
    download.add_argument(
        "--revision", help="commit, tag or branch of the data set (default: a pinned commit)"
    )
    download.set_defaults(run=run_download)
    info = commands.add_parser("info", help="print which models scenes are built from, and why")
    info.set_defaults(run=run_info)
    check = commands.add_parser("check", help="check that all files of the models exist and are unchanged")
    check.add_argument("folder", nargs="?", type=Path, help="folder to check (default: the models in use)")
    check.set_defaults(run=run_check)


def run_download(args: argparse.Namespace) -> None:
    """Download the models and print how to use them."""
    from libero_env.assets.download import REVISION, download
    from libero_env.assets.pack import VARIABLE
    from libero_env.paths import config_file

    folder = download(args.dest, args.revision or REVISION)
    print(f"{folder}: complete and verified")
    print(f"use it:      export {VARIABLE}={folder}")
    print(f"or for good: the line `assets: {folder}` in {config_file()}")


def run_info(args: argparse.Namespace) -> None:
    """Print the models in use and the setting that chose them."""
    from libero_env.assets.download import default_folder, read_manifest
    from libero_env.assets.pack import chosen_assets, select_pack

    choice = chosen_assets()
    pack = select_pack()
    root = getattr(pack, "root", None)
    print(f"models:  {pack.name}" + (f" in {root}" if root else ""))
    print(f"because: {choice.reason} is {choice.value}")
    if root is None and choice.value != pack.name:
        print("         which does not exist")
    if record := read_manifest(Path(root or default_folder())):
        print(f"downloaded: {root or default_folder()}, revision {record[0]}")


def run_check(args: argparse.Namespace) -> int:
    """Print a line for each model that cannot be built and each changed file; return 1 if there are any."""
    from libero_env.assets.check import problems
    from libero_env.assets.pack import select_pack

    pack = select_pack(args.folder)
    found = problems(pack)
    for line in found:
        print(f"FAIL  {line}")
    print(f"{pack.name}: {len(pack.categories())} objects, {len(found)} problems")
    return int(bool(found))
