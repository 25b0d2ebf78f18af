"""One environment of a vector, in a process of its own."""

import multiprocessing
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import connection
from typing import Any

import numpy as np

from libero._adapters.envs.workers import CloudpickleWrapper, EnvWorker, ShArray, WorkerError, set_attribute

_POLL = 0.2  # s, between looks at whether a worker lives
_FAREWELL = 5.0  # s, that a worker is given to close


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
        self._timeout = timeout
        self._buffers: dict[str, ShArray] = {}
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
        waiting, ready = list(workers), []  # type: list[EnvWorker], list[EnvWorker]
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
    main: Any = sys.modules["__main__"]
    hidden: dict[str, Any] = {
        name: main.__dict__.pop(name) for name in ("__file__", "__spec__") if name in main.__dict__
    }
    main.__spec__ = None
    try:
        yield
    finally:
        main.__dict__.update(hidden)


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
                    result = None
                    set_attribute(env, method, *args)
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
