"""Predicates as callables of object states."""

from abc import ABC, abstractmethod
from typing import Any, ClassVar

from libero_env.sim.predicates import evaluate
from libero_env.tasks.problem import Atom


class Expression(ABC):
    """An expression that is true or false for object states."""

    @abstractmethod
    def __call__(self, *args: Any) -> bool:
        """Return the truth for these object states."""


class UnaryAtomic(Expression):
    """A predicate of one object state."""


class BinaryAtomic(Expression):
    """A predicate of two object states."""


class MultiarayAtomic(Expression):
    """A predicate of any number of object states."""


class _Native(Expression):
    """A predicate of `libero_env`."""

    predicate: ClassVar[str]

    def __call__(self, *args: Any) -> bool:
        """Return the truth for these object states."""
        return evaluate(Atom(self.predicate, tuple(arg.object_name for arg in args)), args[0].env.view)


class _StateMethod(UnaryAtomic):
    """A predicate that is a method of the object state."""

    method: ClassVar[str]

    def __call__(self, *args: Any) -> bool:
        """Return the truth for this object state."""
        (state,) = args
        return getattr(state, self.method)()


class TruePredicateFn(MultiarayAtomic):
    """Always true."""

    def __call__(self, *args: Any) -> bool:
        """Return True."""
        return True


class FalsePredicateFn(MultiarayAtomic):
    """Never true."""

    def __call__(self, *args: Any) -> bool:
        """Return False."""
        return False


class InContactPredicateFn(_Native, BinaryAtomic):
    """The two touch."""

    predicate = "Incontact"


class In(_Native, BinaryAtomic):
    """The first is in the second, a region."""

    predicate = "In"


class On(_Native, BinaryAtomic):
    """The first is on the second."""

    predicate = "On"


class Up(_Native, UnaryAtomic):
    """The object is at least a metre above the floor."""

    predicate = "Up"


class Stack(_Native, BinaryAtomic):
    """The first is on the second and inside it."""

    predicate = "Stack"


class PrintJointState(_Native, UnaryAtomic):
    """Always true; prints the joint positions."""

    predicate = "Printjointstate"

    def __call__(self, *args: Any) -> bool:
        """Print the joint positions and return True."""
        print(args[0].get_joint_state())
        return super().__call__(*args)


class Open(_StateMethod):
    """Any joint is in the open range."""

    method = "is_open"


class Close(_StateMethod):
    """All joints are in the closed range."""

    method = "is_close"


class TurnOn(_StateMethod):
    """Any joint is in the range of on."""

    method = "turn_on"


class TurnOff(_StateMethod):
    """All joints are in the range of off."""

    method = "turn_off"
