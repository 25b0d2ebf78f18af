"""One environment in a worker process.

`Host` and `serve` are the end in the worker: an environment, and the commands on it. `Worker` is the parent's end.
"""

import contextlib
import os
import signal
import socket
import struct
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from multiprocessing import connection
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from typing import Any

from gymnasium.vector.utils import CloudpickleWrapper

from libero_env.errors import InvalidInputError, LiberoError, is_debugging
from libero_env.parallel import end_with_parent, spawn_context, user_entries, with_entries

_JOIN_TIMEOUT = 5.0  # [s] for a worker to end by itself
_PIPE_TIMEOUT = 60.0  # [s] for a message that has begun to go on, in either direction


class Host:
    """An environment in a worker; each method is a command.

    Attributes:
        env: The environment, which the command `open` makes with `make`.
    """

    def __init__(self, make: Callable[[], Any]):
        self.make = make
        self.env: Any = None

    def open(self) -> None:
        """Make the environment."""
        self.env = self.make()

    def call(self, method: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        """Call a method of the environment and return its result; Gymnasium's are seeded by a reset."""
        if method == "seed" and not hasattr(self.env, "seed"):
            self.env.reset(seed=args[0])
            return [args[0]]
        return getattr(self.env, method)(*args, **kwargs)

    def get(self, key: str) -> Any:
        """Return an attribute of the environment, of its wrappers first."""
        return getattr(self.env if hasattr(self.env, key) else getattr(self.env, "unwrapped", self.env), key)

    def set(self, key: str, value: Any) -> None:
        """Set an attribute of the environment; where only the one in it, or in its wrappers, has it, of that."""
        if hasattr(self.env, "unwrapped"):
            setattr(self.env.unwrapped, key, value)
        else:
            inner = getattr(self.env, "env", None)
            setattr(inner if inner is not None and not hasattr(self.env, key) else self.env, key, value)

    def close(self) -> None:
        """Close the environment. Idempotent."""
        if self.env is not None:
            self.env.close()
            self.env = None


def serve(pipe: Connection, make: Callable[[], Any]) -> None:
    """Run commands in a worker until `close`, or until the other end of the pipe is gone.

    The wait for the next command has no limit; the process ends with its parent.
    """
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that asks; it decides
    host = Host(make)
    try:
        while True:
            number, command, args = pipe.recv()
            try:
                answer = ForkingPickler.dumps((number, True, getattr(host, command)(*args)))
            except Exception as error:  # noqa: BLE001 - the other end raises it
                says_all = isinstance(error, LiberoError) and not is_debugging()
                text = f" {type(error).__name__}: {error}" if says_all else f"\n{traceback.format_exc()}"
                answer = ForkingPickler.dumps((number, False, f"it raised{text}"))
            pipe.send_bytes(answer)
            if command == "close":
                return
    except (EOFError, BrokenPipeError, ConnectionResetError):
        host.close()


class Worker:
    """The parent's end of one worker, which is started without the main part of the script of this process.

    Requests are numbered, and answers have the number of their request: one that was given up, because of an error or
    an interruption, is dropped when it comes and is never taken for the answer to a later request.

    Args:
        make: Factory of the environment, called in the worker; the first request is to make it.
    """

    def __init__(self, make: Callable[[], Any]):
        context = spawn_context()
        self.pipe, other = context.Pipe()
        _limit_waiting(self.pipe)
        self.requests = 0
        make = CloudpickleWrapper(partial(with_entries, user_entries(), make))
        self.process = context.Process(target=serve, args=(other, make), daemon=True)
        with _hidden_main():
            self.process.start()
        other.close()
        self.send("open")

    def send(self, command: str, *args: Any) -> None:
        """Send a command; nothing happens if the worker is gone.

        Raises:
            InvalidInputError: An argument cannot be sent to another process; nothing was sent.
        """
        try:
            message = ForkingPickler.dumps((self.requests + 1, command, args))
        except Exception as error:
            raise InvalidInputError(
                f"{command}: an argument cannot be sent to a worker process ({error}); "
                "pass plain data, arrays, or functions of a module"
            ) from error
        self.requests += 1
        with contextlib.suppress(OSError):  # it is gone or hangs: so says the wait for its answer
            self.pipe.send_bytes(message)

    def answer(self, request: int, seconds: float) -> tuple[bool, Any]:
        """Return whether a request succeeded, and its result or failure.

        Raises:
            TimeoutError: There was no answer in that time.
            EOFError: There can be none any more; the message says why.
        """
        end = time.monotonic() + seconds
        while connection.wait([self.pipe, self.process.sentinel], max(0.0, end - time.monotonic())):
            ended = not self.process.is_alive()  # before the answer is read: it may have come in between
            try:
                while self.pipe.poll():
                    number, done, value = self.pipe.recv()
                    if number == request:
                        return done, value
            except (EOFError, OSError):
                ended = True
            if ended:
                raise EOFError(self.end_reason())
        raise TimeoutError

    def close(self) -> None:
        """Close the environment and end the process, by force where it does not answer."""
        if self.process.is_alive():
            self.send("close")
        self.process.join(_JOIN_TIMEOUT)
        self.process.kill()
        self.process.join(_JOIN_TIMEOUT)
        self.pipe.close()

    def end_reason(self) -> str:
        """Return why no answer can come any more, after the pipe has failed."""
        self.process.join(_JOIN_TIMEOUT)
        if self.process.exitcode is None:
            return f"it stopped within an answer, for {_PIPE_TIMEOUT:g} s"
        return f"its process ended (exit code {self.process.exitcode})"


def _limit_waiting(pipe: connection.Connection) -> None:
    """Let reads and writes of a pipe fail where the other end stops in the middle of a message."""
    if os.name == "posix":  # where pipes for both directions are sockets
        limit = struct.pack("ll", int(_PIPE_TIMEOUT), 0)
        with socket.socket(fileno=os.dup(pipe.fileno())) as end:  # they hold for all handles of the socket
            end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)


@contextlib.contextmanager
def _hidden_main() -> Iterator[None]:
    """Hide the script of this process from processes that are started."""
    main: dict[str, Any] = vars(sys.modules["__main__"])
    hidden = {name: main.pop(name) for name in ["__file__", "__spec__"] if name in main}
    main["__spec__"] = None
    try:
        yield
    finally:
        main.update(hidden)
