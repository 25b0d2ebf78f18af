"""Observations of recorded states: for new recordings, for replaying, and for rendering files again."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from libero_env.assets.pack import Pack
from libero_env.assets.robot import DEFAULT_ROBOT
from libero_env.demos.stored_model import model_xml, read_fixture_poses, spec_without_textures
from libero_env.demos.write import Episode
from libero_env.envs.env import LiberoEnv
from libero_env.errors import DemoError, InvalidInputError
from libero_env.objects.model import ROOT_BODY
from libero_env.perturbations.catalog import KINDS
from libero_env.perturbations.episodes import checked_perturbations
from libero_env.perturbations.value import Perturbation, format_perturbations
from libero_env.sim.observations import DEFAULT_CAMERAS
from libero_env.sim.scene import FAST, Scene
from libero_env.tasks import Task

PERTURBED_HEADER = ("perturb", "perturb_draws")  # attributes of a file that was rendered under perturbations
PERTURB_DRAWS = 1  # change it when the same perturbation of the same demonstration gives other observations


@dataclass(frozen=True)
class RenderConfig:
    """What is rendered of each state.

    Attributes:
        cameras: Names of the cameras in the model.
        size: (height, width) of the images, pixels.
        modalities: Kinds of image: `rgb`, `depth`, and at most one of `segmentation_instance`, `segmentation_class`
            and `segmentation_element`.
        drawing: How images are drawn, one of `DRAWINGS`; None for the default of the models.
        perturb: Perturbations, as for `EnvConfig`, of kinds that change what is seen or said, and no physics.

    Raises:
        UnknownNameError: A kind of perturbation does not exist.
        InvalidInputError: A perturbation is not valid, or changes what happens.
    """

    cameras: tuple[str, ...] = DEFAULT_CAMERAS
    size: tuple[int, int] = (128, 128)
    modalities: tuple[str, ...] = ("rgb",)
    drawing: str | None = None
    perturb: str | Sequence[Perturbation] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "perturb", rendered_perturbations(self.perturb))

    @property
    def perturbations(self) -> tuple[Perturbation, ...]:
        """Perturbations, in the order in which they are applied."""
        return rendered_perturbations(self.perturb)

    def header(self) -> dict[str, Any]:
        """Return the attributes of a file; the default cameras and modalities, and `fast`, are left out."""
        values = {"cameras": list(self.cameras), "pictures": list(self.modalities)}
        defaults = {"cameras": list(DEFAULT_CAMERAS), "pictures": ["rgb"]}
        drawing = {} if self.drawing in (None, FAST) else {"drawing": self.drawing}
        changed = {k: v for k, v in values.items() if v != defaults[k]}
        found = {"camera_size": list(self.size), **changed, **drawing}
        if self.perturb:
            text = format_perturbations(self.perturbations)
            found |= zip(PERTURBED_HEADER, (text, PERTURB_DRAWS), strict=True)
        return found


def rendered_perturbations(perturb: str | Sequence[Perturbation]) -> tuple[Perturbation, ...]:
    """Return perturbations under which recorded states can be rendered, those of severity 0 left out.

    Raises:
        UnknownNameError: A kind of perturbation does not exist.
        InvalidInputError: A perturbation is not valid, or changes what happens and not only what is seen or said.
    """
    found = []
    for one in checked_perturbations(perturb):
        if not isinstance(one, Perturbation) or not one.definition.is_rendered:
            valid = ", ".join(kind.name for kind in KINDS.values() if kind.is_rendered)
            raise InvalidInputError(
                f"{one} changes what happens, and recorded demonstrations show what happened without it; valid: {valid}"
            )
        found.append(one)
    return tuple(found)


class StateRenderer:
    """Puts one simulation into recorded states and observes it there.

    Args:
        task: Task whose scene is simulated.
        config: What is rendered.
        assets: Where models come from, as for `LiberoEnv`.
        robot: Model of the arm, see `libero_env.assets.robot`.
    """

    def __init__(
        self,
        task: Task,
        config: RenderConfig,
        assets: Pack | str | Path | None = None,
        *,
        robot: str = DEFAULT_ROBOT,
    ):
        self.task = task
        self.env = LiberoEnv(
            task,
            cameras=config.cameras,
            camera_size=config.size,
            assets=assets,
            drawing=config.drawing,
            robot=robot,
            observations=(*config.modalities, "proprioception", "ee_quat"),
            perturb=config.perturb,
        )

    @property
    def scene(self) -> Scene:
        """The compiled scene."""
        return self.env.world.scene

    def place_fixtures(self, fixtures: np.ndarray) -> None:
        """Put the fixtures at the given poses, (nfixtures, 7) pos and quat wxyz, from the next state on."""
        self.env.world.simulations.fixtures[0] = fixtures

    def render_states(
        self, states: np.ndarray, fixtures: np.ndarray, name: str = ""
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Return what is observed in the given states.

        Args:
            states: (T, 1 + nq + nv) time, qpos, qvel.
            fixtures: Poses of the fixtures, (nfixtures, 7) pos and quat wxyz.
            name: Name of the demonstration, by which perturbations are drawn.

        Returns:
            Observations, name to (T, ...), and robot states, (T, 9), which no perturbation changes.
        """
        self.place_fixtures(fixtures)
        frames, robot_states = [], []
        for frame in self._frames(states, name):
            frames.append(frame)
            true = {key: rows[0] for key, rows in self.env.world.observer.state().items()}
            quat_xyzw = true["ee_quat"][[1, 2, 3, 0]]
            robot_states.append(np.concatenate([true["gripper_states"], true["ee_pos"], quat_xyzw]))
        obs = {key: np.stack([frame[key] for frame in frames]) for key in frames[0] if key != "ee_quat"}
        return obs, np.stack(robot_states)

    def _frames(self, states: np.ndarray, name: str) -> Iterator[dict[str, np.ndarray]]:
        """Yield the observation of each state; filters with a memory see them in this order."""
        world = self.env.world
        if (perturbed := world.perturbed) is None:
            yield from map(self.env.set_state, states)
            return
        perturbed.open(0, name)
        world.observer.set_look(0, perturbed.look(name))
        for step, state in enumerate(states):
            world.set_physics_state(0, world.checked_state(state))
            perturbed.steps[0] = step
            yield {**self.env.render_cameras(), **{k: rows[0] for k, rows in world.proprioception().items()}}

    def model_xml(self, fixtures: np.ndarray) -> str:
        """Return the scene as MJCF, complete but for its textures; the robot's meshes are named by their path.

        Args:
            fixtures: Poses of the fixtures, (nfixtures, 7) pos and quat wxyz.
        """
        xml = model_xml(self._spec, dict(zip(self.scene.fixtures, fixtures, strict=True)))
        return re.sub(r'file="[^"]*?(robosuite/models/assets/)', r'file="\1', xml)

    @cached_property
    def _spec(self) -> mujoco.MjSpec:
        return spec_without_textures(self.task.problem, robot=self.scene.robot)

    def close(self) -> None:
        """Free the simulation and the OpenGL context."""
        self.env.close()


def fixture_poses(episode: Episode, scene: Scene, where: str) -> np.ndarray:
    """Return the poses of the fixtures in an episode, (nfixtures, 7) pos and quat wxyz.

    Files of this package store them exactly. All files have them, rounded, in the attribute `model_file`; without
    it, they are those of the scene.

    Args:
        episode: What was recorded.
        scene: Scene of the same task.
        where: File and demonstration, for error messages.

    Raises:
        DemoError: The poses do not fit the scene.
    """
    poses = scene.fixture_poses.copy()
    if episode.fixtures is not None:
        if episode.fixtures.shape != poses.shape:
            raise DemoError(
                f"{where}: attribute fixtures is {episode.fixtures.shape}; expected {poses.shape}"
            )
        return episode.fixtures
    if "model_file" not in episode.attrs or not scene.fixtures:
        return poses
    stored = read_fixture_poses(episode.attrs["model_file"], scene, f"{where}/model_file")
    for pose, name in zip(poses, scene.fixtures, strict=True):
        if name not in stored:
            raise DemoError(
                f"{where}/model_file has no body {name}_{ROOT_BODY}; expected one for each fixture"
            )
        pose[:] = stored[name]
    return poses
