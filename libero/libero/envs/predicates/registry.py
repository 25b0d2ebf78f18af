"""Predicates by name."""

from collections.abc import Callable
from typing import Any

from libero._adapters.lookup import lookup
from libero.libero.envs.predicates import base_predicates as known
from libero_env.errors import UnknownNameError

_FNS = "TruePredicateFn FalsePredicateFn In On Up Stack InContactPredicateFn PrintJointState Open Close TurnOn TurnOff"
VALIDATE_PREDICATE_FN_DICT: dict[str, Callable[..., bool]] = {
    name.removesuffix("PredicateFn").lower(): getattr(known, name)() for name in _FNS.split()
}


def update_predicate_fn_dict(fn_key: str, fn_name: str | type | Callable[..., bool]) -> None:
    """Add a predicate or replace one.

    Args:
        fn_key: Name in task files; case does not matter.
        fn_name: Name of a class of this package, a class, or a callable of object states.
    """
    if isinstance(fn_name, str):
        if not hasattr(known, fn_name):
            raise UnknownNameError("predicate class", fn_name, vars(known))
        fn_name = getattr(known, fn_name)
    predicate: Any = fn_name() if isinstance(fn_name, type) else fn_name
    VALIDATE_PREDICATE_FN_DICT[fn_key.lower()] = predicate


def get_predicate_fn_dict() -> dict[str, Callable[..., bool]]:
    """Return all predicates by name."""
    return VALIDATE_PREDICATE_FN_DICT


def get_predicate_fn(predicate_fn_name: str) -> Callable[..., bool]:
    """Return a predicate by its name, ignoring case; raise an UnknownNameError if there is none."""
    return lookup(VALIDATE_PREDICATE_FN_DICT, "predicate", predicate_fn_name)


def eval_predicate_fn(predicate_fn_name: str, *args: Any) -> bool:
    """Return the truth of a predicate for object states."""
    return get_predicate_fn(predicate_fn_name)(*args)
