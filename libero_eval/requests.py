"""What an evaluation is asked for: a policy, the episodes to run it in, and how they are run."""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator

from libero_env.cli.options import (
    Device,
    Field,
    FilePath,
    Horizon,
    Natural,
    Positional,
    Positive,
    Processes,
    ProcessesOrAll,
    Seconds,
    Seed,
    Side,
)
from libero_env.parallel import cpu_count
from libero_env.perturbations import format_perturbations, parse_perturbations
from libero_env.tasks.task import NUM_INIT_STATES
from libero_env.timing import ControlFreq
from libero_env.validation import validate_arguments
from lifelong.errors import ConfigError

KINDS = (
    *("layout", "distractors", "instruction", "camera", "light", "table", "background"),
    *("robot", "noise", "occlusion", "latency", "gain"),
)
SEVERITIES = (0.2, 0.4, 0.6, 0.8, 1.0)
EVENTS = (
    *("camera@lifted", "light@touched", "noise@touched"),
    *("object@step20", "receptacle@lifted", "distractor@step20"),
)
EVENT_SEVERITIES = (0.3, 0.6, 1.0)
HELD_OUT = 5  # demonstrations that relearning is measured on
CLOCK = "clock="  # beginning of a condition that is no perturbation
PAIRS = ("camera=0.4,light=0.4", "camera=0.4,robot=0.4", "light=0.4,noise=0.4")


def _check_run_folder(path: Path) -> Path:
    if path.is_file():  # a checkpoint is also a policy, but these commands measure a run
        raise ValueError(f"{path} is a file; give the directory of the run")
    return path


RunFolder = Annotated[FilePath, AfterValidator(_check_run_folder)]


