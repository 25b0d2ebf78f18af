"""Predicates as callables of object states."""

from abc import ABC, abstractmethod
from typing import Any, ClassVar

from libero_env.sim.predicates import evaluate
from libero_env.tasks.problem import Atom


class Expression(ABC):
    """Anything that is true or false of object states."""

    @abstractmethod
    def __call__(self, *args: Any) -> bool:
        """Truth for these object states."""


class _Native(Expression):
    """A predicate of `libero_env`."""

    predicate: ClassVar[str]

    def __call__(self, *args: Any) -> bool:
        """Truth for these object states."""
        return evaluate(Atom(self.predicate, tuple(arg.object_name for arg in args)), args[0].env.view)


class UnaryAtomic(Expression):
    """A predicate of one thing."""

    def __call__(self, arg1: Any) -> bool:
        """Truth for this object state."""
        raise NotImplementedError


class BinaryAtomic(Expression):
    """A predicate of two things."""

    def __call__(self, arg1: Any, arg2: Any) -> bool:
        """Truth for these object states."""
        raise NotImplementedError


class MultiarayAtomic(Expression):
    """A predicate of any number of things."""

    def __call__(self, *args: Any) -> bool:
        """Truth for these object states."""
        raise NotImplementedError


class TruePredicateFn(MultiarayAtomic):
    """Always true."""

    def __call__(self, *args: Any) -> bool:
        """True."""
        return True


class FalsePredicateFn(MultiarayAtomic):
    """Never true."""

    def __call__(self, *args: Any) -> bool:
        """False."""
        return False


class InContactPredicateFn(_Native, BinaryAtomic):
    """The two touch."""

    predicate = "Incontact"


class In(_Native, BinaryAtomic):
    """The first is in the second, a region."""

    predicate = "In"


class On(_Native, BinaryAtomic):
    """The first stands on the second."""

    predicate = "On"


class Up(_Native, UnaryAtomic):
    """At least a metre above the floor."""

    predicate = "Up"


class Stack(_Native, BinaryAtomic):
    """The first stands on the second and is inside it."""

    predicate = "Stack"


class PrintJointState(_Native, UnaryAtomic):
    """Always true; prints the joints."""

    predicate = "Printjointstate"

    def __call__(self, *args: Any) -> bool:
        """True."""
        print(args[0].get_joint_state())
        return super().__call__(*args)


class Open(UnaryAtomic):
    """Any joint is as far out as open begins."""

    def __call__(self, arg1: Any) -> bool:
        """Truth for this object state."""
        return arg1.is_open()


class Close(UnaryAtomic):
    """All joints are as far in as closed begins."""

    def __call__(self, arg1: Any) -> bool:
        """Truth for this object state."""
        return arg1.is_close()


class TurnOn(UnaryAtomic):
    """Any joint is as far as on begins."""

    def __call__(self, arg1: Any) -> bool:
        """Truth for this object state."""
        return arg1.turn_on()


class TurnOff(UnaryAtomic):
    """All joints are as far back as off begins."""

    def __call__(self, arg1: Any) -> bool:
        """Truth for this object state."""
        return arg1.turn_off()
