"""Writing of the MJCF file of an object that is made from a mesh, with its OBJ and PNG files."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from libero_env.assets.simplify import decimate
from libero_env.design.objects.collision import Pieces
from libero_env.design.objects.mesh_file import Notify, Surface
from libero_env.objects.builtin.physics import FRICTION, SOLIMP, SOLREF
from libero_env.objects.folder import MODEL
from libero_env.objects.model import ROOT_BODY

_MAX_TEXTURE = 1024  # [pixels] longest side of a texture
_SMALLEST = 0.0005  # [m] half the side of a box


@dataclass(frozen=True)
class Body:
    """Physical properties of an object, in its frame.

    Attributes:
        name: Category.
        mass: Mass, [kg].
        centre: Centre of mass, (3,) [m].
        inertia: Inertia about the centre of mass: xx, yy, zz, xy, xz, yz, [kg m^2].
        pieces: Collision geometry.
        inside: Half size of `contain_region`, which is at the origin, (3,) [m]; None where there is none.
    """

    name: str
    mass: float
    centre: np.ndarray
    inertia: np.ndarray
    pieces: Pieces
    inside: tuple[float, ...] | None = None


def store_mesh(directory: Path, body: Body, surfaces: Sequence[Surface], faces: int, notify: Notify) -> None:
    """Write the files of an object.

    Args:
        directory: Folder to write to.
        body: Physical properties.
        surfaces: Visual geometry.
        faces: Approximate largest number of triangles of all surfaces together.
        notify: Function that receives a message if the surfaces are simplified.
    """
    root = ET.Element("mujoco", {"model": body.name})
    ET.SubElement(root, "compiler", {"angle": "radian", "autolimits": "true"})
    assets = ET.SubElement(root, "asset")
    main = ET.SubElement(ET.SubElement(root, "worldbody"), "body", {"name": ROOT_BODY})
    ET.SubElement(
        main,
        "inertial",
        {"pos": _text(body.centre), "mass": _text([body.mass]), "fullinertia": _text(body.inertia)},
    )
    _add_collision(directory, body, assets, main)
    total = sum(len(surface.faces) for surface in surfaces)
    if total > faces:
        notify(f"its {total} triangles are simplified to about {faces} for display; --faces keeps more")
    for number, surface in enumerate(surfaces):
        share = max(faces * len(surface.faces) // total, 50)
        _add_visual(directory, f"{body.name}_visual{number}", surface, share, assets, main, number)
    if body.inside is not None:
        inside = {"type": "box", "size": _text(body.inside), "rgba": "0 0 0 0", "group": "3"}
        ET.SubElement(main, "site", {"name": "contain_region", **inside})
    ET.indent(root)
    (directory / MODEL).write_text(ET.tostring(root, encoding="unicode") + "\n", encoding="utf-8")


def _add_collision(directory: Path, body: Body, assets: ET.Element, main: ET.Element) -> None:
    contact = {
        "group": "0",
        "condim": "3",
        "rgba": "0.8 0.8 0.8 0.3",
        "friction": _text(FRICTION),
        "solref": _text(SOLREF),
        "solimp": _text((*SOLIMP, 0.5, 2.0)),
        "mass": "0",
    }
    for number, points in enumerate(body.pieces.meshes):
        name = f"{body.name}_collision{number}"
        # MuJoCo computes the hull of the points; no triangles are needed
        ET.SubElement(assets, "mesh", {"name": name, "vertex": _text(points.ravel()), "inertia": "convex"})
        ET.SubElement(main, "geom", {"name": f"g{number}", "type": "mesh", "mesh": name, **contact})
    for number, box in enumerate(body.pieces.boxes):
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
    ET.SubElement(
        main,
        "geom",
        {
            "name": f"visual{number or ''}",
            "type": "mesh",
            "mesh": f"{name}_mesh",
            "material": f"{name}_material",
            "group": "1",
            "contype": "0",
            "conaffinity": "0",
            "mass": "0",
        },
    )


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
    if len(texcoords):
        pairs = zip(faces + 1, corners + 1, strict=True)
        lines += [
            "f " + " ".join(f"{v}/{t}" for v, t in zip(face, corner, strict=True)) for face, corner in pairs
        ]
    else:
        lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _text(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{float(value):.9g}" for value in values)
