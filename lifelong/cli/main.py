"""The `libero` command. Each subcommand is a small function that imports what it needs when it runs."""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from libero_env.cli import assets, demos, objects, tasks, teleop
from libero_env.cli.arguments import Subparsers
from libero_env.errors import LiberoError
from lifelong.cli import evaluate
from lifelong.errors import LifelongError


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
    import libero_env.cli.doctor as environment
    import lifelong.cli.doctor as learning

    findings = environment.examine(gl_only=args.gl)
    if not args.gl:
        findings += learning.examine()
    print(environment.render_findings(findings))
    return int(environment.is_broken(findings))


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
    from lifelong.report.page import write_report

    print(write_report(args.run_dirs, args.out))


COMMANDS: tuple[Callable[[Subparsers], None], ...] = (
    register_doctor,
    tasks.register,
    demos.register,
    assets.register,
    objects.register,
    teleop.register,
    evaluate.register,
    register_report,
)
