"""Policies that can be evaluated: what each sees, and what acts for it. Those of runs, and the scripted expert."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from libero_env.storage import own_folder
from libero_env.tasks import Task
from libero_env.tasks.task import NUM_INIT_STATES
from libero_eval.protocols.adapter import ACTION_DIM, view_of
from libero_eval.protocols.clock import Clock, ClockedActor, Planner
from libero_eval.protocols.environment import OBSERVATIONS, ProtocolEnv, run_protocol
from libero_eval.protocols.protocol import EvalProtocol
from libero_eval.requests import Request
from libero_eval.words import AVOIDING
from lifelong.data.settings import CAMERAS
from lifelong.errors import ConfigError
from lifelong.evaluation.actors import Actor, Obs, PolicyActor
from lifelong.seeding import EVALUATION, generator

if TYPE_CHECKING:
    from libero_env.envs.batch import BatchEnv

# Initial states by which a checkpoint is chosen by default
SELECTION = range(NUM_INIT_STATES - 20, NUM_INIT_STATES)
PROBE_TOLERANCE = 0.01  # of actions in [-1, 1]: what another start of a server may change, by rounding


class PolicyUnderTest(ABC):
    """A policy to be evaluated.

    Args:
        request: What is asked for.

    Attributes:
        identity: Plain data that identify the policy.
        home: Folder of its results, which may be somebody else's.
        place: Where in it they are by default.
        tasks: Tasks of its run, if it has one.
        selection: Initial states by which it may have been chosen.
        on_cpu: Whether it is a network of this package on the CPU, whose bits depend on its number of threads.
        chunk: Number of actions of its answers; None where only they say it.
        inpaints: Whether it can continue a chunk of actions that is being executed.
        hears: Whether it can be told another instruction during an episode.
        relative: Whether it moves relative to the present pose only.
        cameras: Cameras that are rendered for it; None for the protocol's.
        observations: Names of its observations, see `libero_env.sim.observations`.
    """

    identity: Mapping[str, Any]
    home: Path = Path("eval")
    place: Path
    tasks: Sequence[Task] = ()
    selection: Sequence[int] = SELECTION
    on_cpu: bool = False
    chunk: int | None = None
    inpaints: bool = False
    hears: bool = False
    relative: bool = False
    cameras: tuple[str, ...] | None = None
    observations: tuple[str, ...] = OBSERVATIONS

    def __init__(self, request: Request):
        self.request = request

    def folder(self, *parts: str) -> Path:
        """Return the default folder of the results, or one in it; see `own_folder`."""
        return own_folder(self.home, *self.place.parts, *parts, error=ConfigError)

    def protocol(self, base: EvalProtocol) -> EvalProtocol:
        """Return the protocol as it is run with the policy, such as with the image size that it was trained on."""
        return base

    def env(self, task: Task, count: int, protocol: EvalProtocol) -> ProtocolEnv:
        """Build the environment of a task with the given number of simulations."""
        request = self.request
        return ProtocolEnv(
            protocol,
            task,
            count,
            cameras=self.cameras,
            observations=self.observations,
            threads=request.threads_of_worker,
            assets=request.assets,
            backend=request.backend,
        )

    @contextmanager
    def actor(self, task: Task, states: Sequence[int], protocol: EvalProtocol) -> Iterator[Actor]:
        """Yield the task's actor, which starts in the given initial states, on the protocol's clock."""
        clock = Clock.read(protocol.action.clock) if protocol.action.clock else None
        with self.planner(task, states, protocol) as planner:
            yield ClockedActor(
                planner,
                clock,
                self.seeds(task, states),
                hz=protocol.world.control_freq,
                still=protocol.episode.settle_action,
                relative=protocol.world.delta,
            )

    @abstractmethod
    def planner(
        self, task: Task, states: Sequence[int], protocol: EvalProtocol
    ) -> AbstractContextManager[Planner]:
        """Return the context manager of what plans in a task, from the given initial states."""

    def probe(self, protocol: EvalProtocol) -> tuple[float, ...] | None:
        """Return what the policy answers to a fixed observation; None where `identity` is enough, or chance decides."""
        return None

    def seeds(self, task: Task, states: Sequence[int]) -> list[tuple[int, ...]]:
        """Return the words from which the random numbers of each episode are made."""
        return [(self.request.seed, EVALUATION, task.index, state) for state in states]


class RunPolicy(PolicyUnderTest):
    """The policy of a run, evaluated with the images it was trained on: their size and drawing."""

    hears = relative = True

    def __init__(self, request: Request):
        from lifelong.evaluation.restore import restore  # with PyTorch

        super().__init__(request)
        run = restore(
            Path(request.policy_name), after=request.after, device=request.device, allow=request.allow
        )
        self.run = run
        self.identity = {"run": str(run.path), "after": run.learned, "weights": run.weights_digest}
        self.home, self.place = run.path, Path("eval", f"after_{run.learned:02d}")
        self.tasks = run.tasks
        self.selection = tuple(run.eval.init_states("curve"))
        self.on_cpu = run.device.type == "cpu"
        self.chunk, self.inpaints = run.policy.chunk, run.policy.inpaints
        self.cameras = tuple(CAMERAS[view] for view in run.policy.spec.views)

    def protocol(self, base: EvalProtocol) -> EvalProtocol:
        """Return the protocol with the run's images and one prediction for each step; see `PolicyUnderTest`."""
        run = self.run
        return run_protocol(
            base,
            run.policy.spec.image_size,
            run.eval.horizon,
            run.eval.settle_steps,
            run.data.robot,
            drawing=run.data.drawing,
            assets=self.request.assets,
        )

    @contextmanager
    def planner(self, task: Task, states: Sequence[int], protocol: EvalProtocol) -> Iterator[Planner]:
        """Yield the policy with a generator for each episode; see `PolicyUnderTest`."""
        run = self.run
        draws = [generator(*words) for words in self.seeds(task, states)]
        with run.acting(task) as policy:
            yield PolicyActor(policy, run.embed(task), run.device, run.eval.precision, draws, run.embed)


