"""Simulations of a task that start as a protocol says."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from libero_env.assets.pack import BUILTIN, select_pack
from libero_env.assets.robot import DEFAULT_ROBOT
from libero_env.envs.batch import BatchEnv
from libero_env.envs.config import EnvConfig
from libero_env.init_states.original_resets import OriginalResets, drawn_fixtures
from libero_env.init_states.store import load_original_states
from libero_env.sim.scene import Scene, default_drawing
from libero_env.tasks import Task
from libero_eval.protocols.protocol import Card
from lifelong.errors import ConfigError, ProtocolMismatchError
from lifelong.evaluation.inputs import Obs

OBSERVATIONS = ("rgb", "proprioception", "ee_quat")


class ProtocolEnv:
    """A `BatchEnv` whose initial states are a protocol's, fixtures included.

    What an episode starts in depends on protocol, task and initial state alone, so that any part of the initial states
    can be run by itself.

    Attributes:
        env: The simulations.
        card: The protocol.
        num_envs: Number of simulations.
        scene: Compiled scene of the task.
        simulations: Physics and controllers.
        views: State view of each simulation.
    """

    def __init__(self, env: BatchEnv, card: Card):
        self.env, self.card, self.num_envs = env, card, env.num_envs
        self.scene, self.simulations, self.views = env.scene, env.simulations, env.views

    @property
    def task(self) -> Task:
        """Task that is simulated, as the protocol's perturbations change it."""
        return self.env.task

    @property
    def config(self) -> EnvConfig:
        """Configuration of the simulations."""
        return self.env.config

    @property
    def render_images(self) -> bool:
        """Whether images are rendered, as that of the simulations; may be set."""
        return self.env.render_images

    @render_images.setter
    def render_images(self, wanted: bool) -> None:
        self.env.render_images = wanted

    @property
    def atoms(self) -> tuple[str, ...]:
        """Atoms of the goal, in the order of `progress` in infos."""
        return self.env.atoms

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Obs, dict]:
        """Start episodes in the initial states of the option `init_state`, (num_envs,) indices.

        Raises:
            ConfigError: An initial state does not exist.
        """
        options = dict(options or {})
        if "init_state" not in options:
            return self.env.reset(seed=seed, options=options)
        options["outdated_controller"] = "reset" in self.card.episode.reset_order
        if self.card.world.fixture_poses == "stored":
            return self.env.reset(seed=seed, options=options)
        starts = np.broadcast_to(options["init_state"], (self.num_envs,)).tolist()
        rows = start_rows(self.env.base_task, self.env.base_scene, self.card, starts, self._stored())
        return self.env.reset(seed=seed, options={**options, "start": rows})

    def step(self, actions: np.ndarray) -> tuple[Obs, np.ndarray, np.ndarray, np.ndarray, dict]:
        """Apply actions, see `BatchEnv.step`."""
        return self.env.step(actions)

    def close(self) -> None:
        """Free the simulations."""
        self.env.close()

    def _stored(self) -> np.ndarray:
        """Return the initial states of the task that the protocol names, rows that begin with [time, qpos, qvel]."""
        if self.card.world.init_states == "builtin":
            return self.env.init_states
        states = load_original_states(self.env.base_task, self.env.base_scene)
        if states is None:
            raise ConfigError(
                f"{self.env.task.id}: protocol {self.card.name} starts from the states that LIBERO publishes, which "
                "are not here: name LIBERO's folder init_files under init_states in ~/.libero/config.yaml"
            )
        return states


def make_env(
    task: Task,
    count: int,
    protocol: Card,
    *,
    cameras: Sequence[str] | None = None,
    observations: Sequence[str] = OBSERVATIONS,
    threads: int = 0,
    assets: str | None = None,
    drawing: str | None = "protocol",
    backend: str | None = None,
) -> ProtocolEnv:
    """Build the environment of a task under a protocol.

    Args:
        task: Task.
        count: Number of simulations.
        protocol: Protocol.
        cameras: Cameras that are rendered; by default the protocol's.
        observations: Names of observations, see `libero_env.sim.observations`.
        threads: Number of threads of the simulations; 0 is one for each core.
        assets: Models, see `libero_env.envs.config.EnvConfig`.
        drawing: How images are drawn; by default as the protocol says, None for the models' default.
        backend: The protocol's back end with its settings, such as `warp,device=cuda:1`; by default without any.
    """
    world = protocol.world
    size = protocol.pixels.render_size
    assert size is not None, "the protocol has been checked by require()"
    env = BatchEnv(
        task,
        count,
        num_threads=threads,
        cameras=protocol.pixels.cameras if cameras is None else tuple(cameras),
        camera_size=size,
        horizon=protocol.steps(task) + protocol.settle_steps,
        observations=tuple(observations),
        controller=world.controller,
        control_delta=world.delta,
        semantics=world.predicates,
        assets=assets,
        drawing=world.drawing if drawing == "protocol" else drawing,
        robot=world.robot or DEFAULT_ROBOT,
        observed=protocol.episode.observed,
        backend=world.backend if backend is None else backend,
        perturb=world.perturb,
    )
    return ProtocolEnv(env, protocol)


