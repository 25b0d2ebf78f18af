"""Checks of what callers pass to environments."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from libero_env.errors import ActionError, LiberoError, UnknownNameError
from libero_env.sim.osc import ACTION_DIM


def checked_actions(actions: object, num: int | None = None, size: int = ACTION_DIM) -> np.ndarray:
    """Return actions as float64. Values outside the action space are left to the controller, which clips them.

    Args:
        actions: Action (size,), or actions (num, size).
        num: Number of environments; None for a single action.
        size: Length of an action.

    Raises:
        ActionError: The shape is wrong, or a value is not finite.
    """
    shape = (size,) if num is None else (num, size)
    try:
        array = np.asarray(actions, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ActionError(
            f"expected actions of shape {shape}, got {type(actions).__name__}: {error}"
        ) from None
    if array.shape != shape:
        raise ActionError(f"expected actions of shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        where = np.argwhere(~np.isfinite(array))[0].tolist()
        raise ActionError(f"actions must be finite; entry {where} is {array[tuple(where)]}")
    return array


def check_options(options: Mapping[str, Any], valid: Sequence[str]) -> None:
    """Check the names of reset options.

    Raises:
        UnknownNameError: An option does not exist.
    """
    for name in options:
        if name not in valid:
            raise UnknownNameError("reset option", name, valid)


@dataclass(frozen=True)
class ResetRequest:
    """Arguments of `reset` of a vector environment, checked.

    Attributes:
        ids: Indices of the environments to reset.
        seeds: Seed of each environment, (num_envs,); None continues its generator.
        init_states: Index of the initial state of each environment, (num_envs,); None for new placements.
        starts: State that each environment starts in, (num_envs, size); None for stored states or new placements.
    """

    ids: np.ndarray
    seeds: list[int | None]
    init_states: np.ndarray | None
    starts: np.ndarray | None = None

    @classmethod
    def from_arguments(
        cls, num_envs: int, seed: int | Sequence[int | None] | None, options: Mapping[str, Any]
    ) -> "ResetRequest":
        """Check the arguments of `reset`.

        Args:
            num_envs: Number of environments.
            seed: One seed for each environment, or one number from which they count up.
            options: Reset options `init_state`, `start` and `reset_mask`; others are ignored.

        Raises:
            LiberoError: Seeds, mask, initial states or starts have the wrong length.
        """
        mask = np.asarray(options.get("reset_mask", np.ones(num_envs, bool)), bool)
        if mask.shape != (num_envs,):
            raise LiberoError(f"reset_mask: expected ({num_envs},) booleans, got shape {mask.shape}")
        init_states = None
        if "init_state" in options:
            init_states = np.asarray(options["init_state"])
            if init_states.shape not in ((), (1,), (num_envs,)):
                raise LiberoError(
                    f"init_state: expected one or {num_envs} integers, got shape {init_states.shape}"
                )
            init_states = np.broadcast_to(init_states, (num_envs,))
        starts = None
        if "start" in options:
            starts = np.asarray(options["start"], np.float64)
            if starts.ndim != 2 or len(starts) != num_envs or not np.isfinite(starts).all():
                raise LiberoError(
                    f"start: expected {num_envs} rows of finite numbers, got shape {starts.shape}"
                )
        return cls(np.flatnonzero(mask), _seeds(num_envs, seed), init_states, starts)


def _seeds(num_envs: int, seed: int | Sequence[int | None] | None) -> list[int | None]:
    """Return one seed for each environment."""
    if seed is None:
        return [None] * num_envs
    if isinstance(seed, int | np.integer):
        return [int(seed) + i for i in range(num_envs)]
    if len(seed) != num_envs:
        raise LiberoError(f"seed: expected one or {num_envs} seeds, got {len(seed)}")
    return [None if s is None else int(s) for s in seed]
