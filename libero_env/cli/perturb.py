"""`libero perturb`: what can be perturbed, and what it looks like."""

import argparse

from libero_env.cli.arguments import Subparsers


def register(subparsers: Subparsers) -> None:
    """Add the command `libero perturb`."""
    parser = subparsers.add_parser("perturb", help="perturbations of tasks and episodes")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    listing = commands.add_parser("list", help="the kinds, with the unit and what severity 1 is")
    listing.set_defaults(run=run_list)


def run_list(args: argparse.Namespace) -> None:
    """Print a line for each kind, in the order in which they are applied."""
    from libero_env.perturbations import KINDS

    for kind in KINDS.values():
        print(f"{kind.layer:12} {kind.name:14} {kind.at_one:5g} {kind.unit:22} {kind.what}")