@dataclass(frozen=True, kw_only=True)
class Request:
    """Episodes of a policy.

    Attributes:
        policy: A run's directory, one of its checkpoints, module:function that returns an object with predict, the
            address of a policy server: ws://host:port (openpi), vla-eval://..., gr00t://..., or `expert`,
            the scripted one, which as `expert-avoid` keeps clear of what the goal does not need.
        suite: Suites or tasks (default: the run's).
        after: Of a run: the policy after this task, from 0 (default: the last).
        starts: Initial states: all 50, or those by which a policy was not, or may have been, chosen.
        episodes: Number of these starts, from the first on (default: the protocol's, of `--starts all`; otherwise all).
        protocol: libero, openpi, ..., see `libero protocols list`; or a file of your own, my.yaml.
        perturb_seed: Seed of what perturbations draw.
        clock: Let inference take time: latency=120ms, and what is executed meanwhile, wait=rest,merge=replace,every=8
            (default: the protocol's, none).
        horizon: Maximum number of control steps (default: the protocol's).
        control_freq: Control steps per second, 20 or another that divides 500; steps are counted, so that a horizon
            then lasts shorter or longer (default: the protocol's).
        size: Image size in pixels, for a policy that does not define it.
        names: What a policy of your own receives: this package's observations, the original's, or the protocol's inputs
            (default: native for upright images, otherwise original).
        name: Name of the policy, such as pi0_step30000: part of its identity, and name of its default folder. Needed
            where a policy server does not say which policy it serves.
        videos: Record this number of episodes of each task.
        seed: Seed of stochastic policies.
        assets: `builtin`, `original`, or the folder of the original's models.
        robot: Arm: libero, or robosuite-1.4.1 (default: the protocol's, or that of the run).
        backend: Physics and pictures: mujoco, or warp on a GPU, with settings as in warp,device=cuda:1,contacts=256
            (default: the protocol's, mujoco).
        unit_starts: Episodes of a task that are run in one batch.
        policy_threads: Threads of a policy on the CPU (default: 1 for a run's).
        out: Folder of the results (default: in the run, or eval/POLICY; of what is not the plain protocol libero, a
            folder in it that says so).
        workers: Processes that share the work.
        retries: Further attempts after an error.
        device: auto, cpu, cuda, cuda:1.
        allow: Packages of others whose classes a run's configuration, or a result that is run again, may name (default:
            none; their code is executed), and addresses of servers that a result may name.
        threads: Threads of the simulations; 0: all cores, shared by the workers.
        timeout: Seconds until a policy server must answer.
        in_flight: Requests that a policy server gets before it has answered (default: one for each episode of a batch).
        again: Repeat what is done already.

    Raises:
        ConfigError: A value is of another kind or outside of its range.
    """

    policy: Positional[str | None] = None
    suite: tuple[str, ...] = ()
    after: Natural | None = None
    starts: Literal["all", "reporting", "selection"] = "all"
    episodes: Positive | None = None
    protocol: str = "libero"
    perturb_seed: Seed = 0
    clock: str | None = None
    horizon: Horizon | None = None
    control_freq: ControlFreq | None = None
    size: Side | None = None
    names: Literal["native", "original", "protocol"] | None = None
    name: Annotated[str, Field(min_length=1, max_length=100)] | None = None
    videos: Natural = 0
    seed: Seed = 0
    assets: str | None = None
    robot: str | None = None
    backend: str | None = None
    unit_starts: Positive = 10  # measured by experiments/kills/unit_sizes.py
    policy_threads: Processes | None = None
    out: FilePath | None = None
    workers: Processes = 1
    retries: Annotated[int, Field(ge=0, le=1000)] = 1
    device: Device = "auto"
    allow: tuple[str, ...] = ()
    threads: ProcessesOrAll = 0
    timeout: Seconds = 300.0
    in_flight: Positive | None = None
    again: bool = False

    def __post_init__(self) -> None:
        validate_arguments(type(self), vars(self), error=ConfigError)

    @property
    def threads_of_worker(self) -> int:
        """Number of threads of the simulations in each process."""
        return self.threads or max(1, cpu_count() // self.workers)

    @property
    def policy_name(self) -> str:
        """Word that names the policy.

        Raises:
            ConfigError: There is none.
        """
        if self.policy is None:
            raise ConfigError("no policy is named; it comes first: libero eval RUN_DIR --suite libero_goal")
        return self.policy


@dataclass(frozen=True, kw_only=True)
class EvalRequest(Request):
    """An evaluation of a policy, or of a result, eval.json, which is run again; see `libero_eval.evaluate`.

    Attributes:
        perturb: Perturbations, such as camera=0.3,light=0.5, see `libero perturb list` (default: the protocol's, none).
        event: Perturbations that begin during an episode, KIND=SEVERITY@TRIGGER, such as camera=0.5@lifted; triggers:
            step40, 25%, touched, lifted, over_goal.
        until: Stop as soon as this is known: width=0.05, the mean success within an interval of this width; or
            against=RESULT,margin=0.05, whether it is above or below that of a result less a margin (default: never).
        despite: Of a result that is run again: what may differ from then, such as mujoco (default: nothing).
    """

    perturb: str | None = None
    event: tuple[str, ...] = ()
    until: str | None = None
    despite: tuple[str, ...] = ()

    def given(self, names: Iterable[str]) -> list[str]:
        """Return the options of these names that have other values than the defaults."""
        plain = EvalRequest()
        return [
            f"--{name.replace('_', '-')}" for name in names if getattr(self, name) != getattr(plain, name)
        ]


@dataclass(frozen=True, kw_only=True)
class RobustnessRequest(Request):
    """Evaluations of a policy under every kind of perturbation at several severities.

    Attributes:
        episodes: Number of the starts, from the first on.
        kinds: Kinds of perturbations, see `libero perturb list`; those that begin later with their trigger:
            camera@lifted; clock, whose severity is the latency in seconds (default: twelve kinds).
        severities: Severities above 0, at most 1 (default: 0.2 0.4 0.6 0.8 1).
        pairs: Two perturbations at once, of kinds and severities that are also run alone (default: three pairs).
        events: Other defaults: six events during the episodes, at severities 0.3 0.6 1, without pairs.
    """

    episodes: Positive | None = 10
    kinds: tuple[str, ...] | None = None
    severities: tuple[Annotated[float, Field(ge=0, le=1)], ...] | None = None
    pairs: tuple[str, ...] | None = None
    events: bool = False

    def condition(self, text: str, out: Path) -> EvalRequest:
        """Return the evaluation under some perturbations, or a latency, in a folder of its own."""
        shared = {f.name: getattr(self, f.name) for f in fields(Request)}
        if text.startswith(CLOCK):
            clock = f"latency={text.removeprefix(CLOCK)}s,{self.clock or ''}"
            return EvalRequest(**{**shared, "perturb": "", "clock": clock, "out": out})
        parts = parse_perturbations(text, events=True)
        events = tuple(str(one) for one in parts if one.trigger)
        start = format_perturbations(one for one in parts if not one.trigger)
        return EvalRequest(**{**shared, "perturb": start, "event": events, "out": out})


@dataclass(frozen=True, kw_only=True)
class _Checked:
    """Options whose values are checked when they are given; messages begin with the command's name.

    Attributes:
        device: auto, cpu, cuda, cuda:1.
        allow: Packages of others whose classes a run's configuration may name (default: none; their code is executed).
    """

    device: Device = "auto"
    allow: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        command = type(self).__name__.removesuffix("Request").lower()
        validate_arguments(type(self), vars(self), prefix=(command,), error=ConfigError)


@dataclass(frozen=True, kw_only=True)
class RelearnRequest(_Checked):
    """Measure how many steps a forgotten task of a run takes until it is back, and write the run's report again.

    Attributes:
        run: The directory of a finished run.
        tasks: Positions in the run's sequence, from 0 (default: all but the last).
        steps: Steps until it is given up.
        every: Steps between measurements.
        tolerance: Share by which the error may exceed that just after learning, or the difference by which success may
            fall short of it.
        held_out: Demonstrations to measure the error on, after those that were learned from (default: 5).
        episodes: Rollouts to measure success by, instead of the error; 0: the error.
        demos: Folder of the demonstrations that the run learned from (default: what its configuration names, which is
            only read, or the cache).
        initial: The pretrained weights that the run began with: a finished run, or one of its checkpoints.

    Raises:
        ConfigError: A value is of another kind or outside of its range.
    """

    run: Positional[RunFolder]
    tasks: tuple[Natural, ...] = ()
    steps: Positive = 400
    every: Positive = 20
    tolerance: Annotated[float, Field(ge=0, le=10)] = 0.05
    held_out: Annotated[int, Field(ge=1, le=1000)] | None = None
    episodes: Annotated[int, Field(ge=0, le=NUM_INIT_STATES)] = 0
    demos: FilePath | None = None
    initial: FilePath | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.episodes and self.held_out:
            raise ConfigError(
                "--held-out is of the error, and --episodes measures success instead; leave one of them out"
            )

    @property
    def demos_held_out(self) -> int:
        """Number of demonstrations to measure on; none where rollouts are measured."""
        return 0 if self.episodes else self.held_out or HELD_OUT


@dataclass(frozen=True, kw_only=True)
class DiagnoseRequest(_Checked):
    """Measure why a run forgets: what learning moved, and which part of the policy brings an old task back.

    Attributes:
        run: The directory of a run with checkpoints after its tasks.
        held_out: Demonstrations to measure on, after those that were learned from.
        episodes: Rollouts to measure success by, besides the error; 0: none.
        demos: Folder of the demonstrations that the run learned from (default: what its configuration names, which is
            only read, or the cache).

    Raises:
        ConfigError: A value is of another kind or outside of its range.
    """

    run: Positional[RunFolder]
    held_out: Annotated[int, Field(ge=1, le=1000)] = 5
    episodes: Annotated[int, Field(ge=0, le=NUM_INIT_STATES)] = 0
    demos: FilePath | None = None


@dataclass(frozen=True, kw_only=True)
class SaliencyRequest(_Checked):
    """Draw where a policy looks during a rollout, and write the run's report again.

    Attributes:
        run: A run's directory, or one of its checkpoints.
        task: Position in the run's sequence.
        after: The policy after this task, from 0 (default: the last).
        start: Initial state of the rollout.
        moments: Number of images.
        stride: Distance of two places in pixels of a 128-pixel image.
        horizon: Maximum number of control steps (default: the run's).
    """

    run: Positional[FilePath]
    task: Natural = 0
    after: Natural | None = None
    start: Annotated[int, Field(ge=0, lt=NUM_INIT_STATES)] = 0
    moments: Annotated[int, Field(ge=1, le=100)] = 6
    stride: Annotated[float, Field(ge=1, le=128)] = 8.0
    horizon: Horizon | None = None


@dataclass(frozen=True, kw_only=True)
class ViewRequest(_Checked):
    """Show a scene in the browser: starts, perturbations, a demonstration frame by frame, or a policy that acts.

    Attributes:
        what: A task or suite, a task file, a demonstration file that ends in .hdf5, or a run, whose policy acts.
        policy: What acts, as of `libero eval` (default: expert).
        start: Initial state that is shown first.
        perturb: Perturbations that are shown first, such as camera=0.3,light=0.5.
        perturb_seed: Seed of what perturbations draw.
        protocol: Protocol of the episodes, as of `libero eval`.
        bddl: Task file of demonstrations that do not state their task.
        seed: Seed of stochastic policies.
        assets: `builtin`, `original`, or the folder of the original's models.
        host: Address to listen on; others than this machine's own let everybody who reaches it in.
        port: Port to listen on, 0 for a free one.

    Raises:
        ConfigError: A value is of another kind or outside of its range.
    """

    what: Positional[str]
    policy: str | None = None
    start: Annotated[int, Field(ge=0, lt=NUM_INIT_STATES)] = 0
    perturb: str = ""
    perturb_seed: Seed = 0
    protocol: str = "libero"
    bddl: FilePath | None = None
    seed: Seed = 0
    assets: str | None = None
    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 8080
