"""The scene as MJCF in demonstration files, and the poses of the fixtures in it."""

from collections.abc import Mapping
from xml.etree import ElementTree

import mujoco
import numpy as np

from libero_env.assets.pack import Pack
from libero_env.errors import DemoError
from libero_env.mujoco_compat import delete
from libero_env.objects.model import ROOT_BODY
from libero_env.sim.scene import Scene, scene_spec
from libero_env.tasks.problem import Problem


def spec_without_textures(problem: Problem, pack: Pack | None = None) -> mujoco.MjSpec:
    """Return the scene of a problem as an editable model without textures."""
    spec = scene_spec(problem, pack)
    for material in spec.materials:
        material.textures = [""] * len(list(material.textures))
    for texture in list(spec.textures):
        delete(spec, texture)
    spec.compile()
    return spec


def model_xml(spec: mujoco.MjSpec, poses: Mapping[str, np.ndarray]) -> str:
    """Return a scene as MJCF with its fixtures at the given poses, (7,) pos and quat wxyz."""
    for name, pose in poses.items():
        body = spec.body(f"{name}_{ROOT_BODY}")
        body.pos, body.quat = pose[:3], pose[3:]
    return spec.to_xml()


def read_fixture_poses(xml: str, scene: Scene, where: str = "the stored model") -> dict[str, np.ndarray]:
    """Return the poses of the fixtures in a stored model of this package or of the original.

    Args:
        xml: Stored model.
        scene: Scene of the same task.
        where: Name of the model in error messages.

    Returns:
        Fixture -> pose (7,), pos and quat wxyz; without the fixtures that are missing.

    Raises:
        DemoError: The text is not XML.
    """
    try:
        root = ElementTree.fromstring(xml)
    except ElementTree.ParseError as error:
        raise DemoError(f"{where} is not XML ({error}); expected the scene as MJCF") from error
    poses = {}
    for body in root.iter("body"):
        name = body.get("name", "").removesuffix(f"_{ROOT_BODY}")
        if name in scene.fixtures:
            numbers = f"{body.get('pos', '0 0 0')} {body.get('quat', '1 0 0 0')}".split()
            poses[name] = np.array([float(number) for number in numbers])
    return poses
