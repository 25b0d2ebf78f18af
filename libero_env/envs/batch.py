"""Many simulations of one task in one process, as a `gymnasium.vector.VectorEnv`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from libero_env.assets.pack import Pack
from libero_env.envs.checks import checked_actions, checked_options
from libero_env.envs.world import World
from libero_env.errors import LiberoError
from libero_env.sim.observations import DEFAULT_CAMERAS, DEFAULT_OBSERVATIONS
from libero_env.sim.rewards import Reward
from libero_env.tasks import Task
from libero_env.timing import CONTROL_HZ


class BatchEnv(gymnasium.vector.VectorEnv):
    """`num_envs` simulations of a task, stepped together; what each does is bit-identical to `LiberoEnv`.

    There is no autoreset: a simulation whose episode is over stands still, is not drawn again, and returns reward 0
    until it is reset.

    Args:
        task: a `Task`, or what `get_task` takes.
        num_envs: number of simulations.
        num_threads: threads of the physics; 0 is one for each core. Results do not depend on it.
        cameras, camera_size, horizon, observations, controller, control_delta, reward, reward_scale, assets,
            semantics: as in `LiberoEnv`.

    Attributes:
        draw: as in `LiberoEnv`.
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
        observations: Sequence[str] = DEFAULT_OBSERVATIONS,
        controller: str = "osc_pose",
        control_delta: bool = True,
        reward: str = "sparse",
        reward_scale: float = 1.0,
        assets: Pack | str | Path | None = None,
        semantics: str = "original",
    ):
        self.reward = Reward(reward, reward_scale)
        self.world = World(
            task,
            num_envs,
            threads=num_threads,
            cameras=cameras,
            camera_size=camera_size,
            observations=observations,
            controller=controller,
            control_delta=control_delta,
            assets=assets,
            semantics=semantics,
        )
        self.task, self.num_envs, self.horizon, self.render_mode = self.world.task, num_envs, horizon, None
        self.single_observation_space = self.world.observation_space()
        self.single_action_space = self.world.action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._generators = [np.random.default_rng() for _ in range(num_envs)]
        self.draw = True
        self._frames = self.world.empty_frames()
        self._steps = np.zeros(num_envs, np.int64)
        self._running = np.zeros(num_envs, bool)
        self._success = np.zeros(num_envs, bool)
        self._progress = np.zeros((num_envs, len(self.world.atoms)), bool)

    @property
    def atoms(self) -> tuple[str, ...]:
        """The parts of the goal, as infos' `progress` has them: `(On plate_1 stove_1)`."""
        return tuple(f"({a.predicate} {' '.join(a.args)})" for a in self.world.atoms)

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
        self._judge(ids)
        return self._observe(ids), self._info()

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Act for 50 ms in every simulation that is in an episode; actions (num_envs, 7).

        Returns:
            Observations, rewards (num_envs,), terminations, truncations, and infos: `success` (num_envs,) bool and
            `progress` (num_envs, natoms) bool, the truth of each of the goal's `atoms`. Both keep the outcome of
            episodes that are over.

        Raises:
            ActionError: wrong shape or not finite; nothing has moved.
        """
        actions = checked_actions(actions, self.num_envs, self.world.controller.action_dim)
        ids = np.flatnonzero(self._running)
        reached, rewards = np.zeros(self.num_envs, bool), np.zeros(self.num_envs)
        if ids.size:
            self.world.step(ids, actions)
            reached[ids], rewards[ids] = self._judge(ids)
            self._steps[ids] += 1
        truncated = self._running & ~reached & (self._steps >= self.horizon)
        self._success |= reached
        self._running &= ~(reached | truncated)
        return self._observe(ids), rewards, reached, truncated, self._info()

    def get_state(self, i: int) -> np.ndarray:
        """Simulation i as `LiberoEnv.get_state` gives it."""
        return np.append(self.world.simulations.get_state(i), float(self._steps[i]))

    def set_state(self, i: int, state: np.ndarray) -> None:
        """Put simulation i into a state of `get_state` (of this or of a single environment)."""
        self.world.simulations.set_state(i, np.asarray(state[:-1], np.float64))
        self._steps[i], self._running[i], self._success[i] = int(state[-1]), True, False

    def render_frames(self, ids: Sequence[int] | None = None) -> dict[str, np.ndarray]:
        """The observed pictures of the current states, drawn now; by default of all: name -> (n, H, W, ...)."""
        ids = range(self.num_envs) if ids is None else ids
        self.world.draw(ids, self._frames)
        return {key: rows[np.asarray(ids, np.int64)] for key, rows in self._frames.items()}

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

    def _judge(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whether the goal holds in each of the simulations, and its reward."""
        reached, rewards = np.zeros(len(ids), bool), np.zeros(len(ids))
        for k, i in enumerate(ids):
            reached[k], progress = self.world.judge(i)
            self._progress[i] = list(progress.values())
            rewards[k] = self.reward(
                self.world.views[i], bool(reached[k]), self.world.atoms, self._progress[i]
            )
        return reached, rewards

    def _observe(self, drawn: np.ndarray) -> dict[str, np.ndarray]:
        if self.draw:
            self.world.draw(drawn, self._frames)
        return {**{k: v.copy() for k, v in self._frames.items()}, **self.world.proprioception()}

    def _info(self) -> dict[str, Any]:
        return {"success": self._success.copy(), "progress": self._progress.copy()}
