"""What a command answers: a text for a terminal, plain data for `--json`, and a page that `--open` shows."""

import contextlib
import io
import sys
import webbrowser
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from libero_env.errors import InvalidInputError
from libero_env.text import to_json

FLAGS = {
    "json": "Print the answer as JSON, and nothing else on the standard output.",
    "open": "Show the page in the browser.",
}


@dataclass(frozen=True)
class Answer:
    """What a command found.

    Attributes:
        text: Lines for a terminal.
        data: The same as plain data.
        page: Page that was written; its path is printed after the text.
        status: Exit status.
    """

    text: str
    data: Any = None
    page: Path | None = None
    status: int = 0


def tell(command: Callable[[], Answer], flags: Collection[str]) -> int:
    """Run a command, and print its answer in the form that the flags ask for; return its exit status.

    What the command itself prints, such as rows of a table as they become known, is left out with `--json`.

    Raises:
        InvalidInputError: `--open` is given, and no page was written.
    """
    with contextlib.redirect_stdout(io.StringIO()) if "json" in flags else contextlib.nullcontext():
        answer = command()
    if "json" in flags:
        print(to_json(answer.data), end="")
    elif lines := [str(part) for part in (answer.text, answer.page) if part]:
        print("\n".join(lines))
    if "open" in flags:
        if answer.page is None:
            raise InvalidInputError(
                "--open shows a page, and none was written: name a folder for it with --out"
            )
        if not webbrowser.open(answer.page.resolve().as_uri()):
            print(f"note: no browser could be started; the page is {answer.page}", file=sys.stderr)
    return answer.status
