"""What the scripts have in common: options, errors in one line, and an exit status."""

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import Any

from libero_env.cli import ending

Option = Callable[[argparse.ArgumentParser], Any]
Main = Callable[[Sequence[str] | None], int]


def option(*flags: str, **settings: Any) -> Option:
    """Return a function that adds an option to a parser; arguments as in `ArgumentParser.add_argument`."""
    return lambda parser: parser.add_argument(*flags, **settings)


def script(*options: Option, prog: str = "") -> Callable[[Callable[[argparse.Namespace], int | None]], Any]:
    """Turn a function of parsed arguments into the `main(argv)` of a script.

    It returns the exit status: that of the function (None for 0), or that of an error, see
    `libero_env.cli.ending`.

    Args:
        options: Functions that add options to the parser, see `option`.
        prog: Name of the script in messages; by default that of its file.
    """

    def decorate(work: Callable[[argparse.Namespace], int | None]) -> Main:
        name = prog or f"{work.__module__.rpartition('.')[2]}.py"

        def main(argv: Sequence[str] | None = None) -> int:
            parser = argparse.ArgumentParser(prog=name, description=sys.modules[work.__module__].__doc__)
            for add in options:
                add(parser)
            with ending.debugging(sys.argv[1:] if argv is None else argv) as words:
                arguments = parser.parse_args(words)
                try:
                    with ending.interruptible():
                        return work(arguments) or 0
                except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - told by kind
                    return ending.report(error, who=f"{name}: ")

        main.__doc__ = work.__doc__
        return main

    return decorate
