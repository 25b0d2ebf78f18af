"""The configuration files of the learning side, copied to where you want to change them."""

import argparse
import shutil
from collections.abc import Sequence
from importlib.resources import as_file, files
from pathlib import Path

from libero.scripts.command import run
from libero_env.errors import LiberoError


def main(argv: Sequence[str] | None = None) -> int:
    """The script."""
    parser = argparse.ArgumentParser(prog="libero.config_copy", description=__doc__)
    parser.add_argument(
        "target", nargs="?", type=Path, default=Path("configs"), help="folder (default: configs)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace files that are there")
    return run(parser, copy, argv)


def copy(args: argparse.Namespace) -> None:
    """Copy the files and say where they are.

    Raises:
        LiberoError: the folder exists.
    """
    if args.target.exists() and not args.overwrite:
        raise LiberoError(f"{args.target} exists; name another folder, or replace its files with --overwrite")
    with as_file(files("libero") / "configs") as source:
        shutil.copytree(
            source, args.target, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__", "*.py")
        )
    print(f"{args.target}: {len(list(args.target.rglob('*.yaml')))} files")


if __name__ == "__main__":
    raise SystemExit(main())
