"""`libero assets`: fetch the original's models, say which models are in use, check that they are complete."""

import argparse
from pathlib import Path


def register(subparsers: "argparse._SubParsersAction") -> None:
    """`libero assets download|info|check`"""
    parser = subparsers.add_parser("assets", help="the original's models: fetch them, check them")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    download = commands.add_parser(
        "download", help="fetch the original's models (420 MB); goes on where it was stopped"
    )
    download.add_argument("--dest", type=Path, help="the folder (default: assets in the cache)")
    download.add_argument(
        "--revision", help="commit, tag or branch of the data set (default: a pinned commit)"
    )
    download.set_defaults(run=run_download)
    info = commands.add_parser("info", help="which models scenes are built from, and why")
    info.set_defaults(run=run_info)
    check = commands.add_parser("check", help="whether every model's files are there")
    check.add_argument("folder", nargs="?", type=Path, help="default: the models in use")
    check.set_defaults(run=run_check)


def run_download(args: argparse.Namespace) -> None:
    """Fetch, then say how to use it."""
    from libero_env.assets.download import REVISION, download
    from libero_env.assets.pack import VARIABLE
    from libero_env.paths import config_file

    folder = download(args.dest, args.revision or REVISION)
    print(f"{folder}: complete and verified")
    print(f"use it:      export {VARIABLE}={folder}")
    print(f"or for good: the line `assets: {folder}` in {config_file()}")


def run_info(args: argparse.Namespace) -> None:
    """Return the name the models and the setting that chose them."""
    from libero_env.assets.download import default_folder, read_manifest
    from libero_env.assets.pack import chosen_assets, select_pack

    choice = chosen_assets()
    pack = select_pack()
    root = getattr(pack, "root", None)
    print(f"models:  {pack.name}" + (f" in {root}" if root else ""))
    print(f"because: {choice.reason} says {choice.value}")
    if root is None and choice.value != pack.name:
        print("         which does not exist")
    if record := read_manifest(Path(root or default_folder())):
        print(f"fetched: {root or default_folder()}, revision {record[0]}")


def run_check(args: argparse.Namespace) -> int:
    """One line for each model that cannot be built and each file that differs; 1 where there is one."""
    from libero_env.assets.check import problems
    from libero_env.assets.pack import select_pack

    pack = select_pack(args.folder)
    found = problems(pack)
    for line in found:
        print(f"FAIL  {line}")
    print(f"{pack.name}: {len(pack.categories())} objects, {len(found)} problems")
    return int(bool(found))
