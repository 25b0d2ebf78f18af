"""Many simulations of one task in one process, as a `gymnasium.vector.VectorEnv`."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from libero_env.control import checked_actions
from libero_env.env import CONTROL_HZ, action_space, checked_options, observation_space
from libero_env.errors import LiberoError
from libero_env.tasks import Task
from libero_env.world import DEFAULT_CAMERAS, World


class BatchEnv(gymnasium.vector.VectorEnv):
    """`num_envs` simulations of a task, stepped together; what each does is bit-identical to `LiberoEnv`.

    There is no autoreset: a simulation whose episode is over stands still, is not drawn again, and returns reward 0
    until it is reset.

    Args:
        task: a `Task`, or what `get_task` takes.
        num_envs: number of simulations.
        num_threads: threads of the physics; 0 is one for each core. Results do not depend on it.
        cameras, camera_size, horizon: as in `LiberoEnv`.
    """

    metadata = {"render_modes": [], "render_fps": CONTROL_HZ, "autoreset_mode": AutoresetMode.DISABLED}

    def __init__(
        self,
        task: Task | str,
        num_envs: int,
        *,
        num_threads: int = 0,
        cameras: Sequence[str] = DEFAULT_CAMERAS,
        camera_size: tuple[int, int] = (128, 128),
        horizon: int = 600,
    ):
        self.world = World(task, num_envs, threads=num_threads, cameras=cameras, camera_size=camera_size)
        self.task, self.num_envs, self.horizon, self.render_mode = self.world.task, num_envs, horizon, None
        self.single_observation_space, self.single_action_space = observation_space(self.world), action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._generators = [np.random.default_rng() for _ in range(num_envs)]
        self._frames = self.world.empty_frames()
        self._steps = np.zeros(num_envs, np.int64)
        self._running = np.zeros(num_envs, bool)
        self._success = np.zeros(num_envs, bool)

    @property
    def running(self) -> np.ndarray:
        """Which simulations are in an episode, (num_envs,) bool."""
        return self._running.copy()

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start episodes.

        Args:
            seed: one for each simulation, or one from which they count up.
            options: `init_state`: one stored state for all, or (num_envs,) of them; `reset_mask`: (num_envs,) bool,
                the simulations to reset (default all).

        Raises:
            LiberoError: an unknown option or initial state.
            PlacementError: the objects do not fit.
        """
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, bool)), bool)
        if mask.shape != (self.num_envs,):
            raise LiberoError(f"reset_mask: expected ({self.num_envs},) booleans, got shape {mask.shape}")
        options = checked_options(options)
        ids = np.flatnonzero(mask)
        self._seed(ids, seed)
        if "init_state" in options:
            wanted = np.broadcast_to(np.asarray(options["init_state"]), (self.num_envs,))
            self.world.reset_to_init(ids, wanted[ids])
        else:
            self.world.reset_random(ids, [self._generators[i] for i in ids])
        self._steps[ids], self._running[ids], self._success[ids] = 0, True, False
        return self._observe(ids), self._info()

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Act for 50 ms in every simulation that is in an episode; actions (num_envs, 7).

        Returns:
            Observations, rewards (num_envs,), terminations, truncations, and infos with `success` (num_envs,) bool,
            which keeps the outcome of episodes that are over.

        Raises:
            ActionError: wrong shape or not finite; nothing has moved.
        """
        actions = checked_actions(actions, self.num_envs)
        ids = np.flatnonzero(self._running)
        reached = np.zeros(self.num_envs, bool)
        if ids.size:
            self.world.step(ids, actions)
            reached[ids] = self.world.goal_reached(ids)
            self._steps[ids] += 1
        truncated = self._running & ~reached & (self._steps >= self.horizon)
        self._success |= reached
        self._running &= ~(reached | truncated)
        return self._observe(ids), reached.astype(np.float64), reached, truncated, self._info()

    def get_state(self, i: int) -> np.ndarray:
        """Simulation i as `LiberoEnv.get_state` gives it."""
        return np.append(self.world.simulations.get_state(i), float(self._steps[i]))

    def set_state(self, i: int, state: np.ndarray) -> None:
        """Put simulation i into a state of `get_state` (of this or of a single environment)."""
        self.world.simulations.set_state(i, np.asarray(state[:-1], np.float64))
        self._steps[i], self._running[i], self._success[i] = int(state[-1]), True, False

    def close_extras(self, **kwargs: Any) -> None:
        """Free simulations and GL context."""
        self.world.close()

    def _seed(self, ids: np.ndarray, seed: int | Sequence[int | None] | None) -> None:
        if seed is None or np.isscalar(seed):
            seeds = [None if seed is None else seed + i for i in range(self.num_envs)]
        else:
            seeds = seed
        if len(seeds) != self.num_envs:
            raise LiberoError(f"seed: expected one or {self.num_envs} seeds, got {len(seeds)}")
        for i in ids:
            if seeds[i] is not None:
                self._generators[i] = np.random.Generator(np.random.PCG64(int(seeds[i])))

    def _observe(self, drawn: np.ndarray) -> dict[str, np.ndarray]:
        self.world.draw(drawn, self._frames)
        return {**{k: v.copy() for k, v in self._frames.items()}, **self.world.proprioception()}

    def _info(self) -> dict[str, Any]:
        return {"success": self._success.copy()}
