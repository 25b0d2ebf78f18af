"""Workers of a vector of environments: one in this process, and one in a process of its own.

A worker answers requests in order: `send` starts one and `recv` waits for its answer, so several workers run at once.
"""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any

from gymnasium.vector import utils

from libero._adapters.worker import Host, Worker
from libero_env.errors import ClosedEnvironmentError, LiberoError

CALL_TIMEOUT = 600.0  # [s] for a call, unless told otherwise; making an environment may take minutes


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


def _asking(method: str) -> Any:
    """Return a method of a worker that returns the result of the method of its environment."""

    def ask(self: Any, *args: Any, **kwargs: Any) -> Any:
        self.start(method, *args, **kwargs)
        return self.recv()

    return ask


class EnvWorker(ABC):
    """One environment, of the original's interface or of Gymnasium's: its results are passed on as they are."""

    def __init__(self, env_fn: Callable[[], Any]):
        self._env_fn, self.is_closed, self.result = env_fn, False, None

    @abstractmethod
    def _send(self, command: str, *args: Any) -> None:
        """Start a command of `Host`."""

    @abstractmethod
    def recv(self) -> Any:
        """Return the result of the call; raise a WorkerError if it failed, the process died, or the time is over."""

    @abstractmethod
    def close_env(self) -> None:
        """Close the environment, by force where it does not answer."""

    def start(self, method: str, *args: Any, **kwargs: Any) -> None:
        """Start a call of a method of the environment, whose result `recv` returns."""
        self._send("call", method, args, kwargs)

    def send(self, action: Any, **kwargs: Any) -> None:
        """Start a step with an action, or with None a reset with keyword arguments."""
        self.start(*(("reset",) if action is None else ("step", action)), **kwargs)

    def get_env_attr(self, key: str) -> Any:
        """Return an attribute of the environment; of one in another process a copy."""
        self._send("get", key)
        return self.recv()

    def set_env_attr(self, key: str, value: Any) -> None:
        """Set an attribute of the environment without its wrappers, where it or its inner environment has it."""
        self._send("set", key, value)
        self.recv()

    def close(self) -> None:
        """Close the environment. Idempotent."""
        if not self.is_closed:
            self.is_closed = True
            self.close_env()

    def why_lost(self) -> str:
        """Return why no call can succeed any more, such as the end of its process; empty while it works."""
        return ""


for _method in (
    *("reset", "step", "render", "seed", "check_success"),
    *("get_sim_state", "set_init_state", "get_segmentation_of_interest"),
):
    setattr(EnvWorker, _method, _asking(_method))


class DummyEnvWorker(EnvWorker):
    """An environment in this process."""

    def __init__(self, env_fn: Callable[[], Any]):
        super().__init__(env_fn)
        self._host = Host(env_fn)
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


class SubprocEnvWorker(EnvWorker):
    """An environment in a process of its own, which is spawned: no GL context is inherited.

    Args:
        env_fn: Factory of the environment, called in the process; a lambda is allowed.
        share_memory: Without effect: observations come through a pipe.
        timeout: Seconds that a call may take, and at first the start of the process; None for 600.
    """

    def __init__(self, env_fn: Callable[[], Any], share_memory: bool = False, timeout: float | None = None):
        super().__init__(env_fn)
        self.share_memory, self._timeout = False, CALL_TIMEOUT if timeout is None else timeout
        self._worker = Worker(env_fn)
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
        return self._answer(self._request, request)

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
        lost = True
        try:
            done, answer = self._worker.answer(request, self.seconds_left)
            if done:
                return answer
            reason, lost = answer, self._opening is not None
        except EOFError as error:
            reason = str(error)
        except TimeoutError:
            began = time.strftime("%H:%M:%S", time.localtime(time.time() - (time.monotonic() - self._since)))
            reason = (
                f"no answer within {self._timeout:g} s, since {began}; it was ended. If it is only slow, "
                "raise call_timeout="
            )
        if lost:
            self.process.kill()
            self._lost = f"in {name}: {reason}"
        raise WorkerError(f"worker {self.process.pid}, in {name}: {reason}")

    def close_env(self) -> None:
        """End the process, by force where it does not answer."""
        self._worker.close()
