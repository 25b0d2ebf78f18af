"""Conversion of a user's MJCF file, of any convention, into the files of an object that scenes can attach."""

import shutil
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import mujoco
import numpy as np

from libero_env.assets.original_mjcf import attachable_xml, read_file
from libero_env.design.objects.mesh_file import Notify
from libero_env.errors import LiberoError
from libero_env.geometry import surface_points
from libero_env.mujoco_compat import delete
from libero_env.objects.folder import MODEL, read_spec
from libero_env.objects.model import ROOT_BODY

INSIDE = 0.8  # size of `contain_region`, as a share of the bounds
_HIDDEN = 3  # first geom group that viewers hide by default


def store_mjcf(path: Path, name: str, directory: Path, *, container: bool, notify: Notify) -> dict[str, Any]:
    """Write the MJCF file of an object, with its meshes and textures; return its mass and collision geometry.

    The object is the one body of the file's world or, as in the original's files, the body `object` within it.
    Collision geoms become group 0, visual geoms group 1; without visual geoms, copies of the collision geoms are added.

    Args:
        path: MJCF file to read.
        name: Category.
        directory: Folder to write to.
        container: Whether to add a region `contain_region` if the object has none.
        notify: Function that receives a message about omitted elements.

    Returns:
        `mass` [kg] and `collision`, for `object.yaml`.

    Raises:
        LiberoError: The file cannot be read, refers to a missing file, or does not contain exactly one object.
    """
    spec = _read(path, name)
    root = _root(spec, path, notify)
    _sort_geoms(spec)
    _gather_files(spec, name, directory)
    low, high = bounds_of(_compiled(spec, path))
    if container and all(site.name != "contain_region" for site in spec.sites):
        root.add_site(
            name="contain_region",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=(low + high) / 2,
            size=INSIDE * (high - low) / 2,
            rgba=(0, 0, 0, 0),
            group=3,
        )
    model = _compiled(spec, path)
    kilograms = float(model.body_subtreemass[model.body(ROOT_BODY).id])
    if kilograms < 1e-6:
        raise LiberoError(f"{path}: it has no mass; give its collision geoms a mass or density")
    text = spec.to_xml().replace(f"{directory.absolute()}/", "")
    (directory / MODEL).write_text(text, encoding="utf-8")
    solid = int(((model.geom_contype | model.geom_conaffinity) > 0).sum())
    return {"mass": round(kilograms, 5), "collision": {"method": "mjcf", "pieces": solid}}


def bounds_of(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest corner of the collision geoms of an object, (3,) and (3,), in its frame [m].

    Raises:
        LiberoError: The object has no collision geoms.
    """
    points = surface_points(model, model.body(ROOT_BODY).id)
    if not len(points):
        raise LiberoError("it has no collision geoms; give it a geom with contype and conaffinity 1")
    return points.min(axis=0), points.max(axis=0)


def _read(path: Path, name: str) -> mujoco.MjSpec:
    try:
        inner = ET.parse(path).getroot().find("worldbody/body/body[@name='object']")
    except (OSError, ET.ParseError) as error:
        raise LiberoError(f"{path}: {error}; an MJCF file is expected") from error
    if inner is None:
        spec = read_spec(path)
        _rename(spec, name)
        return spec
    assets, world = read_file(path)
    body = world.find("body/body[@name='object']")
    assert body is not None
    try:
        return mujoco.MjSpec.from_string(attachable_xml(name, assets, body))
    except ValueError as error:
        raise LiberoError(f"{path}: {error}") from error


def _root(spec: mujoco.MjSpec, path: Path, notify: Notify) -> mujoco.MjsBody:
    """Return the body of the object, renamed to `main`, without a joint, at the origin and alone in the world."""
    bodies = list(spec.worldbody.bodies)
    if len(bodies) != 1:
        raise LiberoError(
            f"{path}: its world has {len(bodies)} bodies, but an object has one; move all its parts below one body"
        )
    body = bodies[0]
    body.name, body.pos, body.quat = ROOT_BODY, (0, 0, 0), (1, 0, 0, 0)
    around = (spec.worldbody.geoms, spec.worldbody.sites, spec.cameras, spec.lights)
    about = (spec.actuators, spec.sensors, spec.keys)
    omitted = [element for group in (*around, *about) for element in group]
    moving = [joint for joint in body.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE]
    if omitted or moving:
        notify(
            f"{path.name}: omitted are {len(omitted)} elements around the object (lights, cameras, actuators, ...) "
            f"and {len(moving)} joints of its root body, to which scenes add a free joint"
        )
    for element in [*omitted, *body.joints]:
        delete(spec, element)
    return body


def _sort_geoms(spec: mujoco.MjSpec) -> None:
    """Assign the groups of collision (0) and visual (1) geoms; without visuals, add copies of the collision geoms."""
    geoms = list(spec.geoms)
    solid = [geom for geom in geoms if geom.contype or geom.conaffinity]
    visuals = [geom for geom in geoms if not (geom.contype or geom.conaffinity) and geom.group < _HIDDEN]
    for number, geom in enumerate(solid):
        if not visuals:
            _add_visual(geom)
        geom.group, geom.name = 0, geom.name or f"g{number}"
    for geom in visuals:
        geom.group = 1


def _add_visual(geom: mujoco.MjsGeom) -> None:
    visual = geom.parent.add_geom(
        type=geom.type,
        size=geom.size,
        pos=geom.pos,
        quat=geom.quat,
        fromto=geom.fromto,
        rgba=geom.rgba,
        material=geom.material,
        meshname=geom.meshname,
        group=1,
        contype=0,
        conaffinity=0,
        mass=0.0,
    )
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


def _gather_files(spec: mujoco.MjSpec, name: str, directory: Path) -> None:
    """Copy the meshes and textures in use into the folder."""
    for kind, elements in (("mesh", spec.meshes), ("texture", spec.textures)):
        for element in elements:
            if not element.file:
                continue
            source = Path(element.file)
            if not source.is_file():
                raise LiberoError(f"{kind} {source} is missing; put it there, or fix the path in the file")
            target = directory / f"{element.name.removeprefix(f'{name}_') or kind}_{source.name}"
            shutil.copyfile(source, target)
            element.file = str(target.absolute())


def _compiled(spec: mujoco.MjSpec, path: Path) -> mujoco.MjModel:
    try:
        return spec.compile()
    except ValueError as error:
        raise LiberoError(f"{path}: {error}") from error
