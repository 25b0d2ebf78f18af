"""Conversion of a user's MJCF file, of any convention, into the files of an object that scenes can attach."""

import itertools
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from libero_env.assets.original_mjcf import attachable_xml, written_out
from libero_env.design.objects.mesh_file import Notify
from libero_env.design.objects.mesh_object import INSIDE
from libero_env.errors import InvalidInputError, LiberoError
from libero_env.geometry import surface_points
from libero_env.mujoco_compat import delete, mujoco
from libero_env.objects.folder import MODEL, spec_of
from libero_env.objects.mjcf import LIMITS, Mjcf, read_mjcf
from libero_env.objects.model import ROOT_BODY, VISUAL_GEOM
from libero_env.objects.xml_file import explain, parse_xml_text

_HIDDEN = 3  # first geom group that viewers hide by default
_INNER = "worldbody/body/body[@name='object']"  # the object in files made for the original
_LARGEST, _SMALLEST = 3.0, 1e-3  # [m] reach, and longest side
_HEAVIEST = 1e4  # [kg]
_WIDEST = 25.0  # [m^2] sum of the squared radii of collision geoms, whose surface is sampled


def store_mjcf(path: Path, name: str, directory: Path, *, container: bool, notify: Notify) -> dict[str, Any]:
    """Write the MJCF file of an object, with its meshes and textures; return `collision`, for `object.yaml`.

    The object is the one body of the file's world or, as in the original's files, the body `object` within it.
    Collision geoms become group 0, visual geoms group 1. Where there are no visual geoms, or some in the same group,
    copies of the collision geoms are added.

    Args:
        path: MJCF file to read.
        name: Category.
        container: Whether to add a region `contain_region` if the object has none.
        notify: Function that receives a message about omitted elements.

    Raises:
        LiberoError: The file cannot be read, refers to a missing file, or does not contain exactly one object.
    """
    file = read_mjcf(path)
    spec = _spec(file, name)
    root = _root(spec, file, notify)
    _sort_geoms(spec)
    if len(spec.geoms) > LIMITS["geom"]:
        raise InvalidInputError(
            f"{path}: it has {len(spec.geoms)} geoms with their copies for display; at most {LIMITS['geom']} are used"
        )
    names = _gather_files(spec, directory)
    model = _compiled(spec, path)
    _check_extent(model, path)
    low, high = bounds_of(model)
    if container and all(site.name != "contain_region" for site in spec.sites):
        place = {"pos": (low + high) / 2, "size": INSIDE * (high - low) / 2}
        box = mujoco.mjtGeom.mjGEOM_BOX
        root.add_site(name="contain_region", type=box, rgba=(0, 0, 0, 0), group=3, **place)
    model = _compiled(spec, path)
    kilograms = float(model.body_subtreemass[model.body(ROOT_BODY).id])
    if kilograms < 1e-6:
        raise LiberoError(f"{path}: it has no mass; give its collision geoms a mass or density")
    if kilograms > _HEAVIEST:
        raise InvalidInputError(
            f"{path}: its mass is {kilograms:.3g} kg; expected at most {_HEAVIEST:.0f} kg"
        )
    (directory / MODEL).write_text(_with_names(spec.to_xml(), names), encoding="utf-8")
    solid = int(((model.geom_contype | model.geom_conaffinity) > 0).sum())
    return {"collision": {"method": "mjcf", "pieces": solid}}


