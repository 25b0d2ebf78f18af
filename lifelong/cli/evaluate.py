"""`libero eval` and `libero saliency`: the success of a policy, and where it looks."""

import argparse
import hashlib
import importlib
import os
import shutil
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lifelong.errors import ConfigError, LifelongError

if TYPE_CHECKING:
    from libero_env.tasks import Task
    from lifelong.evaluation.actors import Actor
    from lifelong.evaluation.environments import VectorEnv
    from lifelong.evaluation.protocols import EvalProtocol
    from lifelong.evaluation.suite import SuiteEvaluation

ROLLOUT = 4  # first word of the seeds of stochastic policies; those of runs are in lifelong.sequence
POLICY_HELP = (
    "a run's directory, one of its checkpoints, or module:function that returns an object with predict"
)


def register(subparsers: "argparse._SubParsersAction") -> None:
    """Add the commands `libero eval POLICY` and `libero saliency RUN`."""
    _add_eval(subparsers)
    _add_saliency(subparsers)


def _add_eval(subparsers: "argparse._SubParsersAction") -> None:
    parser = subparsers.add_parser("eval", help="success of a policy on tasks; resumes where it was stopped")
    parser.add_argument("policy", help=POLICY_HELP)
    parser.add_argument("--suite", nargs="+", metavar="SUITE", help="suites or tasks (default: the run's)")
    parser.add_argument(
        "--after", type=int, help="of a run: the policy after this task, from 0 (default: the last)"
    )
    parser.add_argument("--starts", default="all", help="all, reporting or selection (default: all 50)")
    parser.add_argument(
        "--episodes", type=int, help="number of these starts, from the first on (default: all of them)"
    )
    parser.add_argument(
        "--protocol", default="libero", help="libero, or openpi with its horizons, settling, images and names"
    )
    parser.add_argument(
        "--horizon", type=int, help="maximum number of control steps (default: the protocol's)"
    )
    parser.add_argument("--size", type=int, help="image size in pixels, for a policy that does not define it")
    parser.add_argument(
        "--names", choices=("native", "original"), help="names of observations (default: the protocol's)"
    )
    parser.add_argument("--videos", type=int, default=0, metavar="N", help="record N episodes of each task")
    parser.add_argument("--seed", type=int, default=0, help="seed of stochastic policies (default: 0)")
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:1")
    parser.add_argument(
        "--threads", type=int, default=0, help="threads of the simulations (default: one for each core)"
    )
    parser.add_argument("--assets", help="`builtin`, or the folder of the original's models")
    parser.add_argument(
        "--out", type=Path, help="folder of the results (default: in the run, or eval/POLICY)"
    )
    parser.add_argument("--again", action="store_true", help="repeat what is done already")
    parser.set_defaults(run=run_eval)


def _add_saliency(subparsers: "argparse._SubParsersAction") -> None:
    parser = subparsers.add_parser("saliency", help="images of where a policy looks during a rollout")
    parser.add_argument(
        "policy", type=Path, metavar="RUN", help="a run's directory, or one of its checkpoints"
    )
    parser.add_argument("--task", type=int, default=0, help="position in the run's sequence (default: 0)")
    parser.add_argument("--after", type=int, help="the policy after this task, from 0 (default: the last)")
    parser.add_argument("--start", type=int, default=0, help="initial state of the rollout (default: 0)")
    parser.add_argument("--moments", type=int, default=6, help="number of images (default: 6)")
    parser.add_argument(
        "--stride",
        type=float,
        default=8.0,
        help="distance of two places in pixels of a 128-pixel image (default: 8)",
    )
    parser.add_argument(
        "--horizon", type=int, default=200, help="maximum number of control steps (default: 200)"
    )
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:1")
    parser.set_defaults(run=run_saliency)


