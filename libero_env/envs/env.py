"""One simulation of a task as a `gymnasium.Env`."""

import importlib
import os
import sys
from typing import Any

import gymnasium
import numpy as np

from libero_env.envs.batch import BatchEnv
from libero_env.envs.checks import ResetRequest, checked_actions
from libero_env.envs.config import EnvConfig, show_options
from libero_env.errors import LiberoError, RenderError, SimulationError, UnknownNameError
from libero_env.tasks import Task
from libero_env.timing import CONTROL_HZ


class LiberoEnv(gymnasium.Env):
    """A task of the benchmark, by default at 20 Hz.

    Observations: `<camera>_rgb` (H, W, 3) uint8, first row on top; `joint_states` (7,) rad; `gripper_states` (2,) m;
    `ee_pos` (3,) m; `ee_ori` (3,) axis-angle; `libero_env.sim.observations` lists the others. All describe the state
    after the step.

    The reward is 1 in the step that reaches the goal and 0 otherwise. Reaching the goal terminates the episode,
    `horizon` steps truncate it. `info["success"]` says whether the goal holds, `info["progress"]` which of its atoms
    do.

    Args:
        task: `Task`, or an argument of `get_task`: `libero_object/3`, `libero_object-3`, or a task's name.
        config: Configuration of the environment.
        render_mode: None; `rgb_array` for `render()`; or `human` for a window of MuJoCo's viewer that shows every step.
        **options: Fields of `EnvConfig`, such as `camera_size=(64, 64)`, which replace those of `config`.

    Attributes:
        config: Configuration of the environment.
        batch: The batch of one simulation of which this is a view.
        scene: Compiled scene of the task.
        simulations: Physics and controller.
        observer: Observer of the simulation.
        view: Read-only view of the whole state, for experts and analysis, not for policies.

    Raises:
        UnknownNameError: The task, a camera, an option or a value of an option does not exist.
        InvalidInputError: A value of an option is of another kind or outside of its range.
        RenderError: `render_mode` is `human`, without a display or with backend `warp`.
        ClosedEnvironmentError: By every method, after `close`.

    Examples:
        >>> env = LiberoEnv("libero_object/3", camera_size=(64, 64))
        >>> observation, info = env.reset(options={"init_state": 0})
        >>> observation["agentview_rgb"].shape, observation["ee_pos"].shape
        ((64, 64, 3), (3,))
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> info["progress"]
        {'(In bbq_sauce_1 basket_1_contain_region)': False}
        >>> env.close()
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": CONTROL_HZ}

    @show_options
    def __init__(
        self,
        task: Task | str,
        *,
        config: EnvConfig | None = None,
        render_mode: str | None = None,
        **options: Any,
    ):
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise UnknownNameError("render_mode", render_mode, ("None", *self.metadata["render_modes"]))
        if render_mode == "human":
            require_display()
        self.render_mode = render_mode
        self._window: Any = None
        self.batch = batch = BatchEnv(task, 1, config=config, **options)
        self.config, self.task, self.scene = batch.config, batch.task, batch.scene
        self.simulations, self.observer, self.view = batch.simulations, batch.observer, batch.views[0]
        if render_mode == "human" and self.config.backend.is_warp:
            raise RenderError("render_mode human shows simulations of backend=mujoco, not of warp")
        self.metadata = {**self.metadata, "render_fps": self.config.control_freq}
        self.observation_space = batch.single_observation_space
        self.action_space = batch.single_action_space

    @property
    def render_images(self) -> bool:
        """Whether images are rendered in each step, see `BatchEnv`; may be set."""
        return self.batch.render_images

    @render_images.setter
    def render_images(self, wanted: bool) -> None:
        self.batch.render_images = wanted

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start an episode, and return the observation, name -> (length,) or (H, W, C), and `info`.

        Args:
            seed: Seed of the placement of objects; the same seed gives the same state.
            options: `{"init_state": i}` starts from the i-th of the 50 stored states instead of a new placement.

        Raises:
            InvalidInputError: The seed is not a whole number from 0, or there is no such initial state; nothing has
                changed.
            UnknownNameError: An option does not exist; nothing has changed.
            PlacementError: The objects do not fit; no episode is running.
        """
        self.batch.require_open()
        request = ResetRequest.from_arguments(1, [seed], options, valid=("init_state",))
        self.batch.generators[0] = self.np_random
        observations, infos = self.batch.start(request)
        if request.seeds[0] is not None:
            self._np_random, self._np_random_seed = self.batch.generators[0], request.seeds[0]
        self._show()
        return _first(observations), self._info(infos)

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Apply an action for a control step, by default 50 ms.

        Args:
            action: Action, (7,) by default, see `action_space`; values outside of it are clipped.

        Raises:
            ActionError: The shape is wrong, or a value is not a finite number; the state has not changed.
            SimulationError: The simulation has diverged; no episode is running.
            LiberoError: No episode is running.
        """
        self.batch.require_open()
        action = checked_actions(action, self.action_space.shape)
        if not self.batch.running[0]:
            raise LiberoError("no episode is running, or its last call was interrupted; call reset()")
        observations, rewards, terminated, truncated, infos = self.batch.advance(action[None])
        if "errors" in infos:
            raise SimulationError(infos["errors"])
        self._show()
        end, cut = bool(terminated[0]), bool(truncated[0])
        return _first(observations), float(rewards[0]), end, cut, self._info(infos)

    def get_state(self) -> np.ndarray:
        """Return all that the rest of the episode depends on, (N,) float64: simulation, controller, number of steps."""
        return self.batch.get_state(0)

    def set_state(self, state: np.ndarray) -> dict[str, np.ndarray]:
        """Restore a state and return its observation; the episode continues from there to the same bits.

        Args:
            state: Vector of `get_state`, or [time, qpos, qvel] as in files of the original, which resets the
                controller and the number of steps.

        Raises:
            InvalidInputError: The vector has another length, or a value is outside of its range; nothing has changed.
        """
        self.batch.set_state(0, state)
        return _first(self.batch.observe(0))

    def render_cameras(self) -> dict[str, np.ndarray]:
        """Render the observed images of the current state: name -> (H, W, ...)."""
        return _first(self.batch.render_cameras())

    def render(self) -> np.ndarray | None:  # type: ignore[override]  # Gymnasium declares any type
        """Return the image of the agent's camera, (H, W, 3) uint8, in `rgb_array` mode, else None."""
        self.batch.require_open()
        self._show()
        return self.observer.render(0, "agentview") if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Free the simulation, the OpenGL context and the window. Idempotent."""
        if self._window is not None:
            self._window.close()
            self._window = None
        self.batch.close()

    def _show(self) -> None:
        """Show the state in the window of `human` mode, which is opened once."""
        if self.render_mode != "human":
            return
        if self._window is None:
            viewer: Any = importlib.import_module("mujoco.viewer")
            self._window = viewer.launch_passive(self.simulations.model, self.simulations.data(0))
            self._window.opt.geomgroup[0] = 0  # collision shapes are hidden
        self._window.sync()

    def _info(self, infos: dict[str, Any]) -> dict[str, Any]:
        atoms = zip(self.batch.atoms, map(bool, infos["progress"][0]), strict=True)
        return {**_first(infos), "success": bool(infos["success"][0]), "progress": dict(atoms)}


def require_display() -> None:
    """Check that a window can be opened.

    Raises:
        RenderError: There is no screen.
    """
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise RenderError("no window: neither DISPLAY nor WAYLAND_DISPLAY names a screen")


def _first(rows: dict[str, Any]) -> dict[str, Any]:
    return {name: values[0] for name, values in rows.items()}
