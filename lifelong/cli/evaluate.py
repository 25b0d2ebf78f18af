"""`libero eval` and `libero saliency`: the success of a policy, and where it looks."""

import argparse
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from lifelong.errors import ConfigError

if TYPE_CHECKING:
    from lifelong.evaluation.suite import SuiteEvaluation

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
    parser.add_argument("--assets", help="`builtin`, `original`, or the folder of the original's models")
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
    from lifelong.evaluation.candidates import RunPolicy, UserPolicy
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
