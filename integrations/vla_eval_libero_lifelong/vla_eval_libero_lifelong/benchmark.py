"""A benchmark of vla-eval that is simulated here, under one of our protocols.

`vla-eval run` takes it by its import string, `vla_eval_libero_lifelong.benchmark:LiberoBenchmark`, with `docker` off.
Its observations have the keys of vla-eval's own `LIBEROBenchmark` (0.8.0, vla_eval/benchmarks/libero/benchmark.py), so
that model servers written for that one serve this one.
"""

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
from vla_eval.benchmarks.base import StepBenchmark, StepResult

from libero_env.assets.robot import DEFAULT_ROBOT
from libero_env.envs.checks import checked_numbers
from libero_env.errors import LiberoError, SimulationError
from libero_env.tasks import Task, get_suite
from libero_eval.protocols.adapter import ProtocolAdapter, view_of
from libero_eval.protocols.environment import ProtocolEnv, resolve_world, run_protocol
from libero_eval.protocols.files import load_protocol
from libero_eval.protocols.protocol import EvalProtocol
from lifelong.errors import PolicyError, ProtocolError, ProtocolMismatchError
from lifelong.evaluation.environments import Obs
from lifelong.results.provenance import installed_versions

ADJUSTABLE = ("vla-eval", "libero")  # protocols that leave some fields to what a policy asks for
IMAGES = {"agentview": "agentview", "robot0_eye_in_hand": "wrist"}  # camera -> key
ROTATIONS = {None: None, True: "axis_angle", False: "axis_angle_positive"}  # by quat_no_antipodal
PREFIX = "observation/"
logger = logging.getLogger(__name__)


