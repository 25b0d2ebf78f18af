"""`libero sweep status`: how far a sweep is."""

import argparse
from pathlib import Path

from libero_env.cli import arguments
from libero_env.cli.arguments import Subparsers
from lifelong.errors import ConfigError


def register(subparsers: Subparsers) -> None:
    """Add the command `libero sweep`."""
    parser = subparsers.add_parser("sweep", help="sweeps of runs (libero train -m)")
    actions = parser.add_subparsers(required=True, metavar="ACTION")
    status = actions.add_parser("status", help="what runs, what failed, and what is left")
    status.add_argument(
        "folders",
        nargs="*",
        type=arguments.path,
        default=[Path("runs")],
        metavar="DIR",
        help="the folder of a sweep, or of runs, for all of its sweeps (default: runs)",
    )
    status.set_defaults(run=run_status)


def run_status(args: argparse.Namespace) -> None:
    """Print the status of each sweep."""
    from lifelong.sweeps import find_sweeps, read_sweep, status_lines

    for folder in args.folders:
        found = find_sweeps(folder)
        if not found:
            raise ConfigError(f"{folder} holds no sweep; `libero train -m KEY=A,B` starts one")
        for one in found:
            print(*status_lines(read_sweep(one)), sep="\n")
