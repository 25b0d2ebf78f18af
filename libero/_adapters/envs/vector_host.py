"""The commands of a worker of the vector of environments, with observations in shared memory."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from libero_env.envs.worker import CallHost, Shared


class Layout(NamedTuple):
    """Shape and type of an array in shared memory."""

    shape: tuple[int, ...]
    dtype: np.dtype


class VectorHost(CallHost):
    """The commands of a worker, with observations in shared memory."""

    def call(self, method: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        """Call a method; None stands for arrays of an observation that are in shared memory."""
        if method == "seed" and not hasattr(
            self.env, "seed"
        ):  # Gymnasium's environments are seeded by a reset
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
        """Set an attribute of the environment: of Gymnasium's interface of the one in the wrappers."""
        if hasattr(self.env, "unwrapped"):
            setattr(self.env.unwrapped, key, value)
        else:
            super().set(key, value)

    def attach(self, name: str, layout: Mapping[str, Layout]) -> None:
        """Write observations to shared memory, where they fit its layout."""
        self.shared = Shared(layout, name)


def observation_of(result: Any) -> dict[str, Any] | None:
    """Return the observation in the result of `reset` or `step`; None where there is none."""
    observation = result[0] if isinstance(result, tuple) else result
    return observation if isinstance(observation, dict) else None


def arrays_of(observation: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the arrays of an observation that processes can share."""
    return {
        key: value
        for key, value in observation.items()
        if isinstance(value, np.ndarray) and not value.dtype.hasobject
    }
