"""A mesh or MJCF file of the user's -> an object that task files can name.

What comes out is plain files in a folder (`libero_env.objects.folder`): MJCF, meshes, pictures and the figures that
placement needs. The original's conventions hold: collision geoms in group 0, what is seen in group 1, contacts as stiff
as its objects have them.
"""

import hashlib
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from dataclasses import replace as changed
from pathlib import Path
from typing import Any

import numpy as np

from libero_env.design.objects.collision import Mass, collision_pieces, hull_mass, solid_mass
from libero_env.design.objects.mesh_file import bounds, is_closed, read_mesh, signed_volume, welded
from libero_env.design.objects.mjcf_file import INSIDE, store_mjcf
from libero_env.design.objects.mjcf_write import Body, store_mesh
from libero_env.errors import LiberoError
from libero_env.objects import catalog, folder
from libero_env.objects.builtin import BUILDERS
from libero_env.objects.model import ObjectModel
from libero_env.paths import cache_dir, objects_dir

DENSITY = 400.0  # kg/m^3, of groceries; the original's objects have a few hundred
_LIGHTEST = 0.02  # kg, of what is not told its mass: the fingers throw lighter things about
_FORMAT = 1  # of stored folders; change it when the same file gives another object
_LARGEST = 0.6  # m


@dataclass(frozen=True)
class Options:
    """How a file becomes an object.

    Attributes:
        size: Longest side, m; None keeps the file's. Of meshes only, as all of these but `container`.
        mass: Kg; None for `density`.
        density: Kg/m^3; None for that of groceries.
        up: Axis of the file that points up, `z` or `y`; None for what the format says.
        collision: `decompose`, `hull` or `boxes`; see `libero_env.design.objects.collision`.
        faces: Triangles that the look is simplified to where it has more.
        container: Add the place `contain_region`, the inside of its bounds, for goals such as
            `In x box_1_contain_region`.
    """

    size: float | None = None
    mass: float | None = None
    density: float | None = None
    up: str | None = None
    collision: str = "decompose"
    faces: int = 3000
    container: bool = False

    def __post_init__(self) -> None:
        for name in ("size", "mass", "density"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise LiberoError(f"{name} is {value}; it must be above 0")
        if self.mass is not None and self.density is not None:
            raise LiberoError("mass and density are both given; say one of them")
        if self.up not in (None, "y", "z"):
            raise LiberoError(f"up is {self.up!r}; valid: y, z")

    @property
    def of_meshes(self) -> tuple[str, ...]:
        """Names of those that are given and that only meshes take."""
        usual = Options()
        names = ("size", "mass", "density", "up", "collision", "faces")
        return tuple(name for name in names if getattr(self, name) != getattr(usual, name))


@dataclass(frozen=True)
class Added:
    """An object that was made. `notes` are guesses and what to look at; `properties` what `object.yaml` says."""

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
    """Make an object of a file and keep it; from then on task files know it by its name.

    It is tried: whether it stands as it is put down, and whether the gripper can hold it. What is found is in the
    properties and notes; it stays either way.

    Args:
        path: MJCF (.xml), OBJ, GLB, glTF, STL or PLY.
        name: Of the category; by default the file's.
        out: Folder for the object's folder; by default where `objects_dir` says, where tasks find it.
        replace: Replace one of the user's objects that has this name.
        options: See `Options`.

    Raises:
        LiberoError: The file cannot be used, or the name is taken; the message says what to do.
    """
    path = Path(path)
    name = check_name(name or _name_of(path), taken_by_own=not replace)
    place = (Path(out) if out else objects_dir()) / name
    if place.exists() and not replace:
        raise LiberoError(
            f"{place} is there already; choose another name (--name), or replace it (--replace)"
        )
    place.parent.mkdir(parents=True, exist_ok=True)
    return _make(path, name, place, Options(**options))


def register_object_file(path: str | Path, name: str | None = None, **options: Any) -> str:
    """As `register_object`, from a file and for this process: `register_object_file("cup.obj", size=0.09)`.

    The object is made once for each content of the file, and kept in the cache.

    Returns:
        The category's name.

    Raises:
        LiberoError: The file cannot be used.
    """
    path, chosen = Path(path), Options(**options)
    if not path.is_file():
        raise LiberoError(f"{path}: no such file")
    name = name or _name_of(path)
    if not name.isidentifier():
        raise LiberoError(f"{name!r} is no valid category; use letters, digits and underscores")
    said = repr((_FORMAT, chosen, hashlib.sha256(path.read_bytes()).hexdigest(), name))
    place = cache_dir() / "objects" / hashlib.sha256(said.encode()).hexdigest()[:16] / name
    if not (place / folder.PROPERTIES).is_file():
        place.parent.mkdir(parents=True, exist_ok=True)
        _make(path, name, place, chosen)
    catalog.register_object(name, lambda: folder.load(place, name))
    return name


def check_name(name: str, *, taken_by_own: bool = True) -> str:
    """Return the name, if an object may be called so.

    Raises:
        LiberoError: Task files cannot say it, or another object has it.
    """
    if not name.isidentifier() or not name.isascii() or name != name.lower():
        raise LiberoError(
            f"{name!r} is no valid name; use small letters, digits and underscores, such as red_cup"
        )
    if name in BUILDERS:
        raise LiberoError(f"{name} is the name of a builtin object; choose another (--name my_{name})")
    if taken_by_own and name in folder.names():
        raise LiberoError(
            f"{name} is the name of an object of yours ({folder.find(name)}); choose another (--name), or "
            "replace it (--replace)"
        )
    return name


def _name_of(path: Path) -> str:
    words = "".join(c if c.isascii() and c.isalnum() else "_" for c in path.stem.lower())
    return words if not words[:1].isdigit() else f"object_{words}"


def _make(path: Path, name: str, place: Path, options: Options) -> Added:
    """Convert beside the place, try it, and move it there whole."""
    from libero_env.design.objects.trial import try_object  # it needs the expert, which needs scenes

    if not path.is_file():
        raise LiberoError(f"{path}: no such file")
    notes: list[str] = []
    scratch = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=place.parent))
    try:
        if path.suffix.lower() in (".xml", ".mjcf"):
            if options.of_meshes:
                raise LiberoError(
                    f"{path}: an MJCF file says {', '.join(options.of_meshes)} itself; leave it out"
                )
            properties = store_mjcf(path, name, scratch, container=options.container, notify=notes.append)
        else:
            properties = _from_mesh(path, name, scratch, options, notes)
        model = ObjectModel(name, folder.read_spec(scratch / folder.MODEL))
        properties |= try_object(model, notes.append, scratch / folder.PREVIEW)
        folder.write_properties(scratch, {"name": name, "source": path.name, **properties})
        if place.exists():
            shutil.rmtree(place)
        scratch.chmod(0o755)  # others may use it, which a temporary folder does not allow
        scratch.replace(place)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return Added(name, place, folder.read_properties(place), tuple(notes))


