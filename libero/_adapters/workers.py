"""Workers of a vector of environments: one in this process, and one in a process of its own.

A worker answers requests in order: `send` starts one and `recv` waits for its answer, so several workers run at once.
"""

import contextlib
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from multiprocessing import connection
from multiprocessing.shared_memory import SharedMemory
from operator import attrgetter
from typing import Any

import numpy as np
from gymnasium.vector import utils

from libero_env.envs.worker import Host, Worker, shut_down, wait_for
from libero_env.errors import ClosedEnvironmentError, LiberoError

CALL_TIMEOUT = 600.0  # [s] for a call, unless told otherwise; making an environment may take minutes


class Shared:
    """Arrays in memory that processes share.

    Args:
        dtype: Type with a field for each array.
        name: Name of the block to attach to; by default a new block is made.

    Attributes:
        name: Name of the block.
        views: Array of each field.
    """

    def __init__(self, dtype: np.dtype, name: str | None = None):
        self._memory = SharedMemory(name, create=name is None, size=max(dtype.itemsize, 1))
        self.name, self._owner = self._memory.name, name is None
        arrays = np.ndarray((), dtype, self._memory.buf)
        self.views = {key: arrays[key] for key in dtype.names or ()}

    def close(self) -> None:
        """Close the block; the process that made it also frees it."""
        self.views = {}
        with contextlib.suppress(BufferError):  # a view is still in use; the memory is closed with it
            self._memory.close()
        if self._owner:
            self._owner = False
            self._memory.unlink()


