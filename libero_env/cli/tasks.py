"""`libero tasks`: list, show, certify, lint, create and preview tasks; make their initial states."""

import argparse
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from libero_env.cli import arguments, tasks_new
from libero_env.cli.arguments import Subparsers

if TYPE_CHECKING:
    from libero_env.design.lint.report import Finding
    from libero_env.tasks import Task

LEVELS = ("error", "warning", "info")


def register(subparsers: Subparsers) -> None:
    """Add the command `libero tasks`."""
    parser = subparsers.add_parser("tasks", help="the tasks of the benchmark")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    listing = commands.add_parser("list", help="the tasks of one suite, or of all")
    listing.add_argument("suite", nargs="?", help="such as libero_object")
    listing.add_argument(
        "--order", type=arguments.whole(0), default=0, help="one of the published sequences (0 to 20)"
    )
    listing.set_defaults(run=run_tasks_list)
    show = commands.add_parser("show", help="the BDDL of a task")
    show.add_argument("task", help="such as libero_object/3, the task's name, or a task file")
    show.set_defaults(run=run_tasks_show)
    states = commands.add_parser(
        "init-states", help="generate the 50 stored initial states of a suite or task file again"
    )
    states.add_argument("suite", help="such as libero_object, or a file that ends in .yaml or .bddl")
    states.add_argument(
        "--out",
        type=arguments.path,
        help="folder for the .npz files (default: those in the package; for a file, the cache)",
    )
    states.add_argument(
        "--jobs",
        type=arguments.processes,
        default=os.cpu_count() or 1,
        help="number of processes (default: one per core)",
    )
    states.set_defaults(run=run_tasks_init_states)
    _register_checks(commands)
    tasks_new.register(commands)


def _register_checks(commands: Subparsers) -> None:
    """Add the commands `libero tasks certify` and `libero tasks lint`."""
    certify = commands.add_parser(
        "certify", help="measure the success of the expert; resumes where it was stopped"
    )
    _add_tasks(certify)
    certify.add_argument(
        "--states",
        type=arguments.whole(1, 50),
        default=50,
        help="initial states of each task, 1 to 50 (default: 50)",
    )
    certify.add_argument(
        "--jobs",
        type=arguments.processes_or_all,
        default=0,
        help="number of processes (default: one per core)",
    )
    certify.add_argument(
        "--out", type=arguments.path, default=Path("certificates"), help="folder (default: certificates)"
    )
    certify.add_argument(
        "--require",
        type=arguments.share,
        default=0.8,
        help="success rate that each task must reach (default: 0.8)",
    )
    certify.add_argument(
        "--disturb", action="store_true", help="add noise to the actions, as demonstrations do"
    )
    certify.add_argument("--again", action="store_true", help="run again what is in the folder")
    certify.set_defaults(run=run_certify, go_on="what is measured is kept; the same command goes on")
    lint = commands.add_parser("lint", help="report what is wrong or doubtful in tasks, and how to fix it")
    _add_tasks(lint)
    lint.add_argument(
        "--level", choices=LEVELS, default="warning", help="lowest level that is printed (default: warning)"
    )
    lint.add_argument(
        "--starts",
        type=arguments.whole(0, 1000),
        default=5,
        help="initial states to check; 0 simulates nothing (default: 5)",
    )
    lint.set_defaults(run=run_lint)


def _add_tasks(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "tasks",
        nargs="+",
        metavar="TASK",
        help="such as libero_goal/3, a suite, or a file that ends in .bddl or .yaml",
    )
    parser.add_argument("--assets", help="`builtin`, `original`, or the folder of the original's models")


def find_tasks(names: Sequence[str]) -> list["Task"]:
    """Return tasks, without duplicates, from names of suites, tasks of suites, and task files.

    Raises:
        LiberoError: A suite, task or file does not exist, or a file is not a task.
    """
    from libero_env.tasks import get_suite, get_task, is_suite
    from libero_env.tasks.files import read_yaml_tasks

    found: dict[tuple[str, str], Task] = {}
    for name in names:
        if name.endswith((".yaml", ".yml")):
            tasks: Sequence[Task] = read_yaml_tasks(name)
        else:
            tasks = get_suite(name).tasks if is_suite(name) else (get_task(name),)
        found |= {(name if task.suite == "file" else task.suite, task.name): task for task in tasks}
    return list(found.values())


