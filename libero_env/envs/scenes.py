"""The scenes of an environment's task, with and without perturbations."""

from dataclasses import dataclass
from functools import partial

import numpy as np

from libero_env.envs.config import EnvConfig
from libero_env.errors import InvalidInputError
from libero_env.perturbations.episodes import PerturbedEpisodes, needs_materials, scene_problem
from libero_env.perturbations.perturbation import Perturbation, perturb_task
from libero_env.perturbations.published import published_changes, rest_of
from libero_env.sim.scene import Scene, build_scene
from libero_env.tasks import Task, get_task
from libero_env.tasks.published.suites import require_available
from libero_env.text import shown


@dataclass(frozen=True)
class TaskScenes:
    """A task and its scene, with and without perturbations.

    Attributes:
        task: Task as the perturbations change it.
        scene: Its compiled scene.
        base_task: The task without perturbations.
        base_scene: Compiled scene of that task.
        rest: Joints that the controller takes for the arm's rest pose, (7,) [rad].
        perturbed: Samples and filters; None without perturbations.
    """

    task: Task
    scene: Scene
    base_task: Task
    base_scene: Scene
    rest: np.ndarray
    perturbed: PerturbedEpisodes | None = None


def open_scenes(task: Task | str, config: EnvConfig, num: int) -> TaskScenes:
    """Compile the scene of a task, and that of the task as the perturbations of a configuration change it.

    Args:
        task: Task without perturbations, or an argument of `get_task`.
        config: Configuration.
        num: Number of simulations.
    """
    if not isinstance(task, Task | str):
        raise InvalidInputError(f"task is {shown(task)}; expected a Task, or a text such as libero_object/3")
    base = get_task(task) if isinstance(task, str) else task
    require_available([base])
    changes = (*config.perturb, *published_changes(base))
    compiled = partial(
        build_scene,
        pack=config.pack,
        drawing=config.drawing,
        robot=config.robot,
        spare_materials=needs_materials(changes),
    )
    base_scene = compiled(base.problem)
    if not changes:
        return TaskScenes(base, base_scene, base, base_scene, rest_of(base))
    changed = perturb_task(base, (one for one in changes if isinstance(one, Perturbation)), base_scene)
    scene = compiled(scene_problem(changed, base))
    perturbed = PerturbedEpisodes(changes, base, base_scene, scene, num)
    return TaskScenes(changed, scene, base, base_scene, rest_of(base), perturbed)
