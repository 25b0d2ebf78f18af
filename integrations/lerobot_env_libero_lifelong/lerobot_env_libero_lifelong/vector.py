"""Simulations of one task as the vector environment that LeRobot's rollouts expect."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import cloudpickle
import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from gymnasium.vector.utils import batch_space

from lerobot_env_libero_lifelong.settings import ROBOT_STATE, Settings
from libero_env.envs.batch import BatchEnv
from libero_env.envs.config import EnvConfig
from libero_env.envs.env import LiberoEnv
from libero_env.errors import LiberoError, SimulationError
from libero_env.geometry import quat_to_mat
from libero_env.images import flip_rows, rotate_180
from libero_env.init_states.original_resets import OriginalResets
from libero_env.init_states.store import NUM_INIT_STATES, load_original_states
from libero_env.sim.controller import get_controller
from libero_env.tasks import Task

ACTION_DIM = 7
WAIT_ACTION = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0)
# the grip site is turned by -90 degrees about the hand's z axis (robosuite's panda_gripper.xml)
HAND_TO_GRIP = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
SHARED = ("task", "task_description", "task_id", "_max_episode_steps")


class TaskEnvs(gymnasium.vector.VectorEnv):
    """Simulations of one task, stepped together; they are built by the first reset and freed by `close`.

    Sub-environment i starts its k-th episode in the stored state i + k num_envs (mod 50), as LeRobot's `LiberoEnv`.
    An episode that is over stays as it is until the next `reset`: there is no autoreset, which would use up a state.

    Args:
        task: Task to simulate.
        num_envs: Number of simulations.
        settings: Options.
        processes: Whether each simulation gets a process of its own, so that images are rendered in parallel; the
            results are the same. Not used with absolute actions or the original's starts.

    Attributes:
        task: Name of the task.
        task_description: Its instruction.
        task_id: Its index in the suite.
        settings: Options.
    """

    metadata: dict[str, Any] = {
        "render_modes": ["rgb_array"],
        "render_fps": 20,
        "autoreset_mode": AutoresetMode.DISABLED,
    }

    def __init__(self, task: Task, num_envs: int, settings: Settings, *, processes: bool = False):
        self._task, self.settings, self.num_envs = task, settings, num_envs
        self.task, self.task_description, self.task_id = task.name, task.language, task.index
        self.render_mode = "rgb_array"
        self.metadata = {**self.metadata, "render_fps": settings.fps}
        self._processes = processes and settings.control_delta and settings.starts != "original"
        self._max_episode_steps = settings.steps(task)
        self.single_observation_space = _observation_space(settings)
        self.single_action_space = spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._envs: BatchEnv | AsyncVectorEnv | None = None
        self._starts = np.arange(num_envs)
        self._last: dict[str, np.ndarray] = {}

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode in every simulation, and let the objects settle.

        Args:
            seed: One seed for each simulation, or one number from which they count up; not used with stored starts.
            options: Ignored; LeRobot passes a mark of its own.

        Raises:
            LiberoError: The starts of the original are asked for without its models or states, or without seeds.
        """
        envs = self._open()
        if isinstance(seed, int):
            seed = [seed + i for i in range(self.num_envs)]
        start: dict[str, Any] = {}
        if self.settings.starts == "stored":
            start = {"init_state": self._starts % NUM_INIT_STATES}
        elif self.settings.starts == "original":
            start = {"start": self._original_starts(seed), "outdated_controller": True}
        self._starts = self._starts + self.num_envs
        if isinstance(envs, AsyncVectorEnv):
            envs.set_attr("start", start.pop("init_state", np.full(self.num_envs, -1)).tolist())
        with _waiting(envs):
            obs, info = envs.reset(seed=seed, options=start)
            for _ in range(self.settings.wait_steps):
                obs, _, _, _, info = envs.step(np.tile(WAIT_ACTION, (self.num_envs, 1)))
        return self._observation(obs), self._info(info)

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Apply actions (num_envs, 7) for 50 ms; simulations whose episode is over do not move.

        Raises:
            ActionError: The shape is wrong, or a value is not finite.
            SimulationError: A simulation has failed; LeRobot would count its episode as a failure of the policy.
        """
        obs, rewards, _, _, info = self._open().step(actions)
        if "errors" in info:
            raise SimulationError(info["errors"])
        reached = np.asarray(info["success"], bool)
        return self._observation(obs), rewards, reached, np.zeros(self.num_envs, bool), self._info(info)

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Return an attribute of each simulation, one of `SHARED`, or its image, `render`."""
        if name == "render":
            return tuple(self.render())
        return self.get_attr(name)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute of each simulation; see `call`."""
        if name not in SHARED:
            raise AttributeError(f"{type(self).__name__} has no {name!r}; valid: render, {', '.join(SHARED)}")
        return (getattr(self, name),) * self.num_envs

    def render(self) -> np.ndarray:  # type: ignore[override]
        """Return the last image of the first camera of each simulation, (num_envs, H, W, 3), as policies see it.

        Raises:
            LiberoError: No episode has started.
        """
        if not self._last:
            raise LiberoError("there is no image before the first reset")
        seen = self._last[_key(next(iter(self.settings.cameras)))]
        return np.ascontiguousarray(rotate_180(flip_rows(seen, 1), 1))

    def close(self, **kwargs: Any) -> None:
        """Free the simulations; a later `reset` builds them again."""
        if self._envs is not None:
            self._envs.close()
        self._envs, self._last = None, {}

    def _open(self) -> BatchEnv | AsyncVectorEnv:
        if self._envs is None:
            config = self.settings.env_config(self._task)
            if self._processes:
                cloudpickle.register_pickle_by_value(
                    sys.modules[__name__]
                )  # processes need not import LeRobot
                make = partial(_Standing, self._task, config)
                mode = AutoresetMode.DISABLED
                self._envs = AsyncVectorEnv([make] * self.num_envs, context="spawn", autoreset_mode=mode)
            else:
                self._envs = BatchEnv(self._task, self.num_envs, config=config)
        return self._envs

    def _original_starts(self, seeds: Sequence[int | None] | None) -> np.ndarray:
        """Return the states in which LeRobot's own environments start, [time, qpos, qvel, poses of the fixtures].

        Each of them has loaded its model when it was made, at a first reset, and at each reset since.
        """
        assert isinstance(self._envs, BatchEnv), "there are no processes with these starts"
        scene, states = self._envs.scene, load_original_states(self._task)
        size = 1 + scene.model.nq + scene.model.nv
        if states is None or len(states[0]) < size:
            raise LiberoError(
                f"{self._task.id}: original_starts needs the states that LIBERO publishes: name its folder init_files "
                "under init_states in ~/.libero/config.yaml, and install the original's models"
            )
        if seeds is None or any(seed is None for seed in seeds):
            raise LiberoError("original_starts places fixtures by the episodes' seeds, and there are none")
        rows = []
        for i, seed in zip(self._starts.tolist(), seeds, strict=True):
            loads = 2 + i // self.num_envs
            poses = (
                OriginalResets(scene, int(seed or 0), loads).reset() if scene.fixtures else np.zeros((0, 7))
            )
            rows.append(np.concatenate([states[i % len(states)][:size], poses.ravel()]))
        return np.array(rows)

    def _observation(self, obs: dict[str, np.ndarray]) -> dict[str, Any]:
        """Return an observation as LeRobot's `LiberoEnv` gives it: lowest row first, quaternions xyzw."""
        self._last = obs
        pixels = {
            name: np.ascontiguousarray(flip_rows(obs[_key(camera)], 1))
            for camera, name in self.settings.cameras.items()
        }
        if not self.settings.with_state:
            return {"pixels": pixels}
        mats = np.stack([quat_to_mat(quat) @ HAND_TO_GRIP for quat in obs["ee_quat"]])
        quats = np.roll(obs["ee_quat"], -1, axis=-1)
        return {
            "pixels": pixels,
            "robot_state": {
                "eef": {"pos": obs["ee_pos"], "quat": quats, "mat": mats},
                "gripper": {"qpos": obs["gripper_states"], "qvel": obs["gripper_velocities"]},
                "joints": {"pos": obs["joint_states"], "vel": obs["joint_velocities"]},
            },
        }

    def _info(self, info: dict[str, Any]) -> dict[str, Any]:
        return {
            "is_success": np.asarray(info["success"], bool),
            "task": np.array([self.task] * self.num_envs),
            "task_id": np.full(self.num_envs, self.task_id),
        }