class PolicyUnderTest(ABC):
    """A policy to be evaluated.

    Attributes:
        identity: Plain data that identify the policy.
        out: Default folder of the results.
        tasks: Tasks of its run, if it has one.
        selection: Initial states by which it may have been chosen.
    """

    identity: Mapping[str, Any]
    out: Path
    tasks: "Sequence[Task]" = ()
    selection: Sequence[int]

    @abstractmethod
    def protocol(self, base: "EvalProtocol") -> "EvalProtocol":
        """Return a protocol with the policy's own image size and steps."""

    @abstractmethod
    def env(self, task: "Task", count: int, protocol: "EvalProtocol") -> "VectorEnv":
        """Build the environment of a task with the given number of simulations."""

    @abstractmethod
    def actor(
        self, task: "Task", states: Sequence[int], protocol: "EvalProtocol"
    ) -> "AbstractContextManager[Actor]":
        """Return the context manager of the task's actor, which starts in the given initial states."""


def run_eval(args: argparse.Namespace) -> None:
    """Evaluate a policy; print a row for each task, the mean, and the file of the results."""
    from lifelong.evaluation.suite import HEADER, table_row, total_row

    plan = plan_eval(args)
    if args.again:
        shutil.rmtree(plan.out / "tasks", ignore_errors=True)
    print(HEADER)
    results = plan.run(on_result=lambda r: print(table_row(r), flush=True))
    print(total_row(results))
    print(plan.out / "eval.json")


def plan_eval(args: argparse.Namespace) -> "SuiteEvaluation":
    """Return the evaluation that the arguments describe.

    Raises:
        LiberoError: The policy, a task, the protocol or the set of initial states does not exist.
    """
    from libero_env.cli.tasks import find_tasks
    from libero_env.errors import UnknownNameError
    from lifelong.evaluation.protocols import PROTOCOLS, choose_init_states
    from lifelong.evaluation.suite import SuiteEvaluation

    if args.protocol not in PROTOCOLS:
        raise UnknownNameError("protocol", args.protocol, list(PROTOCOLS))
    policy = UserPolicy(args) if _is_callable(args.policy) else RunPolicy(args)
    tasks = find_tasks(args.suite) if args.suite else policy.tasks
    if not tasks:
        raise ConfigError("no tasks are given; name a suite, such as --suite libero_object")
    protocol = policy.protocol(PROTOCOLS[args.protocol])
    if args.horizon:
        protocol = replace(protocol, horizon=args.horizon)
    init_states = choose_init_states(args.starts, args.episodes, policy.selection)
    return SuiteEvaluation(
        identity={**policy.identity, "seed": args.seed},
        tasks=tasks,
        init_states=init_states,
        protocol=protocol,
        out=args.out or policy.out,
        env=lambda task: policy.env(task, len(init_states), protocol),
        actor=lambda task: policy.actor(task, init_states, protocol),
        videos=args.videos,
        progress=sys.stderr.isatty(),
    )


def _is_callable(text: str) -> bool:
    return ":" in text and not Path(text).exists()


class RunPolicy(PolicyUnderTest):
    """The policy of a run, evaluated with the image size it was trained on."""

    def __init__(self, args: argparse.Namespace):
        from lifelong.evaluation.restore import restore

        self.args = args
        self.run = restore(Path(args.policy), after=args.after, device=args.device)
        digest = hashlib.sha256(self.run.checkpoint.read_bytes()).hexdigest()[:16]
        self.identity = {"run": str(self.run.path), "after": self.run.learned, "weights": digest}
        self.out = self.run.path / "eval" / f"after_{self.run.learned:02d}"
        self.tasks = self.run.tasks
        self.selection = tuple(self.run.eval.init_states("curve"))

    def protocol(self, base: "EvalProtocol") -> "EvalProtocol":
        settings = self.run.eval
        if self.args.protocol == "libero":  # a run may have other values
            base = replace(base, horizon=settings.horizon, settle_steps=settings.settle_steps)
        return replace(base, camera_size=self.run.policy.spec.image_size, original=False)

    def env(self, task: "Task", count: int, protocol: "EvalProtocol") -> "VectorEnv":
        from libero_env.envs.batch import BatchEnv
        from lifelong.data.settings import CAMERAS

        return BatchEnv(
            task,
            count,
            num_threads=self.args.threads,
            cameras=tuple(CAMERAS[view] for view in self.run.policy.spec.views),
            camera_size=protocol.camera_size,
            horizon=protocol.steps(task) + protocol.settle_steps,
            assets=self.args.assets,
        )

    @contextmanager
    def actor(self, task: "Task", states: Sequence[int], protocol: "EvalProtocol") -> "Iterator[Actor]":
        from lifelong.evaluation.actors import PolicyActor
        from lifelong.seeding import generator

        run = self.run
        draws = [generator(self.args.seed, ROLLOUT, task.index, state) for state in states]
        with run.acting(task) as policy:
            yield PolicyActor(policy, run.embed(task), run.device, run.eval.precision, draws)


