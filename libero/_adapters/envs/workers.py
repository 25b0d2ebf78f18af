"""Workers of a vector of environments: one in this process, and one in a process of its own.

A worker answers requests in order: `send` starts one and `recv` waits for its answer, so several workers run at once.
"""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from multiprocessing import connection
from operator import attrgetter
from typing import Any

import numpy as np
from gymnasium.vector import utils

from libero_env.envs.worker import Worker, shut_down, wait_for
from libero_env.envs.worker_host import CallHost, Shared
from libero_env.errors import LiberoError

# Methods of the environment that a worker has, too: each sends the call and waits for the answer.
METHODS = {"reset", "step", "seed", "render", "check_success", "get_segmentation_of_interest"}
METHODS |= {"get_sim_state", "set_init_state"}


class WorkerError(LiberoError, RuntimeError):
    """A worker failed, died or took too long; the message states which one and why."""


class CloudpickleWrapper(utils.CloudpickleWrapper):
    """Factory that can be sent to another process, also a lambda."""

    data = property(attrgetter("fn"), doc="The factory.")


class ShArray:
    """Array in memory that processes share; the process that made it frees it."""

    def __init__(self, dtype: Any, shape: Sequence[int]):
        self._open(np.dtype(dtype), tuple(shape))

    def _open(self, dtype: np.dtype, shape: tuple[int, ...], name: str | None = None) -> None:
        self.dtype, self.shape = dtype, shape
        self._shared = Shared({"array": np.empty(shape, dtype)}, name)

    def save(self, array: Any) -> None:
        """Write the array."""
        self._shared.write({"array": array})

    def get(self) -> np.ndarray:
        """Return a copy of the array."""
        return self._shared.views["array"].copy()

    def close(self) -> None:
        """Release the memory. Idempotent."""
        self._shared.close()

    def __getstate__(self) -> tuple:
        return self.dtype, self.shape, self._shared.name

    def __setstate__(self, state: tuple) -> None:
        self._open(*state)


class EnvWorker(ABC):
    """One environment. The methods in `METHODS` call those of the environment and return their results."""

    def __init__(self, env_fn: Callable[[], Any]):
        self._env_fn, self.is_closed = env_fn, False

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name in METHODS:
            return partial(self._ask, name)
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    @abstractmethod
    def _send(self, command: str, *args: Any) -> None:
        """Start a command of `VectorHost`."""

    @abstractmethod
    def recv(self) -> Any:
        """Return the result of the call; raise a WorkerError if it failed, the process died, or the time is over."""

    @abstractmethod
    def close_env(self) -> None:
        """Close the environment, by force where it does not answer."""

    def send(self, method: str, *args: Any, **kwargs: Any) -> None:
        """Start a call of a method of the environment."""
        self._send("call", method, args, kwargs)

    def get_env_attr(self, key: str) -> Any:
        """Return an attribute of the environment; of one in another process a copy."""
        self._send("get", key)
        return self.recv()

    def set_env_attr(self, key: str, value: Any) -> None:
        """Set an attribute of the environment, or of its inner environment where only that has it."""
        self._send("set", key, value)
        self.recv()

    def close(self) -> None:
        """Close the environment. Idempotent."""
        if not self.is_closed:
            self.is_closed = True
            self.close_env()

    @staticmethod
    def wait(workers: "list[EnvWorker]", wait_num: int, timeout: float | None = None) -> "list[EnvWorker]":
        """Return the workers that are ready: at least `wait_num`, or fewer after `timeout` seconds."""
        return workers

    def _ask(self, method: str, *args: Any, **kwargs: Any) -> Any:
        self.send(method, *args, **kwargs)
        return self.recv()


class DummyEnvWorker(EnvWorker):
    """An environment in this process."""

    def __init__(self, env_fn: Callable[[], Any]):
        super().__init__(env_fn)
        self._host = VectorHost(env_fn)
        self._host.open()
        self.env, self.result = self._host.env, None

    def _send(self, command: str, *args: Any) -> None:
        self.result = getattr(self._host, command)(*args)

    def recv(self) -> Any:
        """Return the result of the call."""
        return self.result

    def close_env(self) -> None:
        """Close the environment."""
        self._host.close()