class _Standing(gymnasium.Wrapper):
    """A simulation in a process: it starts in the stored state `start`, if any, and stands still when it is over."""

    start = -1

    def __init__(self, task: Task, config: EnvConfig):
        super().__init__(LiberoEnv(task, config=config))
        self._last: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self._last = None
        return super().reset(seed=seed, options={} if self.start < 0 else {"init_state": self.start})

    def step(self, action: np.ndarray) -> Any:
        if self._last is None:
            found = super().step(action)
            obs, _, *over, info = found
            self._last = (obs, 0.0, *over, info) if any(over) else None
            return found
        return self._last


@contextmanager
def _waiting(envs: BatchEnv | AsyncVectorEnv) -> Iterator[None]:
    """Make actions relative, so that they hold the pose; LeRobot, too, changes to absolute ones after waiting."""
    if not isinstance(envs, BatchEnv):
        yield
        return
    state = envs.simulations.controller_state
    own, state.controller = state.controller, get_controller()
    try:
        yield
    finally:
        state.controller = own


def _key(camera: str) -> str:
    """Return our name of a camera's image, such as `eye_in_hand_rgb`."""
    return f"{camera.removesuffix('_image').removeprefix('robot0_')}_rgb"


def _observation_space(settings: Settings) -> spaces.Dict:
    images = {name: spaces.Box(0, 255, (*settings.size, 3), np.uint8) for name in settings.cameras.values()}
    entries: dict[str, spaces.Space] = {"pixels": spaces.Dict(images)}
    if settings.with_state:
        groups: dict[str, dict[str, spaces.Space]] = {}
        for group, name, shape in ROBOT_STATE:
            groups.setdefault(group, {})[name] = spaces.Box(-np.inf, np.inf, shape, np.float64)
        entries["robot_state"] = spaces.Dict({group: spaces.Dict(of) for group, of in groups.items()})
    return spaces.Dict(entries)
