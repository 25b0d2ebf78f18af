"""The scenes of an environment's task, with and without perturbations."""

import os
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from libero_env.assets.arena import workspace_of_problem
from libero_env.envs.config import EnvConfig
from libero_env.errors import InvalidInputError
from libero_env.perturbations.corruptions import CAMERA, Corruption
from libero_env.perturbations.episodes import PerturbedEpisodes, needs_materials, scene_problem
from libero_env.perturbations.kinds import Change
from libero_env.perturbations.perturbation import Perturbation, perturb_task
from libero_env.perturbations.starts import RobotJoints
from libero_env.sim.appearance import Appearance, CameraView
from libero_env.sim.scene import Scene, build_scene
from libero_env.tasks import Task, get_task
from libero_env.tasks.cameras import added_cameras
from libero_env.tasks.published.plus import camera_pose, joint_pose
from libero_env.tasks.published.suites import PublishedTask, require_available
from libero_env.text import shown


@dataclass(frozen=True)
class TaskScenes:
    """A task and its scene, with and without perturbations.

    Attributes:
        task: Task as the perturbations change it.
        base_task: The task without perturbations.
        later: Task that an event changes it into; None without one.
        rest: Joints that the controller takes for the arm's rest pose, (7,) [rad].
        perturbed: Samples and filters; None without perturbations.
    """

    task: Task
    scene: Scene
    base_task: Task
    base_scene: Scene
    rest: np.ndarray
    perturbed: PerturbedEpisodes | None = None
    later: Task | None = None


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
    require_available([base])
    changes = (*config.perturb, *published_changes(base))
    compiled = partial(
        build_scene,
        pack=config.pack,
        drawing=config.drawing,
        robot=config.robot,
        spare_materials=needs_materials(changes),
        cameras=added_cameras(config.cameras),
    )
    base_scene = compiled(base.problem)
    # In LIBERO-Plus the controller pulls towards the joints of the variant in its null space, and its first goals are
    # relative to them, whether the arm starts there or not.
    variant = base.variant if isinstance(base, PublishedTask) else None
    rest = joint_pose(0 if variant is None else variant.pose)
    if not changes:
        return TaskScenes(base, base_scene, base, base_scene, rest)
    sampled = [one for one in changes if isinstance(one, Perturbation)]
    changed, later = perturb_task(base, sampled, base_scene), None
    problem = scene_problem(changed, base)
    if events := [replace(one, trigger="") for one in sampled if one.layer == "problem" and one.trigger]:
        later = perturb_task(base, events[:1], base_scene)
        problem = replace(problem, regions=later.problem.regions)
    scene = compiled(problem)
    perturbed = PerturbedEpisodes(changes, base, base_scene, scene, num)
    return TaskScenes(changed, scene, base, base_scene, rest, perturbed, later)


def published_changes(task: Task) -> tuple[Change, ...]:
    """Return what the environment of a task changes beside the problem; nothing for most tasks.

    Args:
        task: Task; those of LIBERO-Plus change something.
    """
    if not isinstance(task, PublishedTask) or task.variant is None:
        return ()
    variant, workspace = task.variant, workspace_of_problem(task.problem.name).name
    pose = camera_pose(workspace, variant.view)
    view = CameraView(tuple(pose.pos.tolist()), tuple(pose.quat_wxyz.tolist()))
    changes: list[Change] = [Appearance(cameras={CAMERA: view})]
    if variant.pose and task.robot_state == "skipped":
        changes.append(RobotJoints(tuple(joint_pose(variant.pose).tolist())))
    if variant.noise is not None:
        changes.append(Corruption(variant.noise.kind, variant.noise.severity))
    return tuple(changes)
