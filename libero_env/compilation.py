"""Functions that numba compiles when they are first called, once for the user, such that threads may run them.

Until then nothing of numba is imported, which takes a quarter of a second.
"""

import hashlib
import inspect
import logging
import os
import pickle
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cached_property, lru_cache, update_wrapper
from pathlib import Path
from types import FunctionType
from typing import Any

from filelock import FileLock, Timeout

from libero_env.errors import LiberoError
from libero_env.paths import cache_dir
from libero_env.progress import tell_progress
from libero_env.storage import check_trusted, make_cache_folder

_log = logging.getLogger(__name__)
_DAMAGED = (EOFError, pickle.UnpicklingError, ValueError, LookupError, TypeError, AttributeError, ImportError)
_WAIT_SECONDS = 120.0  # for another process that compiles
_SAID_SECONDS = 600.0  # in which several processes say only once that they compile


class compiled:  # noqa: N801 - a decorator
    """Compile a function with numba when it is first called, such that threads may run it at the same time.

    The machine code is kept in `$NUMBA_CACHE_DIR`, or by default in `compiled` in the cache folder, for all
    environments that have the same source, constants and numba. Where it cannot be written, each process compiles it,
    and where a cached file is damaged, it is compiled again. Of several processes one compiles, and the others wait.

    Args:
        function: Function of numbers and arrays, as numba compiles it. Assigning to slices and rows compiles for two
            seconds, to their elements at once; other numbers of a literal argument are compiled apart.

    Attributes:
        function: The function.
    """

    def __init__(self, function: Callable[..., Any]):
        update_wrapper(self, function)
        self.function = function

    def __call__(self, *args: Any) -> Any:
        return self.dispatcher(*args)

    @cached_property
    def dispatcher(self) -> Any:
        """What numba makes of the function, and of those that it calls."""
        from numba import njit

        code, known = self.function.__code__, self.function.__globals__
        called = {
            name: known[name].dispatcher for name in code.co_names if isinstance(known.get(name), compiled)
        }
        made = njit(nogil=True)(FunctionType(code, known | called, self.function.__name__))
        made._cache = _MachineCode(self.function)  # as `cache=True` does, with another class
        return made


class _MachineCode:
    """Cache of one function's machine code; nothing is read or written before its first call."""

    def __init__(self, function: Callable[..., Any]):
        self._function, self._holds = function, False

    @property
    def cache_path(self) -> str:
        return str(_folder() / f"{Path(inspect.getfile(self._function)).stem}-{_digest(self._function)}")

    def load_overload(self, *args: Any) -> Any:
        if not _is_trusted():
            return None
        if (found := self._load(*args)) is not None:
            return found
        try:
            make_cache_folder(_folder())
            _lock(_folder()).acquire(timeout=_WAIT_SECONDS)
        except (OSError, Timeout):
            _say(None)
            return None
        self._holds = True
        if (found := self._load(*args)) is not None:
            self._release()
        else:
            _say(_folder() / ".compiling")
        return found

    def save_overload(self, *args: Any) -> None:
        if not _is_trusted():
            return
        try:
            self._files().save_overload(*args)
        except OSError as error:
            _warn_uncached(f"{self.cache_path}: {error.strerror or error}")
        finally:
            self._release()

    def flush(self) -> None:
        self._files().flush()

    def _load(self, *args: Any) -> Any:
        try:
            return self._files().load_overload(*args)
        except _DAMAGED as error:
            what = f"{type(error).__name__}: {error}"
            name = self._function.__qualname__
            _log.warning(
                "a compiled %s in %s is damaged (%s); it is compiled again", name, self.cache_path, what
            )
            with suppress(OSError):
                self.flush()
        except OSError:
            pass
        return None

    def _release(self) -> None:
        if self._holds:
            self._holds = False
            _lock(_folder()).release()

    def _files(self) -> Any:
        from numba.core.caching import FunctionCache

        place = _Place(self.cache_path)

        class Files(FunctionCache._impl_class):
            _locator_classes = [place]

        return type("Cache", (FunctionCache,), {"_impl_class": Files})(self._function)


class _Place:
    """What numba asks where a function's machine code is kept; the path tells sources apart."""

    def __init__(self, path: str):
        self._path = path

    def from_function(self, *_: object) -> "_Place":
        return self

    def ensure_cache_path(self) -> None:
        make_cache_folder(Path(self._path))

    def get_cache_path(self) -> str:
        return self._path

    def get_source_stamp(self) -> str:
        return self._path

    def get_disambiguator(self) -> str:
        return ""


def _is_trusted() -> bool:
    """Return whether no other user can have written the machine code, which runs when it is read."""
    try:
        check_trusted(_folder())
    except LiberoError as error:
        _warn_uncached(str(error))
        return False
    return True


def _folder() -> Path:
    return Path(os.environ.get("NUMBA_CACHE_DIR") or cache_dir() / "compiled")


@lru_cache
def _lock(folder: Path) -> FileLock:
    return FileLock(folder / ".lock", thread_local=False)


@lru_cache
def _digest(function: Callable[..., Any]) -> str:
    """Return 16 hex digits that change with what is compiled: source, constants, functions that are called, numba."""
    from numba import __version__ as version

    digest = hashlib.sha256(f"{version} {Path(inspect.getfile(function)).read_bytes()!r}".encode())
    for name in function.__code__.co_names:
        value = function.__globals__.get(name)
        if isinstance(value, compiled):
            digest.update(f"{name} {_digest(value.function)}".encode())
        elif value is not None and not callable(value) and not inspect.ismodule(value):
            digest.update(f"{name} {value!r}".encode())
    return digest.hexdigest()[:16]


def _say(marker: Path | None) -> None:
    """Say that functions are compiled, once, whoever of several processes does."""
    if marker is not None:
        with suppress(OSError):
            if marker.exists() and time.time() - marker.stat().st_mtime < _SAID_SECONDS:
                return
            marker.touch()
    _tell()


@lru_cache(maxsize=1)
def _tell() -> None:
    tell_progress("compiling, once for this user: up to half a minute")


@lru_cache(maxsize=1)
def _warn_uncached(reason: str) -> None:
    _log.warning(
        "functions are compiled at each start, for some seconds: %s. Set NUMBA_CACHE_DIR to a folder that you can "
        "write to",
        reason,
    )
