"""The `libero` command: `commands.yaml` lists the commands, each a function that is imported when it is run.

`libero_env.cli.options` turns the words after a command's name into the arguments of its function.
"""

import importlib
import io
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import resources
from typing import Any

from libero_env import __version__
from libero_env.cli import ending
from libero_env.cli.ending import NOT_BEGUN, told_if_interrupted
from libero_env.errors import InvalidInputError, UnknownNameError
from libero_env.storage import parse_yaml


@dataclass(frozen=True)
class Command:
    """A command.

    Attributes:
        target: Its function, as `module:name`. It returns the exit status, or None for 0.
        help: What it does, for lists of commands.
        resume: How to go on after an interruption.
        reads_words: Whether the function takes the words as they are, as its only argument.
        flags: Which of `libero_env.cli.options.FLAGS` it has; its function returns an `Answer`.
    """

    target: str
    help: str
    resume: str = ""
    reads_words: bool = False
    flags: tuple[str, ...] = ()


COMMANDS: dict[str, dict[str, Command]] = {  # by heading
    heading: {name: Command(**fields) for name, fields in group.items()}
    for heading, group in parse_yaml(
        (resources.files(__package__) / "commands.yaml").read_text("utf-8")
    ).items()
}
ALL = {name: command for group in COMMANDS.values() for name, command in group.items()}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: The words after `libero`. None: those of this process.

    Returns:
        The exit status, see `libero_env.cli.ending`.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # names of files need not be text
            stream.reconfigure(errors="backslashreplace")
    with ending.general_options(sys.argv[1:] if argv is None else argv) as words:
        try:
            status = _run(words)
            sys.stdout.flush()
        except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - told by kind
            return ending.report(error)
    return status


def _run(words: list[str]) -> int:
    if any("\0" in word for word in words):  # from Python only: a system passes none
        raise InvalidInputError("a word of the command line has a null character, which no name can have")
    if "" in words:
        before = words[words.index("") - 1] if words[0] else "libero"
        raise InvalidInputError(
            f"the word after {before} is empty, as from a variable of the shell that is not set"
        )
    if (name := find(words)) is None:
        return _overview(words)
    try:
        os.getcwd()
    except OSError:
        raise InvalidInputError("the working folder was removed; change to one that exists") from None
    with ending.interruptible():
        with told_if_interrupted(NOT_BEGUN):
            call = bind(name, words[name.count(" ") + 1 :])
        with told_if_interrupted(ALL[name].resume):
            return call() or 0


def find(words: Sequence[str]) -> str | None:
    """Return the name of the command with which a command line begins; None if there is none."""
    return next((name for count in (2, 1) if (name := " ".join(words[:count])) in ALL), None)


def bind(name: str, words: Sequence[str]) -> Callable[[], int | None]:
    """Read the words after a command's name, and return the call that they ask for.

    Raises:
        SystemExit: The words are not valid, or ask for help.
    """
    command = ALL[name]
    function = load(command)
    if command.reads_words:
        return partial(function, words)
    from libero_env.cli.options import parse

    return parse(function, words, f"libero {name}", command.flags)


def load(command: Command) -> Callable[..., Any]:
    """Import the function of a command."""
    module, _, name = command.target.partition(":")
    return getattr(importlib.import_module(module), name)


def _overview(words: Sequence[str]) -> int:
    """Print the commands; return 0 where they were asked for, otherwise the status of a mistake."""
    if "--version" in words[:1]:
        print(f"libero-lifelong {__version__}")
        return 0
    topics = dict.fromkeys(name.partition(" ")[0] for name in ALL)
    topic = words[0] if words and words[0] in topics else ""
    asked = bool({"-h", "--help"} & set(words[:2]))
    given = [word for word in words[bool(topic) :] if not word.startswith("-")]
    if given and not asked:
        known = [n.partition(" ")[2] for n in ALL if n.startswith(f"{topic} ")] if topic else list(topics)
        raise UnknownNameError(f"command of libero {topic}".rstrip(), given[0], known)
    print("\n".join(_lines(topic)), file=sys.stdout if asked else sys.stderr)
    return 0 if asked else ending.MISTAKE


def _lines(topic: str) -> Iterator[str]:
    yield f"usage: libero {topic or 'COMMAND'}{' COMMAND' if topic else ''} ...\n"
    if not topic:
        yield "Lifelong robot learning on LIBERO.\n"
    for heading, group in COMMANDS.items():
        rows = {name: c for name, c in group.items() if not topic or name.partition(" ")[0] == topic}
        if rows:
            yield f"{heading}:" if not topic else "Commands:"
        for name, command in rows.items():
            yield f"  {name:18} {command.help}"
        if rows:
            yield ""
    yield "libero COMMAND --help explains one; --quiet: no progress; --debug: the traceback of every error; --version"
    yield "--import MODULE: import a module first, which registers predicates or objects"
