"""Objects that are made from a mesh: their mass and collision geometry, and their MJCF, OBJ and PNG files."""

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal
from xml.etree import ElementTree as ET

import numpy as np
from pydantic import Field

from libero_env.assets.simplify import decimate
from libero_env.design.objects.collision import Pieces, collision_pieces, is_closed
from libero_env.design.objects.mesh_file import MAX_FACES, Notify, Surface, bounds, read_mesh
from libero_env.errors import InvalidInputError, LiberoError
from libero_env.objects.builtin.physics import CONTACT
from libero_env.objects.folder import MODEL
from libero_env.objects.model import ROOT_BODY
from libero_env.validation import checked

if TYPE_CHECKING:
    from trimesh import Trimesh

DENSITY = 400.0  # [kg/m^3] of groceries; the original's objects have a few hundred
INSIDE = 0.8  # size of `contain_region`, as a share of the bounds
_LARGEST = 0.6  # [m] longest side
_MIN_DEFAULT_MASS = 0.02  # [kg] the fingers push lighter objects away
_MAX_TEXTURE = 1024  # [pixels] longest side of a texture
_SMALLEST = 0.0005  # [m] half the side of a box


@checked
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
        if self.mass is not None and self.density is not None:
            raise InvalidInputError("mass and density are both given; give only one of them")

    @property
    def mesh_options(self) -> tuple[str, ...]:
        """Names of the options that are set and that are for meshes only."""
        usual = {field.name: field.default for field in fields(self) if field.name != "container"}
        return tuple(name for name, default in usual.items() if getattr(self, name) != default)


