"""Problem + object catalog + workspace -> one MuJoCo model.

Joint order is the original's: arm, gripper, then the objects in the order of the task file; so states of the original
have the same layout.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Any

import mujoco
import numpy as np
import yaml

from libero_env.bddl import Problem
from libero_env.errors import UnknownNameError
from libero_env.objects import ObjectModel, get_object
from libero_env.objects.model import set_damping
from libero_env.robot import OPEN_FINGERS, REST_QPOS, add_panda

TIMESTEP = 0.002  # s
_WORKSPACES = {"floor": "floor"}  # fixture category that is a workspace -> its file
_MAX_FRAME = 1024  # pixels, the largest picture the offscreen buffer holds


@dataclass(frozen=True)
class Workspace:
    """Where a task happens; the figures of one file in `libero_env/workspaces`."""

    name: str
    offset: tuple[float, float, float]  # origin of the regions, world frame, m
    region_height: float  # z of the surface that regions lie on, m
    figures: Mapping[str, Any]


@dataclass(frozen=True)
class Scene:
    """A compiled task. The model is shared by all environments of the task: nobody writes to it."""

    problem: Problem
    workspace: Workspace
    model: mujoco.MjModel
    objects: Mapping[str, ObjectModel]  # instance name -> what it is, in the order of the task file

    @property
    def nq_robot(self) -> int:
        """Number of position coordinates that belong to arm and gripper; objects follow."""
        return len(REST_QPOS) + len(OPEN_FINGERS)


@lru_cache(maxsize=32)
def load_workspace(name: str) -> Workspace:
    """The workspace of that name.

    Raises:
        UnknownNameError: no such workspace; the message lists the valid ones.
    """
    if name not in _WORKSPACES:
        raise UnknownNameError("workspace", name, _WORKSPACES)
    text = resources.files("libero_env").joinpath(f"workspaces/{_WORKSPACES[name]}.yaml").read_text()
    figures = yaml.safe_load(text)
    return Workspace(name, tuple(figures["offset"]), figures["region_height"], figures)


@lru_cache(maxsize=128)
def build_scene(problem: Problem) -> Scene:
    """Compile a problem; the result is cached for the process.

    Raises:
        UnknownNameError: a fixture or object category that has no model.
    """
    objects = {name: get_object(category) for name, category in problem.objects.items()}
    return Scene(problem, load_workspace(workspace_of(problem)), scene_spec(problem, objects).compile(), objects)


def scene_spec(problem: Problem, objects: Mapping[str, ObjectModel] | None = None) -> mujoco.MjSpec:
    """A fresh, editable model of a problem's scene, with these objects or with those of the catalog.

    Raises:
        UnknownNameError: a fixture or object category that has no model.
    """
    workspace = load_workspace(workspace_of(problem))
    spec = mujoco.MjSpec()
    spec.modelname = "libero"
    _set_options(spec)
    _add_arena(spec, workspace)
    add_panda(spec, workspace.figures["robot"]["base_pos_world"])
    for name, category in problem.objects.items():
        _add_object(spec, name, get_object(category) if objects is None else objects[name])
    return spec


def workspace_of(problem: Problem) -> str:
    """The fixture of a problem that is its workspace.

    Raises:
        UnknownNameError: none of the fixtures is one.
    """
    for category in problem.fixtures.values():
        if category in _WORKSPACES:
            return category
    raise UnknownNameError("workspace among the fixtures", list(problem.fixtures.values()), _WORKSPACES)


def initial_qpos(scene: Scene) -> np.ndarray:
    """Positions with the arm at rest, the gripper open and every object at its model's origin; (nq,)."""
    qpos = scene.model.qpos0.copy()
    qpos[: scene.nq_robot] = REST_QPOS + OPEN_FINGERS
    return qpos


def _set_options(spec: mujoco.MjSpec) -> None:
    spec.compiler.degree = False
    option = spec.option
    option.timestep = TIMESTEP
    option.impratio = 20.0
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.density, option.viscosity = 1.2, 2e-5
    visual = spec.visual
    visual.map.znear = 0.001
    visual.quality.offsamples = 0  # multisampling doubles the cost of a picture
    visual.quality.shadowsize = 0
    visual.global_.offwidth = visual.global_.offheight = _MAX_FRAME
    visual.headlight.ambient, visual.headlight.diffuse = [0.1] * 3, [0.4] * 3
    visual.headlight.specular = [0.5] * 3


def _add_arena(spec: mujoco.MjSpec, workspace: Workspace) -> None:
    world, figures = spec.worldbody, workspace.figures
    for name, camera in figures["cameras"].items():
        world.add_camera(name=name, pos=camera["pos"], quat=camera["quat"], fovy=camera["fovy_degrees"])
    for light in figures["lights"]:
        world.add_light(
            name=light["name"], pos=light["pos"], dir=light["dir"], diffuse=[0.8] * 3, specular=[0.3] * 3,
            castshadow=False,
        )  # fmt: skip
    _add_material(spec, "floor_tiles", _tiles(*figures["floor"]["colours"]), repeat=1.0 / figures["floor"]["tile"])
    floor = world.add_body(name="floor")
    floor.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=figures["floor"]["size"], material="floor_tiles",
        group=1, condim=3,
    )  # fmt: skip
    for wall in figures["walls"]["boxes"]:
        world.add_geom(
            name=wall["name"], type=mujoco.mjtGeom.mjGEOM_BOX, pos=wall["pos"], quat=wall["quat"], size=wall["size"],
            rgba=[*figures["walls"]["colour"], 1.0], group=1, contype=0, conaffinity=0,
        )  # fmt: skip


def _add_object(spec: mujoco.MjSpec, name: str, item: ObjectModel) -> None:
    body = item.spec.body("main")
    joint = body.add_joint(name="joint0", type=mujoco.mjtJoint.mjJNT_FREE)
    set_damping(joint, item.joint_damping)
    spec.attach(item.spec, prefix=f"{name}_", frame=spec.worldbody.add_frame())


def _add_material(spec: mujoco.MjSpec, name: str, image: np.ndarray, repeat: float) -> None:
    texture = spec.add_texture(
        name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, height=image.shape[0], width=image.shape[1], nchannel=3,
    )  # fmt: skip
    texture.data = image.tobytes()
    material = spec.add_material(name=name, texuniform=True, texrepeat=[repeat, repeat], specular=0.0, shininess=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


def _tiles(tile_rgb: list[float], joint_rgb: list[float], size: int = 64) -> np.ndarray:
    """One floor tile with its joint, (size, size, 3) uint8."""
    image = np.empty((size, size, 3))
    image[:] = tile_rgb
    image[:1] = image[:, :1] = joint_rgb
    image += np.random.default_rng(0).normal(0.0, 0.008, (size, size, 1))  # a little grain
    return np.clip(image * 255, 0, 255).astype(np.uint8)
