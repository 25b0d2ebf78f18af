"""What the scripts have in common: errors in one line, and an exit status."""

import argparse
import sys
from collections.abc import Callable, Sequence

from libero_env.errors import LiberoError


def run(
    parser: argparse.ArgumentParser,
    work: Callable[[argparse.Namespace], int | None],
    argv: Sequence[str] | None,
) -> int:
    """Parse the arguments and do the work.

    Args:
        parser: of the script.
        work: gets the arguments; returns the exit status, None for 0.
        argv: those of the process by default.

    Returns:
        Exit status: 0, 1 where something broken was found, 2 for an error (told in one line).
    """
    args = parser.parse_args(argv)
    try:
        return work(args) or 0
    except (LiberoError, OSError) as error:
        print(f"{parser.prog}: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"{parser.prog}: interrupted", file=sys.stderr)
        return 130
