"""Predicates by name."""

from collections.abc import Callable
from typing import Any

from libero.libero.envs.predicates import base_predicates as known
from libero_env.errors import UnknownNameError

VALIDATE_PREDICATE_FN_DICT: dict[str, Callable[..., bool]] = {
    "true": known.TruePredicateFn(),
    "false": known.FalsePredicateFn(),
    "in": known.In(),
    "on": known.On(),
    "up": known.Up(),
    "stack": known.Stack(),
    "incontact": known.InContactPredicateFn(),
    "printjointstate": known.PrintJointState(),
    "open": known.Open(),
    "close": known.Close(),
    "turnon": known.TurnOn(),
    "turnoff": known.TurnOff(),
}


def update_predicate_fn_dict(fn_key: str, fn_name: str | type | Callable[..., bool]) -> None:
    """Add a predicate or replace one.

    Args:
        fn_key: as task files write it; case does not count.
        fn_name: name of a class of this package, a class, or a callable of object states.
    """
    if isinstance(fn_name, str):
        if not hasattr(known, fn_name):
            raise UnknownNameError("predicate class", fn_name, vars(known))
        fn_name = getattr(known, fn_name)
    VALIDATE_PREDICATE_FN_DICT[fn_key.lower()] = fn_name() if isinstance(fn_name, type) else fn_name  # type: ignore[assignment]


def get_predicate_fn_dict() -> dict[str, Callable[..., bool]]:
    """All predicates."""
    return VALIDATE_PREDICATE_FN_DICT


def get_predicate_fn(predicate_fn_name: str) -> Callable[..., bool]:
    """One predicate; case does not count.

    Raises:
        UnknownNameError: no predicate has this name.
    """
    if predicate_fn_name.lower() not in VALIDATE_PREDICATE_FN_DICT:
        raise UnknownNameError("predicate", predicate_fn_name, VALIDATE_PREDICATE_FN_DICT)
    return VALIDATE_PREDICATE_FN_DICT[predicate_fn_name.lower()]


def eval_predicate_fn(predicate_fn_name: str, *args: Any) -> bool:
    """Truth of a predicate for object states."""
    return get_predicate_fn(predicate_fn_name)(*args)
