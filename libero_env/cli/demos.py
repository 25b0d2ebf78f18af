"""`libero demos`: record demonstrations, say what there is, check files."""

import argparse
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from libero_env.cli import demos_edit as cli_demos_tools
from libero_env.cli.arguments import pictures, positive, size
from libero_env.demos.curate import describe, find_files

if TYPE_CHECKING:
    from libero_env.demos.record import Recipe, Tally, Variation

VARIATIONS = ("style", "noise", "pushes")
CAMERAS = ("agentview", "robot0_eye_in_hand")
SHOWN_REASONS = 3  # of failed attempts at a task


def register(subparsers: "argparse._SubParsersAction") -> None:
    """`libero demos generate|download|info|check|replay|rerender|filter|export`"""
    parser = subparsers.add_parser("demos", help="record demonstrations, look at them, convert them")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _register_generate(commands)
    _register_download(commands)
    places = "files or folders (default: where demonstrations are kept)"
    info = commands.add_parser("info", help="the demonstration files in a folder")
    info.add_argument("paths", nargs="*", type=Path, help=places)
    info.set_defaults(run=run_info)
    check = commands.add_parser("check", help="read demonstrations whole and say what is in them or broken")
    check.add_argument("paths", nargs="*", type=Path, help=places)
    check.set_defaults(run=run_check)
    cli_demos_tools.register(commands)


def _register_generate(commands: "argparse._SubParsersAction") -> None:
    generate = commands.add_parser(
        "generate", help="record with the scripted expert; goes on where it was stopped"
    )
    what = generate.add_mutually_exclusive_group(required=True)
    what.add_argument("--benchmark", "--suite", help="all tasks of a suite, such as libero_object")
    what.add_argument("--task", help="one task, such as libero_goal/3")
    what.add_argument("--bddl", type=Path, help="a task file of your own")
    add = generate.add_argument
    add("--n", type=positive, default=50, help="demonstrations of each task (default: 50)")
    add("--size", type=size, default=(128, 128), help="of the pictures, 128 or 120x160 (default: 128)")
    add("--cameras", nargs="+", default=CAMERAS, help=f"what is drawn (default: {' '.join(CAMERAS)})")
    add(
        "--no-images",
        action="store_true",
        help="states, proprioception and actions alone; rerender draws later",
    )
    add("--depth", action="store_true", help="record depth too, in metres")
    add("--segmentation", choices=("instance", "class", "element"), help="record a segmentation too")
    add("--seed", type=int, default=0, help="of starts and manners (default: 0)")
    add("--reserved", action="store_true", help="start from the 50 stored states, which evaluation uses")
    add(
        "--variation",
        nargs="+",
        choices=(*VARIATIONS, "none"),
        default=VARIATIONS,
        help="of the manner and of the executed actions (default: all)",
    )
    add("--noise", type=float, help="standard deviation of the noise on actions (default: 0.12)")
    add(
        "--pairing",
        choices=("aligned", "libero"),
        default="aligned",
        help="observations before their action, or after it as in the original (default: aligned)",
    )
    add("--workers", type=int, default=0, help="processes (default: one for each core)")
    add("--folder", type=Path, help="where to keep them (default: LIBERO_DEMOS, or in the cache)")
    generate.set_defaults(run=run_generate)


def _register_download(commands: "argparse._SubParsersAction") -> None:
    download = commands.add_parser(
        "download", help="fetch those that people recorded for the original; goes on where it was stopped"
    )
    add = download.add_argument
    add("names", nargs="+", help="suites such as libero_object, or tasks such as libero_object/3")
    add("--dest", type=Path, help="the folder (default: where demonstrations are kept)")
    add("--revision", help="commit, tag or branch of the data set (default: a pinned commit)")
    add("--overwrite", action="store_true", help="replace files that are there and are others")
    download.set_defaults(run=run_download)


def run_download(args: argparse.Namespace) -> None:
    """Fetch, then name the files."""
    from libero_env.demos.download import REVISION, download_demos

    for path in download_demos(
        args.names, args.dest, revision=args.revision or REVISION, overwrite=args.overwrite
    ):
        print(f"{path}: complete and verified")


