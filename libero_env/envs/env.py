"""One simulation of a task as a `gymnasium.Env`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from libero_env.assets.pack import Pack
from libero_env.envs.checks import checked_actions, checked_options
from libero_env.envs.world import World
from libero_env.errors import LiberoError
from libero_env.sim.observations import DEFAULT_CAMERAS, DEFAULT_OBSERVATIONS
from libero_env.sim.rewards import Reward
from libero_env.sim.state import StateView
from libero_env.tasks import Task
from libero_env.timing import CONTROL_HZ


class LiberoEnv(gymnasium.Env):
    """A task of the benchmark at 20 Hz.

    Observations: `<camera>_rgb` (H, W, 3) uint8, first row on top; `joint_states` (7,) rad; `gripper_states` (2,) m;
    `ee_pos` (3,) m; `ee_ori` (3,) axis-angle; `libero_env.sim.observations` lists what else there is. All describe the
    state after the step.

    Reward is 1 in the step that reaches the goal and 0 otherwise; reaching it terminates the episode, `horizon` steps
    truncate it. `info["success"]` says whether the goal holds, `info["progress"]` the truth of its atoms.

    Attributes:
        draw: set to False, nothing is drawn, and pictures in observations are the last ones drawn (black before the
            first); `render_frames` draws when they are wanted.

    Args:
        task: a `Task`, or what `get_task` takes: `libero_object/3`, `libero_object-3`, or a task's name.
        cameras: drawn for each observation; `()` for none.
        camera_size: (height, width), pixels.
        horizon: steps after which an episode is truncated.
        observations: names from `libero_env.sim.observations`.
        controller, control_delta: what an action means; see `libero_env.sim.controllers`.
        reward, reward_scale: `sparse` or `staged`, see `libero_env.sim.rewards`; and what success is worth.
        semantics: of the predicates: `original`, or `strict` for On and In as a person would judge them.
        assets: where the models come from: None for the user's choice, `builtin`, a folder, or a `Pack`.
        render_mode: None, or `rgb_array` for `render()`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": CONTROL_HZ}

    def __init__(
        self,
        task: Task | str,
        *,
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
        render_mode: str | None = None,
    ):
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise LiberoError(
                f"render_mode {render_mode!r}; valid: None, {', '.join(self.metadata['render_modes'])}"
            )
        self.reward = Reward(reward, reward_scale)
        self.world = World(
            task,
            1,
            cameras=cameras,
            camera_size=camera_size,
            observations=observations,
            controller=controller,
            control_delta=control_delta,
            assets=assets,
            semantics=semantics,
        )
        self.task, self.horizon, self.render_mode = self.world.task, horizon, render_mode
        self.observation_space, self.action_space = self.world.observation_space(), self.world.action_space()
        self.draw = True
        self._frames = self.world.empty_frames()
        self._steps, self._running = 0, False

    @property
    def view(self) -> StateView:
        """The whole state, read-only: for experts and for analysis, not for policies."""
        return self.world.views[0]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start an episode.

        Args:
            seed: of the placement; the same seed gives the same state.
            options: `{"init_state": i}` starts from the i-th of the 50 stored states instead, and from nothing else.

        Raises:
            LiberoError: an unknown option, or no such initial state.
            PlacementError: the objects do not fit.
        """
        super().reset(seed=seed)
        options = checked_options(options)
        if "init_state" in options:
            self.world.reset_to_init([0], np.atleast_1d(options["init_state"]))
        else:
            self.world.reset_random([0], [self.np_random])
        self._steps, self._running = 0, True
        return self._observe(), self._info()

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Act for 50 ms.

        Args:
            action: as `action_space` has it, (7,) by default; values outside it are clipped.

        Raises:
            ActionError: wrong shape or not finite; nothing has moved.
            LiberoError: the episode is over, or has not begun.
        """
        action = checked_actions(action, size=self.world.controller.action_dim)
        if not self._running:
            raise LiberoError("no episode is running; call reset()")
        self.world.step([0], action[None])
        self._steps += 1
        info = self._info()
        terminated = info["success"]
        truncated = not terminated and self._steps >= self.horizon
        self._running = not (terminated or truncated)
        reward = self.reward(self.view, terminated, self.world.atoms, list(info["progress"].values()))
        return self._observe(), reward, terminated, truncated, info

    def get_state(self) -> np.ndarray:
        """Everything the rest of the episode depends on, for `set_state`: simulation, controller and step count."""
        return np.append(self.world.simulations.get_state(0), float(self._steps))

    def set_state(self, state: np.ndarray) -> dict[str, np.ndarray]:
        """Go back to a state; the episode goes on from there to the same bits. Returns the observation.

        Args:
            state: from `get_state`; or [time, qpos, qvel] as the original stores it, then with a fresh controller
                and step count.

        Raises:
            LiberoError: a vector of another length, or not finite.
        """
        state = np.asarray(state, np.float64)
        model, whole = self.world.scene.model, self.world.simulations.state_size + 1
        if state.shape not in ((whole,), (1 + model.nq + model.nv,)) or not np.isfinite(state).all():
            raise LiberoError(
                f"a state of {self.task.id} is {whole} finite numbers (get_state) or {1 + model.nq + model.nv} "
                f"([time, qpos, qvel]); got shape {state.shape}"
            )
        if state.size == whole:
            self.world.simulations.set_state(0, state[:-1])
            self._steps = int(state[-1])
        else:
            self.world.set_physics_state(0, state)
            self._steps = 0
        self._running = True
        return self._observe()

    def render_frames(self) -> dict[str, np.ndarray]:
        """The observed pictures of the current state, drawn now: name -> (H, W, ...)."""
        self.world.draw([0], self._frames)
        return {key: rows[0].copy() for key, rows in self._frames.items()}

    def render(self) -> np.ndarray | None:
        """The agent's camera as (H, W, 3) uint8 in `rgb_array` mode, else None."""
        return self.world.frame(0, "agentview") if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Free simulation and GL context."""
        self.world.close()

    def _observe(self) -> dict[str, np.ndarray]:
        if self.draw:
            self.world.draw([0], self._frames)
        frames = {key: rows[0].copy() for key, rows in self._frames.items()}
        return {**frames, **{key: rows[0] for key, rows in self.world.proprioception().items()}}

    def _info(self) -> dict[str, Any]:
        success, progress = self.world.judge(0)
        return {"success": success, "progress": progress}
