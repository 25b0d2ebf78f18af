"""`libero demos`: record demonstrations, describe and check files."""

import argparse
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from libero_env.cli import arguments, demos_edit
from libero_env.cli.arguments import Subparsers, modalities
from libero_env.demos.curate import describe, find_demo_files

if TYPE_CHECKING:
    from libero_env.demos.config import DemoConfig, Variation
    from libero_env.demos.record import RecordingReport

VARIATIONS = ("style", "noise", "pushes")
CAMERAS = ("agentview", "robot0_eye_in_hand")
SHOWN_REASONS = 3  # most frequent reasons of failure that are listed for a task


def register(subparsers: Subparsers) -> None:
    """Add `libero demos generate|download|info|check|replay|rerender|filter|export`."""
    parser = subparsers.add_parser("demos", help="record demonstrations, look at them, convert them")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _register_generate(commands)
    _register_download(commands)
    paths = "files or folders (default: where demonstrations are kept)"
    info = commands.add_parser("info", help="list the demonstration files in a folder")
    info.add_argument("paths", nargs="*", type=arguments.path, help=paths)
    info.set_defaults(run=run_info)
    check = commands.add_parser("check", help="read files completely and report what is in them or broken")
    check.add_argument("paths", nargs="*", type=arguments.path, help=paths)
    check.set_defaults(run=run_check)
    demos_edit.register(commands)


def _register_generate(commands: Subparsers) -> None:
    generate = commands.add_parser(
        "generate", help="record with the scripted expert; an interrupted recording can be resumed"
    )
    tasks = generate.add_mutually_exclusive_group(required=True)
    tasks.add_argument("--benchmark", "--suite", help="all tasks of a suite, such as libero_object")
    tasks.add_argument("--task", help="one task, such as libero_goal/3")
    tasks.add_argument("--bddl", type=arguments.path, help="a user-defined task file")
    add = generate.add_argument
    add("--n", type=arguments.positive, default=50, help="demonstrations of each task (default: 50)")
    add(
        "--size",
        type=arguments.size,
        default=(128, 128),
        help="size of the images, 128 or 120x160 (default: 128)",
    )
    add("--cameras", nargs="+", default=CAMERAS, help=f"cameras to render (default: {' '.join(CAMERAS)})")
    add(
        "--no-images",
        action="store_true",
        help="record states, proprioception and actions only; `rerender` can add images later",
    )
    add("--drawing", choices=("fast", "faithful"), help="how images are drawn (default: that of the models)")
    add("--depth", action="store_true", help="record depth too, in metres")
    add("--segmentation", choices=("instance", "class", "element"), help="record a segmentation too")
    add("--robot", default="libero", help="model of the arm: libero, or robosuite-1.4.1 (default: libero)")
    add(
        "--backend",
        metavar="NAME",
        default="mujoco",
        help="physics: mujoco, or warp on a GPU, as in warp,device=cuda:1 (default: mujoco)",
    )
    add(
        "--seed",
        type=arguments.seed,
        default=0,
        help="seed of starts, motion styles and action noise (default: 0)",
    )
    add("--reserved", action="store_true", help="start from the 50 stored states, which evaluation uses")
    add(
        "--variation",
        nargs="+",
        choices=(*VARIATIONS, "none"),
        default=VARIATIONS,
        help="what varies: the motion style, noise on the executed actions, pushes (default: all)",
    )
    add(
        "--noise",
        type=arguments.number(0, 10),
        help="standard deviation of the noise on actions (default: 0.12)",
    )
    add(
        "--pairing",
        choices=("aligned", "libero"),
        default="aligned",
        help="store the observation before an action, or the one after it as the original does (default: aligned)",
    )
    add(
        "--workers",
        type=arguments.processes_or_all,
        default=0,
        help="number of processes (default: one per core)",
    )
    add(
        "--folder",
        type=arguments.path,
        help="where to keep the files (default: LIBERO_DEMOS, or in the cache)",
    )
    generate.set_defaults(run=run_generate, go_on="what is recorded is kept; the same command goes on")


def _register_download(commands: Subparsers) -> None:
    download = commands.add_parser(
        "download",
        help="download the original's human demonstrations; an interrupted download can be resumed",
    )
    add = download.add_argument
    add("names", nargs="+", help="suites such as libero_object, or tasks such as libero_object/3")
    add("--dest", type=arguments.path, help="folder to write (default: where demonstrations are kept)")
    add("--revision", help="commit, tag or branch of the data set (default: a pinned commit)")
    add("--overwrite", action="store_true", help="replace existing files of other contents")
    download.set_defaults(run=run_download, go_on="what is downloaded is kept; the same command goes on")


def run_download(args: argparse.Namespace) -> None:
    """Download, then list the files."""
    from libero_env.demos.download import REVISION, download_demos

    for path in download_demos(
        args.names, args.dest, revision=args.revision or REVISION, overwrite=args.overwrite
    ):
        print(f"{path}: complete; it has the digest that the server lists")


