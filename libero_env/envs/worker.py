"""One environment in a worker process: both ends of the pipe, and the memory they share."""

import contextlib
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing import connection, get_context
from multiprocessing.connection import Connection
from multiprocessing.shared_memory import SharedMemory
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import CloudpickleWrapper

from libero_env.errors import LiberoError

_JOIN_TIMEOUT = 5.0  # [s] for a worker to end by itself


class Shared:
    """The observation of one environment in shared memory.

    Args:
        layout: Space or array, with `shape` and `dtype`, of each entry.
        name: Name of the block to attach to; by default a new block is made.

    Attributes:
        name: Name of the block.
        views: Array of each entry.
    """

    def __init__(self, layout: Mapping[str, Any], name: str | None = None):
        boxes = [(key, tuple(box.shape or ()), np.dtype(box.dtype)) for key, box in layout.items()]
        starts = np.cumsum(
            [0, *(-(-int(np.prod(s)) * d.itemsize // 64) * 64 for _, s, d in boxes)]
        )  # aligned
        self._memory = SharedMemory(name, create=name is None, size=max(int(starts[-1]), 1))
        self.name = self._memory.name
        self._owner = name is None
        self.views = {
            key: np.ndarray(shape, dtype, self._memory.buf, int(start))
            for (key, shape, dtype), start in zip(boxes, starts, strict=False)
        }

    def write(self, observation: Mapping[str, np.ndarray]) -> None:
        """Copy an observation to the shared memory."""
        for key, view in self.views.items():
            view[...] = observation[key]

    def close(self) -> None:
        """Close the block; the process that made it also frees it."""
        self.views = {}
        with contextlib.suppress(BufferError):  # a view is still in use; the memory is closed with it
            self._memory.close()
        if self._owner:
            self._owner = False
            self._memory.unlink()


class Host:
    """An environment in a worker; each method of a subclass is a command.

    Attributes:
        env: The environment, which the command `open` makes with `make`.
        shared: Shared memory for observations.
    """

    def __init__(self, make: Callable[[], Any]):
        self.make = make
        self.env: Any = None
        self.shared: Shared | None = None

    def close(self) -> None:
        """Close the environment and the shared memory. Idempotent."""
        if self.env is not None:
            self.env.close()
            self.env = None
        if self.shared is not None:
            self.shared.close()
            self.shared = None


def open_libero(spec: Mapping[str, Any]) -> gymnasium.Env:
    """Make a `LiberoEnv` from its arguments; it is imported here, in the worker."""
    from libero_env.envs.env import LiberoEnv

    return LiberoEnv(**spec)


def serve(
    pipe: Connection, make: Callable[[], Any], variables: Mapping[str, str], host_class: type[Host]
) -> None:
    """Run commands in a worker until `close`, or until the other end of the pipe is gone."""
    os.environ.update(variables)
    host = host_class(make)
    try:
        while True:
            command, *args = pipe.recv()
            try:
                pipe.send((True, getattr(host, command)(*args)))
            except Exception:  # noqa: BLE001 - the other end raises it
                pipe.send((False, traceback.format_exc()))
            if command == "close":
                return
    except (EOFError, BrokenPipeError, KeyboardInterrupt):
        host.close()


class GymHost(Host):
    """A Gymnasium environment in a worker."""

    def open(self) -> tuple[spaces.Space, spaces.Space]:
        """Make the environment and return its observation and action space."""
        self.env = self.make()
        return self.env.observation_space, self.env.action_space

    def attach(self, name: str) -> None:
        """Attach the shared memory for observations."""
        self.shared = Shared(self.env.observation_space, name)

    def reset(self, seed: int | None, options: dict[str, Any]) -> dict[str, Any]:
        """Reset the environment, write its observation and return its info."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._write(observation)
        return info

    def step(self, action: np.ndarray) -> tuple[float, bool, bool, dict[str, Any]]:
        """Step the environment, write its observation and return reward, terminated, truncated and info."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._write(observation)
        return reward, terminated, truncated, info

    def call(self, name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        """Return an attribute of the environment, or the result of calling it."""
        value = getattr(self.env.unwrapped, name)
        return value(*args, **kwargs) if callable(value) else value

    def _write(self, observation: Mapping[str, np.ndarray]) -> None:
        assert self.shared is not None, "the shared memory is attached before the first reset"
        self.shared.write(observation)


class CallHost(Host):
    """Any environment in a worker: its methods and attributes."""

    def open(self) -> None:
        """Make the environment."""
        self.env = self.make()

    def call(self, method: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        """Call a method of the environment and return its result."""
        return getattr(self.env, method)(*args, **kwargs)

    def get(self, key: str) -> Any:
        """Return an attribute of the environment."""
        return getattr(self.env, key)

    def set(self, key: str, value: Any) -> None:
        """Set an attribute of the environment, or of its inner environment where only that has it."""
        inner = getattr(self.env, "env", None)
        setattr(inner if inner is not None and not hasattr(self.env, key) else self.env, key, value)


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
