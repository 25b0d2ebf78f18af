"""A scene as MJCF, as demonstrations store it, and the poses of fixtures that are read from it."""

from xml.etree import ElementTree

import mujoco

from libero_env.errors import LiberoError
from libero_env.sim.scene import Scene, scene_spec

Pose = tuple[list[float], list[float]]


def write_model(scene: Scene, model: mujoco.MjModel) -> str:
    """Return the scene as MJCF without textures, with the poses of the fixtures in `model`."""
    spec = scene_spec(scene.problem, scene.pack)
    for material in spec.materials:
        material.textures = [""] * len(list(material.textures))
    for texture in list(spec.textures):
        spec.delete(texture)
    for name in scene.fixtures:
        body, own = spec.body(f"{name}_main"), model.body(f"{name}_main")
        body.pos, body.quat = own.pos, own.quat
    spec.compile()
    return spec.to_xml()


def fixtures_of(scene: Scene, xml: str) -> dict[str, Pose]:
    """Return fixture -> position (3,), m, and orientation (4,), wxyz, in a stored model of the task.

    Args:
        scene: Scene of the task.
        xml: Stored model, of this package or of the original.

    Raises:
        LiberoError: The text is not XML.
    """
    try:
        root = ElementTree.fromstring(xml)
    except ElementTree.ParseError as error:
        raise LiberoError(f"the stored model is not XML: {error}") from error
    found = {}
    for body in root.iter("body"):
        name = body.get("name", "").removesuffix("_main")
        if name in scene.fixtures:
            pos, quat = body.get("pos", "0 0 0"), body.get("quat", "1 0 0 0")
            found[name] = [float(x) for x in pos.split()], [float(x) for x in quat.split()]
    return found
