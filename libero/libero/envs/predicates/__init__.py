"""Predicates as callables of object states, by name; `libero_env.sim.predicates` decides whether they hold."""

from abc import ABC, abstractmethod
from collections import UserDict
from collections.abc import Callable, MutableMapping
from functools import partial
from operator import methodcaller
from typing import Any

from libero._adapters.lookup import alias_modules, lookup
from libero_env.errors import LiberoError
from libero_env.parallel import send_to_workers
from libero_env.sim.predicates import PREDICATES, evaluate, register_predicate
from libero_env.tasks.expression import Atom
from libero_env.tasks.rules import BUILTIN_PREDICATES


class Expression(ABC):
    """An expression that is true or false for object states."""

    @abstractmethod
    def __call__(self, *args: Any) -> bool:
        """Return whether it holds for these object states."""


class UnaryAtomic(Expression):
    """A predicate of one object state."""


class BinaryAtomic(Expression):
    """A predicate of two object states."""


class MultiarayAtomic(Expression):
    """A predicate of any number of object states."""


def _native(predicate: str, *args: Any) -> bool:
    """Ask `libero_env` about object states; other arguments are passed as they are."""
    names = tuple(getattr(arg, "object_name", arg) for arg in args)
    return evaluate(Atom(predicate, names), next(arg for arg in args if hasattr(arg, "env")).env.view)


def _print_joints(state: Any) -> bool:
    print(state.get_joint_state())
    return _native("Printjointstate", state)


_ONE, _TWO, _ANY = UnaryAtomic, BinaryAtomic, MultiarayAtomic
_PREDICATES: dict[str, tuple[type, Callable[..., bool], str]] = {  # class -> base, answer, meaning
    "TruePredicateFn": (_ANY, lambda *_: True, "Always true."),
    "FalsePredicateFn": (_ANY, lambda *_: False, "Never true."),
    "InContactPredicateFn": (_TWO, partial(_native, "Incontact"), "The two touch."),
    "In": (_TWO, partial(_native, "In"), "The first is in the second, a region."),
    "On": (_TWO, partial(_native, "On"), "The first is on the second."),
    "Stack": (_TWO, partial(_native, "Stack"), "The first is on the second and inside it."),
    "Up": (_ONE, partial(_native, "Up"), "It is at least a metre above the floor."),
    "Open": (_ONE, methodcaller("is_open"), "Any joint is in the open range."),
    "Close": (_ONE, methodcaller("is_close"), "All joints are in the closed range."),
    "TurnOn": (_ONE, methodcaller("turn_on"), "Any joint is in the range of on."),
    "TurnOff": (_ONE, methodcaller("turn_off"), "All joints are in the range of off."),
    "PrintJointState": (_ONE, _print_joints, "Always true; prints the joint positions."),
}
for _name, (_base, _answer, _doc) in _PREDICATES.items():
    _facts = {"__module__": __name__, "__doc__": _doc, "__call__": staticmethod(_answer)}
    globals()[_name] = type(_name, (_base,), _facts)


class _OfStates:
    """A user's predicate of object states as one of `libero_env`, of names; within itself it is the builtin one."""

    def __init__(self, function: Callable[..., Any], builtin: Callable[..., Any] | None):
        self.function, self.builtin, self.is_asked = function, builtin, False

    def __call__(self, view: Any, *names: str) -> bool:
        """Return whether it holds; arguments that are no names of entities or regions are passed as they are."""
        if self.is_asked and self.builtin is not None:
            return self.builtin(view, *names)
        reference = getattr(view.simulations, "domain", None)
        domain = reference and reference()
        if domain is None:
            raise LiberoError(
                "predicates of object states are for environments of libero; use register_predicate"
            )
        self.is_asked = True
        try:
            return bool(self.function(*(domain.object_states_dict.get(name, name) for name in names)))
        finally:
            self.is_asked = False


class _Predicates(UserDict):
    """Predicates by name; those of users hold in goals too, so that all are in one table."""

    def __setitem__(self, key: str, predicate: Callable[..., bool]) -> None:
        super().__setitem__(key, predicate)
        name = key.capitalize()
        register_predicate(
            key, _OfStates(predicate, PREDICATES.get(name) if name in BUILTIN_PREDICATES else None)
        )


VALIDATE_PREDICATE_FN_DICT = _Predicates()
VALIDATE_PREDICATE_FN_DICT.data = {  # which are in the table already
    name.removesuffix("PredicateFn").lower(): globals()[name]() for name in _PREDICATES
}
send_to_workers(__name__, "VALIDATE_PREDICATE_FN_DICT")


def update_predicate_fn_dict(fn_key: str, fn_name: str | type | Callable[..., bool]) -> None:
    """Add a predicate or replace one.

    Args:
        fn_key: Name in task files; case does not matter.
        fn_name: Name of a class of this package, a class, or a callable of object states.
    """
    if isinstance(fn_name, str):
        classes = {name: value for name, value in globals().items() if isinstance(value, type)}
        fn_name = lookup(classes, "predicate class", fn_name)
    predicate: Any = fn_name() if isinstance(fn_name, type) else fn_name
    VALIDATE_PREDICATE_FN_DICT[fn_key.lower()] = predicate


def get_predicate_fn_dict() -> MutableMapping[str, Callable[..., bool]]:
    """Return all predicates by name."""
    return VALIDATE_PREDICATE_FN_DICT


def get_predicate_fn(predicate_fn_name: str) -> Callable[..., bool]:
    """Return a predicate by its name, ignoring case; raise an UnknownNameError if there is none."""
    name = predicate_fn_name.capitalize()
    if name.lower() not in VALIDATE_PREDICATE_FN_DICT and name in PREDICATES:
        return partial(_native, name)  # registered with libero_env
    return lookup(VALIDATE_PREDICATE_FN_DICT, "predicate", predicate_fn_name)


def eval_predicate_fn(predicate_fn_name: str, *args: Any) -> bool:
    """Return whether a predicate holds for object states."""
    return get_predicate_fn(predicate_fn_name)(*args)


alias_modules(__name__, "base_predicates")