def run_generate(args: argparse.Namespace) -> int:
    """Record what is missing, then list the files and what failed; 1 where a task is not complete."""
    from libero_env.demos.generate import demo_path, make_demos
    from libero_env.paths import demos_dir

    root = args.folder or demos_dir()
    jobs = [(recipe, demo_path(root, recipe)) for recipe in recipes(args)]
    tallies = make_demos(jobs, args.n, workers=args.workers, replace=True)
    for path, tally in tallies.items():
        print(describe(path) if path.is_file() else f"{path}: not complete")
        for line in report(tally):
            print(f"    {line}")
    if len(tallies) > 1:
        print(summary(tallies, args.n))
    return int(any(tally.error for tally in tallies.values()))


def recipes(args: argparse.Namespace) -> "list[Recipe]":
    """What the options of `generate` ask for."""
    from libero_env.demos.record import Recipe
    from libero_env.tasks import get_suite, get_task, read_task

    if args.benchmark:
        tasks = get_suite(args.benchmark).tasks
    else:
        tasks = (read_task(args.bddl) if args.bddl else get_task(args.task),)
    disturb, varied = bool({"noise", "pushes"} & set(args.variation)), variation(args)
    cameras = () if args.no_images else tuple(args.cameras)
    return [
        Recipe(task, args.size, args.seed, args.pairing, disturb, varied, cameras, pictures(args))
        for task in tasks
    ]


def variation(args: argparse.Namespace) -> "Variation":
    """How demonstrations differ from each other."""
    from libero_env.demos.record import Variation

    usual = Variation()
    noise = usual.noise if args.noise is None else args.noise
    return Variation(
        style="style" in args.variation,
        noise=noise if "noise" in args.variation else 0.0,
        push_rate=usual.push_rate if "pushes" in args.variation else 0.0,
        reserved=args.reserved,
    )


def report(tally: "Tally") -> list[str]:
    """What came of one task: the share of attempts that succeeded, and why others failed."""
    if not tally.attempts:
        return [tally.error] if tally.error else []
    failed = tally.reasons.total()
    share = f"{tally.attempts - failed} of {tally.attempts} attempts successful"
    lines = [f"{share} ({100 * (1 - failed / tally.attempts):.0f} %)"]
    # reasons that differ in numbers alone are the same
    alike: Counter[str] = Counter()
    for reason, count in tally.reasons.items():
        alike[re.sub(r"(?<!\w)\d+(\.\d+)?", "N", reason)] += count
    lines += [f"{count} x {reason}" for reason, count in alike.most_common(SHOWN_REASONS)]
    return lines + ([f"ERROR {tally.error}"] if tally.error else [])


def summary(tallies: "Mapping[Path, Tally]", n: int) -> str:
    """One line about all tasks."""
    done = sum(not tally.error and tally.recorded >= n for tally in tallies.values())
    attempts = sum(tally.attempts for tally in tallies.values())
    failed = sum(tally.reasons.total() for tally in tallies.values())
    share = f", {100 * (1 - failed / attempts):.1f} % of {attempts} attempts successful" if attempts else ""
    return f"{done} of {len(tallies)} tasks complete{share}"


def run_info(args: argparse.Namespace) -> None:
    """One line for each file."""
    for path in find_files(args.paths):
        print(describe(path))


def run_check(args: argparse.Namespace) -> int:
    """Read every file whole; 1 where one is broken."""
    from libero_env.demos.curate import examine
    from libero_env.errors import DemoError

    broken = 0
    for path in find_files(args.paths):
        try:
            stats = examine(path)
        except DemoError as error:
            broken += 1
            print(f"FAIL  {error}")
            continue
        for fault in stats.faults:
            print(f"FAIL  {path}: {fault}")
        broken += bool(stats.faults)
        if not stats.faults:
            print(f"ok    {path}: {len(stats.lengths)} demonstrations, {stats}")
    return int(broken > 0)
