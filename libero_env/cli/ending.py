"""How a command ends: one line for what its user did wrong, a traceback for a fault of this package, and a status.

| status | meaning |
|---|---|
| 0 | it did what was asked |
| 1 | it found something broken or missing, which is its result |
| 2 | it was asked for something that is not valid, or a policy or another part of the user's raised an error |
| 3 | it was to decide something, and what it was given does not: `libero compare --gate` |
| 70 | this package has a fault: a traceback, and a request to report it |
| 128 + n | signal n ended it: 129 SIGHUP, 130 SIGINT (Ctrl-C), 141 SIGPIPE, 143 SIGTERM |

`--debug`, or the environment variable `LIBERO_DEBUG=1`, which worker processes inherit, shows every traceback;
`--quiet`, or `LIBERO_QUIET=1`, shows no progress.
"""

import errno
import importlib.util
import os
import shlex
import signal
import sys
import sysconfig
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

from libero_env import __distribution__
from libero_env.errors import (
    DEBUG_VARIABLE,
    ENDING_SIGNALS,
    QUIET_VARIABLE,
    RAISED_BY,
    InvalidInputError,
    LiberoError,
    code_of,
    is_debugging,
    missing_package,
)
from libero_env.text import printable

MISTAKE, UNDECIDED, DEFECT, SIGNALLED = 2, 3, 70, 128
NOT_BEGUN = "nothing was begun"
_SIGPIPE = 13  # Windows has no name for it
_VARIABLES = {"--debug": DEBUG_VARIABLE, "--quiet": QUIET_VARIABLE}
EVERYWHERE = (*_VARIABLES, "--import")  # options of every command
_MAX_FRAMES = 12  # of the user's code in a message
_INSTALLED = [sysconfig.get_path(name) + os.sep for name in ("stdlib", "platstdlib", "purelib", "platlib")]
# what a machine refuses; other errors of the operating system are unexpected
_REFUSALS = {
    getattr(errno, name)
    for name in (
        *("EACCES", "EADDRINUSE", "EADDRNOTAVAIL", "EBUSY", "ECONNREFUSED", "ECONNRESET", "EDQUOT", "EEXIST"),
        *("EFBIG", "EHOSTUNREACH", "EIO", "EISDIR", "ELOOP", "EMFILE", "ENAMETOOLONG", "ENETUNREACH"),
        *("ENFILE", "ENODEV", "ENOENT", "ENOLCK", "ENOMEM", "ENOSPC", "ENOTDIR", "ENOTEMPTY", "ENXIO"),
        *("EPERM", "EROFS", "ESTALE", "ETIMEDOUT", "ETXTBSY"),
    )
    if hasattr(errno, name)
}


class Interrupted(KeyboardInterrupt):
    """A signal that asks this process to end; its notes say how to go on.

    Args:
        number: Number of the signal.
    """

    def __init__(self, number: int):
        super().__init__(signal.Signals(number).name)
        self.number = number


@contextmanager
def interruptible() -> Iterator[None]:
    """Raise `Interrupted` at the first of SIGINT, SIGTERM and SIGHUP; a later one ends the process at once.

    One within a second is the same request: `timeout`, for one, sends its signal to a process and again to its group.
    A signal that is ignored, as SIGHUP under `nohup`, stays so. In other threads than the main one nothing changes.
    """
    before: dict[int, Callable[[int, FrameType | None], object] | int] = {}
    asked: list[float] = []

    def end(number: int, frame: FrameType | None) -> None:
        asked.append(time.monotonic())
        if len(asked) == 1:
            raise Interrupted(number)
        if asked[-1] > asked[0] + 1:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)

    if threading.current_thread() is threading.main_thread():
        for number in (getattr(signal, name) for name in ENDING_SIGNALS if hasattr(signal, name)):
            handler = signal.getsignal(number)
            if handler is not None and handler is not signal.SIG_IGN:
                before[number] = handler
                signal.signal(number, end)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def told_if_interrupted(note: str) -> Iterator[None]:
    """Say, where the block is interrupted, what became of the work, unless what was interrupted has said it itself."""
    try:
        yield
    except KeyboardInterrupt as error:
        if note and not getattr(error, "__notes__", ()):
            error.add_note(note)
        raise


@contextmanager
def general_options(words: Sequence[str]) -> Iterator[list[str]]:
    """Yield the words of a command line without the options of every command, which count for its processes, too.

    `--import MODULE` imports a module first, from the current folder or installed: one that registers predicates or
    objects. Closed standard streams lead nowhere: the first files that are opened would take their place.
    """
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        if getattr(sys, name) is None:
            # the lowest free number, which is this one
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
            setattr(sys, name, open(number, mode))  # noqa: SIM115 - until the process ends
    before = {variable: os.environ.get(variable) for variable in _VARIABLES.values()}
    os.environ |= {_VARIABLES[word]: "1" for word in words if word in _VARIABLES}
    try:
        try:
            left = _import_modules([word for word in words if word not in _VARIABLES])
        except Exception as error:  # noqa: BLE001 - told by kind
            sys.exit(report(error))
        yield left
    finally:
        for variable, value in before.items():
            if value is None:
                os.environ.pop(variable, None)
            else:
                os.environ[variable] = value


