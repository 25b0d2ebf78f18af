"""The scene as MJCF in demonstration files, and the poses of the fixtures in it."""

from collections.abc import Mapping
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from libero_env.assets.pack import Pack
from libero_env.assets.robot import DEFAULT_ROBOT
from libero_env.errors import DemoError, InvalidInputError
from libero_env.mujoco_compat import delete, mujoco
from libero_env.objects.model import ROOT_BODY
from libero_env.objects.xml_file import Node, parse_xml_text
from libero_env.sim.scene import Scene
from libero_env.sim.scene_spec import scene_spec
from libero_env.tasks.problem import Problem

_TEXTURE_FIELDS = (
    *("type", "builtin", "mark", "rgb1", "rgb2", "markrgb", "random", "width", "height", "nchannel", "data"),
    *("file", "cubefiles", "content_type", "gridlayout", "gridsize", "hflip", "vflip", "colorspace"),
)
_GROWING = {"include", "replicate", "composite", "flexcomp", "attach", "model", "extension", "plugin"}
_MAX_ELEMENTS = 20_000  # of a model; a kitchen has 3,000
_MAX_COUNT = 10_000  # of key frames and the like, for which <size> reserves memory
MAX_POSITION = 1e6  # [m] of a body in a stored model


def spec_without_textures(
    problem: Problem, pack: Pack | None = None, drawing: str | None = None, robot: str = DEFAULT_ROBOT
) -> mujoco.MjSpec:
    """Return the scene of a problem as an editable model without textures; arguments as of `scene_spec`."""
    spec = scene_spec(problem, pack, drawing=drawing, robot=robot)
    for material in spec.materials:
        material.textures = [""] * len(list(material.textures))
    for texture in list(spec.textures):
        delete(spec, texture)
    try:
        spec.compile()
    except ValueError:  # before MuJoCo 3.4 some materials still ask for theirs
        whole = scene_spec(problem, pack, drawing=drawing, robot=robot)
        for texture in whole.textures:
            if len(texture.data):  # pixels, which MJCF cannot hold
                texture.data, texture.builtin = b"", mujoco.mjtBuiltin.mjBUILTIN_FLAT
                texture.type, texture.width, texture.height = mujoco.mjtTexture.mjTEXTURE_2D, 1, 1
        whole.compile()
        spec = mujoco.MjSpec.from_string(_stripped(whole.to_xml()))
        spec.assets = whole.assets
        spec.compile()
    return spec


def compile_stored(xml: str, spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a stored model; materials that were stored without their textures get those of the task's scene.

    Args:
        xml: Stored model, with or without edits.
        spec: Scene of the same task, complete. It is not changed.

    Raises:
        DemoError: The text is not XML or has elements that grow without bound, or MuJoCo cannot compile the model, as
            when its files are elsewhere; the message is MuJoCo's.
    """
    _parse(xml, "the stored model")
    try:
        stored = mujoco.MjSpec.from_string(xml)
        stored.assets = {**spec.assets, **stored.assets}  # contents of files that are not on disk
        _add_textures(stored, spec)
        return stored.compile()
    except ValueError as error:
        raise DemoError(f"the stored model does not compile: {error}") from error


def _add_textures(stored: mujoco.MjSpec, spec: mujoco.MjSpec) -> None:
    available = {texture.name: texture for texture in spec.textures}
    present = {texture.name for texture in stored.textures}
    textures_of = {material.name: list(material.textures) for material in spec.materials}
    for material in stored.materials:
        textures = textures_of.get(material.name, [])
        if any(material.textures) or not any(textures):
            continue
        material.textures = textures
        for name in filter(None, textures):
            if name not in present:
                present.add(name)
                _copy_texture(stored, available[name])
    for name, texture in available.items():  # no material names the sky
        if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX and name not in present:
            _copy_texture(stored, texture)


def _copy_texture(spec: mujoco.MjSpec, texture: mujoco.MjsTexture) -> None:
    copied = spec.add_texture(name=texture.name)
    for field in _TEXTURE_FIELDS:
        if hasattr(texture, field):  # MuJoCo 3.3 has no colour space of the scene's textures to keep
            value = getattr(texture, field)
            setattr(copied, field, bytes(value) if field == "data" else value)


def model_xml(spec: mujoco.MjSpec, poses: Mapping[str, np.ndarray]) -> str:
    """Return a scene as MJCF with its fixtures at the given poses, (7,) pos and quat wxyz."""
    for name, pose in poses.items():
        body = spec.body(f"{name}_{ROOT_BODY}")
        body.pos, body.quat = pose[:3], pose[3:]
    return spec.to_xml()


def _stripped(xml: str) -> str:
    """Return MJCF without textures."""
    root = ElementTree.fromstring(xml)  # noqa: S314 - our own
    for assets in root.iter("asset"):
        for texture in assets.findall("texture"):
            assets.remove(texture)
        for material in assets.findall("material"):
            material.attrib.pop("texture", None)
            for layer in material.findall("layer"):
                material.remove(layer)
    return ElementTree.tostring(root, encoding="unicode")


def read_fixture_poses(xml: str, scene: Scene, where: str = "the stored model") -> dict[str, np.ndarray]:
    """Return the poses of the fixtures in a stored model of this package or of the original.

    Args:
        xml: Stored model.
        scene: Scene of the same task.
        where: Name of the model in error messages.

    Returns:
        Fixture -> pose (7,), pos and quat wxyz; without the fixtures that are missing.

    Raises:
        DemoError: The text is not XML, or a pose is not one.
    """
    root = _parse(xml, where)
    poses = {}
    for body in root.iter("body"):
        name = body.get("name", "").removesuffix(f"_{ROOT_BODY}")
        if name in scene.fixtures:
            poses[name] = _pose(body, f"{where}, body {body.get('name')}")
    return poses


def _parse(xml: str, where: str) -> Node:
    """Return the root of a stored model, which is complete: it includes no files and makes no elements of others."""
    try:
        root = parse_xml_text(xml.encode("utf-8", "replace"), where)
    except InvalidInputError as error:
        raise DemoError(f"{where} is not XML ({error}); expected the scene as MJCF") from error
    for number, node in enumerate(root.iter()):
        if node.tag in _GROWING or number > _MAX_ELEMENTS:
            what = f"the element <{node.tag}>" if node.tag in _GROWING else f"over {_MAX_ELEMENTS} elements"
            raise DemoError(f"{where} has {what}; expected a complete model, as recordings have it")
    for size in root.iter("size"):
        for key, value in size.items():
            if key != "memory" and not (value.lstrip("-").isdecimal() and int(value[:9]) <= _MAX_COUNT):
                raise DemoError(f"{where} reserves {key}={value!r}; expected at most {_MAX_COUNT}")
    return root


def _pose(body: Element, where: str) -> np.ndarray:
    """Return the pose of a body, (7,) pos and quat wxyz."""
    texts = body.get("pos", "0 0 0").split(), body.get("quat", "1 0 0 0").split()
    try:
        pose = np.array([float(number) for number in sum(texts, [])])
    except ValueError as error:
        raise DemoError(f"{where}: {error}; expected numbers in pos and quat") from None
    if [len(numbers) for numbers in texts] != [3, 4] or not (np.abs(pose) <= MAX_POSITION).all():
        raise DemoError(
            f"{where}: pos and quat are {texts}; expected 3 and 4 numbers of at most {MAX_POSITION:g}"
        )
    if np.linalg.norm(pose[3:]) < 1e-6:
        raise DemoError(f"{where}: quat is zero; expected a rotation")
    return pose
