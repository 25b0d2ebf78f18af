"""The scenes of an environment's task."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from libero_env.doors import enter
from libero_env.envs.config import EnvConfig
from libero_env.envs.hooks import Hooks
from libero_env.errors import InvalidInputError
from libero_env.memory import require_memory
from libero_env.sim.scene import Scene, build_scene
from libero_env.sim.scene_spec import BUFFER_SIDE
from libero_env.tasks import Task, get_task
from libero_env.tasks.cameras import added_cameras
from libero_env.text import shown

Compile = Callable[..., Scene]  # of a problem; `spare_materials` as of `build_scene`


@dataclass(frozen=True)
class TaskScenes:
    """A task and its scene, with and without perturbations.

    Attributes:
        task: Task as the perturbations change it.
        base_task: The task without perturbations.
        later: Task that an event changes it into; None without one.
        perturbed: Samples and filters, a `PerturbedEpisodes`; None without perturbations.
        hooks: What takes part in episodes.
    """

    task: Task
    scene: Scene
    base_task: Task
    base_scene: Scene
    later: Task | None = None
    perturbed: Any = None
    hooks: tuple[Hooks, ...] = ()


def open_scenes(task: Task | str, config: EnvConfig, num: int) -> TaskScenes:
    """Compile the scene of a task, and that of the task as the perturbations of a configuration change it.

    Args:
        task: Task without perturbations, or an argument of `get_task`.
        config: Configuration.
        num: Number of simulations.
    """
    task = str(task) if isinstance(task, os.PathLike) else task
    if not isinstance(task, Task | str):
        raise InvalidInputError(
            f"task is {shown(task)}; expected a Task, a path, or a text such as libero_object/3"
        )
    base = get_task(task) if isinstance(task, str) else task
    base.require_available()
    compiled = partial(
        build_scene,
        pack=config.pack,
        drawing=config.drawing,
        robot=config.robot,
        cameras=added_cameras(config.cameras),
    )
    if changes := (*config.perturb, *base.changes()):
        return enter("perturbations", "open")(base, changes, compiled, num)
    scene = compiled(base.problem)
    return TaskScenes(base, scene, base, scene)


def check_memory(scene: Scene, config: EnvConfig, num: int) -> None:
    """Raise an `InvalidInputError` where simulations of a scene and their images do not fit into memory."""
    if num == 1 and max(config.camera_size) <= BUFFER_SIDE:
        return
    height, width = config.camera_size
    images = 16 * height * width * len(config.cameras)
    state = 0 if config.backend.is_warp else scene.model.narena + scene.model.nbuffer // 8  # on the device
    require_memory(
        num * (state + images),
        f"num_envs={num}" if num > 1 else f"camera_size={height}x{width}",
        "take fewer simulations or smaller images",
    )
