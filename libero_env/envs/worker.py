"""One environment in a worker process.

`Host` and `serve` are the end in the worker: an environment, and the commands on it. `Worker` and `wait_for` are the
parent's end.
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
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import connection
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from typing import Any

from gymnasium import spaces
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

    def open(self) -> Any:
        """Make the environment."""
        self.env = self.make()

    def call(self, method: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        """Call a method of the environment and return its result."""
        return getattr(self.env, method)(*args, **kwargs)

    def close(self) -> None:
        """Close the environment. Idempotent."""
        if self.env is not None:
            self.env.close()
            self.env = None


class GymHost(Host):
    """A Gymnasium environment in a worker."""

    def open(self) -> tuple[spaces.Space, spaces.Space]:
        """Make the environment and return its observation and action space."""
        super().open()
        return self.env.observation_space, self.env.action_space

    def look(self, name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        """Return an attribute of the environment without its wrappers, or the result of calling it."""
        value = getattr(self.env.unwrapped, name)
        return value(*args, **kwargs) if callable(value) else value


def serve(
    pipe: Connection, make: Callable[[], Any], variables: Mapping[str, str], host_class: type[Host]
) -> None:
    """Run commands in a worker until `close`, or until the other end of the pipe is gone.

    The wait for the next command has no limit; the process ends with its parent.
    """
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that asks; it decides
    os.environ.update(variables)
    host = host_class(make)
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


@dataclass
class Worker:
    """The parent's end of one worker.

    Requests are numbered, and answers have the number of their request: one that was given up, because of an error or
    an interruption, is dropped when it comes and is never taken for the answer to a later request.

    Attributes:
        task: Name of the environment in messages.
        make: Factory of the environment, called in the worker.
        variables: Environment variables of the worker, such as the GPU to render on.
        host: Class whose methods are the commands; it is built with `make`, and has a command `open`.
        run_main: Whether the process runs the script of this one again, without its main part. Factories that are
            defined in the script do not need it.
    """

    task: str
    make: Callable[[], Any]
    variables: Mapping[str, str] = field(default_factory=dict)
    host: type[Host] = GymHost
    run_main: bool = True

    def __post_init__(self) -> None:
        self.opened = False
        self.start()

    def start(self) -> None:
        """Start the process and have it make its environment; `wait_for` collects the answer to that."""
        context = spawn_context()
        self.pipe, other = context.Pipe()
        _limit_waiting(self.pipe)
        self.requests = 0
        make = partial(with_entries, user_entries(), self.make)
        arguments = (other, CloudpickleWrapper(make), self.variables, self.host)
        self.process = context.Process(target=serve, args=arguments, daemon=True)
        with contextlib.nullcontext() if self.run_main else _hidden_main():
            self.process.start()
        other.close()
        self.opened = False
        self.send("open")

    def send(self, command: str, *args: Any) -> int:
        """Send a command; nothing happens if the worker is gone.

        Returns:
            Number of the request.

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
        return self.requests

    def receive(self, request: int) -> tuple[bool, Any] | None:
        """Return whether a request succeeded, and its result or failure; None if only earlier answers have come.

        Raises:
            EOFError: The process has ended.
            OSError: It has ended, or stopped within an answer.
        """
        while self.pipe.poll():
            number, done, value = self.pipe.recv()
            if number == request:
                return done, value
        return None

    def kill(self) -> None:
        """End the process at once."""
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


@dataclass(frozen=True)
class Failure:
    """A worker that did not answer.

    Attributes:
        lost: Whether its process has to be replaced.
        late: Whether it had no time left.
    """

    reason: str
    lost: bool
    late: bool = False


def wait_for(
    workers: Mapping[int, Worker], timeout: float, requests: Mapping[int, int] | None = None
) -> tuple[dict[int, Any], dict[int, Failure]]:
    """Wait for the answers to requests.

    Args:
        timeout: Largest time to wait, s.
        requests: Number of the request by index; by default the last one of each worker.

    Returns:
        Answers and failures, by index.
    """
    answers: dict[int, Any] = {}
    failures: dict[int, Failure] = {}
    wanted = {i: worker.requests for i, worker in workers.items()} | dict(requests or {})
    waiting, end = dict(workers), time.monotonic() + timeout
    while waiting:
        index: dict[Any, int] = {w.pipe: i for i, w in waiting.items()}
        index |= {w.process.sentinel: i for i, w in waiting.items()}
        ready = connection.wait(list(index), max(0.0, end - time.monotonic()))
        for i in {index[item] for item in ready}:
            worker = waiting[i]
            ended = not worker.process.is_alive()  # before the answer is read: it may have come in between
            try:
                answer = worker.receive(wanted[i])
            except (EOFError, OSError):
                answer, ended = None, True
            if answer is None and not ended:
                continue  # an answer that was given up
            del waiting[i]
            if answer is None:
                failures[i] = Failure(worker.end_reason(), True)
            elif answer[0]:
                answers[i] = answer[1]
            else:
                failures[i] = Failure(answer[1], False)
        if not ready:
            break
    for i in waiting:
        reason = f"no answer within {timeout:g} s (drivers that hang with several EGL renderers need MUJOCO_GL=osmesa)"
        failures[i] = Failure(reason, True, late=True)
    return answers, failures


def shut_down(workers: Sequence[Worker]) -> None:
    """Close environments and end processes; those that do not answer are killed."""
    for worker in workers:
        if not worker.pipe.closed and worker.process.is_alive():
            worker.send("close")
    end = time.monotonic() + _JOIN_TIMEOUT
    for worker in workers:
        worker.process.join(max(0.0, end - time.monotonic()))
        if not worker.pipe.closed:
            worker.kill()
