"""Several environments together, with the interface that the original took from Tianshou.

Observations are object arrays of dictionaries; rewards and successes are stacked.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from libero._adapters.envs.workers import (  # noqa: F401 - names of the original
    CloudpickleWrapper,
    DummyEnvWorker,
    EnvWorker,
    ShArray,
    SubprocEnvWorker,
    WorkerError,
)
from libero_env.errors import LiberoError

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

    def reset(self, id: Ids = None, **kwargs: Any) -> np.ndarray:
        """Reset the environments and return their observations (k,)."""
        return _objects(self._call("reset", self._ids(id), **kwargs))

    def step(self, action: Any, id: Ids = None) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Act in the environments, actions (k, 7); return observations, rewards, successes and infos, each (k,)."""
        ids = self._ids(id)
        if len(action) != len(ids):
            raise LiberoError(f"step: {len(action)} actions for {len(ids)} environments")
        for i, row in zip(ids, action, strict=True):
            self.workers[i].send("step", row)
        if self.is_async:
            self.waiting_id += ids
            self.ready_id = [i for i in self.ready_id if i not in ids]
            ids = self._wait()
        results = self._receive(ids)
        for i, (_, _, _, info) in zip(ids, results, strict=True):
            info["env_id"] = i
        observations, rewards, successes, infos = zip(*results, strict=True)
        return _objects(observations), np.array(rewards), np.array(successes), _objects(infos)

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
        return _objects(self._call("set_init_state", self._ids(id), init_state))

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
            self.workers[i].send(method, *(() if arguments is None else (arguments[k],)), **kwargs)
        return self._receive(ids)

    def _receive(self, ids: Sequence[int]) -> list[Any]:
        """Return all answers; a failure is raised once no answer is left for the next call."""
        results, failures = [], []
        for i in ids:
            try:
                results.append(self.workers[i].recv())
            except WorkerError as error:
                failures.append(error)
        if failures:
            raise failures[0]
        return results

    def _ids(self, id: Ids) -> list[int]:
        if self.is_closed:
            raise LiberoError("this vector of environments is closed; make a new one")
        ids = list(range(self.env_num)) if id is None else [int(i) for i in np.atleast_1d(id)]
        if busy := [i for i in ids if i in self.waiting_id]:
            raise LiberoError(f"environments {busy} are still at their last step; call step to wait for them")
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


def _objects(items: Sequence[Any]) -> np.ndarray:
    """Return an object array (k,) of the items."""
    array = np.empty(len(items), object)
    for i, item in enumerate(items):
        array[i] = item
    return array