def _import_modules(words: list[str]) -> list[str]:
    """Import what `--import` names; return the other words."""
    while "--import" in words:
        at = words.index("--import")
        name, words = (words[at + 1 : at + 2] or [""])[0], words[:at] + words[at + 2 :]
        if not all(part.isidentifier() for part in name.split(".")):
            raise InvalidInputError(
                f"--import {name!r}: expected a module, such as my_predicates for my_predicates.py"
            )
        if os.getcwd() not in sys.path:
            sys.path.append(os.getcwd())  # for good: processes that this one starts need it as well
        if importlib.util.find_spec(name.partition(".")[0]) is None:
            raise InvalidInputError(
                f"--import {name}: there is no {name}.py in {os.getcwd()}, nor is it installed"
            )
        with code_of(f"the module {name}"):
            importlib.import_module(name)
    return words


def report(error: BaseException, *, who: str = "", mistakes: tuple[type[BaseException], ...] = ()) -> int:
    """Print on the standard error why a command ends, and return its exit status.

    Args:
        error: What ended it.
        who: Which of several processes this is, before the message; empty for the only one.
        mistakes: Errors of other packages that tell what their user did wrong.
    """
    if isinstance(error, KeyboardInterrupt):
        number = getattr(error, "number", signal.SIGINT)
        by = "" if number == signal.SIGINT else f" by {signal.Signals(number).name}"
        _say("; ".join([f"{who}interrupted{by}", *getattr(error, "__notes__", ())]))
        return SIGNALLED + number
    if isinstance(error, BrokenPipeError):  # the reader, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nothing is left to be flushed
        return SIGNALLED + _SIGPIPE
    if is_debugging():
        traceback.print_exception(error)
    told = _told(error, mistakes)
    if told is None and not is_debugging():
        traceback.print_exception(error)
    notes = [note for note in getattr(error, "__notes__", ()) if not note.startswith(RAISED_BY)]
    _say("\n".join([f"error: {who}{told or _request()}", *notes]))
    return MISTAKE if told else DEFECT


def _told(error: BaseException, mistakes: tuple[type[BaseException], ...]) -> str | None:
    """Return what its user is told about an error; None if it is a fault of this package."""
    if isinstance(error, LiberoError):
        return str(error).strip() or type(error).__name__
    if told := _raised_by_user(error):
        return told
    if isinstance(error, mistakes):
        return " ".join(str(error).split()) or type(error).__name__
    return _lack(error)


def _say(text: str) -> None:
    print(printable(text), file=sys.stderr, flush=True)


def _lack(error: BaseException) -> str | None:
    """Return what the machine refused or lacks; None if it is not that."""
    if isinstance(error, ModuleNotFoundError) and (missing := missing_package(error.name or "")):
        return str(missing)
    if isinstance(error, OSError) and error.errno in _REFUSALS:
        names = [str(name) for name in (error.filename, error.filename2) if name is not None]
        return ": ".join([" and ".join(names), error.strerror or str(error)] if names else [str(error)])
    if isinstance(error, MemoryError) or "can't allocate memory" in str(error):  # the latter is PyTorch's
        return f"not enough memory ({str(error).strip() or type(error).__name__}); ask for less at a time"
    if type(error).__name__ == "OutOfMemoryError":
        return f"not enough memory of the GPU ({str(error).partition('. ')[0]}); ask for less at a time"
    return None


def _raised_by_user(error: BaseException) -> str | None:
    """Return where code of the user raised an error; None where no such code had a part in it."""
    roots = _own_folders()
    link: BaseException | None = error
    while link is not None:
        frames = traceback.extract_tb(link.__traceback__)
        ours = [i for i, frame in enumerate(frames) if _is_below(frame.filename, roots)]
        called = frames[ours[0] + 1 :] if ours else []
        own = [frame for frame in called if _is_user_file(frame.filename, roots)]
        notes = [n for n in getattr(link, "__notes__", ()) if n.startswith(RAISED_BY)]
        syntax = isinstance(link, SyntaxError) and _is_user_file(link.filename or "<>", roots)
        if own or notes or syntax:
            shown = own or (frames[ours[-1] + 1 :] if ours else [])
            lines = "".join(traceback.format_list(shown[-_MAX_FRAMES:])).rstrip()
            said = traceback.format_exception_only(link)
            noted = sum(len(note.split("\n")) for note in getattr(link, "__notes__", ()))
            text = "".join(said[: len(said) - noted]).strip()
            culprit = notes[0].removeprefix(RAISED_BY) if notes else "code of yours"
            more = "" if is_debugging() else "(--debug shows the whole traceback)"
            return "\n".join(part for part in (f"{culprit} raised {text}", lines, more) if part)
        link = link.__cause__ or (None if link.__suppress_context__ else link.__context__)
    return None


def _own_folders() -> list[str]:
    """Return the folders of this distribution's packages, as far as they are loaded."""
    own = [
        m
        for n, m in [*sys.modules.items()]
        if "." not in n and getattr(m, "__dict__", {}).get("__distribution__") == __distribution__
    ]
    return [os.path.dirname(str(module.__file__)) + os.sep for module in own]


def _is_user_file(name: str, roots: Sequence[str]) -> bool:
    """Return whether a file belongs to neither this package, nor Python, nor an installed package."""
    if {"site-packages", "dist-packages"} & set(Path(name).parts):
        return False
    if not os.path.exists(name):  # text that was executed, or what a compiled package calls its source
        return False
    return not _is_below(name, [*roots, *_INSTALLED])


def _is_below(name: str, folders: Sequence[str]) -> bool:
    with suppress(OSError):  # the working folder was removed
        return os.path.abspath(name).startswith(tuple(folders))
    return False


def _request() -> str:
    command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    return (
        f"this is a fault of {__distribution__}, not of its user. Please report it to those you have the package\n"
        f"from, with the traceback above, the command ({command}) and what `libero doctor` prints.\n"
        "What was finished before is kept."
    )
