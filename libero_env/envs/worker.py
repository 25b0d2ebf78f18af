"""One environment in a worker process: the parent's end."""

import contextlib
import os
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing import connection, get_context
from multiprocessing.reduction import ForkingPickler
from typing import Any

from gymnasium import spaces
from gymnasium.vector.utils import CloudpickleWrapper

from libero_env.envs.worker_host import GymHost, Host, Shared, serve
from libero_env.errors import InvalidInputError, LiberoError

_JOIN_TIMEOUT = 5.0  # [s] for a worker to end by itself
_PIPE_TIMEOUT = 60.0  # [s] for a message that has begun to go on, in either direction


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
        self.shared: Shared | None = None
        self.opened = False
        self.start()

    def start(self) -> None:
        """Start the process and have it make its environment; `wait_for` collects the answer to that."""
        context = get_context("spawn")
        self.pipe, other = context.Pipe()
        _limit_waiting(self.pipe)
        self.requests = 0
        arguments = (other, CloudpickleWrapper(self.make), self.variables, self.host)
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

    def restart(self) -> None:
        """Replace the process by a new one."""
        self.kill()
        self.start()

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

    def share(self, space: spaces.Dict) -> None:
        """Have observations written to shared memory, the same as before a restart."""
        if self.shared is None:
            self.shared = Shared(space)
        self.send("attach", self.shared.name)

    def free(self) -> None:
        """Free the shared memory."""
        if self.shared is not None:
            self.shared.close()
            self.shared = None


def _limit_waiting(pipe: connection.Connection) -> None:
    """Let reads and writes of a pipe fail where the other end stops in the middle of a message."""
    if os.name == "posix":  # where pipes for both directions are sockets
        limit = struct.pack("ll", int(_PIPE_TIMEOUT), 0)
        with socket.socket(
            fileno=os.dup(pipe.fileno())
        ) as end:  # the limits hold for all handles of the socket
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
        reason: Reason for the error message.
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
        workers: Workers by index.
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
        failures[i] = Failure(f"no answer within {timeout:g} s", True, late=True)
    return answers, failures


def shut_down(workers: Sequence[Worker]) -> None:
    """Close environments, end processes and free memory; those that do not answer are killed."""
    for worker in workers:
        if not worker.pipe.closed and worker.process.is_alive():
            worker.send("close")
    end = time.monotonic() + _JOIN_TIMEOUT
    for worker in workers:
        worker.process.join(max(0.0, end - time.monotonic()))
        if not worker.pipe.closed:
            worker.kill()
        worker.free()


def checked_space(space: spaces.Space, task: str) -> spaces.Dict:
    """Return an observation space if it is a dictionary of boxes.

    Raises:
        LiberoError: It is not.
    """
    if not isinstance(space, spaces.Dict) or not all(isinstance(box, spaces.Box) for box in space.values()):
        raise LiberoError(f"{task}: observations must be a dictionary of arrays to be shared, not {space}")
    return space
