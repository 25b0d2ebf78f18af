"""One simulation of a task as a `gymnasium.Env`."""

from typing import Any, Unpack

import gymnasium
import numpy as np

from libero_env.envs.checks import (
    ClosedGymEnvironmentError,
    checked_actions,
    checked_options,
    checked_seed,
    whole_numbers,
)
from libero_env.envs.config import EnvConfig, EnvOptions, show_options
from libero_env.envs.world import World
from libero_env.errors import LiberoError, UnknownNameError
from libero_env.sim.rewards import Reward
from libero_env.sim.state import StateView
from libero_env.tasks import Task
from libero_env.timing import CONTROL_HZ


class LiberoEnv(gymnasium.Env):
    """A task of the benchmark at 20 Hz.

    Observations: `<camera>_rgb` (H, W, 3) uint8, first row on top; `joint_states` (7,) rad; `gripper_states` (2,) m;
    `ee_pos` (3,) m; `ee_ori` (3,) axis-angle; `libero_env.sim.observations` lists the others. All describe the state
    after the step.

    The reward is 1 in the step that reaches the goal and 0 otherwise. Reaching the goal terminates the episode,
    `horizon` steps truncate it. `info["success"]` is the truth of the goal, `info["progress"]` that of its atoms.

    Args:
        task: `Task`, or an argument of `get_task`: `libero_object/3`, `libero_object-3`, or a task's name.
        config: Configuration of the environment.
        render_mode: None, or `rgb_array` for `render()`.
        **options: Fields of `EnvConfig`, such as `camera_size=(64, 64)`, which replace those of `config`.

    Attributes:
        config: Configuration of the environment.
        task: Task of the environment.
        world: Simulation, scene and observer.
        render_images: Whether images are rendered in each step. If False, observations have the images that were
            rendered last (black before the first); `render_cameras` renders those of the current state.

    Raises:
        UnknownNameError: The task, a camera, an option or a value of an option does not exist.
        InvalidInputError: A value of an option is of another kind or outside of its range.
        ClosedEnvironmentError: By every method, after `close`.

    Example:
        >>> env = LiberoEnv("libero_object/3", camera_size=(64, 64))
        >>> observation, info = env.reset(options={"init_state": 0})
        >>> observation["agentview_rgb"].shape, observation["ee_pos"].shape
        ((64, 64, 3), (3,))
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> info["progress"]
        {'(In bbq_sauce_1 basket_1_contain_region)': False}
        >>> env.close()
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": CONTROL_HZ}

    @show_options
    def __init__(
        self,
        task: Task | str,
        *,
        config: EnvConfig | None = None,
        render_mode: str | None = None,
        **options: Unpack[EnvOptions],
    ):
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise UnknownNameError("render_mode", render_mode, ("None", *self.metadata["render_modes"]))
        self.config = EnvConfig.from_options(config, options)
        self.reward = Reward(self.config.reward, self.config.reward_scale)
        self.world = World(task, config=self.config)
        self.task, self.render_mode = self.world.task, render_mode
        self.observation_space, self.action_space = self.world.observation_space(), self.world.action_space()
        self.render_images = True
        self._images = self.world.empty_images()
        self._steps, self._running, self._closed = 0, False, False

    @property
    def view(self) -> StateView:
        """Read-only view of the whole state, for experts and analysis, not for policies."""
        return self.world.views[0]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of the placement of objects; the same seed gives the same state.
            options: `{"init_state": i}` starts from the i-th of the 50 stored states instead of a new placement.

        Raises:
            InvalidInputError: The seed is no whole number from 0, or there is no such initial state; nothing has
                changed.
            UnknownNameError: An option does not exist; nothing has changed.
            PlacementError: The objects do not fit; no episode is running.
        """
        self._check_open()
        seed, options, rows = checked_seed(seed), checked_options(options, valid=("init_state",)), None
        chosen = None
        if "init_state" in options:
            chosen = np.atleast_1d(whole_numbers(options["init_state"], "init_state", ((), (1,))))
            rows = self.world.init_rows(chosen)
        super().reset(seed=seed)
        self._running = False  # until it is done: an error or an interruption ends the episode
        if rows is not None:
            self.world.reset_to([0], rows, chosen)
        else:
            self.world.reset_random([0], [self.np_random])
        self._steps, self._running = 0, True
        return self._observe(), self._info()

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Apply an action for 50 ms.

        Args:
            action: Action, (7,) by default, see `action_space`; values outside of it are clipped.

        Raises:
            ActionError: The shape is wrong, or a value is no finite number; the state has not changed.
            LiberoError: No episode is running.
        """
        self._check_open()
        action = checked_actions(action, size=self.world.controller.action_dim)
        if not self._running:
            raise LiberoError("no episode is running, or its last call was interrupted; call reset()")
        images = self._images if self.render_images else None
        self._running = False  # until it is done: a step that is interrupted has moved some substeps
        state = self.world.step_and_observe([0], action[None], images)
        self._steps += 1
        info = self._info()
        terminated = info["success"]
        truncated = not terminated and self._steps >= self.config.horizon
        self._running = not (terminated or truncated)
        reward = self.reward(self.view, terminated, self.world.atoms, list(info["progress"].values()))
        return self._observation(state), reward, terminated, truncated, info

    def get_state(self) -> np.ndarray:
        """Return all that the rest of the episode depends on: simulation, controller and number of steps."""
        self._check_open()
        return np.append(self.world.simulations.get_state(0), float(self._steps))

    def set_state(self, state: np.ndarray) -> dict[str, np.ndarray]:
        """Restore a state and return its observation; the episode continues from there to the same bits.

        Args:
            state: Vector of `get_state`, or [time, qpos, qvel] as in files of the original, which resets the
                controller and the number of steps.

        Raises:
            InvalidInputError: The vector has another length, or a value is outside of its range; nothing has changed.
        """
        self._check_open()
        state = self.world.checked_state(state)
        self._running = False
        self._steps = self.world.restore(0, state)
        self._running = True
        return self._observe()

    def render_cameras(self) -> dict[str, np.ndarray]:
        """Render the observed images of the current state: name -> (H, W, ...)."""
        self._check_open()
        self.world.render_cameras([0], self._images)
        return {key: rows[0].copy() for key, rows in self._images.items()}

    def render(self) -> np.ndarray | None:  # type: ignore[override]  # Gymnasium declares any type
        """Return the image of the agent's camera, (H, W, 3) uint8, in `rgb_array` mode, else None."""
        self._check_open()
        return self.world.render(0, "agentview") if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Free the simulation and the OpenGL context. Idempotent."""
        self.world.close()
        self._closed = True

    def _check_open(self) -> None:
        if self._closed:
            raise ClosedGymEnvironmentError(f"this environment of {self.task.id} is closed; make another")

    def _observe(self) -> dict[str, np.ndarray]:
        return self._observation(self.world.observe([0], self._images if self.render_images else None))

    def _observation(self, state: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return copies of the images, and observations of the state, (1, ...) each, without the first axis."""
        images = {key: rows[0].copy() for key, rows in self._images.items()}
        return {**images, **{key: rows[0] for key, rows in state.items()}}

    def _info(self) -> dict[str, Any]:
        success, progress = self.world.check_goal(0)
        if (perturbed := self.world.perturbed) is None:
            return {"success": success, "progress": progress}
        return {"success": success, "progress": progress, "attempts": perturbed.attempts[0].copy()}
