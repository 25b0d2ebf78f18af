"""The end of a worker in its own process: an environment, the commands on it, and shared memory for observations."""

import contextlib
import os
import signal
import traceback
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from multiprocessing.shared_memory import SharedMemory
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from libero_env.errors import LiberoError, is_debugging
from libero_env.parallel import end_with_parent


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
        sizes = [int(np.prod(shape)) * dtype.itemsize for _, shape, dtype in boxes]
        starts = np.cumsum([0, *(-(-size // 64) * 64 for size in sizes)])  # aligned
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
            except LiberoError as error:  # its text says it all
                text = f"{type(error).__name__}: {error}"
                said = f"it raised {text}" if not is_debugging() else f"it raised\n{traceback.format_exc()}"
                answer = ForkingPickler.dumps((number, False, said))
            except Exception:  # noqa: BLE001 - the other end raises it
                answer = ForkingPickler.dumps((number, False, f"it raised\n{traceback.format_exc()}"))
            pipe.send_bytes(answer)
            if command == "close":
                return
    except (EOFError, BrokenPipeError, ConnectionResetError):
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