def bounds_of(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest corner of the collision geoms of an object, (3,) and (3,), in its frame [m].

    Raises:
        LiberoError: The object has no collision geoms.
    """
    points = surface_points(model, model.body(ROOT_BODY).id)
    if not len(points):
        raise LiberoError("it has no collision geoms; give it a geom with contype and conaffinity 1")
    return points.min(axis=0), points.max(axis=0)


def _spec(file: Mjcf, name: str) -> mujoco.MjSpec:
    if file.root.find(_INNER) is None:
        spec = spec_of(file)
        _rename(spec, name)
        return spec
    assets, world = written_out(file.root, file.path)
    body = world.find("body/body[@name='object']")
    assert body is not None
    try:
        return mujoco.MjSpec.from_string(attachable_xml(name, assets, body))
    except ValueError as error:
        raise InvalidInputError(explain(error, file.path)) from error


def _root(spec: mujoco.MjSpec, file: Mjcf, notify: Notify) -> mujoco.MjsBody:
    """Return the body of the object, renamed to `main`, without a joint, at the origin and alone in the world."""
    bodies = list(spec.worldbody.bodies)
    if len(bodies) != 1:
        raise InvalidInputError(
            f"{file.path}: its world has {len(bodies)} bodies, but an object has one; move all its parts below one body"
        )
    body = bodies[0]
    if any(other.name == ROOT_BODY for other in spec.bodies if other is not body and other.name != body.name):
        raise InvalidInputError(
            f"{file.path}: a part is named {ROOT_BODY!r}, as the object itself will be; rename it"
        )
    users: list[tuple[Any, str]] = [(one, key) for one in spec.equalities for key in ("name1", "name2")]
    users += [(one, key) for one in spec.excludes for key in ("bodyname1", "bodyname2")]
    for user, key in users:
        if getattr(user, key) == body.name:
            setattr(user, key, ROOT_BODY)
    if abs(_compiled(spec.copy(), file.path).body_quat[1, 0]) < 1 - 1e-6:
        notify(
            f"{file.path.name}: the rotation of its root body is omitted, to which scenes give a pose; rotate its parts"
        )
    body.name, body.pos, body.quat = ROOT_BODY, (0, 0, 0), (1, 0, 0, 0)
    omitted = [*spec.worldbody.geoms, *spec.worldbody.sites]
    moving = [joint for joint in body.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE]
    if (count := len(omitted) + file.omitted) or moving:
        notify(
            f"{file.path.name}: omitted are {count} elements around the object (lights, cameras, actuators, ...) "
            f"and {len(moving)} joints of its root body, to which scenes add a free joint"
        )
    for element in [*omitted, *body.joints]:
        delete(spec, element)
    return body


def _sort_geoms(spec: mujoco.MjSpec) -> None:
    """Assign the groups of collision (0) and visual (1) geoms, and add copies of collision geoms that are seen.

    What has no mass, because of the file's `inertiagrouprange`, has none in its new group.
    """
    geoms = list(spec.geoms)
    first, last = spec.compiler.inertiagrouprange
    for geom in geoms:
        if not first <= geom.group <= last:
            geom.mass = 0.0
    spec.compiler.inertiagrouprange = [0, mujoco.mjNGROUP - 1]
    solid = [geom for geom in geoms if geom.contype or geom.conaffinity]
    visuals = [geom for geom in geoms if not (geom.contype or geom.conaffinity) and geom.group < _HIDDEN]
    named = {geom.name for geom in geoms}
    seen = {geom.group for geom in visuals}  # solid geoms in the same group are seen as well
    for number, geom in enumerate(solid):
        if not visuals or geom.group in seen:
            _add_visual(geom)
        free = (f"g{k}" for k in itertools.count(number) if f"g{k}" not in named)
        geom.group, geom.name = 0, geom.name or next(free)
        named.add(geom.name)
    for geom in visuals:
        geom.group = 1


def _add_visual(geom: mujoco.MjsGeom) -> None:
    names = ("type", "size", "pos", "quat", "fromto", "rgba", "material", "meshname")
    visual = geom.parent.add_geom(**{name: getattr(geom, name) for name in names}, **VISUAL_GEOM)
    visual.alt = geom.alt


def _rename(spec: mujoco.MjSpec, name: str) -> None:
    """Prefix the names of assets with the category: scenes share one namespace for them."""
    for group, users, key in (
        (spec.meshes, spec.geoms, "meshname"),
        (spec.materials, spec.geoms, "material"),
        (spec.materials, spec.sites, "material"),
    ):
        known = {asset.name for asset in group}
        for user in users:
            if getattr(user, key) in known:
                setattr(user, key, f"{name}_{getattr(user, key)}")
    textures = {texture.name for texture in spec.textures}
    for material in spec.materials:
        material.textures = [f"{name}_{t}" if t in textures else t for t in material.textures]
    for asset in (*spec.meshes, *spec.materials, *spec.textures):
        asset.name = f"{name}_{asset.name}"


def _gather_files(spec: mujoco.MjSpec, directory: Path) -> dict[str, str]:
    """Copy the meshes and textures in use into the folder; return the name of each new file by its path."""
    names: dict[str, str] = {}
    for kind, elements in (("mesh", spec.meshes), ("texture", spec.textures)):
        for number, element in enumerate(elements):
            if not element.file:
                continue
            source = Path(element.file)
            stem = "".join(c if c.isascii() and c.isalnum() else "_" for c in source.stem)[:40]
            target = directory / f"{kind}{number}_{stem}{source.suffix.lower()}"
            shutil.copyfile(source, target)
            element.file = str(target.absolute())
            names[element.file] = target.name
    return names


def _with_names(text: str, names: Mapping[str, str]) -> str:
    """Return an MJCF text with the names of files by their absolute paths replaced."""
    root = parse_xml_text(text.encode(), "the object's MJCF")
    for element in root.iterfind("asset/*[@file]"):
        element.set("file", names[element.attrib["file"]])
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _compiled(spec: mujoco.MjSpec, path: Path) -> mujoco.MjModel:
    try:
        return spec.compile()
    except ValueError as error:
        raise InvalidInputError(explain(error, path)) from error


def _check_extent(model: mujoco.MjModel, path: Path) -> None:
    """Check the size of an object by the boxes around its geoms, before anything is computed along its surface."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    solid = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    if not len(solid):
        return  # `bounds_of` says so
    reach = np.linalg.norm(data.geom_xpos[solid], axis=1) + model.geom_rbound[solid]
    longest = 2 * float(model.geom_rbound[solid].max())
    if not reach.max() <= _LARGEST or longest < _SMALLEST:
        raise InvalidInputError(
            f"{path}: it reaches {reach.max():.3g} m, its largest part is {longest:.3g} m long; expected {_SMALLEST} "
            f"to {_LARGEST:.0f} m: MJCF files are in metres"
        )
    if (area := float((model.geom_rbound[solid] ** 2).sum())) > _WIDEST:
        raise InvalidInputError(
            f"{path}: its {len(solid)} collision geoms have {area:.0f} m^2 in all; expected at most {_WIDEST:.0f}"
        )
