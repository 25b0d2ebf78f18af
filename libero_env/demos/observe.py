"""Observations of recorded states, in the scene that a demonstration file names."""

import re
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from textwrap import shorten
from typing import Any

import numpy as np

from libero_env.assets.pack import Pack
from libero_env.assets.robot import DEFAULT_ROBOT
from libero_env.demos.agreement import recorded_frequency
from libero_env.demos.config import RenderConfig
from libero_env.demos.contents import picture_size, read_header
from libero_env.demos.hdf5 import BrokenDemoError, open_demo_file
from libero_env.demos.read import Episode, read_episodes
from libero_env.demos.stored_model import model_xml, read_fixture_poses, spec_without_textures
from libero_env.envs.checks import check_range
from libero_env.envs.env import LiberoEnv
from libero_env.errors import DemoError, LiberoError, UnknownNameError
from libero_env.mujoco_compat import mujoco
from libero_env.objects.model import ROOT_BODY
from libero_env.sim.scene import Scene
from libero_env.sim.scene_spec import FAST
from libero_env.tasks import Task, bddl, get_suite
from libero_env.tasks.benchmark import task_of_file
from libero_env.tasks.problem import same_meaning
from libero_env.timing import CONTROL_HZ

_OPEN_FILE = "<_io."  # begins what `str(open(file))` returns
_NO_HORIZON = 10**9  # [steps] a recording ends where it ended


def recorded_robot(file: Path) -> str:
    """Return the model of the arm that was recorded, one of `libero_env.assets.robot.ROBOTS`.

    This package's files name it; those before it had a name have robosuite 1.4.1's. The original's have 1.4.0's.

    Raises:
        DemoError: It is not a demonstration file.
    """
    header = read_header(file)
    return str(header.get("robot", "robosuite-1.4.1" if "generator" in header else "libero"))


def recorded_task(file: Path) -> Task:
    """Return the task that was recorded.

    It is the benchmark's task that the file names, if the file's task text means the same, and else the task that the
    text describes. The original's collector stores the text of an open file, `<_io.TextIOWrapper ...>`: no task text.

    Raises:
        DemoError: The file names no task, or its task text cannot be read.
    """
    header = read_header(file)
    name, text = Path(str(header.get("bddl_file_name", ""))), str(header.get("bddl_file_content", ""))
    try:
        named = next((t for t in get_suite(name.parent.name).tasks if t.name == name.stem), None)
    except UnknownNameError:
        named = None
    if not text.strip() or text.startswith(_OPEN_FILE):
        if named is None:
            raise DemoError(
                f"{file}: neither bddl_file_content, {shorten(text, 40)!r}, nor bddl_file_name, {str(name)!r}, states "
                "which task was recorded; name its task file with --bddl"
            )
        return named
    try:
        problem = bddl.parse(text, f"{file} bddl_file_content")
    except LiberoError as error:
        raise DemoError(f"{error}; name its task file with --bddl") from error
    if named is not None and same_meaning(named.problem, problem):
        return named
    return task_of_file(name.stem, problem)


def task_header(file: Path, task: Task | None) -> dict[str, Any]:
    """Return the attributes of a file as `read_header` does, with a task's text where they do not state that task.

    Args:
        task: Task that was recorded; None for the one that the file states.
    """
    header = read_header(file)
    if task is None:
        return header
    try:
        stated = same_meaning(recorded_task(file).problem, task.problem)
    except DemoError:
        stated = False
    if stated and not str(header.get("bddl_file_content", "")).startswith(_OPEN_FILE):
        return header
    name = f"bddl_files/{task.suite}/{task.name}.bddl"
    return header | {"bddl_file_name": name, "bddl_file_content": task.bddl_text}


def recorded_rendering(file: Path) -> RenderConfig:
    """Return how the images of a file were rendered, without the perturbations under which they may have been.

    Raises:
        DemoError: It is not a demonstration file.
    """
    header, default = read_header(file), RenderConfig()
    with open_demo_file(file) as handle:
        size = picture_size(handle, file) or default.size
    return RenderConfig(
        tuple(map(str, header.get("cameras", ()))) or default.cameras,
        size,
        tuple(map(str, header.get("pictures", ()))) or default.modalities,
        header.get("drawing", FAST if "generator" in header else None),
    )