class ExpertPolicy(PolicyUnderTest):
    """The scripted expert, which sees the whole state: how much of a task can be done at all, or done safely."""

    chunk, hears, relative = 1, True, True

    def __init__(self, request: Request):
        from libero_env.demos.config import GENERATOR

        super().__init__(request)
        self.identity = {"policy": request.policy_name, "generator": GENERATOR}
        self.place = Path(request.policy_name)
        self.cameras = ("agentview",) if request.videos else ()
        self.observations = ("rgb",) if request.videos else ()

    @contextmanager
    def planner(self, task: Task, states: Sequence[int], protocol: EvalProtocol) -> Iterator[Planner]:
        """Yield an expert for each episode; see `PolicyUnderTest`."""
        avoid = self.request.policy_name == AVOIDING
        yield ExpertActor(self.seeds(task, states), tuple(map(view_of, self.cameras or ())), avoid)


class ExpertActor:
    """The scripted expert, one for each simulation; what it does depends on its seed and its simulation alone.

    Args:
        seeds: Seed of the motion style of each expert.
        views: Names of the images that recorded rollouts show.
        avoid: Whether they keep clear of what the goal does not need.
    """

    action_dim, replan, observes = ACTION_DIM, 1, "never"

    def __init__(self, seeds: Sequence[Sequence[int]], views: tuple[str, ...] = (), avoid: bool = False):
        self.seeds, self.views, self.avoid = seeds, views, avoid

    def watch(self, env: "BatchEnv") -> None:
        """Receive the simulations; see `WatchesWorld`."""
        from libero_env.expert import Expert, Shapes

        self._env, shapes = env, Shapes(env.scene)
        self._experts = [
            Expert(env.task, np.random.default_rng(seed), shapes=shapes, avoid=self.avoid)
            for seed in self.seeds
        ]

    def reset(self, num_envs: int) -> None:
        """Do nothing: experts are made for episodes; see `Planner`."""

    def hear(self, i: int, task: Task) -> None:
        """Let the expert of simulation i plan again, from its state; see `lifelong.evaluation.actors.Hears`."""
        self._experts[i].replan(task)

    def plan(self, obs: Obs, rows: Sequence[int]) -> np.ndarray:
        """Return the action of some experts, each a chunk of one; those that gave up hold still. See `Planner`."""
        chunks = np.zeros((len(rows), 1, ACTION_DIM))
        for chunk, i in zip(chunks, rows, strict=True):
            if not self._experts[i].failure_reason:
                chunk[0] = self._experts[i].act(self._env.views[i])
        return chunks
