"""Environments of an evaluation: the interface that rollouts use, and a pool of open environments."""

from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from libero_env.envs.batch import BatchEnv
from libero_env.perturbations import Perturbation
from libero_env.tasks import Task
from lifelong.data.settings import CAMERAS
from lifelong.evaluation.settings import EvalSettings
from lifelong.types import PolicySpec

Obs = Mapping[str, np.ndarray]  # name -> (B, ...)


class VectorEnv(Protocol):
    """Interface of `libero_env.envs.batch.BatchEnv` that rollouts use; finished simulations are not stepped.

    An environment may have `atoms`, the atoms of the goal as text; then its infos report under `progress` which of
    them hold, (B, atoms) bool.
    """

    num_envs: int

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Obs, dict]: ...

    def step(self, actions: np.ndarray) -> tuple[Obs, np.ndarray, np.ndarray, np.ndarray, dict]: ...

    def close(self) -> None: ...


class EnvPool:
    """Environments by task, at most `capacity` of them open; the least recently used is closed first."""

    def __init__(self, make: Callable[[Any], VectorEnv], capacity: int = 4):
        """Initialise an empty pool.

        Args:
            make: Function that builds the environment of a key.
            capacity: Maximum number of open environments.
        """
        self._make, self._capacity = make, max(1, capacity)
        self._open: OrderedDict[Hashable, VectorEnv] = OrderedDict()

    def get(self, key: Hashable) -> VectorEnv:
        """Return the environment of a key; it is built if it is not open."""
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


def run_environment(
    task: Task,
    simulations: int,
    spec: PolicySpec,
    settings: EvalSettings,
    *,
    drawing: str | None,
    robot: str,
    perturb: Sequence[Perturbation] = (),
    horizon: int | None = None,
) -> BatchEnv:
    """Return an environment in which a run's policy acts.

    Args:
        task: Task.
        simulations: Number of episodes that run side by side.
        spec: What the policy observes.
        settings: Back end, threads and horizon.
        drawing: How images are drawn; None for the default of the models.
        robot: Model of the arm.
        perturb: Perturbations of the task.
        horizon: Maximum number of the policy's control steps; None for that of the settings.
    """
    return BatchEnv(
        task,
        simulations,
        num_threads=settings.sim_threads,
        cameras=tuple(CAMERAS[view] for view in spec.views),
        camera_size=spec.image_size,
        horizon=(settings.horizon if horizon is None else horizon) + settings.settle_steps,
        drawing=drawing,
        robot=robot,
        backend=settings.backend,
        perturb=tuple(perturb),
    )
