"""Checks of what callers pass to environments; nothing has changed when one of them fails."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Annotated

import gymnasium
import numpy as np
from pydantic import Field

from libero_env.errors import (
    ActionError,
    ClosedEnvironmentError,
    InvalidInputError,
    LiberoError,
    require_known,
)
from libero_env.mujoco_compat import mujoco
from libero_env.tasks import Task
from libero_env.text import shown
from libero_env.validation import validate

RESET_OPTIONS = ("init_state", "start", "outdated_controller", "reset_mask")
Shape = tuple[int, ...]
Whole = Annotated[int, Field(ge=0)]


class ClosedGymEnvironmentError(ClosedEnvironmentError, gymnasium.error.ClosedEnvironmentError):
    """An environment is used after `close`; the error is Gymnasium's and the package's."""


def checked_actions(actions: object, shape: Shape | None) -> np.ndarray:
    """Return actions as float64. Values outside the action space are left to the controller, which clips them.

    Args:
        actions: Action (size,), or actions (num, size).
        shape: Shape that they must have.

    Raises:
        ActionError: The shape is wrong, or a value is not a finite real number.
    """
    return checked_numbers(actions, "actions", (shape or (),), ActionError)


def checked_numbers(
    value: object, name: str, shapes: Sequence[Shape | str], error: type[LiberoError] = InvalidInputError
) -> np.ndarray:
    """Return an array of finite numbers as float64.

    Args:
        value: Array, or what NumPy makes one of.
        name: Name of the value in messages.
        shapes: Shapes that are valid; where they are texts, the caller checks the shape.

    Raises:
        InvalidInputError: The shape is wrong, or a value is not a finite real number; or `error`.
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
    """Return an array as float64; raise a TypeError for what is not a real number, such as a text or a masked entry."""
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        raise TypeError("some of its entries are masked")
    array = np.asarray(value)
    if array.dtype == np.float64:
        return array
    if array.dtype.kind == "O":
        if odd := [one for one in array.ravel() if not isinstance(one, Real)]:
            raise TypeError(f"{type(odd[0]).__name__} is not a real number")
    elif array.dtype.kind not in "biuf":
        raise TypeError(f"{array.dtype} is not a real number")
    with np.errstate(over="ignore"):  # what is too large becomes infinite
        return array.astype(np.float64)


def checked_index(i: object, count: int) -> int:
    """Return an index from 0 to `count - 1` as int.

    Raises:
        InvalidInputError: It is another value.
    """
    index: int = validate(Whole, i, prefix=("index",))
    if index >= count:
        raise InvalidInputError(f"index is {shown(i)}; expected a whole number from 0 to {count - 1}")
    return index


def checked_indices(ids: Sequence[int] | None, count: int) -> np.ndarray:
    """Return indices from 0 to `count - 1`, (k,); None stands for all.

    Raises:
        InvalidInputError: They are other values.
    """
    if ids is None:
        return np.arange(count)
    indices = validate(list[Whole], ids, prefix=("indices",))
    return np.array([checked_index(i, count) for i in indices], np.int64)


@dataclass(frozen=True)
class ResetRequest:
    """Arguments of `reset` of a vector environment, checked.

    Attributes:
        ids: Indices of the environments to reset.
        seeds: Seed of each environment, (num_envs,); None continues its generator.
        init_states: Index of the initial state of each environment, (num_envs,); None for new placements.
        starts: State that each environment starts in, (num_envs, size); None for stored states or new placements.
        outdated_controller: See `BatchEnv.reset`.
    """

    ids: np.ndarray
    seeds: list[int | None]
    init_states: np.ndarray | None
    starts: np.ndarray | None
    outdated_controller: bool

    @property
    def names(self) -> list[int]:
        """Index of the initial state of each environment of `ids`; empty for new placements and other states."""
        return [] if self.init_states is None else self.init_states[self.ids].tolist()

    @classmethod
    def from_arguments(
        cls, num_envs: int, seed: object, options: object, valid: Sequence[str] = RESET_OPTIONS
    ) -> "ResetRequest":
        """Check the arguments of `reset`.

        Args:
            num_envs: Number of environments.
            seed: One seed for each environment, or one number from which they count up.
            options: Reset options.
            valid: Names of options.

        Raises:
            InvalidInputError: Seeds, mask, initial states or starts have the wrong length or are of another kind.
            UnknownNameError: An option does not exist.
        """
        if not isinstance(options, Mapping | None):
            raise InvalidInputError(f"options={shown(options)}: expected a dictionary")
        values = dict(options or {})
        for name in values:
            require_known("reset option", name if isinstance(name, str) else shown(name), valid)
        mask = np.ones(num_envs, bool)
        if "reset_mask" in values:
            chosen = values["reset_mask"]
            mask = checked_numbers(chosen, "reset_mask", ((num_envs,),)) != 0
            if np.asarray(chosen).dtype != bool:
                raise InvalidInputError(
                    f"reset_mask={shown(chosen)}: expected {num_envs} times True or False, not indices"
                )
        init_states = starts = None
        if "init_state" in values:
            chosen = values["init_state"]
            indices = checked_numbers(chosen, "init_state", ((), (1,), (num_envs,)))
            if np.asarray(chosen).dtype.kind not in "iu":
                raise InvalidInputError(f"init_state={shown(chosen)}: expected whole numbers")
            init_states = np.broadcast_to(indices.astype(np.int64), (num_envs,))
        if "start" in values:
            starts = checked_numbers(values["start"], "start", (f"({num_envs}, n)",))
            if starts.ndim != 2 or len(starts) != num_envs:
                raise InvalidInputError(
                    f"start: expected {num_envs} rows of numbers, got shape {starts.shape}"
                )
        outdated = validate(bool, values.get("outdated_controller", False), prefix=("outdated_controller",))
        return cls(np.flatnonzero(mask), _seeds(num_envs, seed), init_states, starts, outdated)


def _seeds(num_envs: int, seed: object) -> list[int | None]:
    """Return one seed for each environment."""
    if isinstance(seed, list | tuple) or (isinstance(seed, np.ndarray) and seed.ndim):
        if len(seed) != num_envs:
            raise InvalidInputError(f"seed: expected one or {num_envs} seeds, got {len(seed)}")
        return [validate(Whole | None, one, prefix=("seed",)) for one in seed]
    first = validate(Whole | None, seed, prefix=("seed",))
    return [None if first is None else first + i for i in range(num_envs)]


def check_range(states: np.ndarray, task: Task) -> None:
    """Raise unless MuJoCo takes the numbers: it resets a simulation with larger ones, without an error."""
    if not (np.abs(states) <= mujoco.mjMAXVAL).all():
        raise InvalidInputError(
            f"{task.id}: a state has a number beyond {mujoco.mjMAXVAL:g}, or not a number"
        )
