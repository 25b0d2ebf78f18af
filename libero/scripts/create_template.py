"""A file to start from: a problem class, a scene with a task, an object with its MJCF, or an arena.

What is not given on the command line is asked for, where there is a terminal to ask.
"""

import argparse
import re
import sys
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from string import Template

from libero.libero.envs.base_object import category_of
from libero.libero.utils.mu_utils import scene_key
from libero.scripts.command import run
from libero_env.errors import LiberoError

# What can be made -> the files it consists of.
KINDS = {
    "problem_class": ("problem_class.py",),
    "scene": ("scene.py",),
    "object": ("object.py", "object.xml"),
    "arena": ("arena.py",),
}


def main(argv: Sequence[str] | None = None) -> int:
    """The script."""
    parser = argparse.ArgumentParser(prog="libero.create_template", description=__doc__)
    add = parser.add_argument
    add("--template", "-t", choices=tuple(KINDS), help="what to make")
    add("--name", "-n", help="of the class, such as MyKitchenScene")
    add("--out", "-o", type=Path, default=Path(), help="folder (default: here)")
    add("--overwrite", action="store_true", help="replace files that are there")
    return run(parser, create, argv)


def create(args: argparse.Namespace) -> None:
    """Write the files and name them.

    Raises:
        LiberoError: an answer is missing or makes no sense, or a file exists.
    """
    kind = args.template or ask(f"What shall it be ({', '.join(KINDS)})", "--template")
    if kind not in KINDS:
        raise LiberoError(f"{kind!r} is no template; valid: {', '.join(KINDS)}")
    name = args.name or ask("Name of the class, such as MyKitchenScene", "--name")
    if not re.fullmatch(r"[A-Z]\w*", name, re.ASCII):
        raise LiberoError(f"{name!r} is no name for a class; use letters and digits, a capital first")
    stem = category_of(name) if kind == "object" else scene_key(name)
    texts = {}
    for file in KINDS[kind]:
        text = (files("libero.scripts") / "templates" / f"{file}.txt").read_text(encoding="utf-8")
        texts[args.out / f"{stem}{Path(file).suffix}"] = Template(text).substitute(Name=name, name=stem)
    if (there := [path for path in texts if path.exists()]) and not args.overwrite:
        raise LiberoError(f"{there[0]} exists; choose another name or folder, or replace it with --overwrite")
    args.out.mkdir(parents=True, exist_ok=True)
    for path, text in texts.items():
        path.write_text(text, encoding="utf-8")
        print(path)


def ask(question: str, option: str) -> str:
    """What the user types.

    Raises:
        LiberoError: there is nobody to ask.
    """
    if not sys.stdin.isatty():
        raise LiberoError(f"{option} is missing, and there is no terminal to ask for it")
    return input(f"{question}: ").strip()


if __name__ == "__main__":
    raise SystemExit(main())
