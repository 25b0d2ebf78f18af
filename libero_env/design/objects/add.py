"""Conversion of a mesh or MJCF file into an object that task files can use.

The result is a folder (see `libero_env.objects.folder`) with MJCF, meshes, textures and the parameters that placement
needs. It follows the original's conventions: collision geoms in group 0, visual geoms in group 1, and the contact
parameters of the original's objects.
"""

import hashlib
import keyword
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from libero_env.design.objects.mesh_file import load_surfaces
from libero_env.design.objects.mesh_object import Options, store_mesh
from libero_env.design.objects.mjcf_file import store_mjcf
from libero_env.design.objects.trial import try_object
from libero_env.errors import InvalidInputError, LiberoError
from libero_env.limited import call_limited, limited_process
from libero_env.objects import catalog, folder
from libero_env.objects.builtin import builtin_names
from libero_env.objects.mjcf import read_mjcf
from libero_env.objects.model import ObjectModel
from libero_env.paths import cache_dir, objects_dir
from libero_env.storage import cached_folder

_FORMAT = 1  # version of stored folders; increase it when the same file gives another object
_LONGEST_NAME = 60  # characters
MJCF_FORMATS = (".xml", ".mjcf")


@dataclass(frozen=True)
class Added:
    """An object that was added.

    Attributes:
        name: Its category.
        properties: Content of `object.yaml`.
        notes: Assumptions that were made, and what should be checked.
    """

    name: str
    folder: Path
    properties: Mapping[str, Any]
    notes: tuple[str, ...] = field(default=())


def add_object(
    path: str | Path,
    *,
    name: str | None = None,
    out: str | Path | None = None,
    replace: bool = False,
    **options: Any,
) -> Added:
    """Convert a mesh or MJCF file into an object and store it, so that task files can use its name.

    The object is tested: whether it stays where it is put down, and whether the gripper can grasp it. The results are
    in its properties and notes; the object is stored in any case.

    Args:
        path: File in MJCF (.xml), OBJ, GLB, glTF, STL or PLY format.
        name: Category; by default it is derived from the name of the file.
        out: Parent folder of the object's folder; None is `objects_dir()`, where tasks find it.
        replace: Whether to replace a user-defined object of this name.
        options: Fields of `Options`.

    Returns:
        The object, with its properties and notes.

    Raises:
        LiberoError: The file cannot be used, or the name is taken; the message states the remedy.
    """
    path, chosen = Path(path), Options(**options)
    name = check_name(name or _name_of(path), reject_existing=not replace)
    directory = (Path(out) if out else objects_dir()) / name
    if directory.exists() and not replace:
        raise LiberoError(
            f"{directory} exists already; choose another name (--name), or replace it (--replace)"
        )
    if directory.exists() and not (directory / folder.PROPERTIES).is_file():
        raise InvalidInputError(
            f"{directory} is not the folder of an object, which --replace would replace; choose another name (--name)"
        )
    try:
        directory.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(
            f"{directory.parent} is not a folder that can be written ({error})"
        ) from error
    with limited_process():
        return _make(path, name, directory, chosen)


def register_object_file(path: str | Path, name: str | None = None, **options: Any) -> str:
    """Convert a mesh or MJCF file into an object for this process, as `register_object` does for a function.

    The object is cached: the same content of the file, and of those that it names, is converted once.

    Args:
        path: File, as for `add_object`.
        name: Category; by default it is derived from the name of the file.
        options: Fields of `Options`, such as `size=0.09`.

    Returns:
        The category.

    Raises:
        LiberoError: The file cannot be used.
    """
    path, chosen = Path(path), Options(**options)
    if not path.is_file():
        raise LiberoError(f"{path}: no such file")
    name = name or _name_of(path)
    if not name.isidentifier() or len(name) > _LONGEST_NAME:
        raise LiberoError(f"{name[:80]!r} is not a valid category; use letters, digits and underscores")
    with limited_process():
        content = repr((_FORMAT, chosen, _content(path), name))
        directory = cache_dir() / "objects" / hashlib.sha256(content.encode()).hexdigest()[:16] / name
        cached_folder(directory, lambda: _make(path, name, directory, chosen))
    catalog.register_object(name, lambda: folder.load(directory, name))
    return name


def check_name(name: str, *, reject_existing: bool = True) -> str:
    """Return a name if it is valid and free.

    Args:
        name: Name of a new object.
        reject_existing: Whether the name of a user-defined object counts as taken.

    Raises:
        LiberoError: The name is not valid in task files, or another object has it.
    """
    if not name.isidentifier() or not name.isascii() or name != name.lower() or len(name) > _LONGEST_NAME:
        raise LiberoError(
            f"{name[:80]!r} is not a valid name; use lower-case letters, digits and underscores, such as red_cup"
        )
    if keyword.iskeyword(name):
        raise InvalidInputError(f"{name} is a reserved word of Python; choose another (--name my_{name})")
    if name in builtin_names():
        raise LiberoError(f"{name} is the name of a builtin object; choose another (--name my_{name})")
    if reject_existing and name in folder.names():
        raise LiberoError(
            f"{name} is the name of a user-defined object ({folder.find(name)}); choose another (--name), or "
            "replace it (--replace)"
        )
    return name


def _content(path: Path) -> str:
    """Return a digest of a file and of those that it names."""
    hashed = hashlib.sha256()
    if path.suffix.lower() in MJCF_FORMATS:
        mjcf = read_mjcf(path)
        hashed.update(mjcf.text.encode())
        for file in mjcf.files:
            hashed.update(file.read_bytes())
    else:
        hashed.update(path.read_bytes())
        for surface in call_limited(load_surfaces, path, about=str(path)):
            hashed.update(repr(surface.rgba).encode() + (surface.image.tobytes() if surface.image else b""))
            for array in (surface.vertices, surface.faces, surface.texcoords):
                hashed.update(b"" if array is None else np.ascontiguousarray(array).tobytes())
    return hashed.hexdigest()


def _name_of(path: Path) -> str:
    words = "".join(c if c.isascii() and c.isalnum() else "_" for c in path.stem.lower())
    return words if not words[:1].isdigit() else f"object_{words}"


def _make(path: Path, name: str, directory: Path, options: Options) -> Added:
    """Convert a file in a temporary folder, test the object, and move the complete folder to `directory`."""
    if not path.is_file():
        raise LiberoError(f"{path}: no such file")
    notes: list[str] = []
    scratch = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=directory.parent))
    try:
        if path.suffix.lower() in MJCF_FORMATS:
            if options.mesh_options:
                raise LiberoError(
                    f"{path}: an MJCF file defines {', '.join(options.mesh_options)} itself; omit it"
                )
            properties = store_mjcf(path, name, scratch, container=options.container, notify=notes.append)
        else:
            properties = store_mesh(path, name, scratch, options, notes.append)
        model = ObjectModel(name, folder.read_spec(scratch / folder.MODEL))
        properties |= try_object(model, notes.append, scratch / folder.PREVIEW)
        folder.write_properties(scratch, {"name": name, "source": path.name, **properties})
        if directory.exists():
            shutil.rmtree(directory)
        scratch.chmod(0o755)  # temporary folders are closed to other users
        scratch.replace(directory)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return Added(name, directory, folder.read_properties(directory), tuple(notes))