def _from_mesh(path: Path, name: str, place: Path, options: Options, notes: list[str]) -> dict[str, Any]:
    """Write the files of an object made of a mesh; its figures."""
    surfaces = read_mesh(path, size=options.size, up=options.up, notify=notes.append)
    low, high = bounds(surfaces)
    if max(high - low) > _LARGEST:
        raise LiberoError(
            f"{path}: {max(high - low):.2f} m is too large for a table and the gripper, which opens 8 cm; say --size "
            "(longest side, m)"
        )
    vertices, faces = welded(surfaces)
    closed = is_closed(faces)
    if not closed:
        notes.append(
            f"{path.name} is not watertight: it weighs as much as its convex hull, filled. Mend the mesh (fill its "
            "holes), or say --mass"
        )
    if closed and signed_volume(vertices, faces) < 0:
        notes.append(f"{path.name} was inside out and has been turned")
        faces = faces[:, ::-1]
        surfaces = [changed(surface, faces=surface.faces[:, ::-1]) for surface in surfaces]
    pieces = collision_pieces(vertices, faces, options.collision, notes.append)
    mass, kilograms = _weigh(vertices, faces, closed, options, notes)
    inside = tuple(INSIDE * float(value) / 2 for value in high - low) if options.container else None
    body = Body(name, kilograms, mass.centre, mass.inertia, pieces, inside)
    store_mesh(place, body, surfaces, options.faces, notes.append)
    return {
        "mass": round(kilograms, 5),
        "watertight": closed,
        "collision": {"method": pieces.method, "pieces": len(pieces)},
    }


def _weigh(
    vertices: np.ndarray, faces: np.ndarray, closed: bool, options: Options, notes: list[str]
) -> tuple[Mass, float]:
    """Return where the mass is, its inertia, and the mass in kg."""
    mass = solid_mass(vertices, faces, 1.0) if closed else hull_mass(vertices, 1.0)
    kilograms = options.mass or mass.volume * (options.density or DENSITY)
    if kilograms < _LIGHTEST and options.mass is None and options.density is None:
        notes.append(
            f"{1000 * kilograms:.2g} g is less than the fingers hold still: it weighs 20 g; or say --mass"
        )
        kilograms = _LIGHTEST
    return Mass(mass.volume, mass.centre, mass.inertia * kilograms / mass.volume), kilograms
