"""Write a file to start from: a problem class, a scene with a task, an object with its MJCF, or an arena.

Options that are missing are asked for, where there is a terminal.
"""

import argparse
import re
import sys
from importlib.resources import files
from pathlib import Path
from string import Template

from libero.libero.envs.base_object import category_of
from libero.libero.utils.mu_utils import scene_key
from libero.scripts.command import option, script
from libero_env.errors import LiberoError

KINDS = ("problem_class", "scene", "object", "arena")


@script(
    option("--template", "-t", choices=KINDS, help="kind of template"),
    option("--name", "-n", help="name of the class, such as MyKitchenScene"),
    option("--out", "-o", type=Path, default=Path(), help="folder (default: the current folder)"),
    option("--overwrite", action="store_true", help="replace files that exist"),
    prog="libero.create_template",
)
def main(args: argparse.Namespace) -> None:
    """Write the files and print their paths; raise a LiberoError if a file exists or an answer is not valid."""
    kind = args.template or ask(f"Kind of template ({', '.join(KINDS)})", "--template")
    if kind not in KINDS:
        raise LiberoError(f"{kind!r} is not a template; valid: {', '.join(KINDS)}")
    name = args.name or ask("Name of the class, such as MyKitchenScene", "--name")
    if not re.fullmatch(r"[A-Z]\w*", name, re.ASCII):
        raise LiberoError(f"{name!r} is not a valid class name; begin with a capital, use letters and digits")
    stem = category_of(name) if kind == "object" else scene_key(name)
    texts = {}
    for ending in ("py", "xml") if kind == "object" else ("py",):
        text = (files("libero.scripts") / "templates" / f"{kind}.{ending}.txt").read_text(encoding="utf-8")
        texts[args.out / f"{stem}.{ending}"] = Template(text).substitute(Name=name, name=stem)
    if (existing := [path for path in texts if path.exists()]) and not args.overwrite:
        raise LiberoError(f"{existing[0]} exists; choose another name or folder, or pass --overwrite")
    args.out.mkdir(parents=True, exist_ok=True)
    for path, text in texts.items():
        path.write_text(text, encoding="utf-8")
        print(path)


def ask(question: str, option: str) -> str:
    """Return what the user types; raise a LiberoError if there is no terminal."""
    if not sys.stdin.isatty():
        raise LiberoError(f"{option} is missing, and there is no terminal to ask for it")
    return input(f"{question}: ").strip()
