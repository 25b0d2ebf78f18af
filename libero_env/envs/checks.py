"""Checks of what callers pass to environments."""

from typing import Any

import numpy as np

from libero_env.errors import ActionError, LiberoError
from libero_env.sim.osc import ACTION_DIM


def checked_actions(actions: object, num: int | None = None, size: int = ACTION_DIM) -> np.ndarray:
    """Actions as float64, (size,) or (num, size).

    Raises:
        ActionError: wrong shape, or a value that is not finite. Values outside [-1, 1] are clipped by the controller.
    """
    shape = (size,) if num is None else (num, size)
    try:
        array = np.asarray(actions, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ActionError(f"an action is {shape} numbers, got {type(actions).__name__}: {error}") from None
    if array.shape != shape:
        raise ActionError(f"expected actions of shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        where = np.argwhere(~np.isfinite(array))[0].tolist()
        raise ActionError(f"actions must be finite; entry {where} is {array[tuple(where)]}")
    return array


def checked_options(options: dict[str, Any] | None) -> dict[str, Any]:
    """Reset options, after a look at their names.

    Raises:
        LiberoError: an option that does not exist.
    """
    options = dict(options or {})
    if unknown := set(options) - {"init_state"}:
        raise LiberoError(f"unknown reset option {', '.join(sorted(unknown))}; valid: init_state")
    return options
