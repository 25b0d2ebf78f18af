"""`libero eval` and `libero saliency`: how well a policy does, and where it looks."""

import argparse
import hashlib
import importlib
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lifelong.errors import ConfigError, LifelongError

if TYPE_CHECKING:
    from libero_env.tasks import Task
    from lifelong.evaluation.actors import Actor
    from lifelong.evaluation.environments import VectorEnv
    from lifelong.evaluation.restore import Restored
    from lifelong.evaluation.suite import Protocol, SuiteEvaluation

ROLLOUT = 4  # first word of the seeds of policies that act at random; those of runs are in lifelong.sequence
POLICY_HELP = (
    "a run's directory, one of its checkpoints, or module:function that gives an object with predict"
)


def register(subparsers: "argparse._SubParsersAction") -> None:
    """`libero eval POLICY` and `libero saliency RUN`"""
    parser = subparsers.add_parser("eval", help="success of a policy on tasks; goes on where it was stopped")
    parser.add_argument("policy", help=POLICY_HELP)
    parser.add_argument("--suite", nargs="+", metavar="SUITE", help="suites or tasks (default: the run's)")
    parser.add_argument(
        "--after", type=int, help="of a run: the policy after this task, from 0 (default: the last)"
    )
    parser.add_argument("--starts", default="all", help="all, reporting or selection (default: all 50)")
    parser.add_argument(
        "--episodes", type=int, help="the first so many of these starts (default: all of them)"
    )
    parser.add_argument(
        "--protocol", default="libero", help="libero, or openpi: its horizons, settling, pictures and names"
    )
    parser.add_argument("--horizon", type=int, help="most control steps (default: the protocol's)")
    parser.add_argument("--size", type=int, help="pixels of the pictures, for a policy that does not say so")
    parser.add_argument(
        "--names", choices=("native", "original"), help="of observations (default: the protocol's)"
    )
    parser.add_argument("--videos", type=int, default=0, metavar="N", help="record N episodes of each task")
    parser.add_argument("--seed", type=int, default=0, help="of policies that act at random (default: 0)")
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:1")
    parser.add_argument(
        "--threads", type=int, default=0, help="of the simulations (default: one for each core)"
    )
    parser.add_argument("--assets", help="`builtin`, or the folder of the original's models")
    parser.add_argument(
        "--out", type=Path, help="folder of the results (default: in the run, or eval/POLICY)"
    )
    parser.add_argument("--again", action="store_true", help="run what is in the folder too")
    parser.set_defaults(run=run_eval)
    look = subparsers.add_parser("saliency", help="pictures of where a policy looks along a rollout")
    look.add_argument("policy", type=Path, metavar="RUN", help="a run's directory, or one of its checkpoints")
    look.add_argument("--task", type=int, default=0, help="position in the run's sequence (default: 0)")
    look.add_argument("--after", type=int, help="the policy after this task, from 0 (default: the last)")
    look.add_argument("--start", type=int, default=0, help="initial state of the rollout (default: 0)")
    look.add_argument("--moments", type=int, default=6, help="pictures along the rollout (default: 6)")
    look.add_argument(
        "--stride", type=float, default=8.0, help="pixels of 128 between two places (default: 8)"
    )
    look.add_argument(
        "--horizon", type=int, default=200, help="most control steps of the rollout (default: 200)"
    )
    look.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:1")
    look.set_defaults(run=run_saliency)


@dataclass(frozen=True)
class Candidate:
    """A policy to be evaluated, wherever it comes from."""

    what: Mapping[str, Any]
    out: Path
    tasks: "Sequence[Task]"  # its own, if it has any
    selection: Sequence[int]  # starts by which it may have been chosen
    protocol: "Callable[[Protocol], Protocol]"  # what it says itself of pictures and steps
    env: "Callable[[Task, int, Protocol, argparse.Namespace], VectorEnv]"
    actor: "Callable[[Task, Sequence[int], Protocol], AbstractContextManager[Actor]]"


def run_eval(args: argparse.Namespace) -> None:
    """Evaluate what is missing; a line for each task as it is done, the mean, and where the numbers are."""
    from lifelong.evaluation.suite import HEADER, line, total_line

    plan = plan_eval(args)
    if args.again:
        shutil.rmtree(plan.out / "tasks", ignore_errors=True)
    print(HEADER)
    results = plan.run(say=lambda r: print(line(r), flush=True))
    print(total_line(results))
    print(plan.out / "eval.json")


