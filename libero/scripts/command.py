"""What the scripts have in common: options from their parameters, errors in one line, and an exit status."""

import functools
import sys
from collections.abc import Callable, Sequence

from libero_env.cli import ending
from libero_env.cli.options import parse


def script(prog: str = "") -> Callable[[Callable[..., int | None]], Callable[..., int]]:
    """Turn a function into a script, `main(argv=None)`, whose options are its parameters.

    It returns the exit status: that of the function (None for 0), or that of an error, see `libero_env.cli.ending`.

    Args:
        prog: Name of the script in messages; by default the function's with the ending `.py`.
    """

    def decorate(work: Callable[..., int | None]) -> Callable[..., int]:
        name = prog or f"{work.__name__}.py"

        @functools.wraps(work)
        def main(argv: Sequence[str] | None = None) -> int:
            with ending.general_options(sys.argv[1:] if argv is None else argv) as words:
                call = parse(work, words, name)
                try:
                    with ending.interruptible():
                        return call() or 0
                except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - told by kind
                    return ending.report(error, who=f"{name}: ")

        return main

    return decorate
