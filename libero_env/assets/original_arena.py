"""The original's rooms: its scene files, with table, floor and walls as its problem classes set them.

A scene of these files has rounded cameras, and visual meshes in a frame of their own. Both move a picture by a few grey
levels; `restore_drawing` makes the scene what the original compiles, without any change to its physics.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

from libero_env.assets.arena import Workspace, add_light
from libero_env.assets.furnishing import chosen_styles
from libero_env.assets.original_mjcf import read_file, read_spec, to_xml, used_assets
from libero_env.mujoco_compat import delete, mujoco
from libero_env.storage import read_yaml

_NAMES = read_yaml("assets/original.yaml")
SCENES: Mapping[str, str] = _NAMES["scenes"]  # workspace -> beginning of its files' names
TEXTURES: Mapping[str, Mapping[str, str]] = _NAMES["textures"]  # name of a style -> file
_TEXTURE_NAMES = {"floor": "texplane", "wall": "tex-wall"}
_STIFF = 0.004  # [s] smallest time constant that the timestep allows
_FIRM_SOLREF = (0.02, 1.0)  # time constant [s] and damping ratio
_FULL_BOX_DEPTH = tuple(int(n) for n in mujoco.__version__.split(".")[:2]) >= (3, 4)
_CAMERAS = "assets/workspaces/original_cameras.yaml"
_EXCLUDED = ("camera", "light")  # those of the workspace's parameters are used


def arena_spec(root: Path, workspace: Workspace, scene_properties: Mapping[str, str]) -> mujoco.MjSpec:
    """Return a room as a model of its own, without cameras and lights.

    Args:
        root: Asset folder.
        workspace: Workspace that the room belongs to.
        scene_properties: Styles, as for `libero_env.assets.arena.add_arena`.

    Raises:
        UnknownNameError: A property or a style does not exist.
        LiberoError: Files are missing.
    """
    styles = chosen_styles(workspace.parameters["styles"], scene_properties)
    file = scene_file(root, workspace.name, styles["scene"])
    assets, world = read_file(file, root)
    for element in assets:
        for kind, name in _TEXTURE_NAMES.items():
            if element.tag == "texture" and element.get("name") == name:
                element.set("file", str(root / "textures" / TEXTURES[kind][styles[kind]]))
    for element in list(world):
        if element.tag in _EXCLUDED:
            world.remove(element)
    _fit_table(world, workspace.parameters.get("table", {}))
    spec = read_spec(to_xml(workspace.name, used_assets(assets, world), world), file)
    if _FULL_BOX_DEPTH:
        _soften_tables(spec)
    return spec


def _soften_tables(spec: mujoco.MjSpec) -> None:
    """Make stiff table tops as firm as before MuJoCo 3.4.

    Since then the penetration depth of two boxes is their overlap, where it was half of it, and the contact force grows
    with the depth over the square of the time constant. Some of the original's states start three centimetres deep in
    the living room table: with the same parameters, the objects would fly half a metre up.
    """
    for geom in spec.geoms:
        if geom.type == mujoco.mjtGeom.mjGEOM_BOX and geom.contype and geom.solref[0] < _STIFF:
            geom.solref, geom.solimp = _FIRM_SOLREF, (0.9, 0.95, 0.001, 0.5, 2.0)


def scene_file(root: Path, workspace: str, scene: str = "base") -> Path:
    """Return the file of a scene; the base one where the workspace has none of that name."""
    folder = root / "scenes"
    path = folder / f"{SCENES[workspace]}_{scene}_style.xml"
    return path if path.is_file() else folder / f"{SCENES[workspace]}_base_style.xml"


def _fit_table(world: ET.Element, table: Mapping[str, Any]) -> None:
    """Set the size of the named parts of a table to that of the workspace: the files contain placeholders."""
    named: dict[tuple[str, str], Mapping[str, Any]] = {
        ("geom", part["name"]): part
        for key in ("collision", "visual")
        for part in table.get(key, ())
        if "name" in part
    }
    named |= {("site", name): {"pos": pos} for name, pos in table.get("sites", {}).items()}
    named |= {("body", name): {"pos": pos} for name, pos in table.get("bodies", {}).items()}
    for element in world.iter():
        part = named.get((element.tag, element.get("name", "")), {})
        for key in ("pos", "size", "friction"):
            if key in part:
                element.set(key, " ".join(map(repr, part[key])))


def restore_drawing(spec: mujoco.MjSpec, root: Path, workspace: Workspace, scene_file: Path | None) -> None:
    """Make a scene of the original's files look as the original's own, in place.

    Args:
        spec: Complete scene.
        root: Asset folder.
        scene_file: File of its room; None for that of a user's workspace.

    Raises:
        LiberoError: The file is missing.
    """
    if scene_file is not None:
        _restore_cameras_and_lights(spec, workspace, read_file(scene_file)[1])
    solid = {g.meshname for g in spec.geoms if g.contype or g.conaffinity or g.group == 0}
    for mesh in spec.meshes:  # their vertices are rounded in the frame that MuJoCo gives them by default
        if mesh.name not in solid and mesh.file and Path(mesh.file).is_relative_to(root):
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_LEGACY
    # after 3.3.2, which converts no colours of files that are tagged as sRGB
    if hasattr(mujoco, "mjtColorSpace"):
        for texture in spec.textures:
            texture.colorspace = mujoco.mjtColorSpace.mjCOLORSPACE_LINEAR


def _restore_cameras_and_lights(spec: mujoco.MjSpec, workspace: Workspace, world: ET.Element) -> None:
    parent = spec.worldbody
    for element in (*parent.cameras, *parent.lights):
        delete(spec, element)
    cameras: dict[str, Mapping[str, list[float]]] = {
        camera.get("name", ""): {"pos": _numbers(camera, "pos"), "quat": _numbers(camera, "quat")}
        for camera in world.findall("camera")
    }
    for name, pose in (cameras | read_yaml(_CAMERAS)[workspace.name]).items():
        parent.add_camera(name=name, pos=pose["pos"], quat=pose["quat"])
    for light in world.findall("light"):  # their order is that of a sum of floats
        values = {key: _numbers(light, key) for key in ("pos", "dir", "diffuse", "specular")}
        directional = light.get("directional") == "true"
        add_light(spec, light.get("name", ""), directional=directional, **values)


def _numbers(element: ET.Element, key: str) -> list[float]:
    return [float(number) for number in element.get(key, "").split()]