class SubprocEnvWorker(EnvWorker):
    """An environment in a process of its own, which is spawned: no GL context is inherited.

    Args:
        env_fn: Factory of the environment, called in the process; a lambda is allowed.
        share_memory: Whether the arrays of observations come back through shared memory.
        timeout: Seconds that a call may take; None for no limit.
    """

    def __init__(self, env_fn: Callable[[], Any], share_memory: bool = False, timeout: float | None = None):
        super().__init__(env_fn)
        self.share_memory, self._timeout, self._request = share_memory, timeout, ""
        self._worker = Worker("", env_fn, host=VectorHost, run_main=False)
        self.process, self.parent_remote = self._worker.process, self._worker.pipe

    def _send(self, command: str, *args: Any) -> None:
        self._request = args[0]
        self._worker.send(command, *args)

    def recv(self) -> Any:
        """Return the result of the call that was started; see `EnvWorker.recv`."""
        if not self._worker.opened:
            self._answer("making the environment")
            self._worker.opened = True
        result = self._answer(self._request)
        if self.share_memory and (observation := _observation(result)):
            self._unshare(observation)
        return result

    def _answer(self, request: str) -> Any:
        """Return the answer to a request; a worker that does not answer, or has no environment, is killed."""
        answers, failures = wait_for({0: self._worker}, self._timeout)
        if not failures:
            return answers[0]
        if failures[0].lost or not self._worker.opened:
            self.process.kill()
        raise WorkerError(f"worker {self.process.pid}, in {request}: {failures[0].reason}")

    def _unshare(self, observation: dict[str, Any]) -> None:
        """Fill in the arrays that came through shared memory, which the first observation sets up."""
        shared = self._worker.shared
        if shared is not None:
            absent = [key for key in shared.views if observation.get(key, 0) is None]
            observation.update({key: shared.views[key].copy() for key in absent})
        elif arrays := _arrays(observation):
            self._worker.shared = Shared(arrays)
            self._worker.send("attach", self._worker.shared.name)
            self._answer("attach")

    def close_env(self) -> None:
        """End the process, by force where it does not answer."""
        shut_down([self._worker])

    @staticmethod
    def wait(workers: "list[EnvWorker]", wait_num: int, timeout: float | None = None) -> "list[EnvWorker]":
        """Return the workers that are ready: at least `wait_num`, or fewer after `timeout` seconds."""
        remotes: dict[Any, EnvWorker] = {worker.parent_remote: worker for worker in workers}
        end = None if timeout is None else time.monotonic() + timeout
        ready: list[EnvWorker] = []
        while remotes and len(ready) < wait_num:
            found = connection.wait(list(remotes), None if end is None else max(0.0, end - time.monotonic()))
            ready += [remotes.pop(remote) for remote in found]
            if not found:
                break
        return ready


class VectorHost(CallHost):
    """The commands of a worker, with observations in shared memory."""

    layout: Mapping[str, np.ndarray] = {}  # arrays of the first observation

    def call(self, method: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        """Call a method; None stands for arrays of an observation that are in shared memory."""
        result = super().call(method, args, kwargs)
        if observation := _observation(result):
            arrays = _arrays(observation)
            self.layout = self.layout or arrays
            for key, view in self.shared.views.items() if self.shared else ():
                if key in arrays and arrays[key].shape == view.shape:
                    view[...] = arrays[key]
                    observation[key] = None
        return result

    def attach(self, name: str) -> None:
        """Write observations to shared memory, laid out as the first observation was."""
        self.shared = Shared(self.layout, name)


def _observation(result: Any) -> dict[str, Any] | None:
    """Return the observation in the result of `reset` or `step`; None where there is none."""
    observation = result[0] if isinstance(result, tuple) else result
    return observation if isinstance(observation, dict) else None


def _arrays(observation: Mapping[str, Any]) -> dict[str, np.ndarray]:
    return {key: value for key, value in observation.items() if isinstance(value, np.ndarray)}