def resolve_world(card: Card, tasks: Sequence[Task], assets: str | None = None) -> tuple[Card, list[str]]:
    """Return a card with the models and initial states that are here, and a line for each that is not as it says.

    Args:
        card: Protocol.
        tasks: Tasks that are to be run.
        assets: Models that the user has chosen, see `libero_env.assets.pack.select_pack`.

    Raises:
        ProtocolMismatchError: The models have another digest than the card names.
    """
    changes: dict[str, Any] = {}
    notes: list[str] = []
    pack = select_pack(assets)
    digest = getattr(pack, "digest", None)
    if card.world.models_digest is not None and card.world.models_digest != digest:
        raise ProtocolMismatchError(
            f"world.models_digest: protocol {card.name} has {card.world.models_digest}, the models here {digest}"
        )
    here = "builtin" if pack.name == BUILTIN else "original"
    if card.world.models not in ("any", here):
        changes["world.models"] = here
        notes.append(f"models: {here}, where protocol {card.name} has {card.world.models} (see --assets)")
    if card.world.init_states == "original" and any(load_original_states(t) is None for t in tasks):
        changes |= {"world.init_states": "builtin", "world.fixture_poses": "stored", "world.env_seed": None}
        notes.append(
            f"initial states: this package's, with their fixtures, where protocol {card.name} has those that LIBERO "
            "publishes (init_states in ~/.libero/config.yaml)"
        )
    return card.changed(changes), notes


def start_rows(task: Task, scene: Scene, card: Card, starts: Sequence[int], stored: np.ndarray) -> np.ndarray:
    """Return the states in which episodes of a protocol start.

    Args:
        task: Task.
        scene: Compiled scene of the task.
        card: Protocol whose fixtures are drawn.
        starts: Indices of the initial states.
        stored: Initial states of the task, rows that begin with [time, qpos, qvel].

    Returns:
        Rows [time, qpos, qvel, poses of the fixtures], one for each start.

    Raises:
        ConfigError: An initial state does not exist.
    """
    if not all(0 <= i < len(stored) for i in starts):
        raise ConfigError(f"{task.id} has initial states 0 to {len(stored) - 1}; got {list(starts)}")
    size = 1 + scene.model.nq + scene.model.nv
    poses = fixture_poses(task, scene, card, starts)
    return np.stack([np.concatenate([stored[i][:size], poses[i].ravel()]) for i in starts])


def fixture_poses(task: Task, scene: Scene, card: Card, starts: Sequence[int]) -> dict[int, np.ndarray]:
    """Return the poses of the fixtures at the start of episodes, (nfixtures, 7), by initial state."""
    if not scene.fixtures:
        return {i: np.zeros((0, 7)) for i in starts}
    loads = card.world.loads or 1
    if card.world.seeding == "once":
        drawn = list(drawn_fixtures(scene, card.env_seed(task, 0) or 0, max(starts) + 1, loads))
        return {i: drawn[i] for i in starts}
    return {i: OriginalResets(scene, card.env_seed(task, i) or 0, loads).reset() for i in set(starts)}


def run_protocol(
    base: Card,
    image_size: tuple[int, ...],
    horizon: int,
    settle_steps: int,
    robot: str = DEFAULT_ROBOT,
    *,
    drawing: str | None = None,
    assets: str | None = None,
) -> Card:
    """Return a protocol as it is run with a policy of this package.

    The policy sees upright images of the size that it was trained on, and predicts an action for each step. Under
    `libero`, episodes have the run's own length, settling and robot.

    Args:
        base: Protocol.
        image_size: Height and width of the policy's images, [pixels].
        horizon: Maximum number of control steps of an episode of the run.
        settle_steps: Number of steps before the policy acts in the run.
        robot: Model of the arm in the run.
        drawing: How the images were drawn that it was trained on; None for the models' default.
        assets: Models that are evaluated with, see `libero_env.assets.pack.select_pack`.
    """
    own: dict[str, Any] = {
        "world.drawing": drawing or default_drawing(select_pack(assets)),
        "pixels.render_size": tuple(image_size),
        "pixels.orientation": "upright",
        "pixels.resize": "none",
        "pixels.resize_size": None,
        "pixels.crop": 1.0,
        "action.gripper": "as_predicted",
        "action.chunk": 1,
        "action.replan": 1,
    }
    if base.name == "libero":
        own |= {"episode.horizon": horizon, "episode.settle_steps": settle_steps}
        own["world.robot"] = robot
        own["episode.settle_action"] = base.settle_action if settle_steps else None
    return base.changed(own)