def plan_eval(args: argparse.Namespace) -> "SuiteEvaluation":
    """What the arguments ask for.

    Raises:
        LiberoError: There is no such policy, task, protocol or set of starts.
    """
    from libero_env.cli.tasks import find_tasks
    from libero_env.errors import UnknownNameError
    from lifelong.evaluation.suite import PROTOCOLS, SuiteEvaluation, starts

    if args.protocol not in PROTOCOLS:
        raise UnknownNameError("protocol", args.protocol, list(PROTOCOLS))
    found = _own_policy(args) if _is_callable(args.policy) else _run_policy(args)
    tasks = find_tasks(args.suite) if args.suite else found.tasks
    if not tasks:
        raise ConfigError("which tasks? Name a suite, such as --suite libero_object")
    protocol = found.protocol(PROTOCOLS[args.protocol])
    if args.horizon:
        protocol = replace(protocol, horizon=args.horizon)
    chosen = starts(args.starts, args.episodes, found.selection)
    return SuiteEvaluation(
        what={**found.what, "seed": args.seed},
        tasks=tasks,
        init_states=chosen,
        protocol=protocol,
        out=args.out or found.out,
        env=lambda task: found.env(task, len(chosen), protocol, args),
        actor=lambda task: found.actor(task, chosen, protocol),
        videos=args.videos,
        progress=sys.stderr.isatty(),
    )


def _is_callable(text: str) -> bool:
    return ":" in text and not Path(text).exists()


def _run_policy(args: argparse.Namespace) -> Candidate:
    """The policy of a run, evaluated with the pictures it was trained on."""
    from lifelong.evaluation.restore import restore

    found = restore(Path(args.policy), after=args.after, device=args.device)
    digest = hashlib.sha256(found.checkpoint.read_bytes()).hexdigest()[:16]
    settings = found.eval

    def protocol(p: "Protocol") -> "Protocol":
        if args.protocol == "libero":  # a run may have its own numbers there
            p = replace(p, horizon=settings.horizon, settle_steps=settings.settle_steps)
        return replace(p, camera_size=found.policy.spec.image_size, original=False)

    return Candidate(
        what={"run": str(found.path), "after": found.learned, "weights": digest},
        out=found.path / "eval" / f"after_{found.learned:02d}",
        tasks=found.tasks,
        selection=tuple(settings.init_states("curve")),
        protocol=protocol,
        env=lambda task, count, protocol, a: _run_env(found, task, count, protocol, a),
        actor=lambda task, states, _: _run_actor(found, task, states, args.seed),
    )


def _run_env(
    found: "Restored", task: "Task", count: int, protocol: "Protocol", args: argparse.Namespace
) -> "VectorEnv":
    from libero_env.envs.batch import BatchEnv
    from lifelong.data.settings import CAMERAS

    return BatchEnv(
        task,
        count,
        num_threads=args.threads,
        cameras=tuple(CAMERAS[view] for view in found.policy.spec.views),
        camera_size=protocol.camera_size,
        horizon=protocol.steps(task) + protocol.settle_steps,
        assets=args.assets,
    )


@contextmanager
def _run_actor(found: "Restored", task: "Task", states: Sequence[int], seed: int) -> "Iterator[Actor]":
    from lifelong.evaluation.actors import PolicyActor
    from lifelong.seeding import generator

    draws = [generator(seed, ROLLOUT, task.index, state) for state in states]
    with found.acting(task) as policy:
        yield PolicyActor(policy, found.embed(task), found.device, found.eval.precision, draws)


def _own_policy(args: argparse.Namespace) -> Candidate:
    """Anybody's policy; see `lifelong.evaluation.actors.CallableActor` for what it must have."""
    from libero_env.envs.batch import BatchEnv
    from lifelong.evaluation.actors import CallableActor
    from lifelong.evaluation.suite import SELECTION

    policy = load_callable(args.policy)
    cameras = tuple(getattr(policy, "cameras", ("agentview", "robot0_eye_in_hand")))
    views = tuple(f"{c.removeprefix('robot0_')}_rgb" for c in cameras)
    observations = tuple(getattr(policy, "observations", ("rgb", "proprioception", "ee_quat")))

    def protocol(p: "Protocol") -> "Protocol":
        size = (args.size, args.size) if args.size else tuple(getattr(policy, "camera_size", p.camera_size))
        return replace(
            p, camera_size=size, original=p.original if args.names is None else args.names == "original"
        )

    def env(task: "Task", count: int, p: "Protocol", a: argparse.Namespace) -> "VectorEnv":
        return BatchEnv(
            task,
            count,
            num_threads=a.threads,
            cameras=cameras,
            camera_size=p.camera_size,
            horizon=p.steps(task) + p.settle_steps,
            observations=observations,
            assets=a.assets,
        )

    @contextmanager
    def actor(task: "Task", states: Sequence[int], p: "Protocol") -> "Iterator[Actor]":
        yield CallableActor(policy, task.language, views, p.original)

    name = args.policy.replace(":", ".")
    return Candidate({"policy": args.policy}, Path("eval") / name, (), SELECTION, protocol, env, actor)


def load_callable(text: str) -> Any:
    """What `module:function` gives: an object with `predict`. Modules of the working directory are found.

    Raises:
        LifelongError: No such module or function, or what it gives has no `predict`.
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
            f"{text}() gives a {type(policy).__name__} without predict(observations) -> (B, 7) actions"
        )
    return policy


def run_saliency(args: argparse.Namespace) -> None:
    """Draw one contact sheet into the run's folder `saliency`, and its report anew."""
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
