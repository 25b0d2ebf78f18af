"""Simulations of a task that start as a protocol says."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from libero_env.assets.pack import BUILTIN, select_pack
from libero_env.assets.robot import DEFAULT_ROBOT
from libero_env.envs.batch import BatchEnv
from libero_env.init_states.original_resets import OriginalResets, drawn_fixtures
from libero_env.init_states.store import load_original_states
from libero_env.sim.controller import get_controller
from libero_env.sim.scene import Scene
from libero_env.sim.scene_spec import default_drawing
from libero_env.tasks import Task
from libero_eval.protocols.files import load_protocol
from libero_eval.protocols.protocol import EvalProtocol
from lifelong.errors import ConfigError, ProtocolMismatchError

OBSERVATIONS = ("rgb", "proprioception", "ee_quat")  # what `ProtocolAdapter` reads is among them


class ProtocolEnv(BatchEnv):
    """A `BatchEnv` whose initial states are a protocol's, fixtures included.

    What an episode starts in depends on protocol, task and initial state alone, so that any part of the initial states
    can be run by itself.

    Args:
        protocol: Protocol that has been checked by `require`.
        task: Task.
        count: Number of simulations.
        cameras: Cameras that are rendered; by default the protocol's.
        observations: Names of observations, see `libero_env.sim.observations`.
        threads: Number of threads of the simulations; 0 is one for each core.
        assets: Models, see `libero_env.envs.config.EnvConfig`.
        drawing: How images are drawn; by default as the protocol says, None for the models' default.
        backend: The protocol's backend with its settings, such as `warp,device=cuda:1`; by default without any.
    """

    def __init__(
        self,
        protocol: EvalProtocol,
        task: Task,
        count: int,
        *,
        cameras: Sequence[str] | None = None,
        observations: Sequence[str] = OBSERVATIONS,
        threads: int = 0,
        assets: str | None = None,
        drawing: str | None = "protocol",
        backend: str | None = None,
    ):
        self.protocol, world, self._waits = protocol, protocol.world, 0
        assert protocol.pixels.render_size is not None, "the protocol has been checked by require()"
        super().__init__(
            task,
            count,
            num_threads=threads,
            cameras=protocol.pixels.cameras if cameras is None else tuple(cameras),
            camera_size=protocol.pixels.render_size,
            horizon=protocol.steps(task) + protocol.settle_steps,
            observations=tuple(observations),
            controller=world.controller,
            control_delta=world.delta,
            control_freq=world.control_freq,
            semantics=world.predicates,
            assets=assets,
            drawing=world.drawing if drawing == "protocol" else drawing,
            robot=world.robot or DEFAULT_ROBOT,
            observed=protocol.episode.observed,
            backend=world.backend if backend is None else backend,
            perturb=world.perturb,
        )

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Start episodes in the initial states of the option `init_state`, (num_envs,) indices.

        Raises:
            ConfigError: An initial state does not exist.
        """
        options = dict(options or {})
        if "init_state" in options:
            options["outdated_controller"] = "reset" in self.protocol.episode.reset_order
            if self.protocol.world.fixture_poses == "drawn":
                indices = np.broadcast_to(options["init_state"], (self.num_envs,)).tolist()
                options["start"] = initial_states(
                    self.base_task, self.base_scene, self.protocol, indices, self._stored()
                )
        self._waits = self.protocol.settle_steps
        return super().reset(seed=seed, options=options)

    def advance(self, actions: np.ndarray) -> Any:
        """Step; see `BatchEnv`. While the robot waits, actions are relative, as in vla-eval and LeRobot.

        `episode.settle_action` would otherwise be a goal beside the robot's base.
        """
        if self.protocol.world.delta or not self._waits:
            return super().advance(actions)
        self._waits, state = self._waits - 1, self.simulations.controller_state
        own, state.controller = state.controller, get_controller(self.protocol.world.controller)
        try:
            return super().advance(actions)
        finally:
            state.controller = own

    def _stored(self) -> np.ndarray:
        """Return the initial states of the task that the protocol names, rows that begin with [time, qpos, qvel]."""
        if self.protocol.world.init_states == "builtin":
            return self.init_states
        states = load_original_states(self.base_task, self.base_scene)
        if states is None:
            raise ConfigError(
                f"{self.task.id}: protocol {self.protocol.name} starts from the states that LIBERO publishes, which "
                "are not here: name LIBERO's folder init_files under init_states in ~/.libero/config.yaml"
            )
        return states


