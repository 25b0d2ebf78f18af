"""Simulations of one task: initial states, control steps, observations and the truth of the goal.

`LiberoEnv` has a world of one simulation and `BatchEnv` one of many, so that both give the same bits.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Unpack

import numpy as np
from gymnasium import spaces

from libero_env.assets.pack import select_pack
from libero_env.envs.config import AFTER, EnvConfig, EnvOptions, show_options
from libero_env.errors import LiberoError
from libero_env.init_states.settle import sample_settled
from libero_env.init_states.store import load_init_states, split_row
from libero_env.sim.controller import ControllerState, get_controller
from libero_env.sim.observations import Observer, is_of_joints
from libero_env.sim.predicates import evaluate
from libero_env.sim.scene import build_scene
from libero_env.sim.simulation import WATCHED, Indices, make_simulations
from libero_env.sim.state import StateView
from libero_env.tasks import Task, get_task
from libero_env.tasks.problem import And, atoms_of


class World:
    """Simulations of one task, without episodes.

    Args:
        task: `Task`, or an argument of `get_task` such as `libero_object/3`.
        num: Number of simulations.
        threads: Number of threads of the physics; 0 is one for each core. Results do not depend on it.
        config: Configuration; of its fields, `horizon` and the reward are not used here.
        **options: Fields of `EnvConfig`, which replace those of `config`.

    Attributes:
        config: Configuration.
        task: Task that is simulated.
        scene: Compiled scene of the task.
        simulations: Physics and controllers.
        views: State view of each simulation.
        observer: Observer of the simulations.
        atoms: Atoms of the goal, except those with variables of quantifiers.
        atom_names: Each of `atoms` as text, such as `(On plate_1 stove_1)`.
    """

    @show_options
    def __init__(
        self,
        task: Task | str,
        num: int = 1,
        *,
        threads: int = 0,
        config: EnvConfig | None = None,
        **options: Unpack[EnvOptions],
    ):
        self.config = config = EnvConfig.from_options(config, options)
        self.controller = get_controller(config.controller, config.control_delta)
        self.task = get_task(task) if isinstance(task, str) else task
        assets = config.assets
        pack = select_pack(assets) if assets is None or isinstance(assets, str | Path) else assets
        self.num = num
        self.scene = build_scene(self.task.problem, pack, drawing=config.drawing, robot=config.robot)
        self.simulations = make_simulations(self.scene.model, num, threads, self.scene.fixture_bodies)
        self.simulations.controller_state = ControllerState(num, self.controller)
        self.views = [StateView(self.scene, self.simulations, i) for i in range(num)]
        self.observer = Observer(
            self.scene,
            self.simulations,
            self.views,
            observations=config.observations,
            cameras=config.cameras,
            camera_size=config.camera_size,
        )
        self.atoms = tuple(a for a in atoms_of(self.task.problem.goal) if all(map(self._exists, a.args)))
        self.atom_names = tuple(f"({a.predicate} {' '.join(a.args)})" for a in self.atoms)

    @property
    def init_states(self) -> np.ndarray:
        """Stored initial states of the task, rows as of `libero_env.init_states.generate_init_states`."""
        return load_init_states(self.task, self.scene)

    def reset_to_init(self, ids: Indices, init_states: Indices) -> None:
        """Start simulations from stored initial states.

        Args:
            ids: Indices of the simulations.
            init_states: Index of the initial state of each of them.

        Raises:
            LiberoError: An initial state does not exist.
        """
        stored = self.init_states
        chosen = np.asarray(init_states)
        if chosen.shape != (len(ids),) or not np.issubdtype(chosen.dtype, np.integer):
            raise LiberoError(f"init_state: expected {len(ids)} integers, got {init_states!r}")
        if ((chosen < 0) | (chosen >= len(stored))).any():
            raise LiberoError(f"init_state {chosen.tolist()}: {self.task.id} has 0 to {len(stored) - 1}")
        qpos, qvel, fixtures = split_row(self.scene.model, stored[chosen])
        self.simulations.reset(ids, qpos, qvel, fixtures=fixtures)

    def reset_to(self, ids: Indices, rows: np.ndarray) -> None:
        """Start simulations from given states.

        Args:
            ids: Indices of the simulations, (k,).
            rows: States [time, qpos, qvel, pose of each fixture], (k, 1 + nq + nv + 7 nfixtures).

        Raises:
            LiberoError: The states have another length.
        """
        model, fixtures = self.scene.model, len(self.scene.fixtures)
        size = 1 + model.nq + model.nv + 7 * fixtures
        if rows.shape != (len(ids), size):
            raise LiberoError(
                f"{self.task.id}: a start has {size} numbers, [time, qpos, qvel] and the poses of {fixtures} fixtures; "
                f"got {rows.shape[-1]}. Is it one of another task?"
            )
        qpos, qvel, poses = split_row(model, rows)
        self.simulations.reset(ids, qpos, qvel, fixtures=poses)

    def reset_random(self, ids: Indices, generators: Sequence[np.random.Generator]) -> None:
        """Start simulations from new placements.

        Args:
            ids: Indices of the simulations.
            generators: Random generator of each of them.

        Raises:
            PlacementError: The objects do not fit, or do not come to rest.
        """
        simulations, controller_state = self.simulations, self.simulations.controller_state
        simulations.controller_state = ControllerState(self.num)  # the default one holds the pose
        try:
            starts = [
                sample_settled(self.scene, simulations, i, rng)
                for i, rng in zip(ids, generators, strict=True)
            ]
        finally:
            simulations.controller_state = controller_state
        qpos = np.stack([start.qpos for start in starts])
        fixtures = np.stack([start.fixtures for start in starts])
        simulations.reset(ids, qpos, np.zeros((len(ids), self.scene.model.nv)), fixtures=fixtures)

    def step(self, ids: Indices, actions: np.ndarray) -> None:
        """Advance simulations by one control period of 50 ms.

        Args:
            ids: Indices of the simulations.
            actions: Action of each simulation, (num, action_dim), finite; rows of other simulations are not used.
        """
        self.simulations.step(ids, actions)

    def step_and_observe(
        self, ids: Indices, actions: np.ndarray, images: dict[str, np.ndarray] | None
    ) -> dict[str, np.ndarray]:
        """Advance simulations by one control period, and observe them when `config.observed` says.

        Args:
            ids: As in `step`.
            actions: As in `step`.
            images: Arrays of `empty_images` whose rows `ids` are rendered; None renders nothing.

        Returns:
            All observations except images, see `proprioception`.
        """
        if self.config.observed == AFTER:
            self.step(ids, actions)
            if images is not None:
                self.render_cameras(ids, images)
            return self.proprioception()
        seen = self.proprioception()

        def watch(done: int, rows: np.ndarray) -> None:
            now = self.proprioception()
            if done == WATCHED[0] and images is not None:
                self.render_cameras(rows, images)
            for name, values in now.items():
                if (done == WATCHED[1]) == is_of_joints(name):
                    seen[name][rows] = values[rows]

        self.simulations.step(ids, actions, watch=watch)
        return seen

    def progress(self, i: int) -> dict[str, bool]:
        """Return the truth of each atom of the goal in simulation i, by its text."""
        truth = (evaluate(atom, self.views[i], self.config.semantics) for atom in self.atoms)
        return dict(zip(self.atom_names, truth, strict=True))

    def check_goal(self, i: int) -> tuple[bool, dict[str, bool]]:
        """Return the truth of the goal in simulation i and that of each of its atoms.

        No atom of a conjunction is evaluated twice.
        """
        goal, progress = self.task.problem.goal, self.progress(i)
        parts = goal.parts if isinstance(goal, And) else (goal,)
        if all(part in self.atoms for part in parts):
            return all(progress.values()), progress
        return evaluate(goal, self.views[i], self.config.semantics), progress

    def physics_state(self, i: int) -> np.ndarray:
        """Return [time, qpos, qvel] of simulation i, the original's layout."""
        fields = self.simulations.fields
        return np.concatenate([[self.simulations.time(i)], fields["qpos"][i], fields["qvel"][i]])

    def set_physics_state(self, i: int, state: np.ndarray) -> None:
        """Restore [time, qpos, qvel] of simulation i; the controller is reset and holds the pose."""
        nq = self.scene.model.nq
        self.simulations.reset([i], state[None, 1 : 1 + nq], state[None, 1 + nq :], float(state[0]))

    def observation_space(self) -> spaces.Dict:
        """Return the observation space of one simulation."""
        return self.observer.space()

    def action_space(self) -> spaces.Box:
        """Return the action space of one simulation."""
        return spaces.Box(self.controller.low.astype(np.float32), self.controller.high.astype(np.float32))

    def proprioception(self) -> dict[str, np.ndarray]:
        """Return all observations except images: name -> (num, length) float64."""
        return self.observer.state()

    def empty_images(self) -> dict[str, np.ndarray]:
        """Return zero arrays for `render_cameras`: name -> (num, height, width, ...)."""
        return self.observer.empty_images()

    def render_cameras(self, ids: Indices, images: dict[str, np.ndarray]) -> None:
        """Render the observed images of simulations into rows `ids` of arrays of `empty_images`."""
        self.observer.render_cameras(ids, images)

    def render(self, i: int, camera: str, kind: str = "rgb") -> np.ndarray:
        """Render one image of simulation i, from any camera of the model; see `Observer.render`."""
        return self.observer.render(i, camera, kind)

    def close(self) -> None:
        """Free the OpenGL context and the simulations."""
        self.observer.close()
        self.simulations.close()

    def _exists(self, name: str) -> bool:
        return name in self.scene.entities or self.task.problem.region(name) is not None
