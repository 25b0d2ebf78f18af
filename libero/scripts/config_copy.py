"""Copy the configuration files of the learning half to a folder of your own, to change them there."""

import argparse
import shutil
from importlib.resources import as_file, files
from pathlib import Path

from libero.scripts.command import option, script
from libero_env.errors import LiberoError


@script(
    option("target", nargs="?", type=Path, default=Path("configs"), help="folder (default: configs)"),
    option("--overwrite", action="store_true", help="replace files that exist"),
    prog="libero.config_copy",
)
def main(args: argparse.Namespace) -> None:
    """Copy the files and print the folder; raise a LiberoError if the folder exists."""
    if args.target.exists() and not args.overwrite:
        raise LiberoError(f"{args.target} exists; choose another folder, or pass --overwrite")
    with as_file(files("libero") / "configs") as source:
        ignored = shutil.ignore_patterns("__pycache__", "*.py")
        shutil.copytree(source, args.target, dirs_exist_ok=True, ignore=ignored)
    print(f"{args.target}: {len(list(args.target.rglob('*.yaml')))} files")
