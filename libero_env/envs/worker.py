"""One environment in a worker process: the parent's end."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing import connection, get_context
from typing import Any

from gymnasium import spaces
from gymnasium.vector.utils import CloudpickleWrapper

from libero_env.envs.worker_host import GymHost, Host, Shared, serve
from libero_env.errors import LiberoError

_JOIN_TIMEOUT = 5.0  # [s] for a worker to end by itself


@dataclass
class Worker:
    """The parent's end of one worker.

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
        arguments = (other, CloudpickleWrapper(self.make), self.variables, self.host)
        self.process = context.Process(target=serve, args=arguments, daemon=True)
        with contextlib.nullcontext() if self.run_main else _hidden_main():
            self.process.start()
        other.close()
        self.opened = False
        self.send("open")

    def send(self, command: str, *args: Any) -> None:
        """Send a command; nothing happens if the worker is gone."""
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.pipe.send((command, *args))

    def restart(self) -> None:
        """Replace the process by a new one."""
        self.kill()
        self.start()

    def kill(self) -> None:
        """End the process at once."""
        self.process.kill()
        self.process.join(_JOIN_TIMEOUT)
        self.pipe.close()

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
    """

    reason: str
    lost: bool


def wait_for(
    workers: Mapping[int, Worker], timeout: float | None
) -> tuple[dict[int, Any], dict[int, Failure]]:
    """Wait for the answers to the last commands.

    Args:
        workers: Workers by index.
        timeout: Largest time to wait, s; None waits forever.

    Returns:
        Answers and failures, by index.
    """
    answers: dict[int, Any] = {}
    failures: dict[int, Failure] = {}
    waiting, end = dict(workers), None if timeout is None else time.monotonic() + timeout
    while waiting:
        index: dict[Any, int] = {w.pipe: i for i, w in waiting.items()}
        index |= {w.process.sentinel: i for i, w in waiting.items()}
        ready = connection.wait(list(index), None if end is None else max(0.0, end - time.monotonic()))
        for i in {index[item] for item in ready}:
            worker = waiting.pop(i)
            try:
                if not worker.pipe.poll():
                    raise EOFError
                done, value = worker.pipe.recv()
            except (EOFError, ConnectionResetError):
                worker.process.join(_JOIN_TIMEOUT)
                failures[i] = Failure(f"its process ended (exit code {worker.process.exitcode})", True)
                continue
            if done:
                answers[i] = value
            else:
                failures[i] = Failure(f"it raised\n{value}", False)
        if not ready:
            break
    for i in waiting:
        failures[i] = Failure(f"no answer within {timeout:g} s", True)
    return answers, failures


def shut_down(workers: Sequence[Worker]) -> None:
    """Close environments, end processes and free memory; those that do not answer are killed."""
    for worker in workers:
        if worker.process.is_alive():
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
