"""Simulations of one task: initial states, control steps, observations and the truth of the goal.

`LiberoEnv` has a world of one simulation and `BatchEnv` one of many, so that both give the same bits.
"""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Unpack

import mujoco
import numpy as np
from gymnasium import spaces
from pydantic import Field

from libero_env.assets.pack import select_pack
from libero_env.envs.checks import checked_numbers
from libero_env.envs.config import AFTER, EnvConfig, EnvOptions, show_options
from libero_env.envs.perturbed_starts import open_scenes, sample_rows, start_perturbed
from libero_env.errors import InvalidInputError
from libero_env.init_states.settle import sample_settled
from libero_env.init_states.store import load_init_states, split_row
from libero_env.memory import require_memory
from libero_env.perturbations.drawing import start_name
from libero_env.perturbations.published import rest_of
from libero_env.sim.back_ends import make_simulations
from libero_env.sim.controller import ControllerState, get_controller
from libero_env.sim.goals import make_goals
from libero_env.sim.observations import is_of_joints, make_observer
from libero_env.sim.simulation import WATCHED, Indices
from libero_env.sim.state import StateView
from libero_env.tasks import Task, get_task
from libero_env.tasks.published.task import require_available
from libero_env.text import shown
from libero_env.validation import validate

Count = Annotated[int, Field(ge=1)]
Threads = Annotated[int, Field(ge=0, le=4096)]


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
        task: Task that is simulated, as the perturbations of the configuration change it.
        scene: Compiled scene of the task.
        base_task: The task without perturbations, to which initial states belong.
        base_scene: Compiled scene of that task.
        perturbed: Draws and filters of the perturbations; None without any.
        simulations: Physics and controllers.
        views: State view of each simulation.
        observer: Observer of the simulations.
        atoms: Atoms of the goal, except those with variables of quantifiers.
        atom_names: Each of `atoms` as text, such as `(On plate_1 stove_1)`.
        goals: Truth of the goal and its atoms in many simulations.
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
        num, threads = (
            validate(Count, num, prefix=("num_envs",)),
            validate(Threads, threads, prefix=("num_threads",)),
        )
        if not isinstance(task, Task | str):
            raise InvalidInputError(
                f"task is {shown(task)}; expected a Task, or a text such as libero_object/3"
            )
        self.controller = get_controller(config.controller, config.control_delta)
        self.base_task = get_task(task) if isinstance(task, str) else task
        require_available([self.base_task])
        assets = config.assets
        pack = select_pack(assets) if assets is None or isinstance(assets, str | Path) else assets
        self.num, self.threads = num, threads
        opened = open_scenes(self.base_task, config, pack, num)
        self.task, self.scene, self.base_scene = opened.task, opened.scene, opened.base_scene
        self.perturbed = opened.perturbed
        self._check_memory()
        back_end = config.back_end
        self.simulations = make_simulations(
            self.scene.model, num, threads, self.scene.fixture_bodies, back_end
        )
        if not self.simulations.has_controller(self.controller):
            raise InvalidInputError(
                f"backend={back_end.name} has no controller {self.controller.name}, only osc_pose and osc_position; "
                "backend=mujoco has"
            )
        self.simulations.controller_state = ControllerState(num, self.controller)
        self.simulations.rest = rest_of(self.base_task)
        self.views = [StateView(self.scene, self.simulations, i) for i in range(num)]
        self.observer = make_observer(
            self.scene,
            self.simulations,
            self.views,
            observations=config.observations,
            cameras=config.cameras,
            camera_size=config.camera_size,
        )
        self.atoms = tuple(a for a in self.task.problem.goal.atoms() if all(map(self._exists, a.args)))
        self.atom_names = tuple(map(str, self.atoms))
        goal = self.task.problem.goal
        self.goals = make_goals(goal, self.atoms, self.views, config.semantics, self.simulations)

    @cached_property
    def init_states(self) -> np.ndarray:
        """Stored initial states of `base_task`, rows as of `libero_env.init_states.generate_init_states`."""
        return load_init_states(self.base_task, self.base_scene)

    def reset_to_init(self, ids: Indices, init_states: Indices) -> None:
        """Start simulations from stored initial states.

        Args:
            ids: Indices of the simulations.
            init_states: Index of the initial state of each of them.

        Raises:
            InvalidInputError: An initial state does not exist.
        """
        self.reset_to(ids, self.init_rows(np.asarray(init_states)), init_states)

    def init_rows(self, init_states: np.ndarray) -> np.ndarray:
        """Return stored initial states by index, (k,) integers -> (k, n).

        Raises:
            InvalidInputError: An initial state does not exist.
        """
        stored = self.init_states
        if ((init_states < 0) | (init_states >= len(stored))).any():
            raise InvalidInputError(
                f"init_state {init_states.tolist()}: {self.task.id} has 0 to {len(stored) - 1}"
            )
        return stored[init_states]

    def reset_to(self, ids: Indices, rows: np.ndarray, init_states: Indices | None = None) -> None:
        """Start simulations from given states, or from those that the perturbations make of them.

        Args:
            ids: Indices of the simulations, (k,).
            rows: States [time, qpos, qvel, pose of each fixture] of `base_task`, (k, 1 + nq + nv + 7 nfixtures).
            init_states: Indices of the initial states, (k,), which name the draws of perturbations; by default the
                states themselves do.

        Raises:
            InvalidInputError: The states have another length, or numbers that no physics has.
            PlacementError: Perturbations make no valid start of a state.
        """
        rows = self.checked_starts(rows)
        if self.perturbed is not None:
            names = map(start_name, rows) if init_states is None else map(int, init_states)
            for i, name, row in zip(ids, names, rows, strict=True):
                start_perturbed(self, self.perturbed, int(i), name, row)
            return
        qpos, qvel, poses = split_row(self.scene.model, rows)
        self.simulations.reset(ids, qpos, qvel, fixtures=poses)

    def _drawn(self, images: dict[str, np.ndarray] | None) -> dict[str, np.ndarray] | None:
        """Return the images to draw: those that are asked for, or unseen ones that perturbations remember."""
        remembered = self.perturbed is not None and self.perturbed.has_memory
        return self._unseen if images is None and remembered else images

    @cached_property
    def _unseen(self) -> dict[str, np.ndarray]:
        """Images that are drawn for perturbations that remember them, where nobody else wants them."""
        return self.observer.empty_images()

    def checked_starts(self, rows: np.ndarray) -> np.ndarray:
        """Return states for `reset_to`, (k, n), after a check of their length and range.

        Raises:
            InvalidInputError: They are not of this task, or not of any physics.
        """
        model, fixtures = self.base_scene.model, len(self.base_scene.fixtures)
        size = 1 + model.nq + model.nv + 7 * fixtures
        if rows.ndim != 2 or rows.shape[1] != size:
            raise InvalidInputError(
                f"{self.task.id}: a start has {size} numbers, [time, qpos, qvel] and the poses of {fixtures} fixtures; "
                f"got {rows.shape[-1] if rows.ndim else 1}. Is it one of another task?"
            )
        self._check_range(rows)
        return rows

    def checked_state(self, state: object) -> np.ndarray:
        """Return a state for `restore` as float64.

        Args:
            state: State of `LiberoEnv.get_state`, or [time, qpos, qvel].

        Raises:
            InvalidInputError: It has another length, or numbers that no physics has.
        """
        model, size = self.scene.model, self.simulations.state_size + 1
        name = f"state of {self.task.id} (get_state, or [time, qpos, qvel])"
        array = checked_numbers(state, name, ((size,), (1 + model.nq + model.nv,)))
        self._check_range(array)
        if array.size == size and not (array[-1] >= 0 and array[-1].is_integer()):
            raise InvalidInputError(
                f"a state ends with its number of steps, a whole number; got {array[-1]:g}"
            )
        return array

    def restore(self, i: int, state: np.ndarray) -> int:
        """Restore a state of `checked_state` in simulation i, and return the number of steps of its episode."""
        if state.size == self.simulations.state_size + 1:
            self.simulations.set_state(i, state[:-1])
            steps = int(state[-1])
        else:
            self.set_physics_state(i, state)
            steps = 0
        if self.perturbed is not None:
            self.perturbed.resume(i, steps)
        return steps

    def _check_range(self, states: np.ndarray) -> None:
        """Raise unless MuJoCo takes the numbers: it resets a simulation with larger ones, without an error."""
        if not (np.abs(states) <= mujoco.mjMAXVAL).all():
            raise InvalidInputError(
                f"{self.task.id}: a state has a number beyond {mujoco.mjMAXVAL:g}, or no number"
            )

    def _check_memory(self) -> None:
        """Raise if the simulations and their images do not fit into memory."""
        if self.num == 1:
            return
        height, width = self.config.camera_size
        images = 16 * height * width * len(self.config.cameras)
        model = self.scene.model
        state = 0 if self.config.back_end.is_warp else model.narena + model.nbuffer // 8  # on the device
        needed = self.num * (state + images)
        require_memory(needed, f"num_envs={self.num}", "take fewer simulations or smaller images")

    def reset_random(self, ids: Indices, generators: Sequence[np.random.Generator]) -> None:
        """Start simulations from new placements.

        Args:
            ids: Indices of the simulations.
            generators: Random generator of each of them.

        Raises:
            PlacementError: The objects do not fit, or do not come to rest.
        """
        if self.perturbed is not None or self.config.back_end.is_warp:
            self.reset_to(ids, sample_rows(self.base_scene, generators))
            return
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
        if self.perturbed is not None:
            actions = self.perturbed.act(ids, actions)
        images = self._drawn(images)
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
        return self.check_goal(i)[1]

    def check_goal(self, i: int) -> tuple[bool, dict[str, bool]]:
        """Return the truth of the goal in simulation i and that of each of its atoms."""
        reached, truths = self.goals.check([i])
        return bool(reached[0]), dict(zip(self.atom_names, map(bool, truths[0]), strict=True))

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

    def observe(self, ids: Indices, images: dict[str, np.ndarray] | None) -> dict[str, np.ndarray]:
        """Observe simulations without a step.

        Args:
            ids: Indices of the simulations.
            images: Arrays of `empty_images` whose rows `ids` are rendered; None renders nothing.

        Returns:
            All observations except images, see `proprioception`.
        """
        images = self._drawn(images)
        if images is not None:
            self.render_cameras(ids, images)
        return self.proprioception()

    def proprioception(self) -> dict[str, np.ndarray]:
        """Return all observations except images: name -> (num, length) float64."""
        entries = self.observer.state()
        return entries if self.perturbed is None else self.perturbed.see_state(entries)

    def empty_images(self) -> dict[str, np.ndarray]:
        """Return zero arrays for `render_cameras`: name -> (num, height, width, ...)."""
        return self.observer.empty_images()

    def render_cameras(self, ids: Indices, images: dict[str, np.ndarray]) -> None:
        """Render the observed images of simulations into rows `ids` of arrays of `empty_images`."""
        self.observer.render_cameras(ids, images)
        if self.perturbed is not None:
            self.perturbed.see_images(ids, images)

    def render(self, i: int, camera: str, kind: str = "rgb") -> np.ndarray:
        """Render one image of simulation i, from any camera of the model; see `Observer.render`."""
        return self.observer.render(i, camera, kind)

    def close(self) -> None:
        """Free the OpenGL context and the simulations."""
        self.observer.close()
        self.simulations.close()

    def __getstate__(self) -> dict[str, Any]:
        raise InvalidInputError(
            "an environment cannot be copied or pickled: it holds a compiled simulation and an OpenGL context. Make "
            "another with the same task and config=, and pass it the state: set_state(get_state())"
        )

    def _exists(self, name: str) -> bool:
        return name in self.scene.entities or self.task.problem.region(name) is not None
