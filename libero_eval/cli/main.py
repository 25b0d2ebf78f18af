"""The `libero` command. Each subcommand is a small function that imports what it needs when it runs."""

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from libero_env.cli import ending
from libero_env.cli.arguments import Subparsers
from libero_eval.cli import check, compare, evaluate, protocols, relearn, robustness, saliency, serve


def main(words: Sequence[str]) -> int:
    """Run one command, words with its name first."""
    args = build_parser().parse_args(words)
    return args.run(args) or 0


class _Parser(argparse.ArgumentParser):
    """A parser that tells an error in one line, and prints its help where a command is missing."""

    def __init__(self, **options: Any):
        super().__init__(**options)
        # read before the words come here: it may stand anywhere
        self.add_argument(ending.DEBUG, action="store_true", help="show the traceback of every error")

    def error(self, message: str) -> NoReturn:
        """Print what is wrong, or the commands there are, and exit."""
        if message.endswith((": COMMAND", ": ACTION")):
            self.print_help(sys.stderr)
            self.exit(ending.MISTAKE)
        self.exit(ending.MISTAKE, f"error: {' '.join(message.split())}; see {self.prog} --help\n")


def build_parser() -> argparse.ArgumentParser:
    """Return the parser with every subcommand; each stores its function as `run`."""
    parser = _Parser(prog="libero", description="Lifelong robot learning on LIBERO.")
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND")
    for register in COMMANDS:
        register(subparsers)
    return parser


COMMANDS: tuple[Callable[[Subparsers], None], ...] = (
    robustness.register,
    evaluate.register,
    saliency.register,
    relearn.register,
    protocols.register,
    serve.register,
    compare.register,
    check.register,
)
