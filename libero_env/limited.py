"""Calls of functions in a process of their own, with limits of time and memory.

Libraries read meshes, pictures and models of others there: a file that makes one hang, crash or ask for all memory ends
that process, and the caller gets an error in one line.
"""

import json
import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import Any

from libero_env.errors import InvalidInputError, LiberoError

SECONDS = 60.0  # of one call
MEMORY = 3 << 30  # [bytes] of the process, where the system can limit it
_START = "import json, sys; sys.path[:] = json.loads(sys.argv[1]); import libero_env.limited as l; l.serve()"
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # each thread reserves memory


def call_limited(function: Callable[..., Any], *args: Any, about: str) -> Any:
    """Return what a function returns in a process with limits.

    Args:
        args: Its arguments; they and the result can be pickled.
        about: What it reads, such as a path, for messages.

    Raises:
        InvalidInputError: The function raised an error, took more than `SECONDS`, or ended its process.
    """
    with limited_process() as process:
        return process.call(function, args, about)


@contextmanager
def limited_process() -> "Iterator[_Process]":
    """Use the same process for all calls in the block, or that of a block around it: it starts in most of a second."""
    if (running := _current.get()) is not None:
        yield running
        return
    process = _Process()
    token = _current.set(process)
    try:
        yield process
    finally:
        _current.reset(token)
        process.end()


class _Process:
    def __init__(self) -> None:
        self._running: subprocess.Popen[bytes] | None = None

    def call(self, function: Callable[..., Any], args: tuple[Any, ...], about: str) -> Any:
        running = self._running or self._start()
        assert running.stdin is not None and running.stdout is not None
        timer, start = threading.Timer(SECONDS, running.kill), time.monotonic()
        timer.start()
        try:
            pickle.dump((function, args), running.stdin)
            running.stdin.flush()
            error, result = pickle.load(running.stdout)  # noqa: S301 - from our own code
        except (EOFError, OSError, pickle.UnpicklingError):
            late = time.monotonic() - start >= SECONDS
            self.end()
            reason = (
                f"takes more than {SECONDS:.0f} s"
                if late
                else f"ends the process that does it, or needs more than {MEMORY >> 30} GiB"
            )
            raise InvalidInputError(
                f"{about}: reading it {reason}; export it again, or simplify it"
            ) from None
        except BaseException:
            self.end()
            raise
        finally:
            timer.cancel()
        if error is not None:
            raise InvalidInputError(error if error.startswith(about) else f"{about}: {error}")
        return result

    def _start(self) -> "subprocess.Popen[bytes]":
        command = [sys.executable, "-I", "-c", _START, json.dumps(sys.path)]
        self._running = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **_ONE_THREAD},
        )
        return self._running

    def end(self) -> None:
        if self._running is not None:
            self._running.kill()
            self._running.communicate()
            self._running = None


_current: ContextVar[_Process | None] = ContextVar("_current", default=None)


def serve() -> None:
    """Answer the calls of `call_limited`, in the process with limits."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # libraries print to standard output
    _limit_memory()
    while True:
        try:
            function, args = pickle.load(sys.stdin.buffer)  # noqa: S301 - from our own code
        except EOFError:
            return
        try:
            answer: tuple[str | None, Any] = (None, function(*args))
        except MemoryError:
            answer = (f"it needs more than {MEMORY >> 30} GiB of memory; simplify it", None)
        except LiberoError as error:
            answer = (str(error), None)
        except Exception as error:  # noqa: BLE001 - readers of formats raise errors of many types
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            answer = (f"it cannot be read ({reason}); export it again", None)
        pickle.dump(answer, answers)
        answers.flush()


def _limit_memory() -> None:
    with suppress(ImportError, ValueError, OSError):  # Windows limits no processes, and macOS not this
        import resource

        _, most = resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY if most < 0 else min(MEMORY, most), most))