class LiberoBenchmark(StepBenchmark):
    """Tasks of one suite under a protocol; the same episodes as `libero eval --protocol`.

    Episode i of a task starts in initial state i. Observations are `images` (`agentview`, and `wrist`), `states` and
    `task_description`, after the whole of the protocol's processing; with `observations`, they are instead our own
    arrays under the names that `libero serve` takes, `observation/agentview_rgb`.

    A protocol fixes what a policy sees. What the model server announces (its parameters reach this constructor) must
    agree with it, or the run is refused. The protocols `vla-eval` and `libero` take the values of `seed`, `env_seed`,
    `num_steps_wait`, `max_steps`, `quat_no_antipodal` and `absolute_action` instead, as vla-eval's own benchmark does.

    Args:
        card: Name of a protocol, or path of its file.
        task_ids: Indices of the tasks; None for all.
        send_wrist_image: Whether observations have the image of the wrist's camera.
        send_state: Whether they have the state.
        seed: Seed of the evaluation; that of the environment unless `env_seed` is given.
        env_seed: Seed of the environment, from which the poses of fixtures are drawn.
        num_steps_wait: Number of steps before the policy acts.
        max_steps: Maximum number of steps of the policy.
        quat_no_antipodal: Whether rotation vectors keep the quaternion's sign.
        observations: Names of our own observations to send, such as `agentview_rgb` and `joint_states`.
        camera_size: Height and width of the images of `observations`, [pixels].
        drawing: How these images are drawn; None for the models' default.
        robot: Model of the arm of `observations` under `libero`; None for the default.
        assets: Models: `builtin`, a folder, or None for the user's choice.

    Raises:
        UnknownNameError: The suite or the protocol does not exist.
        ProtocolMismatchError: The server or the configuration asks for something else than the protocol; both values
            are named.
        LiberoError: A task does not exist.
    """

    render_backends = frozenset({"gpu", "cpu"})
    _ALL_RECORD_FIELDS = frozenset({"reward", "done", "success", "action"})

    @classmethod
    def configure_render(cls, mode: str) -> dict[str, str]:
        """Select the rendering backend, before a simulation exists; see vla-eval's `Benchmark`."""
        from vla_eval.render import configure_mujoco_render

        return configure_mujoco_render(mode)

    def __init__(
        self,
        suite: str = "libero_spatial",
        card: str = "vla-eval",
        task_ids: Sequence[int] | None = None,
        *,
        send_wrist_image: bool = False,
        send_state: bool = False,
        seed: int | None = None,
        env_seed: int | None = None,
        num_steps_wait: int | None = None,
        max_steps: int | None = None,
        quat_no_antipodal: bool | None = None,
        absolute_action: bool = False,
        observations: Sequence[str] | None = None,
        camera_size: Sequence[int] | None = None,
        drawing: str | None = None,
        robot: str | None = None,
        assets: str | None = None,
    ):
        super().__init__()
        self.suite, self.assets = suite, assets
        self.send_wrist_image, self.send_state = send_wrist_image, send_state
        self.observations = None if observations is None else tuple(observations)
        asked = {
            "world.env_seed": seed if env_seed is None else env_seed,
            "world.delta": not absolute_action,
            "episode.settle_steps": num_steps_wait,
            "episode.horizon": max_steps,
            "proprioception.rotation": ROTATIONS[quat_no_antipodal],
            "proprioception.source": "observation" if send_state else None,
        }
        self.tasks = _tasks(suite, task_ids)
        chosen = load_protocol(card)
        if self.observations is None:
            own = {"camera_size": camera_size, "drawing": drawing, "robot": robot}
            if given := [name for name, value in own.items() if value is not None]:
                raise ProtocolError(
                    f"{', '.join(given)}: protocol {chosen.name} has its own; only with observations, our own arrays"
                )
            chosen = _agreed(chosen, {k: v for k, v in asked.items() if v is not None})
            cameras = chosen.pixels.cameras
            if lacking := [c for c in IMAGES if c not in cameras and (c == "agentview" or send_wrist_image)]:
                raise ProtocolMismatchError(
                    f"pixels.cameras: protocol {chosen.name} has {', '.join(cameras)}, and the policy needs "
                    f"{', '.join(lacking)}"
                )
        else:
            height, width = camera_size or chosen.pixels.render_size or (128, 128)
            settling = chosen.settle_steps if num_steps_wait is None else num_steps_wait
            if absolute_action or not chosen.world.delta:
                raise ProtocolError(
                    "absolute_action cannot be used with observations: runs move relative to the pose"
                )
            if (env_seed := asked["world.env_seed"]) is not None:
                chosen = _agreed(chosen, {"world.env_seed": env_seed})
            steps = 600 if max_steps is None else max_steps
            arm = robot or DEFAULT_ROBOT
            chosen = run_protocol(
                chosen, (height, width), steps, settling, arm, drawing=drawing, assets=assets
            )
        self.protocol, notes = resolve_world(chosen, self.tasks, assets)
        self.protocol.require()
        if self.protocol.action.clock:
            raise ProtocolError(
                f"protocol {self.protocol.name} has action.clock, and no time passes in vla-eval: run it by libero eval"
            )
        for note in notes:
            logger.warning(note)
        self._adapter: ProtocolAdapter | None = None
        self._task: Task | None = None
        self._env: ProtocolEnv | None = None
        self._ever = False

    def get_tasks(self) -> list[dict[str, Any]]:
        """Return the tasks; each has what identifies the simulation, which vla-eval stores with every episode."""
        versions = installed_versions(self.assets)
        about = {
            "protocol": self.protocol.name,
            "protocol_digest": self.protocol.digest,
            "models": versions["models"],
            "models_digest": versions["models_digest"],
            "drawing": self.protocol.world.drawing,
            "robot": self.protocol.world.robot,
            "mujoco": versions["mujoco"],
            "libero_lifelong": versions.get("libero-lifelong", "source"),
        }
        languages = [task.language for task in get_suite(self.suite).tasks]
        return [
            {
                # results are grouped by name, and some tasks of libero_90 share an instruction
                "name": t.language if languages.count(t.language) == 1 else f"{t.language} ({t.id})",
                "suite": self.suite,
                "task_id": t.index,
                "prompt": self.protocol.prompt(t),
                **about,
            }
            for t in self.tasks
        ]

    def reset(self, task: dict[str, Any]) -> Obs:
        """Start an episode in the initial state `episode_idx` of a task, and let the objects settle."""
        env = self._open(next(t for t in self.tasks if t.index == task["task_id"]))
        obs, _ = env.reset(options={"init_state": np.array([task.get("episode_idx", 0)])})
        settling = np.asarray(self.protocol.episode.settle_action or np.zeros(7))
        for _ in range(self.protocol.settle_steps):
            obs, *_ = env.step(settling[None])
        self._ever = False
        self._recorder.record_video(self._frame(obs))
        return obs

    def step(self, action: dict[str, Any]) -> StepResult:
        """Apply a server's action, (7,).

        Raises:
            PolicyError: It has another shape, or values that are not finite.
            SimulationError: The simulation has diverged.
        """
        assert self._env is not None and self._adapter is not None, "reset was called"
        answer = action.get("actions", action.get("action"))
        predicted = checked_numbers(answer, "the server's actions", ((7,),), PolicyError)
        executed = predicted if self.observations else self._adapter.actions(predicted)
        obs, reward, _, _, info = self._env.step(executed[None])
        if "errors" in info:
            raise SimulationError(info["errors"])
        success = bool(info["success"][0])
        self._ever |= success
        self._recorder.record_video(self._frame(obs))
        self._recorder.record_step(
            reward=float(reward[0]), done=success, success=success, action=executed.astype(np.float32)
        )
        return StepResult(obs=obs, reward=float(reward[0]), done=success, info={"success": self._ever})

    def make_obs(self, raw_obs: Obs, task: dict[str, Any]) -> dict[str, Any]:
        """Return what the server receives for an observation of the simulation."""
        assert self._adapter is not None and self._env is not None, "reset was called"
        acted = self._env.task_of(0)  # as an event may have changed it
        if self.observations is not None:
            arrays = {PREFIX + name: raw_obs[name][0] for name in self.observations}
            return {"task_description": acted.language, "task": acted.id, **arrays}
        (given,) = self._adapter.inputs(raw_obs)
        cameras = [c for c in given.images if c == "agentview" or self.send_wrist_image]
        observation: dict[str, Any] = {
            "images": {IMAGES[camera]: given.images[camera] for camera in cameras},
            "task_description": self.protocol.prompt(acted),
        }
        if self.send_state:
            observation |= {"states": given.state, **given.extra}
        return observation

    def get_step_result(self, step_result: StepResult) -> dict[str, Any]:
        """Return the outcome of an episode."""
        return {"success": bool(step_result.info.get("success", False))}

    def get_metadata(self) -> dict[str, Any]:
        """Return the length of episodes, their number, and everything that identifies protocol and simulation."""
        return {
            "max_steps": max(self.protocol.steps(task) for task in self.tasks),
            "max_episodes_per_task": 50,
            "suite": self.suite,
            "card": self.protocol.resolved(),
            "versions": installed_versions(self.assets),
        }

    def get_action_spec(self) -> dict[str, Any]:
        """Return the conventions of actions."""
        from vla_eval.specs import (
            GRIPPER_01,
            GRIPPER_CLOSE_POS,
            POSITION_ABSOLUTE,
            POSITION_DELTA,
            ROTATION_AA,
        )

        opens = (self.protocol.action.gripper or "").startswith("open")
        gripper = GRIPPER_01 if opens else GRIPPER_CLOSE_POS
        position = POSITION_DELTA if self.protocol.world.delta else POSITION_ABSOLUTE
        return {"position": position, "rotation": ROTATION_AA, "gripper": gripper}

    def get_observation_spec(self) -> dict[str, Any]:
        """Return the conventions of observations."""
        from vla_eval.specs import IMAGE_RGB, LANGUAGE, RAW, STATE_EEF_POS_AA_GRIP

        if self.observations is not None:
            return {"language": LANGUAGE, **{PREFIX + name: RAW for name in self.observations}}
        spec = {"agentview": IMAGE_RGB, "language": LANGUAGE}
        if self.send_wrist_image:
            spec["wrist"] = IMAGE_RGB
        if self.send_state:
            spec["state"] = STATE_EEF_POS_AA_GRIP
        return spec

    def cleanup(self) -> None:
        """Free the simulation."""
        if self._env is not None:
            self._env.close()
        self._env = self._task = None

    def render(self) -> np.ndarray | None:
        """Return the present image of the agent's camera, (H, W, 3) uint8."""
        return None if self._env is None else self._env.observer.render(0, "agentview")

    def _open(self, task: Task) -> ProtocolEnv:
        """Return the simulation of a task; it is kept for all of the task's episodes."""
        if self._env is None or self._task is not task:
            self.cleanup()
            options: dict[str, Any] = {"assets": self.assets}
            if names := self.observations:
                options["cameras"] = tuple(camera for camera in IMAGES if view_of(camera) in names)
                options["observations"] = ("rgb", *(name for name in names if not name.endswith("_rgb")))
            self._task, self._env = task, ProtocolEnv(self.protocol, task, 1, **options)
            # the task as the protocol's perturbations change it
            self._adapter = ProtocolAdapter(self.protocol, self._env.task)
        return self._env

    def _frame(self, obs: Obs) -> np.ndarray | None:
        """Return the agent's image of a recorded video, as policies see it in most protocols."""
        image = obs.get("agentview_rgb")
        return None if image is None else np.ascontiguousarray(image[0][:, ::-1])


def _tasks(suite: str, ids: Sequence[int] | None) -> tuple[Task, ...]:
    """Return tasks of a suite."""
    tasks = get_suite(suite).tasks
    if ids is None:
        return tuple(tasks)
    if wrong := [i for i in ids if not 0 <= i < len(tasks)]:
        raise LiberoError(f"task_ids {wrong} do not exist: {suite} has 0 to {len(tasks) - 1}")
    return tuple(tasks[i] for i in ids)


def _agreed(protocol: EvalProtocol, asked: dict[str, Any]) -> EvalProtocol:
    """Return the protocol with what is asked for, if it leaves that open; otherwise check that it is the same."""
    if protocol.name not in ADJUSTABLE:
        protocol.check(asked)
        return protocol
    if protocol.world.fixture_poses == "stored":
        asked.pop("world.env_seed", None)  # nothing is drawn
    if asked.get("episode.settle_steps") == 0:
        asked["episode.settle_action"] = None
    return protocol.changed(asked)