def store_mesh(path: Path, name: str, directory: Path, options: Options, notify: Notify) -> dict[str, Any]:
    """Write the files of an object that is made from a mesh.

    Args:
        name: Category.
        options: Options of the conversion.
        notify: Function that receives a message about each assumption and each problem.

    Returns:
        `watertight` and `collision`, for `object.yaml`.

    Raises:
        LiberoError: The file cannot be read, or its mesh is too large or has no volume.
    """
    surfaces = read_mesh(path, size=options.size, up=options.up, notify=notify)
    low, high = bounds(surfaces)
    if max(high - low) > _LARGEST:
        raise LiberoError(
            f"{path}: {max(high - low):.2f} m is too large for a table and the gripper, which opens 8 cm; give --size "
            "(longest side, m)"
        )
    mesh = merge_vertices(surfaces)
    closed = is_closed(mesh)
    if not closed:
        notify(
            f"{path.name} is not watertight: its mass is that of its filled convex hull. Fix the mesh (fill its "
            "holes), or give --mass"
        )
    elif mesh.volume < 0:
        notify(f"{path.name} was inside out; its faces have been reversed")
        mesh.invert()
        surfaces = [replace(surface, faces=surface.faces[:, ::-1]) for surface in surfaces]
    pieces = collision_pieces(mesh, options.collision, notify)
    solid = mesh if closed else mesh.convex_hull
    if not solid.volume > 0:
        raise LiberoError(f"{path}: the mesh has no volume; fix it")
    kilograms = _mass(float(solid.volume), options, notify)
    root = ET.Element("mujoco", {"model": name})
    ET.SubElement(root, "compiler", {"angle": "radian", "autolimits": "true"})
    assets = ET.SubElement(root, "asset")
    main = ET.SubElement(ET.SubElement(root, "worldbody"), "body", {"name": ROOT_BODY})
    inertia = (solid.moment_inertia * kilograms / solid.volume)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    inertial = {"pos": _text(solid.center_mass), "mass": _text([kilograms]), "fullinertia": _text(inertia)}
    ET.SubElement(main, "inertial", inertial)
    _add_collision(name, pieces, assets, main)
    total = sum(len(surface.faces) for surface in surfaces)
    if total > options.faces:
        notify(
            f"its {total} triangles are simplified to about {options.faces} for display; --faces keeps more"
        )
    for number, surface in enumerate(surfaces):
        share = max(options.faces * len(surface.faces) // total, 50)
        _add_visual(directory, f"{name}_visual{number}", surface, share, assets, main, number)
    if options.container:
        inside = {"type": "box", "size": _text(INSIDE / 2 * (high - low)), "rgba": "0 0 0 0", "group": "3"}
        ET.SubElement(main, "site", {"name": "contain_region", **inside})
    ET.indent(root)
    (directory / MODEL).write_text(ET.tostring(root, encoding="unicode") + "\n", encoding="utf-8")
    return {"watertight": closed, "collision": {"method": pieces.method, "pieces": len(pieces)}}


def merge_vertices(surfaces: Sequence[Surface]) -> "Trimesh":
    """Return all surfaces as one mesh, [m]; vertices at the same position are merged, also at seams."""
    import trimesh

    starts = np.cumsum([0, *(len(s.vertices) for s in surfaces)])
    points = np.concatenate([s.vertices for s in surfaces])
    faces = np.concatenate([s.faces + start for s, start in zip(surfaces, starts, strict=False)])
    grain = 1e-5 * np.ptp(points, axis=0).max()
    _, first, where = np.unique(np.round(points / grain), axis=0, return_index=True, return_inverse=True)
    faces = where.reshape(-1)[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    return trimesh.Trimesh(points[first], faces, process=False)


def _mass(volume: float, options: Options, notify: Notify) -> float:
    kilograms = options.mass or volume * (options.density or DENSITY)
    if kilograms < _MIN_DEFAULT_MASS and options.mass is None and options.density is None:
        notify(
            f"{1000 * kilograms:.2g} g is too light to be grasped: 20 g is used instead; --mass sets another value"
        )
        return _MIN_DEFAULT_MASS
    return kilograms


def _add_collision(category: str, pieces: Pieces, assets: ET.Element, main: ET.Element) -> None:
    contact = {"group": "0", "condim": "3", "rgba": "0.8 0.8 0.8 0.3", "mass": "0"}
    contact |= {key: _text(values) for key, values in CONTACT.items()}
    for number, points in enumerate(pieces.meshes):
        name = f"{category}_collision{number}"
        # MuJoCo computes the hull of the points; no triangles are needed
        ET.SubElement(assets, "mesh", {"name": name, "vertex": _text(points.ravel()), "inertia": "convex"})
        ET.SubElement(main, "geom", {"name": f"g{number}", "type": "mesh", "mesh": name, **contact})
    for number, box in enumerate(pieces.boxes):
        pose = {"pos": _text(box[:3]), "size": _text(np.maximum(box[3:], _SMALLEST))}
        ET.SubElement(main, "geom", {"name": f"g{number}", "type": "box", **pose, **contact})


def _add_visual(
    directory: Path,
    name: str,
    surface: Surface,
    faces: int,
    assets: ET.Element,
    main: ET.Element,
    number: int,
) -> None:
    vertices, triangles, texcoords, corners = _simplified(surface, faces)
    _write_obj(directory / f"{name}.obj", vertices, triangles, texcoords, corners)
    material = {
        "name": f"{name}_material",
        "rgba": _text(surface.rgba),
        "specular": "0.25",
        "shininess": "0.4",
    }
    if surface.image is not None:
        texture = surface.image.copy()
        texture.thumbnail((_MAX_TEXTURE, _MAX_TEXTURE))
        texture.save(directory / f"{name}.png")
        ET.SubElement(assets, "texture", {"name": f"{name}_texture", "type": "2d", "file": f"{name}.png"})
        material["texture"] = f"{name}_texture"
    ET.SubElement(assets, "material", material)
    ET.SubElement(assets, "mesh", {"name": f"{name}_mesh", "file": f"{name}.obj", "inertia": "shell"})
    look = {"type": "mesh", "mesh": f"{name}_mesh", "material": f"{name}_material", "group": "1"}
    unfelt = {"contype": "0", "conaffinity": "0", "mass": "0"}
    ET.SubElement(main, "geom", {"name": f"visual{number or ''}", **look, **unfelt})


def _simplified(surface: Surface, faces: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, triangles, texture coordinates and their indices, with at most about `faces` triangles."""
    texcoords = np.zeros((0, 2)) if surface.texcoords is None else surface.texcoords
    corners = surface.faces if len(texcoords) else np.zeros((0, 3), np.int64)
    if len(surface.faces) <= faces:
        return surface.vertices, surface.faces, texcoords, corners
    size = np.ptp(surface.vertices, axis=0).max()
    vertices, *rest = decimate(surface.vertices / size, surface.faces, texcoords, corners, faces)
    return vertices * size, rest[0], rest[1], rest[2]


def _write_obj(
    path: Path, vertices: np.ndarray, faces: np.ndarray, texcoords: np.ndarray, corners: np.ndarray
) -> None:
    lines = [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in vertices]
    lines += [f"vt {u:.6g} {v:.6g}" for u, v in texcoords]
    numbers = [faces + 1, corners + 1] if len(texcoords) else [faces + 1]
    for corners_of in np.stack(numbers, axis=-1):  # of a triangle, (3, 1 or 2)
        lines.append("f " + " ".join("/".join(map(str, corner)) for corner in corners_of))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _text(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{float(value):.9g}" for value in values)
