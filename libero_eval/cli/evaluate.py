"""`libero eval`: the success of a policy."""

import argparse
import io
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, suppress
from typing import TYPE_CHECKING

from libero_env.cli import arguments, ending
from libero_env.memory import require_memory
from libero_env.parallel import cpu_count
from libero_eval.cli import options
from libero_eval.cli.plan import plan_eval
from lifelong.errors import ConfigError

if TYPE_CHECKING:
    from libero_eval.evaluation_file import EvaluationResult
    from libero_eval.work.suite import SuiteEvaluation

POLICY_HELP = (
    "a run's directory, one of its checkpoints, module:function that returns an object with predict, the address of a "
    "policy server: ws://host:port (openpi, libero serve), vla-eval://..., gr00t://..., or `expert`, the scripted one"
)


def register(subparsers: "argparse._SubParsersAction") -> None:
    """Add the command `libero eval POLICY`."""
    parser = subparsers.add_parser("eval", help="success of a policy on tasks; resumes where it was stopped")
    parser.add_argument(
        "policy", nargs="?", help=f"{POLICY_HELP}; or a result, eval.json, which is run again"
    )
    measured = parser.add_argument_group("what is measured")
    add_episode_options(measured)
    measured.add_argument(
        "--perturb",
        metavar="KIND=SEVERITY,...",
        help="perturbations, such as camera=0.3,light=0.5, see `libero perturb list` (default: the protocol's, none)",
    )
    work = parser.add_argument_group("how it is run")
    add_work_options(work)
    work.add_argument(
        "--despite",
        nargs="+",
        default=[],
        metavar="NAME",
        help="of a result that is run again: what may differ from then, such as mujoco (default: nothing)",
    )
    work.add_argument(
        "--status",
        type=arguments.path,
        metavar="OUT",
        help="only say how far the evaluation in this folder is",
    )
    parser.set_defaults(run=run_eval)


def add_episode_options(parser: argparse._ArgumentGroup) -> None:
    """Add what decides the numbers: tasks, starts, protocol, models."""
    parser.add_argument("--suite", nargs="+", metavar="SUITE", help="suites or tasks (default: the run's)")
    options.add_after(parser, "of a run: ")
    parser.add_argument(
        "--starts", choices=("all", "reporting", "selection"), default="all", help="(default: all 50)"
    )
    parser.add_argument(
        "--episodes",
        type=arguments.positive,
        help="number of these starts, from the first on (default: all of them)",
    )
    parser.add_argument(
        "--protocol",
        default="libero",
        metavar="CARD",
        help="libero, openpi, ..., see `libero protocols list`; or a card of your own, my.yaml (default: libero)",
    )
    parser.add_argument(
        "--perturb-seed", type=arguments.seed, default=0, help="seed of what perturbations draw (default: 0)"
    )
    parser.add_argument(
        "--horizon", type=arguments.horizon, help="maximum number of control steps (default: the protocol's)"
    )
    parser.add_argument(
        "--size", type=arguments.side, help="image size in pixels, for a policy that does not define it"
    )
    parser.add_argument(
        "--names",
        choices=("native", "original", "protocol"),
        help="what a policy of your own receives: this package's observations, the original's, or the protocol's "
        "inputs (default: native for upright images, otherwise original)",
    )
    parser.add_argument(
        "--videos", type=arguments.whole(0), default=0, metavar="N", help="record N episodes of each task"
    )
    parser.add_argument(
        "--seed", type=arguments.seed, default=0, help="seed of stochastic policies (default: 0)"
    )
    parser.add_argument("--assets", help="`builtin`, `original`, or the folder of the original's models")
    parser.add_argument(
        "--robot", help="arm: libero, or robosuite-1.4.1 (default: the protocol's, or that of the run)"
    )
    parser.add_argument(
        "--backend",
        metavar="NAME",
        help="physics and pictures: mujoco, or warp on a GPU, with settings as in warp,device=cuda:1,contacts=256 "
        "(default: the protocol's, mujoco)",
    )
    parser.add_argument(
        "--unit-starts",
        type=arguments.positive,
        metavar="N",
        help="episodes of a task that are run in one batch (default: 10)",
    )
    parser.add_argument(
        "--policy-threads",
        type=arguments.processes,
        metavar="N",
        help="threads of a policy on the CPU (default: 1 for a run's)",
    )


