"""What the original's pictures show beyond the shapes: its cameras and lights to the last digit, meshes, textures.

A scene of the original's files has rounded cameras, and visual meshes in a frame of their own. Both move a picture by a
few grey levels. Here the scene becomes what the original compiles, without any change to its physics.
"""

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree as ET

import mujoco

from libero_env.assets.arena import Workspace, add_light
from libero_env.assets.original_mjcf import read_file
from libero_env.mujoco_compat import delete
from libero_env.storage import read_yaml

_CAMERAS = "assets/workspaces/original_cameras.yaml"


def restore_drawing(spec: mujoco.MjSpec, root: Path, workspace: Workspace, scene_file: Path) -> None:
    """Make a scene of the original's files look as the original's own, in place.

    Args:
        spec: Complete scene.
        root: Asset folder.
        workspace: Workspace of the scene.
        scene_file: File of its room.

    Raises:
        LiberoError: The file is missing.
    """
    _restore_cameras_and_lights(spec, workspace, read_file(scene_file)[1])
    _restore_meshes(spec, root)
    _restore_textures(spec)


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
        add_light(
            spec,
            light.get("name", ""),
            pos=_numbers(light, "pos"),
            dir=_numbers(light, "dir"),
            diffuse=_numbers(light, "diffuse"),
            specular=_numbers(light, "specular"),
            directional=light.get("directional") == "true",
        )


def _restore_meshes(spec: mujoco.MjSpec, root: Path) -> None:
    """Give visual meshes the frame that MuJoCo gives them by default: their vertices are rounded in it."""
    solid = {g.meshname for g in spec.geoms if g.contype or g.conaffinity or g.group == 0}
    for mesh in spec.meshes:
        if mesh.name not in solid and mesh.file and Path(mesh.file).is_relative_to(root):
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_LEGACY


def _restore_textures(spec: mujoco.MjSpec) -> None:
    """Read colours as MuJoCo 3.3.2 does: later versions convert those of files that are tagged as sRGB."""
    if hasattr(mujoco, "mjtColorSpace"):
        for texture in spec.textures:
            texture.colorspace = mujoco.mjtColorSpace.mjCOLORSPACE_LINEAR


def _numbers(element: ET.Element, key: str) -> list[float]:
    return [float(number) for number in element.get(key, "").split()]
