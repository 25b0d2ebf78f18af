"""The scenes and starts of a world under perturbations."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from libero_env.assets.pack import Pack
from libero_env.errors import PlacementError
from libero_env.init_states.settle import sample_settled
from libero_env.init_states.store import split_row
from libero_env.perturbations.episodes import (
    TRIES,
    PerturbedEpisodes,
    checked_perturbations,
    needs_materials,
    scene_problem,
)
from libero_env.perturbations.problem import perturb_task
from libero_env.perturbations.published import published_changes
from libero_env.perturbations.value import Perturbation
from libero_env.sim.back_ends import make_simulations
from libero_env.sim.scene import Scene, build_scene
from libero_env.tasks import Task

if TYPE_CHECKING:
    from libero_env.envs.config import EnvConfig
    from libero_env.envs.world import World


@dataclass(frozen=True)
class Opened:
    """A task and its scene, with and without perturbations.

    Attributes:
        task: Task as the perturbations change it.
        scene: Its compiled scene.
        base_scene: Compiled scene of the task without perturbations.
        perturbed: Draws and filters; None without perturbations.
    """

    task: Task
    scene: Scene
    base_scene: Scene
    perturbed: PerturbedEpisodes | None = None


def open_scenes(task: Task, config: "EnvConfig", pack: Pack, num: int) -> Opened:
    """Compile the scene of a task, and that of the task as the perturbations of a configuration change it.

    Args:
        task: Task without perturbations.
        config: Configuration.
        pack: Asset pack of the models.
        num: Number of simulations.
    """
    drawing, robot = config.drawing, config.robot
    changes = (*checked_perturbations(config.perturb), *published_changes(task))
    spare = needs_materials(changes)
    base = build_scene(task.problem, pack, drawing=drawing, robot=robot, spare_materials=spare)
    if not changes:
        return Opened(task, base, base)
    changed = perturb_task(task, (one for one in changes if isinstance(one, Perturbation)), base)
    problem = scene_problem(changed, task)
    scene = build_scene(problem, pack, drawing=drawing, robot=robot, spare_materials=spare)
    return Opened(changed, scene, base, PerturbedEpisodes(changes, task, base, scene, num))


def start_perturbed(
    world: "World", perturbed: PerturbedEpisodes, i: int, name: object, row: np.ndarray
) -> None:
    """Start a simulation from what the perturbations make of a state; the goal does not hold there.

    Args:
        world: World of the simulation.
        perturbed: Its draws and filters.
        i: Index of the simulation.
        name: Index of the initial state, or another name of it.
        row: State of the task without perturbations.

    Raises:
        PlacementError: No draw is valid.
    """
    paired, again = perturbed.paired(i, name, row), 0
    while True:
        start = perturbed.begin(i, name, paired, again)
        qpos, qvel, poses = split_row(world.scene.model, start[None])
        world.simulations.reset([i], qpos, qvel, fixtures=poses)
        if not perturbed.is_physical or not world.check_goal(i)[0]:
            break
        again += 1
        if not perturbed.draws_starts or again == TRIES:
            raise PlacementError(f"{world.base_task.id}, start {name}: the perturbed goal holds at the start")
    world.observer.set_look(i, perturbed.look(name))


def sample_rows(scene: Scene, generators: Sequence[np.random.Generator]) -> np.ndarray:
    """Return new placements of a scene, one from each generator, (k, n) rows as of stored initial states.

    Raises:
        PlacementError: The objects do not fit, or do not come to rest.
    """
    simulations, speed = make_simulations(scene.model, 1, 1, scene.fixture_bodies), np.zeros(scene.model.nv)
    try:
        starts = [sample_settled(scene, simulations, 0, rng) for rng in generators]
    finally:
        simulations.close()
    return np.stack([np.concatenate([[0.0], s.qpos, speed, s.fixtures.ravel()]) for s in starts])