def run_generate(args: argparse.Namespace) -> int:
    """Record what is missing, then list the files and the failures; return 1 if a task is not complete."""
    from libero_env.demos.generate import RecordingJob, demo_path, make_demos
    from libero_env.paths import demos_dir

    root = args.folder or demos_dir()
    jobs = [RecordingJob(config, demo_path(root, config)) for config in demo_configs(args)]
    reports = make_demos(jobs, args.n, workers=args.workers, replace=True)
    for path, report in reports.items():
        print(describe(path) if path.is_file() else f"{path}: not complete")
        for line in report_lines(report):
            print(f"    {line}")
    if len(reports) > 1:
        print(summary(reports, args.n))
    return int(any(report.error for report in reports.values()))


def demo_configs(args: argparse.Namespace) -> "list[DemoConfig]":
    """Return the configurations of the demonstrations that the options of `generate` ask for, one per task."""
    from libero_env.demos.config import DemoConfig
    from libero_env.tasks import get_suite, get_task, read_task

    if args.benchmark:
        tasks = get_suite(args.benchmark).tasks
    else:
        tasks = (read_task(args.bddl) if args.bddl else get_task(args.task),)
    return [
        DemoConfig(
            task,
            args.size,
            args.seed,
            args.pairing,
            disturb=bool({"noise", "pushes"} & set(args.variation)),
            variation=variation(args),
            cameras=() if args.no_images else tuple(args.cameras),
            modalities=modalities(args),
            drawing=args.drawing,
            robot=args.robot,
            backend=args.backend,
        )
        for task in tasks
    ]


def variation(args: argparse.Namespace) -> "Variation":
    """Return how the demonstrations differ from each other, by the options of `generate`."""
    from libero_env.demos.config import Variation

    default = Variation()
    noise = default.noise if args.noise is None else args.noise
    return Variation(
        style="style" in args.variation,
        noise=noise if "noise" in args.variation else 0.0,
        push_rate=default.push_rate if "pushes" in args.variation else 0.0,
        reserved=args.reserved,
    )


def report_lines(report: "RecordingReport") -> list[str]:
    """Return the outcome of one task: the share of attempts that succeeded, and why others failed."""
    if not report.attempts:
        return [report.error] if report.error else []
    failed = report.failure_reasons.total()
    share = f"{report.attempts - failed} of {report.attempts} attempts successful"
    lines = [f"{share} ({100 * (1 - failed / report.attempts):.0f} %)"]
    reasons: Counter[str] = Counter()
    for reason, count in report.failure_reasons.items():
        reasons[re.sub(r"(?<!\w)\d+(\.\d+)?", "N", reason)] += count  # reasons may differ in numbers only
    lines += [f"{count} x {reason}" for reason, count in reasons.most_common(SHOWN_REASONS)]
    return lines + ([f"ERROR {report.error}"] if report.error else [])


def summary(reports: "Mapping[Path, RecordingReport]", n: int) -> str:
    """Return one line about all tasks."""
    done = sum(not report.error and report.recorded >= n for report in reports.values())
    attempts = sum(report.attempts for report in reports.values())
    failed = sum(report.failure_reasons.total() for report in reports.values())
    share = f", {100 * (1 - failed / attempts):.1f} % of {attempts} attempts successful" if attempts else ""
    return f"{done} of {len(reports)} tasks complete{share}"


def run_info(args: argparse.Namespace) -> int:
    """Print one line about each file; return 1 if one cannot be read."""
    from libero_env.errors import DemoError

    broken = 0
    for path in demo_files(args.paths):
        try:
            print(describe(path))
        except DemoError as error:
            broken += 1
            print(f"FAIL  {error}")
    return int(broken > 0)


def run_check(args: argparse.Namespace) -> int:
    """Read every file completely; return 1 if one is broken."""
    return int(check_files(demo_files(args.paths)) > 0)


def demo_files(paths: list[Path]) -> list[Path]:
    """Return the demonstration files among the given paths and in the given folders; see `find_demo_files`.

    Raises:
        DemoError: A folder is missing, or there are no files.
    """
    from libero_env.errors import DemoError

    if missing := [path for path in paths if path.suffix != ".hdf5" and not path.exists()]:
        raise DemoError(f"{missing[0]} does not exist; give demonstration files, or folders that hold some")
    return find_demo_files(paths)


def check_files(files: Iterable[Path], num_demos: int | None = None) -> int:
    """Read files completely and print one line about each; return the number of broken files.

    Args:
        files: Demonstration files.
        num_demos: Number of demonstrations that each file must have; None for any.
    """
    from libero_env.demos.curate import examine
    from libero_env.errors import DemoError

    broken = 0
    for path in files:
        try:
            stats = examine(path)
        except DemoError as error:
            broken += 1
            print(f"FAIL  {error}")
            continue
        faults = list(map(str, stats.faults))
        if num_demos not in (None, len(stats.lengths)):
            faults.append(f"{len(stats.lengths)} demonstrations; expected {num_demos}")
        broken += bool(faults)
        for fault in faults:
            print(f"FAIL  {path}: {fault}")
        if not faults:
            print(f"ok    {path}: {len(stats.lengths)} demonstrations, {stats}")
    return broken
