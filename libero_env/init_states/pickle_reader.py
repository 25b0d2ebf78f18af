"""Pickles as plain data: what a pickle describes is read, nothing that it names is imported or called.

`pickletools` of the standard library splits the pickle into its operations. The few that describe arrays of numbers
are followed here, and any other is an error. A name or a call in the pickle becomes a `Call` of this module, made for
this one reading; so no pickle can reach an object that another reading uses.
"""

import io
import pickletools
import struct
from collections.abc import Container
from dataclasses import dataclass

from libero_env.errors import LiberoError

_MAX_OPERATIONS = 2000  # an array takes 60, a tensor 40
_MAX_SHOWN = 80  # characters of a name in a message


class StateFileError(LiberoError, ValueError):
    """A file of initial states that is broken or has other content than arrays; the message names the file."""


@dataclass(frozen=True)
class Name:
    """A function or class that a pickle names.

    Attributes:
        text: Module and name, such as `numpy.ndarray`.
    """

    text: str


@dataclass(frozen=True)
class External:
    """A reference to data outside of the pickle.

    Attributes:
        key: What the pickle has written as its identifier.
    """

    key: object


@dataclass(eq=False)
class Call:
    """A call that a pickle describes.

    Attributes:
        name: What would be called, module and name.
        args: Arguments.
        state: What the result would be given as its state; None for none.
    """

    name: str
    args: tuple[object, ...]
    state: tuple[object, ...] | None = None


def read_pickle(content: bytes, names: Container[str]) -> object:
    """Return what a pickle describes, made of numbers, texts, bytes, tuples and the classes of this module.

    Args:
        content: The pickle, of any protocol.
        names: Functions and classes that it may name, such as `numpy.ndarray`.

    Raises:
        StateFileError: The pickle is broken, has an operation that arrays do not need, or names something else.
    """
    machine = _Machine(names)
    try:
        for count, (operation, argument, _) in enumerate(pickletools.genops(io.BytesIO(content))):
            if count >= _MAX_OPERATIONS:
                raise StateFileError(
                    f"a pickle of more than {_MAX_OPERATIONS} operations; expected one array"
                )
            machine.follow(operation.name, argument)
        return machine.pop()
    except StateFileError:
        raise
    # a warning: `pickletools` on a text with unknown escapes, where warnings are errors
    except (ValueError, IndexError, KeyError, struct.error, DeprecationWarning) as error:
        raise StateFileError(f"the pickle is broken ({type(error).__name__}: {shown(error)})") from None


def shown(value: object) -> str:
    """Return text from a file for a message: short, and without control characters."""
    return str(value)[:_MAX_SHOWN].encode("unicode_escape").decode("ascii")


class _Machine:
    """The stack and the memory of a pickle that is being read."""

    def __init__(self, names: Container[str]):
        self._names = names
        self._stack: list[object] = []
        self._marks: list[int] = []  # heights of the stack
        self._memory: dict[int, object] = {}

    def follow(self, operation: str, argument: object) -> None:
        """Follow one operation.

        Raises:
            StateFileError: Arrays do not need it.
            IndexError: The stack is empty.
            KeyError: The memory has no such entry.
        """
        match operation:
            case "PROTO" | "FRAME" | "STOP":
                pass
            case _ if operation in _CONSTANTS:
                self._stack.append(_CONSTANTS[operation])
            case _ if operation in _VALUES:
                self._stack.append(argument)
            case "PUT" | "BINPUT" | "LONG_BINPUT":
                assert isinstance(argument, int)
                self._memory[argument] = self._stack[-1]
            case "MEMOIZE":
                self._memory[len(self._memory)] = self._stack[-1]
            case "GET" | "BINGET" | "LONG_BINGET":
                assert isinstance(argument, int)
                self._stack.append(self._memory[argument])
            case "MARK":
                self._marks.append(len(self._stack))
            case "TUPLE":
                self._stack.append(self._take(len(self._stack) - self._marks.pop()))
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                self._stack.append(self._take(int(operation[-1])))
            case _:
                self._describe(operation, argument)

    def pop(self) -> object:
        """Return the top of the stack and remove it."""
        if self._marks and self._marks[-1] >= len(self._stack):
            raise IndexError("nothing above the mark")
        return self._stack.pop()

    def _take(self, count: int) -> tuple[object, ...]:
        return tuple(reversed([self.pop() for _ in range(count)]))

    def _describe(self, operation: str, argument: object) -> None:
        match operation:
            case "GLOBAL":
                self._push_name(str(argument).replace(" ", ".", 1))
            case "STACK_GLOBAL":
                self._push_name(".".join(str(part) for part in self._take(2)))
            case "BINPERSID":
                self._stack.append(External(self.pop()))
            case "REDUCE":
                name, args = self._take(2)
                if not isinstance(name, Name) or not isinstance(args, tuple):
                    raise StateFileError("the pickle calls what is no function")
                self._stack.append(Call(name.text, args))
            case "BUILD":
                state = self.pop()
                call = self._stack[-1]
                if not isinstance(call, Call) or call.state is not None or not isinstance(state, tuple):
                    raise StateFileError("the pickle changes what is no array")
                call.state = state
            case _:
                raise StateFileError(f"the pickle has the operation {operation}, which arrays do not need")

    def _push_name(self, text: str) -> None:
        if text not in self._names:
            raise StateFileError(
                f"the pickle names {shown(text)}; only arrays of numbers are read, nothing is executed"
            )
        self._stack.append(Name(text))


_CONSTANTS: dict[str, object] = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
_VALUES = frozenset(
    ("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE")
    + ("BINUNICODE8", "SHORT_BINBYTES", "BINBYTES", "BINBYTES8", "BYTEARRAY8")
)
