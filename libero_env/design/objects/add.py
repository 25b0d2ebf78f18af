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
from dataclasses import dataclass, field, fields
from dataclasses import replace as changed
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from libero_env.design.objects.collision import Mass, collision_pieces, hull_mass, solid_mass
from libero_env.design.objects.mesh_file import bounds, is_closed, merge_vertices, read_mesh, signed_volume
from libero_env.design.objects.mjcf_file import INSIDE, store_mjcf
from libero_env.design.objects.mjcf_write import Body, store_mesh
from libero_env.design.objects.trial import try_object
from libero_env.errors import InvalidInputError, LiberoError
from libero_env.objects import catalog, folder
from libero_env.objects.builtin import builtin_names
from libero_env.objects.model import ObjectModel
from libero_env.objects.references import MAX_FACES
from libero_env.paths import cache_dir, objects_dir
from libero_env.storage import cached_folder
from libero_env.validation import validate_arguments

DENSITY = 400.0  # [kg/m^3] of groceries; the original's objects have a few hundred
_MIN_DEFAULT_MASS = 0.02  # [kg] the fingers push lighter objects away
_FORMAT = 1  # version of stored folders; increase it when the same file gives another object
_LARGEST = 0.6  # [m] longest side
_LONGEST_NAME = 60  # characters


@dataclass(frozen=True)
class Options:
    """Options of the conversion. All but `container` are for meshes only.

    Attributes:
        size: Longest side, [m]; None keeps that of the file.
        mass: Mass, [kg]; None computes it from `density`.
        density: Density, [kg/m^3]; None is that of groceries.
        up: Axis of the file that points up, `z` or `y`; None is the convention of the format.
        collision: `decompose`, `hull` or `boxes`; see `libero_env.design.objects.collision`.
        faces: Approximate largest number of triangles of the visual mesh.
        container: Whether to add the region `contain_region`, the inside of the object's bounds, for goals such as
            `In x box_1_contain_region`.
    """

    size: Annotated[float, Field(ge=1e-3, le=100)] | None = None
    mass: Annotated[float, Field(gt=0, le=1e4)] | None = None
    density: Annotated[float, Field(gt=0, le=1e5)] | None = None
    up: Literal["y", "z"] | None = None
    collision: Literal["decompose", "hull", "boxes"] = "decompose"
    faces: Annotated[int, Field(ge=1, le=MAX_FACES)] = 3000
    container: bool = False

    def __post_init__(self) -> None:
        validate_arguments(Options, {one.name: getattr(self, one.name) for one in fields(self)})
        if self.mass is not None and self.density is not None:
            raise InvalidInputError("mass and density are both given; give only one of them")

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> "Options":
        """Return options by their names.

        Raises:
            InvalidInputError: A name is unknown, or a value is not valid.
        """
        validate_arguments(cls, options)
        return cls(**options)

    @property
    def mesh_options(self) -> tuple[str, ...]:
        """Names of the options that are set and that are for meshes only."""
        usual = Options()
        names = ("size", "mass", "density", "up", "collision", "faces")
        return tuple(name for name in names if getattr(self, name) != getattr(usual, name))


@dataclass(frozen=True)
class Added:
    """An object that was added.

    Attributes:
        name: Its category.
        folder: Folder with its files.
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
    path, chosen = Path(path), Options.of(options)
    name = check_name(name or _name_of(path), reject_existing=not replace)
    directory = (Path(out) if out else objects_dir()) / name
    if directory.exists() and not replace:
        raise LiberoError(
            f"{directory} exists already; choose another name (--name), or replace it (--replace)"
        )
    try:
        directory.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(
            f"{directory.parent} is not a folder that can be written ({error})"
        ) from error
    return _make(path, name, directory, chosen)


def register_object_file(path: str | Path, name: str | None = None, **options: Any) -> str:
    """Convert a mesh or MJCF file into an object for this process, as `register_object` does for a function.

    The object is cached: the same content of the file is converted once.

    Args:
        path: File, as for `add_object`.
        name: Category; by default it is derived from the name of the file.
        options: Fields of `Options`, such as `size=0.09`.

    Returns:
        The category.

    Raises:
        LiberoError: The file cannot be used.
    """
    path, chosen = Path(path), Options.of(options)
    if not path.is_file():
        raise LiberoError(f"{path}: no such file")
    name = name or _name_of(path)
    if not name.isidentifier() or len(name) > _LONGEST_NAME:
        raise LiberoError(f"{name[:80]!r} is not a valid category; use letters, digits and underscores")
    content = repr((_FORMAT, chosen, hashlib.sha256(path.read_bytes()).hexdigest(), name))
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
        if path.suffix.lower() in (".xml", ".mjcf"):
            if options.mesh_options:
                raise LiberoError(
                    f"{path}: an MJCF file defines {', '.join(options.mesh_options)} itself; omit it"
                )
            properties = store_mjcf(path, name, scratch, container=options.container, notify=notes.append)
        else:
            properties = _from_mesh(path, name, scratch, options, notes)
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


def _from_mesh(path: Path, name: str, directory: Path, options: Options, notes: list[str]) -> dict[str, Any]:
    """Write the files of an object that is made from a mesh; return its properties."""
    surfaces = read_mesh(path, size=options.size, up=options.up, notify=notes.append)
    low, high = bounds(surfaces)
    if max(high - low) > _LARGEST:
        raise LiberoError(
            f"{path}: {max(high - low):.2f} m is too large for a table and the gripper, which opens 8 cm; give --size "
            "(longest side, m)"
        )
    vertices, faces = merge_vertices(surfaces)
    closed = is_closed(faces)
    if not closed:
        notes.append(
            f"{path.name} is not watertight: its mass is that of its filled convex hull. Fix the mesh (fill its "
            "holes), or give --mass"
        )
    if closed and signed_volume(vertices, faces) < 0:
        notes.append(f"{path.name} was inside out; its faces have been reversed")
        faces = faces[:, ::-1]
        surfaces = [changed(surface, faces=surface.faces[:, ::-1]) for surface in surfaces]
    pieces = collision_pieces(vertices, faces, options.collision, notes.append)
    mass, kilograms = _compute_mass(vertices, faces, closed, options, notes)
    inside = tuple(INSIDE * float(value) / 2 for value in high - low) if options.container else None
    body = Body(name, kilograms, mass.centre, mass.inertia, pieces, inside)
    store_mesh(directory, body, surfaces, options.faces, notes.append)
    return {
        "mass": round(kilograms, 5),
        "watertight": closed,
        "collision": {"method": pieces.method, "pieces": len(pieces)},
    }


def _compute_mass(
    vertices: np.ndarray, faces: np.ndarray, closed: bool, options: Options, notes: list[str]
) -> tuple[Mass, float]:
    """Return the distribution of the mass, scaled to it, and the mass in kg."""
    mass = solid_mass(vertices, faces, 1.0) if closed else hull_mass(vertices, 1.0)
    kilograms = options.mass or mass.volume * (options.density or DENSITY)
    if kilograms < _MIN_DEFAULT_MASS and options.mass is None and options.density is None:
        notes.append(
            f"{1000 * kilograms:.2g} g is too light to be grasped: 20 g is used instead; --mass sets another value"
        )
        kilograms = _MIN_DEFAULT_MASS
    return Mass(mass.volume, mass.centre, mass.inertia * kilograms / mass.volume), kilograms