class UserPolicy(PolicyUnderTest):
    """A user-defined policy; see `lifelong.evaluation.actors.CallableActor` for its interface."""

    def __init__(self, args: argparse.Namespace):
        from lifelong.evaluation.protocols import SELECTION

        self.args, self.policy = args, load_callable(args.policy)
        self.cameras = tuple(getattr(self.policy, "cameras", ("agentview", "robot0_eye_in_hand")))
        self.identity = {"policy": args.policy}
        self.out = Path("eval") / args.policy.replace(":", ".")
        self.selection = SELECTION

    def protocol(self, base: "EvalProtocol") -> "EvalProtocol":
        args, size = self.args, tuple(getattr(self.policy, "camera_size", base.camera_size))
        if args.size:
            size = (args.size, args.size)
        original = base.original if args.names is None else args.names == "original"
        return replace(base, camera_size=size, original=original)

    def env(self, task: "Task", count: int, protocol: "EvalProtocol") -> "VectorEnv":
        from libero_env.envs.batch import BatchEnv

        default = ("rgb", "proprioception", "ee_quat")
        return BatchEnv(
            task,
            count,
            num_threads=self.args.threads,
            cameras=self.cameras,
            camera_size=protocol.camera_size,
            horizon=protocol.steps(task) + protocol.settle_steps,
            observations=tuple(getattr(self.policy, "observations", default)),
            assets=self.args.assets,
        )

    @contextmanager
    def actor(self, task: "Task", states: Sequence[int], protocol: "EvalProtocol") -> "Iterator[Actor]":
        from lifelong.evaluation.actors import CallableActor

        views = tuple(f"{camera.removeprefix('robot0_')}_rgb" for camera in self.cameras)
        yield CallableActor(self.policy, task.language, views, protocol.original)


def load_callable(text: str) -> Any:
    """Return the result of `module:function`, an object with `predict`. The working directory is searched too.

    Raises:
        LifelongError: The module or function does not exist, or its result has no `predict`.
    """
    module, _, name = text.partition(":")
    folder = os.getcwd()
    added = folder not in sys.path
    if added:
        sys.path.insert(0, folder)
    try:
        make = getattr(importlib.import_module(module), name)
    except (ModuleNotFoundError, AttributeError) as error:
        raise LifelongError(f"{text}: {error}; write module:function, such as my_policy:make") from error
    finally:
        if added:
            sys.path.remove(folder)
    policy = make()
    if not callable(getattr(policy, "predict", None)):
        raise LifelongError(
            f"{text}() returns a {type(policy).__name__} without predict(observations) -> (B, 7) actions"
        )
    return policy


def run_saliency(args: argparse.Namespace) -> None:
    """Draw a contact sheet in the run's folder `saliency`, and write the run's report again."""
    from lifelong.evaluation.saliency import SaliencySettings
    from lifelong.evaluation.saliency_sheet import draw_saliency
    from lifelong.report.page import write_report

    path = draw_saliency(
        args.policy,
        task=args.task,
        after=args.after,
        start=args.start,
        moments=args.moments,
        horizon=args.horizon,
        settings=SaliencySettings(stride=args.stride),
        device=args.device,
    )
    print(path)
    print(write_report([path.parents[1]]))
