"""Scripts of files: copy the configurations, write templates, print and check checksums."""

import hashlib
import re
import shutil
import sys
from importlib.resources import as_file, files
from pathlib import Path
from string import Template
from typing import Annotated, Literal, get_args

from tqdm import tqdm

from libero.libero.envs.base_object import category_of
from libero.libero.utils.download_utils import datasets_folder
from libero.libero.utils.mu_utils import scene_key
from libero.scripts.command import script
from libero_env.cli.options import Positional, arg
from libero_env.errors import LiberoError, require_known

Kind = Literal["problem_class", "scene", "object", "arena"]


@script("libero.config_copy")
def config_copy(target: Positional[Path] = Path("configs"), *, overwrite: bool = False) -> None:
    """Copy the configuration files of the learning half to a folder of your own, to change them there.

    Args:
        target: Folder.
        overwrite: Replace files that exist.
    """
    if target.exists() and not overwrite:
        raise LiberoError(f"{target} exists; choose another folder, or pass --overwrite")
    with as_file(files("libero") / "configs") as source:
        ignored = shutil.ignore_patterns("__pycache__", "*.py")
        shutil.copytree(source, target, dirs_exist_ok=True, ignore=ignored)
    print(f"{target}: {len(list(target.rglob('*.yaml')))} files")


@script("libero.create_template")
def create_template(
    *,
    template: Annotated[Kind | None, arg(aliases=["-t"])] = None,
    name: Annotated[str | None, arg(aliases=["-n"])] = None,
    out: Annotated[Path, arg(aliases=["-o"])] = Path(),
    overwrite: bool = False,
) -> None:
    """Write a file to start from: a problem class, a scene with a task, an object with its MJCF, or an arena.

    Options that are missing are asked for, where there is a terminal.

    Args:
        template: Kind of template.
        name: Name of the class, such as MyKitchenScene.
        out: Folder.
        overwrite: Replace files that exist.
    """
    kinds = get_args(Kind)
    kind = template or _ask(f"Kind of template ({', '.join(kinds)})", "--template")
    require_known("template", kind, kinds)
    name = name or _ask("Name of the class, such as MyKitchenScene", "--name")
    if not re.fullmatch(r"[A-Z]\w*", name, re.ASCII):
        raise LiberoError(f"{name!r} is not a valid class name; begin with a capital, use letters and digits")
    stem = category_of(name) if kind == "object" else scene_key(name)
    texts = {}
    for ending in ("py", "xml") if kind == "object" else ("py",):
        text = (files("libero.scripts") / "templates" / f"{kind}.{ending}.txt").read_text(encoding="utf-8")
        texts[out / f"{stem}.{ending}"] = Template(text).substitute(Name=name, name=stem)
    if (existing := [path for path in texts if path.exists()]) and not overwrite:
        raise LiberoError(f"{existing[0]} exists; choose another name or folder, or pass --overwrite")
    out.mkdir(parents=True, exist_ok=True)
    for path, text in texts.items():
        path.write_text(text, encoding="utf-8")
        print(path)


def _ask(question: str, option: str) -> str:
    """Return what the user types; raise a LiberoError if there is no terminal."""
    if not sys.stdin.isatty():
        raise LiberoError(f"{option} is missing, and there is no terminal to ask for it")
    return input(f"{question}: ").strip()


@script()
def shasum_files(paths: Positional[tuple[Path, ...]] = (), *, check: Path | None = None) -> int:
    """Print or check the SHA-256 of files, in the format of `sha256sum`; return 1 where one differs.

    Args:
        paths: Files or folders (default: the folder of the data sets).
        check: Compare with a list that was printed before.
    """
    if check:
        if paths:
            raise LiberoError("--check compares the files that its list names; leave out the others")
        return _compare(check)
    roots = paths or [datasets_folder()]
    all_files = [f for root in roots for f in (root, *sorted(root.rglob("*"))) if f.is_file()]
    if not all_files:
        raise LiberoError(f"no files in {', '.join(map(str, roots))}")
    for file in tqdm(all_files, unit="file", disable=None):
        tqdm.write(f"{_digest(file)}  {file}")
    return 0


def _compare(listing: Path) -> int:
    """Print one line for each file of a list; return 1 where one is missing or differs."""
    lines = [line.partition("  ") for line in listing.read_text(encoding="utf-8").splitlines() if line]
    if bad := [line[0] for line in lines if len(line[0]) != 64 or not line[2]]:
        raise LiberoError(f"{listing}: {bad[0]!r} is not a checksum; expected lines of `<sha256>  <file>`")
    wrong = 0
    for listed, _, name in tqdm(lines, unit="file", disable=None):
        digest = _digest(Path(name)) if Path(name).is_file() else None
        wrong += digest != listed
        tqdm.write(f"{name}: {'OK' if digest == listed else 'FAILED' if digest else 'missing'}")
    return int(wrong > 0)


def _digest(file: Path) -> str:
    """Return the SHA-256 of a file, in hex."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
