"""Checks of what callers pass to environments; nothing has changed when one of them fails."""

import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any

import gymnasium
import numpy as np

from libero_env.errors import (
    ActionError,
    ClosedEnvironmentError,
    InvalidInputError,
    LiberoError,
    UnknownNameError,
)
from libero_env.sim.osc import ACTION_DIM
from libero_env.text import shown

Shape = tuple[int, ...]
_MAX_SEED_BITS = 4096


class ClosedGymEnvironmentError(ClosedEnvironmentError, gymnasium.error.ClosedEnvironmentError):
    """An environment is used after `close`; the error is Gymnasium's and the package's."""


def checked_actions(actions: object, num: int | None = None, size: int = ACTION_DIM) -> np.ndarray:
    """Return actions as float64. Values outside the action space are left to the controller, which clips them.

    Args:
        actions: Action (size,), or actions (num, size).
        num: Number of environments; None for a single action.
        size: Length of an action.

    Raises:
        ActionError: The shape is wrong, or a value is no finite real number.
    """
    return checked_numbers(actions, "actions", ((size,) if num is None else (num, size),), ActionError)


def checked_numbers(
    value: object, name: str, shapes: Sequence[Shape | str], error: type[LiberoError] = InvalidInputError
) -> np.ndarray:
    """Return an array of finite numbers as float64.

    Args:
        value: Array, or what NumPy makes one of.
        name: Name of the value in messages.
        shapes: Shapes that are valid; where they are texts, the caller checks the shape.
        error: Type of the error.

    Raises:
        InvalidInputError: The shape is wrong, or a value is no finite real number; or `error`.
    """
    expected = f"{name}: expected finite numbers of shape {' or '.join(map(str, shapes))}"
    try:
        array = real_array(value)
    except (TypeError, ValueError, RuntimeError, OverflowError) as reason:  # the last but one is of tensors
        text = " ".join(str(reason).split())
        raise error(f"{expected}, got {type(value).__name__}: {text[:200]}") from None
    if array.shape not in shapes and not isinstance(shapes[0], str):
        raise error(f"{expected}, got {array.shape}")
    if not np.isfinite(array).all():
        where = np.argwhere(~np.isfinite(array))[0].tolist()
        raise error(f"{name} must be finite; entry {where} is {array[tuple(where)]}")
    return array


def real_array(value: object) -> np.ndarray:
    """Return an array as float64; raise a TypeError for what is no real number, such as a text or a masked entry."""
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        raise TypeError("some of its entries are masked")
    array = np.asarray(value)
    if array.dtype == np.float64:
        return array
    if array.dtype.kind == "O":
        if odd := [one for one in array.ravel() if not isinstance(one, Real)]:
            raise TypeError(f"{type(odd[0]).__name__} is no real number")
    elif array.dtype.kind not in "biuf":
        raise TypeError(f"{array.dtype} is no real number")
    with np.errstate(over="ignore"):  # what is too large becomes infinite
        return array.astype(np.float64)


def checked_index(i: object, count: int, name: str = "index") -> int:
    """Return an index from 0 to `count - 1` as int.

    Raises:
        InvalidInputError: It is another value.
    """
    if not isinstance(i, bool | np.bool_):
        try:
            index = operator.index(i)  # type: ignore[arg-type]
        except TypeError:
            index = -1
        if 0 <= index < count:
            return index
    raise InvalidInputError(f"{name} {shown(i)}: expected a whole number from 0 to {count - 1}")


def checked_indices(ids: object, count: int) -> np.ndarray:
    """Return indices from 0 to `count - 1`, (k,); None stands for all.

    Raises:
        InvalidInputError: They are other values.
    """
    if ids is None:
        return np.arange(count)
    if isinstance(ids, str) or not isinstance(ids, Iterable) or not getattr(ids, "ndim", 1):
        raise InvalidInputError(f"ids={shown(ids)}: expected a list of indices from 0 to {count - 1}")
    return np.array([checked_index(i, count) for i in ids], np.int64)


def checked_seed(seed: object) -> int | None:
    """Return a seed as int; None stands for none.

    Raises:
        InvalidInputError: It is no whole number from 0.
    """
    if seed is None:
        return None
    if not isinstance(seed, bool | np.bool_ | str | bytes):
        try:
            number = operator.index(seed)  # type: ignore[arg-type]
        except TypeError:
            number = -1
        if number >= 0 and number.bit_length() <= _MAX_SEED_BITS:
            return number
    raise InvalidInputError(f"seed={shown(seed)}: expected a whole number from 0, or None")


def checked_options(options: object, valid: Sequence[str] | None = None) -> dict[str, Any]:
    """Return reset options, after a check of their names; None stands for none.

    Args:
        options: What the caller passed.
        valid: Names of options; None for any.

    Raises:
        InvalidInputError: They are no dictionary.
        UnknownNameError: An option does not exist.
    """
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise InvalidInputError(f"options={shown(options)}: expected a dictionary")
    for name in options:
        if valid is not None and name not in valid:
            raise UnknownNameError("reset option", name if isinstance(name, str) else shown(name), valid)
    return dict(options)


def checked_truth(options: Mapping[str, Any], name: str) -> bool:
    """Return a reset option that is true or false; false where it is not given.

    Raises:
        InvalidInputError: It is another value.
    """
    value = options.get(name, False)
    if not isinstance(value, bool | np.bool_):
        raise InvalidInputError(f"{name}={shown(value)}: expected true or false")
    return bool(value)


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
            InvalidInputError: Seeds, mask, initial states or starts have the wrong length or are of another kind.
        """
        mask = np.ones(num_envs, bool)
        if "reset_mask" in options:
            mask = checked_numbers(options["reset_mask"], "reset_mask", ((num_envs,),)) != 0
        init_states = starts = None
        if "init_state" in options:
            init_states = whole_numbers(options["init_state"], "init_state", ((), (1,), (num_envs,)))
            init_states = np.broadcast_to(init_states, (num_envs,))
        if "start" in options:
            starts = checked_numbers(options["start"], "start", (f"({num_envs}, n)",))
            if starts.ndim != 2 or len(starts) != num_envs:
                raise InvalidInputError(
                    f"start: expected {num_envs} rows of numbers, got shape {starts.shape}"
                )
        return cls(np.flatnonzero(mask), _seeds(num_envs, seed), init_states, starts)


def whole_numbers(value: object, name: str, shapes: Sequence[Shape]) -> np.ndarray:
    """Return an array of whole numbers, int64.

    Raises:
        InvalidInputError: The shape is wrong, or a value is no whole number.
    """
    array = checked_numbers(value, name, shapes)
    if np.asarray(value).dtype.kind not in "iu":
        raise InvalidInputError(f"{name}={shown(value)}: expected whole numbers")
    return array.astype(np.int64)


def _seeds(num_envs: int, seed: object) -> list[int | None]:
    """Return one seed for each environment."""
    if isinstance(seed, list | tuple) or (isinstance(seed, np.ndarray) and seed.ndim):
        if len(seed) != num_envs:
            raise InvalidInputError(f"seed: expected one or {num_envs} seeds, got {len(seed)}")
        return [checked_seed(one) for one in seed]
    first = checked_seed(seed)
    return [None if first is None else first + i for i in range(num_envs)]