class StateRenderer:
    """Puts one simulation into recorded states and observes it there.

    Args:
        task: Task whose scene is simulated.
        assets: Where models come from, as for `LiberoEnv`.
        robot: Model of the arm, see `libero_env.assets.robot`.
        control_freq: Control steps per second, [Hz].
        control: Name of the controller, and whether its actions are relative.
    """

    def __init__(
        self,
        task: Task,
        config: RenderConfig,
        assets: Pack | str | Path | None = None,
        *,
        robot: str = DEFAULT_ROBOT,
        control_freq: int = CONTROL_HZ,
        control: tuple[str, bool] = ("osc_pose", True),
    ):
        self.task = task
        self.env = LiberoEnv(
            task,
            cameras=config.cameras,
            camera_size=config.size,
            horizon=_NO_HORIZON,
            assets=assets,
            drawing=config.drawing,
            robot=robot,
            control_freq=control_freq,
            controller=control[0],
            control_delta=control[1],
            observations=(*config.modalities, "proprioception", "ee_quat"),
            perturb=config.perturb,
        )
        self._xml: tuple[np.ndarray, str] | None = None  # poses of fixtures, and the scene with them

    @classmethod
    def of_file(
        cls,
        file: Path,
        config: RenderConfig,
        assets: Pack | str | Path | None = None,
        *,
        task: Task | None = None,
        control: tuple[str, bool] = ("osc_pose", True),
    ) -> "StateRenderer":
        """Return a renderer in the scene of a file's demonstrations.

        Args:
            assets: Where models come from, as for `LiberoEnv`.
            task: Task that was recorded; None for the one that the file names.
            control: Name of the controller, and whether its actions are relative.

        Raises:
            DemoError: It is not a demonstration file, or names no task.
        """
        arm, hz = recorded_robot(file), recorded_frequency(file)
        return cls(task or recorded_task(file), config, assets, robot=arm, control_freq=hz, control=control)

    @property
    def scene(self) -> Scene:
        """The compiled scene."""
        return self.env.scene

    def prepare(self, episode: Episode, where: str) -> None:
        """Put the fixtures at the poses of an episode, from the next state on; `where` is for error messages.

        Raises:
            DemoError: The states or the fixtures do not fit the scene.
        """
        self.env.simulations.fixtures[0] = fixture_poses(episode, self.scene, where)

    def episodes(self, file: Path, names: Sequence[str] | None = None) -> Iterator[Episode]:
        """Yield the demonstrations of a file, each after its fixtures are placed.

        Args:
            file: Where they are.
            names: Which ones; None for all.

        Raises:
            DemoError: The file is broken, does not fit the scene, or lacks one of the names.
        """
        seen = set()
        for episode in read_episodes(file):
            if names is None or episode.name in names:
                seen.add(episode.name)
                self.prepare(episode, f"{file}: {episode.name}")
                yield episode
        if absent := set(names or ()) - seen:
            raise DemoError(f"{file}: no demonstration {', '.join(sorted(absent))}")

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
        check_range(states, self.task)
        batch, simulations = self.env.batch, self.env.simulations
        simulations.fixtures[0] = fixtures
        if (perturbed := batch.perturbed) is not None:
            perturbed.open(0, name)
            batch.observer.set_appearance(0, perturbed.appearance(0))
        frames, robot_states = [], []
        for step, state in enumerate(states):  # filters with a memory see them in this order
            simulations.show_state(0, state)
            true = batch.observer.state()
            if perturbed is not None:
                perturbed.steps[0] = step
            images = batch.render_cameras()
            frames.append({**images, **(true if perturbed is None else batch.proprioception())})
            parts = true["gripper_states"], true["ee_pos"], true["ee_quat"][:, [1, 2, 3, 0]]
            robot_states.append(np.concatenate(parts, axis=1))
        obs = {key: np.concatenate([f[key] for f in frames]) for key in frames[0] if key != "ee_quat"}
        return obs, np.concatenate(robot_states)

    def model_xml(self, fixtures: np.ndarray) -> str:
        """Return the scene as MJCF, complete but for its textures; the robot's meshes are named by their path.

        Args:
            fixtures: Poses of the fixtures, (nfixtures, 7) pos and quat wxyz.
        """
        if self._xml is None or not np.array_equal(self._xml[0], fixtures):
            xml = model_xml(self._spec, dict(zip(self.scene.fixtures, fixtures, strict=True)))
            self._xml = fixtures.copy(), re.sub(r'file="[^"]*?(robosuite/models/assets/)', r'file="\1', xml)
        return self._xml[1]

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
        DemoError: The states or the poses do not fit the scene.
    """
    length = 1 + scene.model.nq + scene.model.nv
    if episode.states.shape[1] != length:
        raise BrokenDemoError(
            f"{where}/states is {episode.states.shape}; expected (T, {length}) for {scene.problem.language!r}"
        )
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
