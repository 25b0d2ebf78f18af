"""Hooks: what takes part in the episodes of a `BatchEnv`, and is called where it has something to do.

| hook | when |
|---|---|
| `attach` | once, when the environment is made |
| `before_reset` | with the states that episodes are to start in; returns those that they start in |
| `after_reset` | when they have started |
| `before_step` | with the actions that were chosen; returns those that are executed |
| `observe` | with what has been observed; changes what arrives of it |
| `after_step` | at the end of a control step |
| `info` | when infos are made |
| `state`, `restore` | with what of an episode belongs to it, beside its simulation |
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

Entries = dict[str, np.ndarray]  # (num_envs, ...) by name
HOOKS = ("before_reset", "after_reset", "before_step", "observe", "after_step", "info", "state", "restore")


class Hooks:
    """What takes part in episodes; by default in nothing. Indices of simulations are (k,).

    Attributes:
        has_memory: Whether `observe` depends on earlier images, so that all of them must be rendered.
        is_counted: Whether the numbers of `state` are whole, from -1.
    """

    has_memory = False
    is_counted = True

    def attach(self, batch: Any) -> None:
        """Get to know the environment, a `BatchEnv` whose parts are there."""

    def before_reset(self, ids: np.ndarray, states: np.ndarray, names: Sequence[object]) -> np.ndarray:
        """Return the states that episodes start in, [time, qpos, qvel, poses of the fixtures], (k, size).

        Args:
            ids: Indices of the simulations.
            states: States of the task without perturbations.
            names: Index of each stored state, or another name.
        """
        return states

    def after_reset(self, ids: np.ndarray) -> None:
        """Begin episodes in the present states."""

    def before_step(self, ids: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Return the actions that are executed for those that were chosen, (num_envs, action_dim) float64."""
        return actions

    def observe(self, ids: np.ndarray, images: Entries, entries: Entries) -> None:
        """Change what arrives: rows `ids` of images, and all rows of the other entries; one of them may be empty."""

    def after_step(self, ids: np.ndarray) -> None:
        """Take note of the present states, at the end of a control step."""

    def info(self) -> dict[str, Any]:
        """Return entries of infos, which the caller may keep."""
        return {}

    def state(self, i: int) -> np.ndarray:
        """Return what the rest of the episode in simulation i depends on here, (n,)."""
        return np.zeros(0)

    def restore(self, i: int, values: np.ndarray | None) -> None:
        """Go on with the episode in simulation i, which is in its state; without values of `state`, it begins."""


def overridden(parts: Sequence[Hooks]) -> dict[str, list[Callable[..., Any]]]:
    """Return the methods of parts by hook, in their order, without those that do nothing."""
    return {
        name: [getattr(one, name) for one in parts if getattr(type(one), name) is not getattr(Hooks, name)]
        for name in HOOKS
    }