def add_work_options(parser: argparse._ArgumentGroup) -> None:
    """Add what does not change the numbers: folder, processes, device."""
    parser.add_argument(
        "--out", type=arguments.path, help="folder of the results (default: in the run, or eval/POLICY)"
    )
    parser.add_argument(
        "--workers",
        type=arguments.processes,
        default=1,
        metavar="N",
        help="processes that share the work (default: 1)",
    )
    parser.add_argument(
        "--retries",
        type=arguments.whole(0, 1000),
        default=1,
        metavar="N",
        help="further attempts after an error (default: 1)",
    )
    options.add_loading(parser)
    parser.add_argument(
        "--threads",
        type=arguments.processes_or_all,
        default=0,
        help="threads of the simulations (default: all cores, shared by the workers)",
    )
    parser.add_argument(
        "--timeout",
        type=arguments.seconds,
        default=300.0,
        help="seconds until a policy server must answer (default: 300)",
    )
    parser.add_argument(
        "--in-flight",
        type=arguments.positive,
        metavar="N",
        help="requests that a policy server gets before it has answered (default: one for each episode of a batch)",
    )
    parser.add_argument("--again", action="store_true", help="repeat what is done already")


def run_eval(args: argparse.Namespace) -> None:
    """Evaluate a policy; print a row for each task, the mean, and the file of the results."""
    from libero_eval.evaluation_file import FILE_NAME
    from libero_eval.work.progress import HEADER, table_row, total_rows
    from libero_eval.work.status import describe_status
    from libero_eval.work.worker import Worker
    from libero_eval.work.workers import Crew

    if args.status:
        print(describe_status(args.status))
        return
    if args.policy is None:
        raise ConfigError("no policy is named; it comes first: libero eval RUN_DIR --suite libero_goal")
    args.threads = args.threads or max(1, cpu_count() // args.workers)
    plan = plan_eval(args)
    workers = min(args.workers, len(plan.units))
    remedy = "fewer --workers, --unit-starts or --videos, or a smaller --size"
    require_memory(plan.memory(workers), f"an evaluation by {workers} processes", remedy)
    if args.again:
        plan.folder.clear()
    print(HEADER, flush=True)
    helpers = argparse.Namespace(**(vars(args) | {"again": False}))
    try:
        with policy_threads(plan), Crew(workers - 1, help_eval, helpers) as crew:
            result = Worker(
                plan,
                on_result=lambda row: print(table_row(row), flush=True),
                on_progress=_print_progress,
                on_wait=crew.tend,
            ).run()
    except KeyboardInterrupt as error:
        error.add_note(f"{plan.out} keeps what is done; the same command goes on")
        raise
    for row in total_rows(result.tasks):
        print(row)
    print(plan.out / FILE_NAME)
    _warn_of_differences(result)


def _warn_of_differences(result: "EvaluationResult") -> None:
    for name in ("renderer", "instruction_set"):
        if isinstance(values := result.environment.get(name), list):
            found = ", ".join(map(str, values))
            print(f"the processes differ in {name} ({found}): bits may too", file=sys.stderr)


def help_eval(args: argparse.Namespace) -> None:
    """Work on the evaluation that another process of this command prints; errors go to the standard error."""
    from libero_eval.work.worker import Worker

    with suppress(KeyboardInterrupt), ending.interruptible():
        try:
            with redirect_stderr(io.StringIO()):  # the other process says the same
                plan = plan_eval(args)
            with policy_threads(plan):
                Worker(plan).run()
        except Exception as error:  # noqa: BLE001 - told by kind
            sys.exit(ending.report(error, who="a worker ended: "))


@contextmanager
def policy_threads(plan: "SuiteEvaluation") -> Iterator[None]:
    """Give PyTorch the number of threads that the evaluation names; their number changes the bits of a policy."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(plan.policy_threads or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _print_progress(progress: object) -> None:
    from tqdm import tqdm

    tqdm.write(str(progress), file=sys.stderr)  # above the bar of a terminal
