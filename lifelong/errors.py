"""Errors of the learning side; all derive from `LifelongError`."""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.machinery import PathFinder
from pathlib import Path

from libero_env.errors import LiberoError

RESUME = "the same command resumes the run"


class LifelongError(LiberoError):
    """Base class of the errors of this package; the message states what is wrong, where, and how to fix it."""


class ConfigError(LifelongError, ValueError):
    """Raised for a configuration that is invalid, or differs from the one of the run directory."""


class RunLockedError(LifelongError):
    """Another process writes the run."""


class CheckpointError(LifelongError, ValueError):
    """Raised for a checkpoint that is missing, broken, or does not fit the model."""


class DamagedCheckpointError(CheckpointError):
    """Raised for a checkpoint that is not as it was written, or a file that never was one."""


class TrainingError(LifelongError, RuntimeError):
    """Raised when training cannot continue: the loss is not finite, or the dataset is empty."""


class LanguageError(LifelongError, ValueError):
    """Raised when an instruction cannot be embedded; the message states the remedy."""


class DataError(LifelongError, ValueError):
    """Raised for demonstrations that do not fit the policy's spec; the message names file, key and expected value."""


class PolicyError(LifelongError, ValueError):
    """Raised when a policy is built or used in an invalid way; the message states what is valid."""


class MissingObservationError(PolicyError, KeyError):
    """Raised when a policy asks for an observation that it is not given; the message lists those that it is."""

    __str__ = PolicyError.__str__  # that of KeyError quotes the message


class ResultsError(LifelongError):
    """Raised when results cannot be read or written; the message names the file and what is missing."""


class ProtocolError(ConfigError):
    """Raised for a protocol that is not valid; the message names its file and key."""


class ProtocolMismatchError(LifelongError, ValueError):
    """Raised when a policy was made for another protocol; the message names both values of every field that differs."""


class EvaluationFileError(ResultsError, ValueError):
    """Raised for the result of an evaluation that is missing, broken, or of another format or version."""


class CodecError(LifelongError, ValueError):
    """Raised for bytes or values that are not valid in a policy server's protocol."""


class ServerError(LifelongError, RuntimeError):
    """Raised for a policy server that cannot be reached, fails, or answers what is not valid; the message names it."""


class ConnectionLost(ServerError):
    """Raised when the connection to a policy server breaks; the episodes in flight are repeated from their start."""


class EvaluationIncompleteError(LifelongError, RuntimeError):
    """Raised when units of an evaluation ended with errors; the others are kept, the same command tries again."""


class ComparisonError(LifelongError, ValueError):
    """Raised when results cannot be compared; the message names both values of every field that differs."""


@contextmanager
def writing(path: Path, what: str) -> Iterator[None]:
    """Turn what the machine refuses while the block writes, an `OSError`, into a `ResultsError` that names it.

    Args:
        path: Where it is written.
        what: What is written, such as `the page`.
    """
    try:
        yield
    except OSError as error:
        raise ResultsError(f"{path}: {what} cannot be written ({error})") from error


def require_run(path: Path) -> Path:
    """Return the path of a run, or of something of one, if it exists.

    Raises:
        LifelongError: There is nothing.
    """
    if not path.exists():
        raise LifelongError(
            f"{path} does not exist; give the directory of a run, such as runs/libero_object/er/NAME"
        )
    return path


def require_same_module(package: str, folders: Sequence[str], text: str) -> None:
    """Check that a module that has been imported is the one that an import from some folders would find.

    Args:
        package: Name of the module, without points.
        folders: Folders in the order in which they are searched.
        text: What names the module, with which the message begins.

    Raises:
        ConfigError: It is another file.
    """
    loaded = getattr(sys.modules.get(package), "__file__", None)
    if not loaded or package == "__main__":  # which is run, not found
        return
    found = PathFinder.find_spec(package, folders)
    if found and found.origin and os.path.realpath(loaded) != os.path.realpath(found.origin):
        raise ConfigError(
            f"{text}: this process has already imported {package} from {loaded}, which is not {found.origin}; "
            "use the other in a process of its own"
        )
