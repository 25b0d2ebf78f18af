"""Simulations of one task in one process, as a `gymnasium.vector.VectorEnv`."""

from collections.abc import Sequence
from typing import Any, Unpack

import numpy as np
from gymnasium.vector.utils import batch_space

from libero_env.envs.checks import (
    ResetRequest,
    checked_actions,
    checked_index,
    checked_indices,
    checked_options,
    checked_truth,
)
from libero_env.envs.config import EnvConfig, EnvOptions, show_options
from libero_env.envs.vector import LiberoVectorEnv
from libero_env.envs.world import World
from libero_env.sim.rewards import Reward
from libero_env.tasks import Task


class BatchEnv(LiberoVectorEnv):
    """Simulations of one task that are stepped together; the results of each are bit-identical to `LiberoEnv`.

    There is no autoreset: a simulation whose episode is over does not move, is not rendered, and returns reward 0
    until it is reset.

    Args:
        task: `Task`, or an argument of `get_task`: `libero_object/3`, `libero_object-3`, or a task's name.
        num_envs: Number of simulations.
        num_threads: Number of threads of the physics; 0 is one for each core. Results do not depend on it.
        config: Configuration of all simulations.
        **options: Fields of `EnvConfig`, such as `camera_size=(64, 64)`, which replace those of `config`.

    Attributes:
        config: Configuration of all simulations.
        task: Task of the simulations.
        world: Simulations, scene and observer.
        render_images: As in `LiberoEnv`.

    Raises:
        UnknownNameError: The task, a camera, an option or a value of an option does not exist.
        InvalidInputError: A value is of another kind or outside of its range, or the memory does not suffice.
        ClosedEnvironmentError: By every method, after `close`.

    Example:
        >>> envs = BatchEnv("libero_object/3", num_envs=4, cameras=("agentview",), camera_size=(64, 64))
        >>> observations, infos = envs.reset(options={"init_state": [0, 1, 2, 3]})
        >>> observations["agentview_rgb"].shape
        (4, 64, 64, 3)
        >>> observations, rewards, terminated, truncated, infos = envs.step(envs.action_space.sample())
        >>> infos["success"].tolist()
        [False, False, False, False]
        >>> envs.close()
    """

    @show_options
    def __init__(
        self,
        task: Task | str,
        num_envs: int,
        *,
        num_threads: int = 0,
        config: EnvConfig | None = None,
        **options: Unpack[EnvOptions],
    ):
        self.config = EnvConfig.from_options(config, options)
        self.reward = Reward(self.config.reward, self.config.reward_scale)
        self.world = World(task, num_envs, threads=num_threads, config=self.config)
        self.task, self.num_envs, self.render_mode = self.world.task, self.world.num, None
        self.single_observation_space = self.world.observation_space()
        self.single_action_space = self.world.action_space()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.render_images = True
        self._generators = [np.random.default_rng() for _ in range(self.num_envs)]
        self._images = self.world.empty_images()
        self._steps = np.zeros(self.num_envs, np.int64)
        self._running = np.zeros(self.num_envs, bool)
        self._success = np.zeros(self.num_envs, bool)
        self._progress = np.zeros((self.num_envs, len(self.world.atoms)), bool)

    @property
    def atoms(self) -> tuple[str, ...]:
        """Atoms of the goal, in the order of `progress` in infos, such as `(On plate_1 stove_1)`."""
        return self.world.atom_names

    @property
    def running(self) -> np.ndarray:
        """Whether each simulation is in an episode, (num_envs,) bool."""
        return self._running.copy()

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start episodes.

        Args:
            seed: One seed for each simulation, or one number from which they count up.
            options: `init_state`: index of one stored state, or of one for each simulation, (num_envs,).
                `start`: instead of it, a state for each simulation, [time, qpos, qvel, poses of the fixtures], of the
                task without perturbations; where both are given, the index only names what perturbations draw.
                `outdated_controller`: whether the controller takes the arm to be in its rest pose at first, as that of
                the original, see `libero_env.sim.simulation.Simulations.outdate_controller`.
                `reset_mask`: which simulations to reset, (num_envs,) bool; by default all.

        Raises:
            UnknownNameError: An option does not exist; nothing has changed.
            InvalidInputError: An initial state does not exist, or seeds, mask or starts have the wrong length or are of
                another kind; nothing has changed.
            PlacementError: The objects do not fit; none of these simulations is in an episode.
        """
        self._check_open()
        options = checked_options(options, valid=("init_state", "start", "outdated_controller", "reset_mask"))
        request, outdated = (
            ResetRequest.from_arguments(self.num_envs, seed, options),
            checked_truth(options, "outdated_controller"),
        )
        ids, rows = request.ids, None
        if request.starts is not None:
            rows = self.world.checked_starts(request.starts[ids])
        elif request.init_states is not None:
            rows = self.world.init_rows(request.init_states[ids])
        if not ids.size:
            return self._observe(ids), self._info()
        self._running[ids] = False  # until it is done: an error or an interruption ends the episodes
        for i in ids:
            if (new_seed := request.seeds[i]) is not None:
                self._generators[i] = np.random.Generator(np.random.PCG64(new_seed))
        if rows is not None:
            named = request.init_states
            self.world.reset_to(ids, rows, None if named is None else named[ids])
        else:
            self.world.reset_random(ids, [self._generators[i] for i in ids])
        if outdated:
            self.world.simulations.outdate_controller(ids)
        self._steps[ids], self._running[ids], self._success[ids] = 0, True, False
        self._check_goals(ids)
        return self._observe(ids), self._info()

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Apply actions for 50 ms in every simulation that is in an episode.

        Args:
            actions: Action of each simulation, (num_envs, 7) by default.

        Returns:
            Observations, rewards (num_envs,), terminations, truncations, and infos: `success` (num_envs,) bool and
            `progress` (num_envs, natoms) bool, the truth of each of the goal's `atoms`. Both keep the outcome of
            episodes that are over. With perturbations also `attempts` (num_envs, n): how many draws of each were not
            valid at the reset.

        Raises:
            ActionError: The shape is wrong, or a value is no finite number; no state has changed.
        """
        self._check_open()
        actions = checked_actions(actions, self.num_envs, self.world.controller.action_dim)
        running, ids = self._running.copy(), np.flatnonzero(self._running)
        self._running[:] = False  # until it is done: a step that is interrupted has moved some substeps
        reached, rewards = np.zeros(self.num_envs, bool), np.zeros(self.num_envs)
        state = None
        if ids.size:
            state = self.world.step_and_observe(ids, actions, self._images if self.render_images else None)
            reached[ids], rewards[ids] = self._check_goals(ids)
            self._steps[ids] += 1
        truncated = running & ~reached & (self._steps >= self.config.horizon)
        self._success |= reached
        self._running = running & ~(reached | truncated)
        return self._observation(state), rewards, reached, truncated, self._info()

    def get_state(self, i: int) -> np.ndarray:
        """Return the state of simulation i, as `LiberoEnv.get_state`."""
        self._check_open()
        i = checked_index(i, self.num_envs)
        return np.append(self.world.simulations.get_state(i), float(self._steps[i]))

    def set_state(self, i: int, state: np.ndarray) -> None:
        """Restore a state in simulation i; see `LiberoEnv.set_state`.

        Raises:
            InvalidInputError: There is no such simulation, or the state is not valid; nothing has changed.
        """
        self._check_open()
        i, state = checked_index(i, self.num_envs), self.world.checked_state(state)
        self._running[i] = False
        self._steps[i] = self.world.restore(i, state)
        self._running[i], self._success[i] = True, False

    def render_cameras(self, ids: Sequence[int] | None = None) -> dict[str, np.ndarray]:
        """Render the observed images of the current states: name -> (n, H, W, ...).

        Args:
            ids: Indices of the simulations; by default all.
        """
        self._check_open()
        rows = checked_indices(ids, self.num_envs)
        self.world.render_cameras(rows, self._images)
        return {key: images[rows] for key, images in self._images.items()}

    def close_extras(self, **kwargs: Any) -> None:
        """Free the simulations and the OpenGL context."""
        self.world.close()

    def _check_goals(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whether the goal is reached in each of the simulations, and its reward; note the truth of atoms."""
        reached, truths = self.world.goals.check(ids)
        self._progress[ids] = truths
        rewards = [
            self.reward(self.world.views[i], bool(won), self.world.atoms, list(row))
            for i, won, row in zip(ids, reached, truths, strict=True)
        ]
        return reached, np.array(rewards, np.float64)

    def _observe(self, ids: np.ndarray) -> dict[str, np.ndarray]:
        """Return the observations of all simulations, with images rendered of the given ones."""
        return self._observation(self.world.observe(ids, self._images if self.render_images else None))

    def _observation(self, state: dict[str, np.ndarray] | None) -> dict[str, np.ndarray]:
        """Return copies of the images, with the given observations of the state or those of the present one."""
        images = {name: values.copy() for name, values in self._images.items()}
        return {**images, **(self.world.proprioception() if state is None else state)}

    def _info(self) -> dict[str, Any]:
        found = {"success": self._success.copy(), "progress": self._progress.copy()}
        if (perturbed := self.world.perturbed) is not None:
            found["attempts"] = perturbed.attempts.copy()
        return found
