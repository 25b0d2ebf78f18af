"""Observations of states that were recorded: what filming, replaying and rendering anew have in common."""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from libero_env.assets.pack import Pack
from libero_env.envs.env import LiberoEnv
from libero_env.errors import DemoError
from libero_env.mujoco_compat import delete
from libero_env.objects.model import ROOT_BODY
from libero_env.sim.observations import DEFAULT_CAMERAS
from libero_env.sim.scene import Scene, scene_spec
from libero_env.tasks import Task


@dataclass(frozen=True)
class Shots:
    """What is drawn of each state.

    Attributes:
        cameras: names in the model.
        size: (height, width), pixels.
        pictures: `rgb`, `depth`, and at most one of `segmentation_instance`, `_class` and `_element`.
    """

    cameras: tuple[str, ...] = DEFAULT_CAMERAS
    size: tuple[int, int] = (128, 128)
    pictures: tuple[str, ...] = ("rgb",)

    def header(self) -> dict:
        """Attributes of a file; those of the ordinary cameras go without saying."""
        extra = {"cameras": list(self.cameras), "pictures": list(self.pictures)}
        usual = {"cameras": list(DEFAULT_CAMERAS), "pictures": ["rgb"]}
        return {"camera_size": list(self.size)} | {k: v for k, v in extra.items() if v != usual[k]}


class Filmer:
    """Puts one simulation into recorded states and says what is seen there.

    Args:
        task: whose scene.
        shots: what is drawn.
        assets: as in `LiberoEnv`.
    """

    def __init__(self, task: Task, shots: Shots, assets: Pack | str | Path | None = None):
        self.env = LiberoEnv(
            task,
            cameras=shots.cameras,
            camera_size=shots.size,
            assets=assets,
            observations=(*shots.pictures, "proprioception", "ee_quat"),
        )

    @property
    def scene(self) -> Scene:
        """The compiled scene."""
        return self.env.world.scene

    def pose_fixtures(self, fixtures: np.ndarray) -> None:
        """Let fixtures stand at (nfixtures, 7) pos, quat wxyz from the next state on."""
        self.env.world.simulations.fixtures[0] = fixtures

    def film(self, states: np.ndarray, fixtures: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Observations name -> (T, ...) and robot states (T, 9) of states (T, 1 + nq + nv)."""
        self.pose_fixtures(fixtures)
        seen = [self.env.set_state(state) for state in states]
        obs = {key: np.stack([frame[key] for frame in seen]) for key in seen[0]}
        quat_xyzw = obs.pop("ee_quat")[:, [1, 2, 3, 0]]
        return obs, np.concatenate([obs["gripper_states"], obs["ee_pos"], quat_xyzw], axis=1)

    def close(self) -> None:
        """Free simulation and GL context."""
        self.env.close()


@lru_cache(maxsize=4)
def _bare_spec(task: Task) -> mujoco.MjSpec:
    """The scene without its textures, which are made in memory."""
    spec = scene_spec(task.problem)
    for material in spec.materials:
        material.textures = [""] * len(list(material.textures))
    for texture in list(spec.textures):
        delete(spec, texture)
    spec.compile()
    return spec


def model_file(task: Task, names: Sequence[str], fixtures: np.ndarray) -> str:
    """The scene as MJCF, whole but for its textures; the robot's meshes by their path.

    Args:
        task: whose scene.
        names: of the fixtures.
        fixtures: where they stand, (nfixtures, 7) pos, quat wxyz.
    """
    spec = _bare_spec(task)
    for name, pose in zip(names, fixtures, strict=True):
        body = spec.body(f"{name}_{ROOT_BODY}")
        body.pos, body.quat = pose[:3], pose[3:]
    return re.sub(r'file="[^"]*?(robosuite/models/assets/)', r'file="\1', spec.to_xml())


def fixtures_of(attrs: Mapping[str, Any], scene: Scene, where: str) -> np.ndarray:
    """Where the fixtures of a demonstration stand, (nfixtures, 7) pos, quat wxyz.

    They are in the attribute `fixtures` of our files, rounded in the `model_file` of all, and else where the scene has
    them.

    Raises:
        DemoError: an attribute that does not fit the scene; the message starts with `where`.
    """
    poses = scene.fixture_poses.copy()
    if "fixtures" in attrs:
        if np.shape(attrs["fixtures"]) != poses.shape:
            raise DemoError(
                f"{where}: attribute fixtures is {np.shape(attrs['fixtures'])}; expected {poses.shape}"
            )
        return np.asarray(attrs["fixtures"], np.float64)
    if "model_file" not in attrs or not scene.fixtures:
        return poses
    xml = attrs["model_file"]
    try:
        bodies = {body.get("name"): body for body in ElementTree.fromstring(xml).iter("body")}
    except ElementTree.ParseError as error:
        raise DemoError(f"{where}/model_file is no XML ({error}); expected the scene as MJCF") from error
    for pose, name in zip(poses, scene.fixtures, strict=True):
        body = bodies.get(f"{name}_{ROOT_BODY}")
        if body is None:
            raise DemoError(
                f"{where}/model_file has no body {name}_{ROOT_BODY}; expected one for each fixture"
            )
        pose[:3] = [float(number) for number in body.get("pos", "0 0 0").split()]
        pose[3:] = [float(number) for number in body.get("quat", "1 0 0 0").split()]
    return poses
