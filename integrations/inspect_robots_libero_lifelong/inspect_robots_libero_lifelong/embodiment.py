"""The simulated Panda of LIBERO as an embodiment of Inspect Robots."""

from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

from inspect_robots.embodiment import (
    AUTO_RESET,
    PRIVILEGED_SUCCESS,
    RENDERABLE,
    RESETTABLE,
    SEEDABLE,
    EmbodimentBase,
    EmbodimentInfo,
)
from inspect_robots.scene import Scene
from inspect_robots.spaces import CameraSpec, ObservationSpace, StateField, StateSpec
from inspect_robots.types import Action, Observation, StepResult

from inspect_robots_libero_lifelong.errors import as_config_error
from inspect_robots_libero_lifelong.spaces import ACTION, STATE
from libero_env.envs.config import EnvConfig
from libero_env.envs.env import LiberoEnv
from libero_env.errors import LiberoError
from libero_env.sim.observations import DEFAULT_CAMERAS, image_name
from libero_env.tasks import get_task
from libero_env.timing import CONTROL_HZ

UNITS = {
    "joint_pos": ((7,), "rad"),
    "joint_vel": ((7,), "rad/s"),
    "eef_pos": ((3,), "m"),
    "eef_quat": ((4,), "unit_quat"),
    "eef_axis_angle": ((3,), "rad"),
    "gripper_qpos": ((2,), "m"),
}
NO_HORIZON = 10**9  # the number of steps is the task's of Inspect Robots
DOCS = """\
A simulated Franka Panda, 20 actions per second. An action is relative to the current pose, in axes of the base:
1 is 5 cm in dx, dy, dz and 0.5 rad in drx, dry, drz (a rotation vector). gripper: -1 opens, +1 closes.
x points from the robot to the front, y to its left, z up. Images have their first row on top; agentview looks at
the robot from the front. eef_pos is the point between the fingers, eef_quat is wxyz, gripper_qpos the positions of
the two fingers.
"""


class LiberoEmbodiment(EmbodimentBase):
    """LIBERO's tasks in simulation.

    A scene of the task `libero` names its LIBERO task and initial state in its metadata, `task` and `init_state`. A
    scene without them, such as that of `--instruction`, is `task` of this constructor with a placement by the trial's
    seed.

    Args:
        task: LIBERO task of scenes that name none, such as `libero_goal/7`.
        camera_size: Height and width of the images, [pixels].
        settle_steps: Number of steps without motion before the policy acts; LIBERO has 5.
        cameras: Names of the cameras, as in `libero_env.envs.config.EnvConfig`; so are the following.
        assets: Models.
        drawing: Quality of the images.
        robot: Model of the arm.
        perturb: Perturbations, such as `camera=0.3,light=0.5`.

    Raises:
        ConfigError: An option is not valid; it is named.
    """

    @as_config_error()
    def __init__(
        self,
        task: str | None = None,
        *,
        camera_size: int = 128,
        settle_steps: int = 5,
        cameras: Sequence[str] = DEFAULT_CAMERAS,
        assets: str | None = None,
        drawing: str | None = None,
        robot: str = "libero",
        perturb: str | None = None,
    ):
        if not isinstance(settle_steps, int) or settle_steps < 0:
            raise LiberoError(f"settle_steps is {settle_steps!r}; expected a whole number from 0")
        self.task = None if task is None else get_task(task)
        self.settle_steps = settle_steps
        self.config = EnvConfig(
            cameras=cameras,
            camera_size=camera_size,
            horizon=NO_HORIZON,
            observations=("rgb", *STATE.values()),
            assets=assets,
            drawing=drawing,
            robot=robot,
            perturb=perturb or (),
        )
        if shares := [str(p) for p in self.config.perturb if getattr(p, "trigger", "").endswith("%")]:
            raise LiberoError(
                f"perturb={shares[0]} begins at a share of an episode's length, which Inspect Robots alone knows: name "
                "a step, such as @step40"
            )
        self._env: LiberoEnv | None = None
        self._words: dict[str, str] = {}  # of the task -> of the scene
        self._images = [image_name(camera, "rgb") for camera in self.config.cameras]
        height, width = self.config.camera_size
        self.info = EmbodimentInfo(
            name="libero",
            action_space=ACTION,
            observation_space=ObservationSpace(
                cameras=tuple(CameraSpec(name, height, width) for name in self._images),
                state=StateSpec(tuple(StateField(key, *about) for key, about in UNITS.items())),
            ),
            control_hz=float(CONTROL_HZ),
            is_simulated=True,
            capabilities=frozenset({SEEDABLE, RESETTABLE, AUTO_RESET, PRIVILEGED_SUCCESS, RENDERABLE}),
            docs=DOCS,
            environment_id=f"libero-lifelong {version('libero-lifelong')}, MuJoCo {version('mujoco')}",
            environment_revision=self.config.pack.digest,
        )

    def reset(self, scene: Scene, *, seed: int | None = None) -> Observation:
        """Start an episode and let the objects settle.

        Args:
            scene: Scene; see the class.
            seed: Seed of the placement of objects where the scene names no initial state.

        Raises:
            UnknownNameError: Its task does not exist.
            LiberoError: Neither the scene nor the constructor names a task.
        """
        task = get_task(scene.metadata["task"]) if "task" in scene.metadata else self.task
        if task is None:
            raise LiberoError(
                f"scene {scene.id!r} names no LIBERO task: use --task libero, or -E task=libero_goal/7"
            )
        if self._env is None or self._env.task != task:
            self.close()
            self._env = LiberoEnv(task, config=self.config)
        start = scene.metadata.get("init_state")
        obs, _ = self._env.reset(seed=seed, options=None if start is None else {"init_state": start})
        for _ in range(self.settle_steps):
            obs, *_ = self._env.step([0.0] * 7)
        self._words = {task.language: scene.instruction}
        return self._observation(obs)

    def step(self, action: Action) -> StepResult:
        """Apply an action for 50 ms.

        Raises:
            LiberoError: No episode is running, or the simulation has diverged, which is not the policy's failure.
        """
        if self._env is None:
            raise LiberoError("no episode is running; call reset()")
        obs, reward, terminated, _, info = self._env.step(action.data)
        return StepResult(
            observation=self._observation(obs),
            reward=reward,
            terminated=terminated,
            termination_reason="success" if terminated else None,
            info={"success": info["success"], "progress": info["progress"]},
        )

    def close(self) -> None:
        """Free the simulation; a later `reset` builds it again."""
        if self._env is not None:
            self._env.close()
            self._env = None

    def _observation(self, obs: dict[str, Any]) -> Observation:
        assert self._env is not None
        words = self._env.batch.task_of(0).language  # as perturbations change it
        return Observation(
            images={name: obs[name] for name in self._images},
            state={key: obs[name] for key, name in STATE.items()},
            instruction=self._words.get(words, words),
            extra={
                "settle_steps": self.settle_steps,
                "drawing": self.config.drawing,
                "robot": self.config.robot,
            },
        )
