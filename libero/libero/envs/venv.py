"""Several environments together, with the interface that the original took from Tianshou.

They may be of the original's interface, whose `reset` returns an observation and whose `step` returns four results, or
of Gymnasium's, with (observation, info) and five. Results are stacked: dictionaries as an object array of them.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces

from libero._adapters.envs.workers import (  # noqa: F401 - names of the original
    CloudpickleWrapper,
    DummyEnvWorker,
    EnvWorker,
    ShArray,
    SubprocEnvWorker,
    WorkerError,
)
from libero_env.errors import LiberoError

# Attributes of a vector that are those of its environments, in a list.
GYM_RESERVED_KEYS = ["metadata", "reward_range", "spec", "action_space", "observation_space"]

gym_old_venv_step_type = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
gym_new_venv_step_type = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
Ids = int | Sequence[int] | np.ndarray | None


class BaseVectorEnv:
    """Environments that are stepped together.

    With `wait_num` or `timeout`, `step` returns as soon as that many environments are ready; `info["env_id"]` states
    which ones, and the others continue in the meantime.

    Args:
        env_fns: One factory for each environment.
        worker_fn: Function that makes a worker of a factory.
        wait_num: Number of environments that `step` waits for; None for all.
        timeout: Seconds that `step` waits for them; None for no limit.

    Raises:
        LiberoError: `wait_num` or `timeout` is out of range.
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], Any]],
        worker_fn: Callable[[Callable[[], Any]], EnvWorker],
        wait_num: int | None = None,
        timeout: float | None = None,
    ):
        self.env_num = len(env_fns)
        self.wait_num = wait_num or self.env_num
        if not 1 <= self.wait_num <= self.env_num:
            raise LiberoError(f"wait_num={wait_num}: expected 1 to {self.env_num} environments")
        if timeout is not None and timeout <= 0:
            raise LiberoError(f"timeout={timeout}: expected a positive number of seconds")
        self.timeout = timeout
        self.is_async = self.wait_num != self.env_num or timeout is not None
        self.is_closed = False
        self.workers = [worker_fn(env_fn) for env_fn in env_fns]
        self.worker_class = type(self.workers[0])
        self.waiting_id: list[int] = []
        self.ready_id = list(range(self.env_num))

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
        return [self.workers[i].get_env_attr(key) for i in self._ids(id)]

    def set_env_attr(self, key: str, value: Any, id: Ids = None) -> None:
        """Set an attribute of each environment."""
        for i in self._ids(id):
            self.workers[i].set_env_attr(key, value)

    def reset(self, id: Ids = None, **kwargs: Any) -> Any:
        """Reset the environments; return their observations (k,), or these and a list of their infos."""
        results = self._call("reset", self._ids(id), **kwargs)
        if all(isinstance(r, tuple | list) and len(r) == 2 and isinstance(r[1], dict) for r in results):
            return _stack([observation for observation, _ in results]), [info for _, info in results]
        return _stack(results)

    def step(self, action: Any, id: Ids = None) -> tuple[np.ndarray, ...]:
        """Act in the environments, actions (k, 7); with `wait_num` or `timeout`, None only waits for those that act.

        Returns:
            Observations, rewards, successes and infos, each (k,); of environments of Gymnasium's interface
            observations, rewards, terminated, truncated and infos.
        """
        ids = self._ids(id) if action is not None else []
        if action is not None and len(action) != len(ids):
            raise LiberoError(f"step: {len(action)} actions for {len(ids)} environments")
        for i, row in zip(ids, () if action is None else action, strict=True):
            self.workers[i].start("step", row)
        if self.is_async:
            self.waiting_id += ids
            self.ready_id = [i for i in self.ready_id if i not in ids]
            ids = self._wait()
        results = self._receive("step", ids)
        for i, result in zip(ids, results, strict=True):
            result[-1]["env_id"] = i
        return tuple(map(_stack, zip(*results, strict=True)))

    def _wait(self) -> list[int]:
        """Wait for some environments, and move them from waiting to ready."""
        found: list[EnvWorker] = []
        while not found:
            waiting = [self.workers[i] for i in self.waiting_id]
            found = self.worker_class.wait(waiting, self.wait_num, self.timeout)
        ids = [i for i in self.waiting_id if self.workers[i] in found]
        self.waiting_id = [i for i in self.waiting_id if i not in ids]
        self.ready_id += ids
        return ids

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
        if arguments is not None and len(arguments) != len(ids):
            raise LiberoError(f"{method}: {len(arguments)} values for {len(ids)} environments")
        for k, i in enumerate(ids):
            self.workers[i].start(method, *(() if arguments is None else (arguments[k],)), **kwargs)
        return self._receive(method, ids)

    def _receive(self, method: str, ids: Sequence[int]) -> list[Any]:
        """Return all answers; a failure is raised once no answer is left for the next call."""
        results, failures = [], []
        for i in ids:
            try:
                results.append(self.workers[i].finish(method))
            except WorkerError as error:
                failures.append(error)
        if failures:
            raise failures[0]
        return results

    def _assert_is_not_closed(self) -> None:
        if self.is_closed:
            raise LiberoError("this vector of environments is closed; make a new one")

    def _wrap_id(self, id: Ids = None) -> list[int]:
        return list(range(self.env_num)) if id is None else [int(i) for i in np.atleast_1d(id)]

    def _assert_id(self, id: Sequence[int]) -> None:
        if busy := [i for i in id if i in self.waiting_id]:
            raise LiberoError(f"environments {busy} are still at their last step; call step to wait for them")

    def _ids(self, id: Ids) -> list[int]:
        self._assert_is_not_closed()
        ids = self._wrap_id(id)
        self._assert_id(ids)
        return ids


class DummyVectorEnv(BaseVectorEnv):
    """Environments in this process, one after the other."""

    def __init__(self, env_fns: Sequence[Callable[[], Any]], **kwargs: Any):
        super().__init__(env_fns, DummyEnvWorker, **kwargs)


class SubprocVectorEnv(BaseVectorEnv):
    """Environments in processes of their own.

    Args:
        env_fns: One factory for each environment; a lambda is allowed.
        share_memory: Whether the arrays of observations come back through shared memory.
        call_timeout: Seconds after which a worker that does not answer is killed; None for no limit.
        kwargs: Further arguments of `BaseVectorEnv`.
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], Any]],
        share_memory: bool = False,
        call_timeout: float | None = None,
        **kwargs: Any,
    ):
        worker_fn = partial(SubprocEnvWorker, share_memory=share_memory, timeout=call_timeout)
        super().__init__(env_fns, worker_fn, **kwargs)


def _stack(items: Sequence[Any]) -> np.ndarray:
    """Return an array (k, ...) of the items; an object array (k,) of dictionaries, and of arrays of unequal shape."""
    try:
        return np.stack(items)
    except ValueError:
        array = np.empty(len(items), object)
        for i, item in enumerate(items):
            array[i] = item
        return array


def _setup_buf(space: spaces.Space) -> Any:
    """Return shared memory for observations of a space: an array, or a dictionary or tuple of them."""
    if isinstance(space, spaces.Dict):
        return {key: _setup_buf(part) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(map(_setup_buf, space.spaces))
    return ShArray(space.dtype, space.shape or ())