class VectorHost(Host):
    """The commands of a worker, with observations in shared memory."""

    shared: Shared | None = None

    def call(self, method: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        """Call a method; None stands for arrays of an observation that are in shared memory."""
        # Gymnasium's environments are seeded by a reset
        if method == "seed" and not hasattr(self.env, "seed"):
            self.env.reset(seed=args[0])
            return [args[0]]
        result = super().call(method, args, kwargs)
        if observation := observation_of(result):
            arrays = arrays_of(observation)
            for key, view in self.shared.views.items() if self.shared else ():
                if key in arrays and (arrays[key].shape, arrays[key].dtype) == (view.shape, view.dtype):
                    view[...] = arrays[key]
                    observation[key] = None
        return result

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

    def attach(self, name: str, dtype: np.dtype) -> None:
        """Write observations to shared memory, where they fit its fields."""
        self.shared = Shared(dtype, name)

    def close(self) -> None:
        super().close()
        if self.shared is not None:
            self.shared.close()
            self.shared = None


def observation_of(result: Any) -> dict[str, Any] | None:
    """Return the observation in the result of `reset` or `step`; None where there is none."""
    observation = result[0] if isinstance(result, tuple) else result
    return observation if isinstance(observation, dict) else None


def arrays_of(observation: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the arrays of an observation that processes can share."""
    return {
        key: value
        for key, value in observation.items()
        if isinstance(key, str) and isinstance(value, np.ndarray) and not value.dtype.hasobject
    }


class WorkerError(LiberoError, RuntimeError):
    """Workers failed, died or took too long; the message states which, why, and how to go on.

    Attributes:
        failed: Reason by index of the environment; empty in the error of a single worker.
        results: What the call returned for the other environments, by index.
    """

    def __init__(
        self, message: str, failed: Mapping[int, str] | None = None, results: Mapping[int, Any] | None = None
    ):
        super().__init__(message)
        self.failed, self.results = dict(failed or {}), dict(results or {})


class CloudpickleWrapper(utils.CloudpickleWrapper):
    """Factory that can be sent to another process, also a lambda."""

    data = property(attrgetter("fn"), doc="The factory.")


class ShArray:
    """Array in memory that processes share; the process that made it frees it."""

    def __init__(self, dtype: Any, shape: Sequence[int]):
        self._open(np.dtype(dtype), tuple(shape))

    def _open(self, dtype: np.dtype, shape: tuple[int, ...], name: str | None = None) -> None:
        self.dtype, self.shape = dtype, shape
        self._shared = Shared(np.dtype([("array", dtype, shape)]), name)

    def save(self, array: Any) -> None:
        """Write the array."""
        self._shared.views["array"][...] = array

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


def _asking(method: str) -> Any:
    """Return a method of a worker that returns the result of the method of its environment."""

    def ask(self: Any, *args: Any, **kwargs: Any) -> Any:
        self.start(method, *args, **kwargs)
        return self.finish(method)

    return ask


class EnvWorker(ABC):
    """One environment, of the original's interface or of Gymnasium's: its results are passed on as they are.

    A class of a client's own, such as one written for Tianshou, has to define `send`, `recv`, `get_env_attr`,
    `set_env_attr` and `close_env`.
    """

    def __init__(self, env_fn: Callable[[], Any]):
        self._env_fn, self.is_closed, self.result = env_fn, False, None

    @abstractmethod
    def send(self, action: Any, **kwargs: Any) -> None:
        """Start a step with an action, or with None a reset with keyword arguments."""

    @abstractmethod
    def recv(self) -> Any:
        """Return the result of the call; raise a WorkerError if it failed, the process died, or the time is over."""

    @abstractmethod
    def close_env(self) -> None:
        """Close the environment, by force where it does not answer."""

    @abstractmethod
    def get_env_attr(self, key: str) -> Any:
        """Return an attribute of the environment; of one in another process a copy."""

    @abstractmethod
    def set_env_attr(self, key: str, value: Any) -> None:
        """Set an attribute of the environment without its wrappers, where it or its inner environment has it."""

    def start(self, method: str, *args: Any, **kwargs: Any) -> None:
        """Start a call of a method of the environment, whose result `finish` returns."""
        if method in ("reset", "step"):
            self.send(*(args or (None,)), **kwargs)
        elif getattr(type(self), method) is getattr(EnvWorker, method):
            raise LiberoError(f"{type(self).__name__} does not define {method}")
        else:
            self.result = getattr(self, method)(*args, **kwargs)

    def finish(self, method: str) -> Any:
        """Return the result of the call that was started."""
        return self.recv() if method in ("reset", "step") else self.result

    reset, step, render = map(_asking, ("reset", "step", "render"))
    check_success, get_sim_state = map(_asking, ("check_success", "get_sim_state"))
    set_init_state, get_segmentation_of_interest = map(
        _asking, ("set_init_state", "get_segmentation_of_interest")
    )

    def seed(self, seed: int | None = None) -> Any:
        """Seed the environment, by a reset where it has no `seed`."""
        self.start("seed", seed)
        return self.finish("seed")

    def close(self) -> None:
        """Close the environment. Idempotent."""
        if not self.is_closed:
            self.is_closed = True
            self.close_env()

    def why_lost(self) -> str:
        """Return why no call can succeed any more, such as the end of its process; empty while it works."""
        return ""

    @staticmethod
    def wait(workers: "list[EnvWorker]", wait_num: int, timeout: float | None = None) -> "list[EnvWorker]":
        """Return the workers that are ready: at least `wait_num`, or fewer after `timeout` seconds."""
        return workers


class _HostWorker(EnvWorker):
    """A worker whose environment is in a `VectorHost`."""

    @abstractmethod
    def _send(self, command: str, *args: Any) -> None:
        """Start a command of `VectorHost`."""

    def send(self, action: Any, **kwargs: Any) -> None:
        """Start a step with an action, or with None a reset with keyword arguments."""
        if action is None:
            self.start("reset", **kwargs)
        else:
            self.start("step", action)

    def start(self, method: str, *args: Any, **kwargs: Any) -> None:
        """Start a call of a method of the environment, whose result `finish` returns."""
        self._send("call", method, args, kwargs)

    def finish(self, method: str) -> Any:
        """Return the result of the call that was started."""
        return self.recv()

    def get_env_attr(self, key: str) -> Any:
        """Return an attribute of the environment; of one in another process a copy."""
        self._send("get", key)
        return self.recv()

    def set_env_attr(self, key: str, value: Any) -> None:
        """Set an attribute of the environment without its wrappers, where it or its inner environment has it."""
        self._send("set", key, value)
        self.recv()


class DummyEnvWorker(_HostWorker):
    """An environment in this process."""

    def __init__(self, env_fn: Callable[[], Any]):
        super().__init__(env_fn)
        self._host = VectorHost(env_fn)
        self._host.open()
        self.env = self._host.env

    def _send(self, command: str, *args: Any) -> None:
        if self.is_closed:
            raise ClosedEnvironmentError("this environment is closed; make another")
        self.result = getattr(self._host, command)(*args)

    def recv(self) -> Any:
        """Return the result of the call."""
        return self.result

    def close_env(self) -> None:
        """Close the environment."""
        self._host.close()


class SubprocEnvWorker(_HostWorker):
    """An environment in a process of its own, which is spawned: no GL context is inherited.

    Args:
        env_fn: Factory of the environment, called in the process; a lambda is allowed.
        share_memory: Whether the arrays of observations come back through shared memory.
        timeout: Seconds that a call may take, and at first the start of the process; None for 600.
    """

    def __init__(self, env_fn: Callable[[], Any], share_memory: bool = False, timeout: float | None = None):
        super().__init__(env_fn)
        self.share_memory, self._timeout = share_memory, CALL_TIMEOUT if timeout is None else timeout
        self._worker = Worker("", env_fn, host=VectorHost, run_main=False)
        self._shared: Shared | None = None
        self._opening: int | None = self._worker.requests  # until its answer has come
        self._request, self._since, self._lost = "open", time.monotonic(), ""
        self.process, self.parent_remote = self._worker.process, self._worker.pipe

    def _send(self, command: str, *args: Any) -> None:
        self._check(self.why_lost())
        self._worker.send(command, *args)
        self._request, self._since = args[0], time.monotonic()

    def recv(self) -> Any:
        """Return the result of the call that was started; see `EnvWorker.recv`."""
        self._check(self._lost)
        request = self._worker.requests
        if self._opening is not None:
            self._answer("making the environment", self._opening)
            self._opening, self._since = None, time.monotonic()
        result = self._answer(self._request, request)
        if self.share_memory and (observation := observation_of(result)):
            self._unshare(observation)
        return result

    def why_lost(self) -> str:
        """Return why no call can succeed any more; see `EnvWorker.why_lost`."""
        if not self._lost and not self.process.is_alive():
            self._lost = self._worker.end_reason()
        return self._lost

    def _check(self, lost: str) -> None:
        if self.is_closed:
            raise ClosedEnvironmentError("this environment is closed; make another")
        if lost:
            raise WorkerError(f"worker {self.process.pid}: {lost}")

    @property
    def seconds_left(self) -> float:
        """Seconds until the call that was started has taken too long."""
        return max(0.0, self._since + self._timeout - time.monotonic())

    def _answer(self, name: str, request: int) -> Any:
        """Return the answer to a request; a worker that does not answer, or has no environment, is killed."""
        answers, failures = wait_for({0: self._worker}, self.seconds_left, {0: request})
        if not failures:
            return answers[0]
        reason = failures[0].reason
        if failures[0].late:
            began = time.strftime("%H:%M:%S", time.localtime(time.time() - (time.monotonic() - self._since)))
            reason = (
                f"no answer within {self._timeout:g} s, since {began}; it was ended. If it is only slow, "
                "raise call_timeout="
            )
        if failures[0].lost or self._opening is not None:
            self.process.kill()
            self._lost = f"in {name}: {reason}"
        raise WorkerError(f"worker {self.process.pid}, in {name}: {reason}")

    def _unshare(self, observation: dict[str, Any]) -> None:
        """Fill in the arrays that came through shared memory, which the first observation sets up."""
        if (shared := self._shared) is not None:
            absent = [key for key in shared.views if observation.get(key, 0) is None]
            observation.update({key: shared.views[key].copy() for key in absent})
        elif arrays := arrays_of(observation):
            dtype = np.dtype([(key, one.dtype, one.shape) for key, one in arrays.items()], align=True)
            self._shared = shared = Shared(dtype)
            self._answer("attach", self._worker.send("attach", shared.name, dtype))

    def close_env(self) -> None:
        """End the process, by force where it does not answer."""
        shut_down([self._worker])
        if self._shared is not None:
            self._shared.close()
            self._shared = None

    @staticmethod
    def wait(workers: "list[EnvWorker]", wait_num: int, timeout: float | None = None) -> "list[EnvWorker]":
        """Return the workers that are ready: at least `wait_num`, or fewer after `timeout` seconds."""
        processes = [worker for worker in workers if isinstance(worker, SubprocEnvWorker)]
        remotes: dict[Any, SubprocEnvWorker] = {worker.parent_remote: worker for worker in processes}
        end = time.monotonic() + (math.inf if timeout is None else timeout)
        ready: list[EnvWorker] = []
        while remotes and len(ready) < wait_num:
            late = [remote for remote, worker in remotes.items() if not worker.seconds_left]
            left = min(end - time.monotonic(), *(worker.seconds_left for worker in remotes.values()))
            answered = late or connection.wait(list(remotes), max(0.0, left))
            ready += [remotes.pop(remote) for remote in answered]
            if not answered and time.monotonic() >= end:
                break
        return ready
