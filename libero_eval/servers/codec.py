"""Messages of policy servers as bytes, which are of others: their size and depth are limited."""

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from libero_env.errors import need
from libero_env.text import shorten
from lifelong.errors import CodecError

MAX_PARTS = 10_000  # lists and maps of a message
MAX_DEPTH = 30  # lists and maps within each other
MAX_TEXT = 2000  # characters of a server's error that are shown, its last ones


@dataclass(frozen=True)
class Codec:
    """Messages as bytes: MessagePack, and what a kind of server makes of arrays.

    Attributes:
        name: Name of the server's protocol, for error messages.
        encode: Function that returns plain data for an array or a NumPy scalar.
        decode: Function that returns the value of a decoded map.
    """

    name: str
    encode: Callable[[Any], Any]
    decode: Callable[[Mapping], Any]

    def pack(self, message: Any) -> bytes:
        """Return a message as bytes.

        Raises:
            CodecError: It has a value that the protocol cannot carry.
        """

        def encode(value: Any) -> Any:
            if isinstance(value, np.ndarray | np.generic):
                return self.encode(value)
            raise TypeError(f"a {type(value).__name__} is neither plain data nor an array")

        try:
            return need("msgpack").packb(message, default=encode)
        except (TypeError, ValueError, OverflowError) as error:
            raise CodecError(f"{self.name} cannot carry this message: {error}") from error

    def unpack(self, data: bytes) -> Any:
        """Return the message that bytes hold; its arrays are writable copies.

        Raises:
            CodecError: The bytes are not a message of the protocol.
        """
        parts = itertools.count(1)

        def counted(value: Any) -> Any:
            if next(parts) > MAX_PARTS:
                raise ValueError(f"more than {MAX_PARTS} lists and maps")
            return value

        try:
            found = need("msgpack").unpackb(
                data, object_hook=lambda value: self.decode(counted(value)), list_hook=counted
            )
            _check_depth(found)
        except Exception as error:  # noqa: BLE001 - bytes of a stranger: msgpack and NumPy raise many kinds
            start = bytes(data[:16]).hex(" ")
            raise CodecError(
                f"{len(data)} bytes that are not a message of {self.name} ({type(error).__name__}: "
                f"{shorten(str(error), 200)}); they begin with {start or 'nothing'}"
            ) from error
        return found


def _check_depth(value: Any, left: int = MAX_DEPTH) -> None:
    parts = value.values() if isinstance(value, Mapping) else value if isinstance(value, list) else ()
    if parts and not left:
        raise ValueError(f"lists and maps within each other, more than {MAX_DEPTH} deep")
    for part in parts:
        _check_depth(part, left - 1)


def ending(text: Any) -> str:
    """Return the end of a server's text for a message; it may have any size."""
    said = str(text).strip()
    return said if len(said) <= MAX_TEXT else f"... {said[-MAX_TEXT:]}"


def refuse(dtype: np.dtype, kinds: str) -> None:
    """Check that an array is not of some kinds of NumPy, such as `O`.

    Raises:
        ValueError: It is.
    """
    if dtype.kind in kinds:
        raise ValueError(f"dtype {dtype} is refused")


def array_of(data: Any, dtype: str, shape: Any) -> np.ndarray:
    """Return the array that raw bytes hold, as a copy; bytes and shape must agree."""
    kind, sizes = np.dtype(dtype), tuple(int(n) for n in shape)
    refuse(kind, "VOc")
    if min(sizes, default=0) < 0 or len(data) != math.prod(sizes) * kind.itemsize:
        raise ValueError(f"{len(data)} bytes for shape {sizes} of {kind}")
    return np.frombuffer(data, kind).reshape(sizes).copy()
