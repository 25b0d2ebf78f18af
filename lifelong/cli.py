"""The `libero` command. Each subcommand is a small function that imports what it needs when it runs."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from libero_env.errors import LiberoError
from lifelong import cli_assets, cli_demos, cli_eval, cli_objects, cli_tasks, cli_teleop
from lifelong.errors import LifelongError

Subparsers = argparse._SubParsersAction  # argparse has no public name for it


def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand.

    Args:
        argv: the words after `libero`; those of the process by default.

    Returns:
        Exit status: 0, 1 where the command found something broken, 2 for an error (told in one line).
    """
    parser = build_parser()
    args = parser.parse_args(argv)
    try:
        return args.run(args) or 0
    except (LiberoError, LifelongError, OSError) as error:
        print(f"libero: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("libero: interrupted", file=sys.stderr)
        return 130


def build_parser() -> argparse.ArgumentParser:
    """The parser with every subcommand; each stores its function as `run`."""
    parser = argparse.ArgumentParser(prog="libero", description="Lifelong robot learning on LIBERO.")
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND")
    for register in COMMANDS:
        register(subparsers)
    return parser


def register_doctor(subparsers: Subparsers) -> None:
    """`libero doctor`"""
    parser = subparsers.add_parser("doctor", help="what this machine has and lacks, and how to mend it")
    parser.add_argument("--gl", action="store_true", help="only draw a frame")
    parser.set_defaults(run=run_doctor)


def run_doctor(args: argparse.Namespace) -> int:
    """Print the findings; 1 where something essential is broken."""
    import libero_env.doctor as environment
    import lifelong.doctor as learning

    findings = environment.examine(gl_only=args.gl)
    if not args.gl:
        findings += learning.examine()
    print(environment.render_findings(findings))
    return int(environment.is_broken(findings))


def register_tasks(subparsers: Subparsers) -> None:
    """`libero tasks list|show|init-states|certify|lint|new|preview`"""
    parser = subparsers.add_parser("tasks", help="the tasks of the benchmark")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    listing = commands.add_parser("list", help="the tasks of one suite, or of all")
    listing.add_argument("suite", nargs="?", help="such as libero_object")
    listing.add_argument("--order", type=int, default=0, help="one of the published sequences (0 to 20)")
    listing.set_defaults(run=run_tasks_list)
    show = commands.add_parser("show", help="the BDDL of a task")
    show.add_argument("task", help="such as libero_object/3, the task's name, or a file of your own")
    show.set_defaults(run=run_tasks_show)
    states = commands.add_parser(
        "init-states", help="make the 50 stored initial states of a suite or task file anew"
    )
    states.add_argument("suite", help="such as libero_object, or a file that ends in .yaml or .bddl")
    states.add_argument(
        "--out",
        type=Path,
        help="folder for the .npz files (default: those the package ships; of a file, the cache)",
    )
    states.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, help="processes (default: one per core)"
    )
    states.set_defaults(run=run_tasks_init_states)
    cli_tasks.register(commands)


def run_tasks_list(args: argparse.Namespace) -> None:
    """One line per task."""
    from libero_env.tasks import get_suite, suite_names

    names = [args.suite] if args.suite else suite_names()
    tasks = {task.id: task for name in names for task in get_suite(name).order(args.order)}
    for task in tasks.values():
        print(f"{task.id:18} {task.language}")


def run_tasks_show(args: argparse.Namespace) -> None:
    """The task file, as generated."""
    from libero_env.tasks import get_task

    print(get_task(args.task).bddl_text, end="")


def run_tasks_init_states(args: argparse.Namespace) -> None:
    """Write the files, one for each suite that the tasks come from, and say where they are."""
    from libero_env.init_states import cache_init_states, shipped_path, write_suite
    from libero_env.tasks import get_suite
    from libero_env.tasks.suites import ENDINGS

    if args.suite.endswith(ENDINGS) and not args.out:
        for task in cli_tasks.find_tasks([args.suite]):
            print(cache_init_states(task))
        return
    tasks = (
        cli_tasks.find_tasks([args.suite]) if args.suite.endswith(ENDINGS) else get_suite(args.suite).tasks
    )
    for suite in dict.fromkeys(task.suite for task in tasks):
        path = args.out / f"{suite}.npz" if args.out else shipped_path(suite)
        write_suite(path, [task for task in tasks if task.suite == suite], args.jobs)
        print(path)


def register_report(subparsers: Subparsers) -> None:
    """`libero report RUN_DIR...`"""
    parser = subparsers.add_parser("report", help="a page about one run, or about several side by side")
    parser.add_argument(
        "run_dirs", nargs="+", type=Path, metavar="RUN_DIR", help="such as runs/libero_object/ewc/..."
    )
    parser.add_argument(
        "--out",
        type=Path,
        help="the page, or a folder for it (default: report.html in the run directory, or here for several)",
    )
    parser.set_defaults(run=run_report)


def run_report(args: argparse.Namespace) -> None:
    """Write the page and say where it is."""
    from lifelong.report import write_report

    print(write_report(args.run_dirs, args.out))


COMMANDS: tuple[Callable[[Subparsers], None], ...] = (
    register_doctor,
    register_tasks,
    cli_demos.register,
    cli_assets.register,
    cli_objects.register,
    cli_teleop.register,
    cli_eval.register,
    register_report,
)

if __name__ == "__main__":
    sys.exit(main())
