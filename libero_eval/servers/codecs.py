"""Messages as bytes: MessagePack with NumPy arrays, in the encodings of three kinds of policy servers.

Sources: openpi `packages/openpi-client/src/openpi_client/msgpack_numpy.py`; vla-eval 0.8.0 `vla_eval/protocol`;
GR00T `gr00t/policy/server_client.py`.
"""

import io
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image

from libero_eval.servers.packages import need
from lifelong.errors import WireError

_IMAGE_CHANNELS = (
    3,
    4,
)  # of the arrays that vla-eval sends as PNG; it names 1 too, which Pillow does not take


@dataclass(frozen=True)
class Codec:
    """An encoding of messages.

    Attributes:
        name: Name of the protocol, for error messages.
        encode: Function that returns plain data for an array or a NumPy scalar.
        decode: Function that returns the value of a decoded map.
    """

    name: str
    encode: Callable[[Any], Any]
    decode: Callable[[Mapping], Any]

    def pack(self, message: Any) -> bytes:
        """Return a message as bytes.

        Raises:
            WireError: It has a value that the protocol cannot carry.
        """
        try:
            return need("msgpack").packb(message, default=self._encode)
        except (TypeError, ValueError, OverflowError) as error:
            raise WireError(f"{self.name} cannot carry this message: {error}") from error

    def unpack(self, data: bytes) -> Any:
        """Return the message that bytes hold; its arrays are writable copies.

        Raises:
            WireError: The bytes are no message of the protocol.
        """
        try:
            return need("msgpack").unpackb(data, object_hook=self._decode)
        except Exception as error:  # noqa: BLE001 - bytes of a stranger: msgpack and NumPy raise many kinds
            start = bytes(data[:16]).hex(" ")
            raise WireError(
                f"{len(data)} bytes that are no {self.name} message ({type(error).__name__}: {error}); "
                f"they begin with {start or 'nothing'}"
            ) from error

    def _encode(self, value: Any) -> Any:
        if isinstance(value, np.ndarray | np.generic):
            return self.encode(value)
        raise TypeError(f"a {type(value).__name__} is neither plain data nor an array")

    def _decode(self, found: dict) -> Any:
        return self.decode(found)


def _refuse(dtype: np.dtype, kinds: str) -> None:
    if dtype.kind in kinds:
        raise ValueError(f"dtype {dtype} is refused")


def _array(data: Any, dtype: str, shape: Any) -> np.ndarray:
    """Return the array that raw bytes hold, as a copy; bytes and shape must agree."""
    kind, sizes = np.dtype(dtype), tuple(int(n) for n in shape)
    _refuse(kind, "VOc")
    if min(sizes, default=0) < 0 or len(data) != math.prod(sizes) * kind.itemsize:
        raise ValueError(f"{len(data)} bytes for shape {sizes} of {kind}")
    return np.frombuffer(data, kind).reshape(sizes).copy()


def _encode_openpi(value: np.ndarray | np.generic) -> dict:
    _refuse(value.dtype, "VOc")
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    return {
        b"__ndarray__": True,
        b"data": value.tobytes(),
        b"dtype": value.dtype.str,
        b"shape": value.shape,
    }


def _decode_openpi(found: Mapping) -> Any:
    if b"__ndarray__" in found:
        return _array(found[b"data"], found[b"dtype"], found[b"shape"])
    if b"__npgeneric__" in found:
        kind = np.dtype(found[b"dtype"])
        _refuse(kind, "VOc")
        return kind.type(found[b"data"])
    return found


def _encode_vla_eval(value: np.ndarray | np.generic) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if value.dtype.kind not in "biuf":
        raise ValueError(f"dtype {value.dtype} is refused; valid: bool, integers, floats")
    if value.dtype == np.uint8 and value.ndim == 3 and value.shape[2] in _IMAGE_CHANNELS:
        file = io.BytesIO()
        Image.fromarray(value).save(file, format="PNG")
        return {"__image__": True, "format": "png", "data": file.getvalue(), "shape": list(value.shape)}
    return {
        "__ndarray__": True,
        "data": value.tobytes(),
        "dtype": value.dtype.str,
        "shape": list(value.shape),
    }


def _decode_vla_eval(found: Mapping) -> Any:
    if "__image__" in found and found["format"] != "raw":
        return np.array(Image.open(io.BytesIO(found["data"])))
    if "__image__" in found or "__ndarray__" in found:
        _refuse(np.dtype(found["dtype"]), "SUMm")
        return _array(found["data"], found["dtype"], found["shape"])
    return found


def _encode_groot(value: np.ndarray | np.generic) -> Any:
    _refuse(value.dtype, "VO")
    if isinstance(value, np.generic):
        return value.item()
    file = io.BytesIO()
    np.save(file, value, allow_pickle=False)
    return {"__ndarray_class__": True, "as_npy": file.getvalue()}


def _decode_groot(found: Mapping) -> Any:
    if "__ndarray_class__" in found:
        return np.load(io.BytesIO(found["as_npy"]), allow_pickle=False)
    if "__ModalityConfig_class__" in found:
        return found["as_json"]
    return found


OPENPI = Codec("openpi", _encode_openpi, _decode_openpi)
VLA_EVAL = Codec("vla-eval", _encode_vla_eval, _decode_vla_eval)
GROOT = Codec("GR00T", _encode_groot, _decode_groot)