def run_certify(args: argparse.Namespace) -> int:
    """Run missing attempts, write the results and print tasks below the required success; return 1 if there are any."""
    from libero_env.design.certify import certify
    from libero_env.design.certify_figure import write_results
    from libero_env.parallel import cpu_count

    jobs = args.jobs or cpu_count()
    found = certify(
        find_tasks(args.tasks),
        args.states,
        jobs=jobs,
        out=args.out,
        assets=args.assets,
        disturb=args.disturb,
        again=args.again,
    )
    write_results(found, args.out, assets=args.assets, disturb=args.disturb)
    short = [certificate for certificate in found if certificate.rate < args.require]
    for certificate in short:
        reason = next((o.reason for o in certificate.outcomes if not o.success), "")
        print(
            f"FAIL  {certificate.task} {certificate.name}: {100 * certificate.rate:.0f} %, such as: {reason}"
        )
    good, total = sum(len(c.lengths) for c in found), sum(len(c.outcomes) for c in found)
    print(
        f"{good}/{total} = {100 * good / total:.1f} %; {len(short)} of {len(found)} tasks under {args.require:.0%}"
    )
    return int(bool(short))


def run_lint(args: argparse.Namespace) -> int:
    """Print a line for each finding and their numbers; return 1 if one is an error."""
    from collections import Counter

    counts, number = Counter[str](), 0
    for findings in _lint(args):
        number += 1
        counts.update(finding.level for finding in findings)
        for finding in findings:
            if LEVELS.index(finding.level) <= LEVELS.index(args.level):
                print(finding, flush=True)
    print(f"{number} tasks: {counts['error']} errors, {counts['warning']} warnings, {counts['info']} notes")
    return int(counts["error"] > 0)


def _lint(args: argparse.Namespace) -> "Iterator[list[Finding]]":
    """Yield the findings of each task."""
    from libero_env.assets.pack import select_pack
    from libero_env.design.lint.checks import lint_file, lint_task, lint_text

    pack = select_pack(args.assets)
    for name in dict.fromkeys(args.tasks):
        if name.endswith(".bddl"):
            yield lint_file(name, pack, starts=args.starts)
            continue
        for task in find_tasks([name]):
            if task.suite == "file":  # line numbers refer to the text that `libero tasks show` prints
                yield lint_text(task.bddl_text, name, task, pack, starts=args.starts)
            else:
                yield lint_task(task, pack, starts=args.starts)


def run_tasks_list(args: argparse.Namespace) -> None:
    """Print a line for each task; of the variants that others have published, one for each suite unless it is named."""
    from libero_env.tasks import get_suite, suite_names
    from libero_env.tasks.published import PublishedTask, published_sizes

    names = [args.suite] if args.suite else suite_names()
    tasks = {task.id: task for name in names for task in get_suite(name).order(args.order)}
    for task in tasks.values():
        if isinstance(task, PublishedTask):
            print(f"{task.id:24} {task.kind:10} {task.language}  ({task.name})")
        else:
            print(f"{task.id:18} {task.language}")
    for name, size in {} if args.suite else published_sizes().items():
        print(f"{name:28} {size} variants: libero tasks list {name}")


def run_tasks_show(args: argparse.Namespace) -> None:
    """Print the generated task file."""
    from libero_env.tasks import get_task

    print(get_task(args.task).bddl_text, end="")


def run_tasks_init_states(args: argparse.Namespace) -> None:
    """Write the files, one for each suite of the tasks, and print their paths."""
    from libero_env.errors import InvalidInputError
    from libero_env.init_states.store import cache_init_states, shipped_path, write_suite
    from libero_env.tasks import get_suite
    from libero_env.tasks.files import ENDINGS
    from libero_env.tasks.published import is_published

    if args.suite.endswith(ENDINGS) and not args.out:
        for task in find_tasks([args.suite]):
            print(cache_init_states(task))
        return
    if is_published(args.suite):
        raise InvalidInputError(
            f"{args.suite} starts from the states of the tasks that it varies, or from its own, made when they "
            "are needed; there is nothing to generate"
        )
    tasks = find_tasks([args.suite]) if args.suite.endswith(ENDINGS) else get_suite(args.suite).tasks
    for suite in dict.fromkeys(task.suite for task in tasks):
        path = args.out / f"{suite}.npz" if args.out else shipped_path(suite)
        write_suite(path, [task for task in tasks if task.suite == suite], args.jobs)
        print(path)