def resolve_world(
    protocol: EvalProtocol, tasks: Sequence[Task], assets: str | None = None
) -> tuple[EvalProtocol, list[str]]:
    """Return a protocol with the models and initial states that are here, and a line for each that is not as it says.

    Args:
        assets: Models that the user has chosen, see `libero_env.assets.pack.select_pack`.

    Raises:
        ProtocolMismatchError: The models have another digest than the protocol names.
    """
    changes: dict[str, Any] = {}
    notes: list[str] = []
    world, pack = protocol.world, select_pack(assets)
    digest = getattr(pack, "digest", None)
    if world.models_digest is not None and world.models_digest != digest:
        raise ProtocolMismatchError(
            f"world.models_digest: protocol {protocol.name} has {world.models_digest}, the models here {digest}"
        )
    models = "builtin" if pack.name == BUILTIN else "original"
    if world.models not in ("any", models):
        changes["world.models"] = models
        notes.append(f"models: {models}, where protocol {protocol.name} has {world.models} (see --assets)")
    if world.init_states == "original" and any(load_original_states(t) is None for t in tasks):
        changes |= {"world.init_states": "builtin", "world.fixture_poses": "stored", "world.env_seed": None}
        notes.append(
            f"initial states: this package's, with their fixtures, where protocol {protocol.name} has those that "
            "LIBERO publishes (init_states in ~/.libero/config.yaml)"
        )
    return protocol.changed(changes), notes


def initial_states(
    task: Task, scene: Scene, protocol: EvalProtocol, indices: Sequence[int], stored: np.ndarray
) -> np.ndarray:
    """Return the states in which episodes of a protocol start, fixtures as the original's resets draw them.

    Args:
        stored: Initial states of the task, rows that begin with [time, qpos, qvel].

    Returns:
        Rows [time, qpos, qvel, poses of the fixtures], one for each index.

    Raises:
        ConfigError: An initial state does not exist.
    """
    if not all(0 <= i < len(stored) for i in indices):
        raise ConfigError(f"{task.id} has initial states 0 to {len(stored) - 1}; got {list(indices)}")
    size = 1 + scene.model.nq + scene.model.nv
    poses = fixture_poses(task, scene, protocol, indices)
    return np.stack([np.concatenate([stored[i][:size], poses[i].ravel()]) for i in indices])


def fixture_poses(
    task: Task, scene: Scene, protocol: EvalProtocol, indices: Sequence[int]
) -> dict[int, np.ndarray]:
    """Return the poses of the fixtures at the start of episodes, (nfixtures, 7), by initial state."""
    if not scene.fixtures:
        return {i: np.zeros((0, 7)) for i in indices}
    loads = protocol.world.loads or 1
    if protocol.world.seeding == "once":
        drawn = list(drawn_fixtures(scene, protocol.env_seed(task, 0) or 0, max(indices) + 1, loads))
        return {i: drawn[i] for i in indices}
    return {i: OriginalResets(scene, protocol.env_seed(task, i) or 0, loads).reset() for i in set(indices)}


def run_protocol(
    base: EvalProtocol,
    image_size: tuple[int, ...],
    horizon: int,
    settle_steps: int,
    robot: str = DEFAULT_ROBOT,
    *,
    drawing: str | None = None,
    assets: str | None = None,
) -> EvalProtocol:
    """Return a protocol as it is run with a policy of this package.

    The policy sees upright images of the size that it was trained on, is told the words of the task's name, and
    predicts an action for each step. Under the package's `libero`, episodes have the run's own length, settling and
    robot.

    Args:
        image_size: Height and width of the policy's images, [pixels].
        horizon: Maximum number of control steps of an episode of the run.
        settle_steps: Number of steps before the policy acts in the run.
        robot: Model of the arm in the run.
        drawing: How the images were drawn that it was trained on; None for the models' default.
        assets: Models that are evaluated with, see `libero_env.assets.pack.select_pack`.
    """
    changes: dict[str, Any] = {
        "world.drawing": drawing or default_drawing(select_pack(assets)),
        "pixels.render_size": tuple(image_size),
        "pixels.orientation": "upright",
        "pixels.resize": "none",
        "pixels.resize_size": None,
        "pixels.crop": 1.0,
        "language.source": "file_name",
        "language.template": "{instruction}",
        "action.gripper": "as_predicted",
        "action.chunk": 1,
        "action.replan": 1,
    }
    if base == load_protocol("libero"):
        changes |= {"episode.horizon": horizon, "episode.settle_steps": settle_steps}
        changes["world.robot"] = robot
        changes["episode.settle_action"] = base.episode.settle_action if settle_steps else None
    return base.changed(changes)
