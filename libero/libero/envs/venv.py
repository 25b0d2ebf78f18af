"""Several environments together, with the interface that the original took from Tianshou.

They may be of the original's interface, whose `reset` returns an observation and whose `step` returns four results, or
of Gymnasium's, with (observation, info) and five. Results are stacked: dictionaries as an object array of them.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from libero._adapters.workers import (  # noqa: F401 - names of the original
    CloudpickleWrapper,
    DummyEnvWorker,
    EnvWorker,
    SubprocEnvWorker,
    WorkerError,
)
from libero_env.errors import ClosedEnvironmentError, InvalidInputError
from libero_env.text import shown
from libero_env.validation import validate

# Attributes of a vector that are those of its environments, in a list.
GYM_RESERVED_KEYS = ["metadata", "reward_range", "spec", "action_space", "observation_space"]

_Seconds = Annotated[float, Field(gt=0, le=1e6)]
Ids = int | Sequence[int] | np.ndarray | None


class BaseVectorEnv:
    """Environments that are stepped together; a step waits for all of them.

    Args:
        env_fns: One factory for each environment.
        worker_fn: Function that makes a worker of a factory.

    Raises:
        InvalidInputError: There are no factories.
    """

    is_async = False

    def __init__(
        self,
        env_fns: Sequence[Callable[[], Any]],
        worker_fn: Callable[[Callable[[], Any]], EnvWorker],
    ):
        env_fns = list(env_fns)
        if not env_fns or not all(map(callable, env_fns)):
            raise InvalidInputError(
                f"env_fns={shown(env_fns)}: expected at least one function that makes an environment"
            )
        self.env_num = len(env_fns)
        self.is_closed = False
        self.workers = [worker_fn(env_fn) for env_fn in env_fns]
        self.worker_class = type(self.workers[0])

    def __getattr__(self, key: str) -> Any:
        """Return the attribute of each environment, of those in `GYM_RESERVED_KEYS`."""
        if key in GYM_RESERVED_KEYS:
            return self.get_env_attr(key)
        hint = f"; get_env_attr({key!r}) returns that of each environment"
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {key!r}{hint}")

    def __len__(self) -> int:
        """Return the number of environments."""
        return self.env_num

    def get_env_attr(self, key: str, id: Ids = None) -> list[Any]:
        """Return an attribute of each environment."""
        return self._each(self._ids(id), lambda worker: worker.get_env_attr(key))

    def set_env_attr(self, key: str, value: Any, id: Ids = None) -> None:
        """Set an attribute of each environment."""
        self._each(self._ids(id), lambda worker: worker.set_env_attr(key, value))

    def reset(self, id: Ids = None, **kwargs: Any) -> Any:
        """Reset the environments; return their observations (k,), or these and a list of their infos."""
        results = self._call("reset", self._ids(id), **kwargs)
        if all(isinstance(r, tuple | list) and len(r) == 2 and isinstance(r[1], dict) for r in results):
            return _stack([observation for observation, _ in results]), [info for _, info in results]
        return _stack(results)

    def step(self, action: Any, id: Ids = None) -> tuple[np.ndarray, ...]:
        """Act in the environments, actions (k, 7).

        Returns:
            Observations, rewards, successes and infos, each (k,); of environments of Gymnasium's interface
            observations, rewards, terminated, truncated and infos. `info["env_id"]` is the index of the environment.
        """
        ids = self._ids(id)
        failed = self._start("step", ids, [] if action is None else action)
        ids = [i for i in ids if i not in failed]
        results = self._each(ids, lambda worker: worker.recv(), failed)
        for i, result in zip(ids, results, strict=True):
            result[-1]["env_id"] = i
        return tuple(map(_stack, zip(*results, strict=True)))

    def seed(self, seed: int | Sequence[int | None] | None = None) -> list[Any]:
        """Seed the environments: with a list, or with numbers that count up from one."""
        if seed is None or isinstance(seed, int | np.integer):
            seed = [None if seed is None else int(seed) + i for i in range(self.env_num)]
        return self._call("seed", self._ids(None), list(seed))

    def render(self, **kwargs: Any) -> list[Any]:
        """Call `render` of each environment."""
        return self._call("render", self._ids(None), **kwargs)

    def check_success(self, id: Ids = None) -> list[bool]:
        """Return whether the goal of each environment holds."""
        return self._call("check_success", self._ids(id))

    def get_segmentation_of_interest(self, segmentation_images: Any, id: Ids = None) -> list[np.ndarray]:
        """Call `get_segmentation_of_interest` of each environment with its picture."""
        return self._call("get_segmentation_of_interest", self._ids(id), segmentation_images)

    def get_sim_state(self, id: Ids = None) -> list[np.ndarray]:
        """Return [time, qpos, qvel] of each environment."""
        return self._call("get_sim_state", self._ids(id))

    def set_init_state(self, init_state: Sequence[np.ndarray], id: Ids = None) -> np.ndarray:
        """Set the state of each environment and return their observations (k,)."""
        return _stack(self._call("set_init_state", self._ids(id), init_state))

    def close(self) -> None:
        """Close all environments. Idempotent."""
        if not self.is_closed:
            self.is_closed = True
            for worker in self.workers:
                worker.close()

    def _call(self, method: str, ids: Sequence[int], arguments: Any = None, **kwargs: Any) -> list[Any]:
        """Call a method of these environments at once, each with its own argument."""
        failed = self._start(method, ids, arguments, **kwargs)
        return self._each([i for i in ids if i not in failed], lambda worker: worker.recv(), failed)

    def _start(self, method: str, ids: Sequence[int], arguments: Any, **kwargs: Any) -> dict[int, str]:
        """Start a call of a method of these environments, each with its own argument; return failures by index."""
        if arguments is not None and (not hasattr(arguments, "__len__") or len(arguments) != len(ids)):
            count = len(arguments) if hasattr(arguments, "__len__") else type(arguments).__name__
            values = "actions" if method == "step" else "values"
            raise InvalidInputError(f"{method}: {count} {values} for {len(ids)} environments")
        failed = {}
        for k, i in enumerate(ids):
            try:
                self.workers[i].start(method, *(() if arguments is None else (arguments[k],)), **kwargs)
            except WorkerError as error:
                failed[i] = str(error)
        return failed

    def _each(
        self, ids: Sequence[int], ask: Callable[[EnvWorker], Any], failed: Mapping[int, str] | None = None
    ) -> list[Any]:
        """Return the answer of each worker; failures are raised when all others have come, with their results."""
        results: dict[int, Any] = {}
        failed = dict(failed or {})
        for i in ids:
            try:
                results[i] = ask(self.workers[i])
            except WorkerError as error:
                failed[i] = str(error)
        if failed:
            done = (
                f"The others, {list(results)}, have done it: see `results` of this error. " if results else ""
            )
            raise WorkerError(f"{_named(failed)}\n{done}{self._remedy()}", failed, results)
        return list(results.values())

    def _remedy(self) -> str:
        """Return how to go on after a failure."""
        lost = [i for i, worker in enumerate(self.workers) if worker.why_lost()]
        if not lost:
            return "All environments can still be used"
        rest = [i for i in range(self.env_num) if i not in lost]
        return (
            f"Go on with id={rest}, or close this vector and make a new one" if rest else "Make a new vector"
        )

    def _assert_is_not_closed(self) -> None:
        if self.is_closed:
            raise ClosedEnvironmentError("this vector of environments is closed; make a new one")

    def _wrap_id(self, id: Ids = None) -> list[int]:
        if id is None:
            return list(range(self.env_num))
        ids = np.atleast_1d(id)
        whole = ids.ndim == 1 and (not ids.size or ids.dtype.kind in "iu")
        if not whole or any(not -self.env_num <= i < self.env_num for i in ids):
            raise InvalidInputError(f"id={shown(id)}: expected indices from 0 to {self.env_num - 1}")
        chosen = [int(i) % self.env_num for i in ids]
        if len(set(chosen)) < len(chosen):
            raise InvalidInputError(f"id={shown(id)}: an environment occurs twice")
        return chosen

    def _assert_id(self, id: Sequence[int]) -> None:
        """Do nothing: no environment is still at its last step."""

    def _ids(self, id: Ids) -> list[int]:
        self._assert_is_not_closed()
        ids = self._wrap_id(id)
        if lost := {i: reason for i in ids if (reason := self.workers[i].why_lost())}:
            raise WorkerError(f"{_named(lost)}\nNothing was done. {self._remedy()}", lost)
        return ids


class DummyVectorEnv(BaseVectorEnv):
    """Environments in this process, one after the other."""

    def __init__(self, env_fns: Sequence[Callable[[], Any]]):
        super().__init__(env_fns, DummyEnvWorker)


class SubprocVectorEnv(BaseVectorEnv):
    """Environments in processes of their own.

    Args:
        env_fns: One factory for each environment; a lambda is allowed.
        share_memory: Without effect, see `SubprocEnvWorker`.
        call_timeout: Seconds after which a worker that does not answer is ended, the start of the processes included;
            None for 600. The environments of other workers go on.
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], Any]],
        share_memory: bool = False,
        call_timeout: float | None = None,
    ):
        limit = validate(_Seconds | None, call_timeout, prefix=("call_timeout",))
        super().__init__(env_fns, partial(SubprocEnvWorker, timeout=limit))


def _named(reasons: Mapping[int, str]) -> str:
    return "\n".join(f"environment {i}: {reason.rstrip()}" for i, reason in sorted(reasons.items()))


def _stack(items: Sequence[Any]) -> np.ndarray:
    """Return an array (k, ...) of the items; an object array (k,) of dictionaries, and of arrays of unequal shape."""
    try:
        return np.stack(items)
    except ValueError:
        array = np.empty(len(items), object)
        for i, item in enumerate(items):
            array[i] = item
        return array
