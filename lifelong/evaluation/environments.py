"""The environments of an evaluation: what a rollout needs of one, and a pool of open ones."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, Protocol

import numpy as np

from lifelong.evaluation.actors import Obs


class VectorEnv(Protocol):
    """What a rollout needs of `libero_env.envs.batch.BatchEnv`; finished simulations stand still.

    Where it has `atoms`, the parts of the goal as text, its infos say under `progress` which hold, (B, atoms) bool.
    """

    num_envs: int

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Obs, dict]: ...

    def step(self, actions: np.ndarray) -> tuple[Obs, np.ndarray, np.ndarray, np.ndarray, dict]: ...

    def close(self) -> None: ...


class EnvPool:
    """Environments by task, at most `capacity` of them open; the one not used for longest is closed first."""

    def __init__(self, make: Callable[[Any], VectorEnv], capacity: int = 4):
        """Make a pool.

        Args:
            make: Builds the environment of a key.
            capacity: Largest number of open environments.
        """
        self._make, self._capacity = make, max(1, capacity)
        self._open: OrderedDict[Hashable, VectorEnv] = OrderedDict()

    def get(self, key: Hashable) -> VectorEnv:
        """The environment of a key, built if it is not open."""
        if key not in self._open:
            while len(self._open) >= self._capacity:
                self._open.popitem(last=False)[1].close()
            self._open[key] = self._make(key)
        self._open.move_to_end(key)
        return self._open[key]

    def close(self) -> None:
        """Close all environments."""
        while self._open:
            self._open.popitem()[1].close()

    def __enter__(self) -> "EnvPool":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
