"""One environment of a vector: in this process, or in one of its own.

A worker answers requests in order: `send` starts one and `recv` waits for its answer, so that several work at once.
"""

import multiprocessing
import sys
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import connection, shared_memory
from typing import Any

import cloudpickle
import numpy as np

from libero_env.errors import LiberoError

_POLL = 0.2  # s, between looks at whether a worker lives
_FAREWELL = 5.0  # s, that a worker is given to close


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
        self._memory, self._owner = shared_memory.SharedMemory(create=True, size=size), True

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
        _set(self.env, key, value)

    def close_env(self) -> None:
        """Close the environment."""
        self.env.close()


class SubprocEnvWorker(EnvWorker):
    """An environment in a process of its own, which is spawned: no GL context is inherited.

    Args:
        env_fn: makes the environment, there.
        share_memory: whether observations come back through shared memory.
        timeout: seconds that a call may take; None for any time.
    """

    def __init__(self, env_fn: Callable[[], Any], share_memory: bool = False, timeout: float | None = None):
        super().__init__(env_fn)
        context = multiprocessing.get_context("spawn")
        self.parent_remote, child = context.Pipe()
        self._timeout, self._buffers = timeout, {}  # type: ignore[var-annotated]
        self.share_memory, self._method = share_memory, "making the environment"
        self.process = context.Process(target=_serve, args=(child, CloudpickleWrapper(env_fn)), daemon=True)
        with _without_main():
            self.process.start()
        child.close()

    def send(self, method: str, *args: Any, **kwargs: Any) -> None:
        """Start a call."""
        self._request("call", method, args, kwargs)

    def _request(
        self, kind: str, method: str, args: tuple = (), kwargs: dict[str, Any] | None = None
    ) -> None:
        self._method = method
        buffers = self._buffers if self.share_memory else None
        try:
            self.parent_remote.send((kind, method, args, kwargs or {}, buffers))
        except OSError as error:
            raise WorkerError(self._obituary()) from error

    def recv(self) -> Any:
        """The result of the call that was started.

        Raises:
            WorkerError: it failed there, the process died, or the time is over.
        """
        limit = None if self._timeout is None else time.monotonic() + self._timeout
        while not self.parent_remote.poll(_POLL):
            if not self.process.is_alive() and not self.parent_remote.poll(0):
                raise WorkerError(self._obituary())
            if limit is not None and time.monotonic() > limit:
                self._kill()
                raise WorkerError(
                    f"worker {self.process.pid}: {self._method} took more than {self._timeout} s"
                )
        try:
            kind, result = self.parent_remote.recv()
        except EOFError as error:
            raise WorkerError(self._obituary()) from error
        if kind == "error":
            raise WorkerError(f"worker {self.process.pid}, in {self._method}:\n{result}")
        return self._unshared(result)

    def _obituary(self) -> str:
        self.process.join(_POLL)
        return f"worker {self.process.pid} died in {self._method} (exit code {self.process.exitcode})"

    def _unshared(self, result: Any) -> Any:
        """Make buffers for observations once their shapes are known; later ones come back through them."""
        if not self.share_memory:
            return result
        observation = result[0] if isinstance(result, tuple) else result
        if isinstance(observation, dict):
            for key, value in observation.items():
                if isinstance(value, ShArray):
                    observation[key] = self._buffers[key].get()
                elif isinstance(value, np.ndarray) and key not in self._buffers:
                    self._buffers[key] = ShArray(value.dtype, value.shape)
        return result

    def get_env_attr(self, key: str) -> Any:
        """A copy of an attribute of the environment."""
        self._request("get", key)
        return self.recv()

    def set_env_attr(self, key: str, value: Any) -> None:
        """Set an attribute of the environment, or of the one inside where that has it."""
        self._request("set", key, (value,))
        self.recv()

    def close_env(self) -> None:
        """End the process, by force where it does not answer."""
        try:
            self.parent_remote.send(("close", "close", (), {}, None))
            self.process.join(_FAREWELL)
        except OSError:
            pass
        self._kill()
        self.parent_remote.close()
        for buffer in self._buffers.values():
            buffer.close()

    def _kill(self) -> None:
        if self.process.is_alive():
            self.process.terminate()
            self.process.join(_FAREWELL)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()

    @staticmethod
    def wait(workers: "list[EnvWorker]", wait_num: int, timeout: float | None = None) -> "list[EnvWorker]":
        """The workers that are ready, `wait_num` of them at least unless the time is over."""
        waiting, ready = list(workers), []
        limit = None if timeout is None else time.monotonic() + timeout
        while waiting and len(ready) < min(wait_num, len(workers)):
            left = None if limit is None else max(0.0, limit - time.monotonic())
            remotes = connection.wait([worker.parent_remote for worker in waiting], left)  # type: ignore[attr-defined]
            found = [worker for worker in waiting if worker.parent_remote in remotes]  # type: ignore[attr-defined]
            ready += found
            waiting = [worker for worker in waiting if worker not in found]
            if left == 0.0:
                break
        return ready


@contextmanager
def _without_main() -> Iterator[None]:
    """Keep a process that is spawned from running the script again: what it needs of it comes with the factory."""
    main = sys.modules["__main__"]
    hidden = {name: main.__dict__.pop(name) for name in ("__file__", "__spec__") if name in main.__dict__}
    main.__spec__ = None
    try:
        yield
    finally:
        main.__dict__.update(hidden)


def _set(env: Any, key: str, value: Any) -> None:
    inner = getattr(env, "env", None)
    setattr(inner if inner is not None and not hasattr(env, key) else env, key, value)


def _serve(remote: Any, env_fn: CloudpickleWrapper) -> None:
    """The life of a worker process."""
    env = None
    try:
        while True:
            kind, method, args, kwargs, buffers = remote.recv()
            if kind == "close":
                break
            try:
                env = env_fn.data() if env is None else env
                if kind == "get":
                    result = getattr(env, method)
                elif kind == "set":
                    result = _set(env, method, *args)
                else:
                    result = _shared(getattr(env, method)(*args, **kwargs), buffers)
                remote.send(("result", result))
            except Exception:  # noqa: BLE001 - whatever it is, the parent is told
                remote.send(("error", traceback.format_exc()))
    except (EOFError, KeyboardInterrupt):
        pass  # the parent is gone
    finally:
        if env is not None:
            env.close()
        remote.close()


def _shared(result: Any, buffers: dict[str, ShArray] | None) -> Any:
    """A result with the observation's arrays in shared memory, where there is some of their shape."""
    if not buffers:
        return result
    observation = result[0] if isinstance(result, tuple) else result
    if not isinstance(observation, dict):
        return result
    for key, value in observation.items():
        buffer = buffers.get(key)
        if buffer is not None and isinstance(value, np.ndarray) and value.shape == buffer.shape:
            buffer.save(value)
            observation[key] = buffer
    return result
