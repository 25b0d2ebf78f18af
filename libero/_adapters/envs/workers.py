"""One environment of a vector: what any worker does, and the one that works in this process.

A worker answers requests in order: `send` starts one and `recv` waits for its answer, so that several work at once.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from multiprocessing import shared_memory
from typing import Any

import cloudpickle
import numpy as np

from libero_env.errors import LiberoError


class WorkerError(LiberoError, RuntimeError):
    """A worker failed, died or took too long; the message says which and why."""


class CloudpickleWrapper:
    """A factory that survives being sent to another process, a lambda included."""

    def __init__(self, data: Any):
        self.data = data

    def __getstate__(self) -> bytes:
        return cloudpickle.dumps(self.data)

    def __setstate__(self, data: bytes) -> None:
        self.data = cloudpickle.loads(data)


class ShArray:
    """An array in memory that processes share; whoever made it frees it."""

    def __init__(self, dtype: Any, shape: Sequence[int]):
        self.dtype, self.shape = np.dtype(dtype), tuple(shape)
        size = max(1, self.dtype.itemsize * int(np.prod(self.shape)))
        self._memory: Any = shared_memory.SharedMemory(create=True, size=size)
        self._owner = True

    def save(self, array: Any) -> None:
        """Write."""
        self._view()[...] = array

    def get(self) -> np.ndarray:
        """A copy."""
        return self._view().copy()

    def close(self) -> None:
        """Let go of the memory. Idempotent."""
        if self._memory is not None:
            self._memory.close()
            if self._owner:
                self._memory.unlink()
            self._memory = None

    def _view(self) -> np.ndarray:
        return np.ndarray(self.shape, self.dtype, self._memory.buf)

    def __getstate__(self) -> tuple:
        return self.dtype, self.shape, self._memory.name

    def __setstate__(self, state: tuple) -> None:
        self.dtype, self.shape, name = state
        self._memory, self._owner = shared_memory.SharedMemory(name), False


class EnvWorker(ABC):
    """One environment."""

    def __init__(self, env_fn: Callable[[], Any]):
        self._env_fn, self.is_closed = env_fn, False
        self.result: Any = None

    @abstractmethod
    def send(self, method: str, *args: Any, **kwargs: Any) -> None:
        """Start a call of the environment."""

    @abstractmethod
    def recv(self) -> Any:
        """The result of the call that was started.

        Raises:
            WorkerError: it failed.
        """

    @abstractmethod
    def get_env_attr(self, key: str) -> Any:
        """An attribute of the environment."""

    @abstractmethod
    def set_env_attr(self, key: str, value: Any) -> None:
        """Set an attribute of the environment."""

    @abstractmethod
    def close_env(self) -> None:
        """Close the environment."""

    def call(self, method: str, *args: Any, **kwargs: Any) -> Any:
        """Call a method of the environment."""
        self.send(method, *args, **kwargs)
        return self.recv()

    def reset(self, **kwargs: Any) -> Any:
        """Call `reset`."""
        return self.call("reset", **kwargs)

    def step(self, action: Any) -> Any:
        """Call `step`."""
        return self.call("step", action)

    def seed(self, seed: int | None = None) -> Any:
        """Call `seed`."""
        return self.call("seed", seed)

    def render(self, **kwargs: Any) -> Any:
        """Call `render`."""
        return self.call("render", **kwargs)

    def check_success(self) -> bool:
        """Call `check_success`."""
        return self.call("check_success")

    def get_segmentation_of_interest(self, segmentation_image: np.ndarray) -> np.ndarray:
        """Call `get_segmentation_of_interest`."""
        return self.call("get_segmentation_of_interest", segmentation_image)

    def get_sim_state(self) -> np.ndarray:
        """Call `get_sim_state`."""
        return self.call("get_sim_state")

    def set_init_state(self, init_state: np.ndarray) -> Any:
        """Call `set_init_state`."""
        return self.call("set_init_state", init_state)

    def close(self) -> None:
        """Close the environment. Idempotent."""
        if not self.is_closed:
            self.is_closed = True
            self.close_env()

    @staticmethod
    def wait(workers: "list[EnvWorker]", wait_num: int, timeout: float | None = None) -> "list[EnvWorker]":
        """The workers that are ready, `wait_num` of them at least unless the time is over."""
        return workers


class DummyEnvWorker(EnvWorker):
    """An environment in this process."""

    def __init__(self, env_fn: Callable[[], Any]):
        super().__init__(env_fn)
        self.env = env_fn()

    def send(self, method: str, *args: Any, **kwargs: Any) -> None:
        """Make the call."""
        self.result = getattr(self.env, method)(*args, **kwargs)

    def recv(self) -> Any:
        """Its result."""
        return self.result

    def get_env_attr(self, key: str) -> Any:
        """An attribute of the environment."""
        return getattr(self.env, key)

    def set_env_attr(self, key: str, value: Any) -> None:
        """Set an attribute of the environment, or of the one inside where that has it."""
        set_attribute(self.env, key, value)

    def close_env(self) -> None:
        """Close the environment."""
        self.env.close()


def set_attribute(env: Any, key: str, value: Any) -> None:
    """Set an attribute of an environment, or of the one inside where only that has it."""
    inner = getattr(env, "env", None)
    setattr(inner if inner is not None and not hasattr(env, key) else env, key, value)
