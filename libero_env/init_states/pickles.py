"""Initial states in the original's files: one array in a pickle, which is in a zip; nothing is executed.

What is read, and no more: a zip as `torch.save` writes it, or a bare pickle; in it one array of NumPy, of two
dimensions or of one for a single state, with finite numbers of 4 or 8 bytes, at most 10,000 states of at most 10,000
numbers and 16 million numbers in all. Sizes are compared with the file before memory is asked for.
"""

import io
import pickle
import pickletools
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from libero_env.errors import LiberoError
from libero_env.storage import atomic_path, read_bounded
from libero_env.text import shown

_MAX_OPERATIONS = 2000  # an array takes 60
_MAX_BYTES = 1 << 28  # of a file, and of a part of it
_MAX_PARTS = 1000  # of a zip
_MAX_EDGE = 10_000  # states, and numbers of a state
_MAX_NUMBERS = 1 << 24
_EPOCH = (1980, 1, 1, 0, 0, 0)  # date of all parts, so that equal states give equal files
_OPERATION_NAMES = (
    "PROTO FRAME STOP NONE NEWTRUE NEWFALSE EMPTY_TUPLE INT BININT BININT1 BININT2 LONG LONG1 UNICODE BINUNICODE "
    "SHORT_BINUNICODE BINUNICODE8 SHORT_BINBYTES BINBYTES BINBYTES8 BYTEARRAY8 PUT BINPUT LONG_BINPUT MEMOIZE GET "
    "BINGET LONG_BINGET MARK TUPLE TUPLE1 TUPLE2 TUPLE3 GLOBAL STACK_GLOBAL REDUCE BUILD"
)
_OPERATIONS = frozenset(_OPERATION_NAMES.split())
_CODES = ("f8", "f4", "i8", "i4")
_RECONSTRUCT = ("numpy.core.multiarray._reconstruct", "numpy._core.multiarray._reconstruct")
_FROM_BUFFER = ("numpy.core.numeric._frombuffer", "numpy._core.numeric._frombuffer")
_NAMES = frozenset((*_RECONSTRUCT, *_FROM_BUFFER, "numpy.ndarray", "numpy.dtype", "_codecs.encode"))


class StateFileError(LiberoError, ValueError):
    """A file of initial states that is broken or has other content than arrays; the message names the file."""


@dataclass(frozen=True)
class Name:
    """A function or class that a pickle names, such as `numpy.ndarray`; a call of it is only described."""

    text: str

    def __call__(self, *args: object) -> "Call":
        """Return the call that the pickle describes."""
        return Call(self.text, args)


@dataclass(eq=False)
class Call:
    """A call that a pickle describes: of what, the arguments, and what the result would be given as its state."""

    name: str
    args: tuple[object, ...]
    state: tuple[object, ...] | None = None

    def __setstate__(self, state: object) -> None:
        if self.state is not None or not isinstance(state, tuple):
            raise StateFileError("the pickle changes what is not an array")
        self.state = state


class _Reader(pickle.Unpickler):
    """An unpickler that knows a few names, and calls none of them."""

    def find_class(self, module: str, name: str) -> Name:
        if (text := f"{module}.{name}") not in _NAMES:
            raise StateFileError(
                f"the pickle names {shown(text)}; only arrays of numbers are read, nothing is executed"
            )
        return Name(text)


def _read_pickle(content: bytes) -> object:
    """Return what a pickle of any protocol describes: numbers, texts, bytes, tuples, and the classes of this module.

    Raises:
        StateFileError: The pickle is broken, has an operation that arrays do not need, or names something else.
    """
    try:
        for count, (operation, argument, _) in enumerate(pickletools.genops(io.BytesIO(content))):
            if count >= _MAX_OPERATIONS:
                raise StateFileError(
                    f"a pickle of more than {_MAX_OPERATIONS} operations; expected one array"
                )
            if operation.name not in _OPERATIONS:
                raise StateFileError(
                    f"the pickle has the operation {operation.name}, which arrays do not need"
                )
            if "PUT" in operation.name and int(argument or 0) > _MAX_OPERATIONS:  # the size of a table
                raise StateFileError(f"the pickle has more than {_MAX_OPERATIONS} values")
        return _Reader(io.BytesIO(content)).load()
    except StateFileError:
        raise
    except Exception as error:  # noqa: BLE001 - what pickle reads of broken bytes raises errors of many types
        raise StateFileError(f"the pickle is broken ({shown(error)})") from None


def read_states(path: str | Path) -> np.ndarray:
    """Read a `.pruned_init` or `.init` file.

    Returns:
        Rows [time, qpos, qvel], (n, size) float64.

    Raises:
        StateFileError: The file does not exist, is broken, or has something else than one array of the kind that the
            module describes.
    """
    try:
        content = read_bounded(Path(path), _MAX_BYTES)
        if content.startswith(b"PK"):
            array = _read_zip(content)
        else:
            array = _to_array(_read_pickle(content))
        if not np.isfinite(array).all():
            raise StateFileError("a state has numbers that are not finite")
    except StateFileError as error:
        raise StateFileError(f"{path}: {error}") from None
    except OSError as error:
        raise StateFileError(
            f"{path}: {error.strerror or error}; see `init_states` in the config file"
        ) from error
    return np.ascontiguousarray(array, np.float64)


def write_states(path: str | Path, rows: np.ndarray) -> None:
    """Write rows (n, size) in the original's format, which `torch.load` and `read_states` read."""
    path = Path(path)
    with atomic_path(path) as temporary:
        temporary.write_bytes(states_content(rows, path.stem))


def states_content(rows: np.ndarray, name: str) -> bytes:
    """Return the content of a file of `write_states`.

    Args:
        rows: States, (n, size).
        name: Folder in the zip.
    """
    # Names of the older NumPy, which all versions read.
    content = pickle.dumps(np.ascontiguousarray(rows, np.float64), protocol=2)
    content = content.replace(b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n")
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for part, data in (("data.pkl", content), ("version", b"3\n")):
            archive.writestr(zipfile.ZipInfo(f"{name}/{part}", _EPOCH), data)
    return stream.getvalue()


def _read_zip(content: bytes) -> np.ndarray:
    if content.count(b"PK\x01\x02") > _MAX_PARTS:
        raise StateFileError(f"a zip of more than {_MAX_PARTS} parts; expected what torch.save writes")
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            names = archive.namelist()
            pickles = [name for name in names if name.rpartition("/")[2] == "data.pkl"]
            if len(pickles) != 1 or len(set(names)) < len(names):
                raise StateFileError("a zip without one data.pkl; expected what torch.save writes")
            info = archive.getinfo(pickles[0])
            if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or info.flag_bits & 1:
                raise StateFileError("data.pkl is encrypted or compressed in an unusual way")
            if info.file_size > _MAX_BYTES:
                raise StateFileError(f"data.pkl is larger than {_MAX_BYTES >> 20} MiB")
            return _to_array(_read_pickle(archive.read(info)))
    except StateFileError:
        raise
    except Exception as error:  # noqa: BLE001 - as for a pickle
        raise StateFileError(f"the zip is broken ({shown(error)})") from None


def _to_array(found: object) -> np.ndarray:
    """Return the array that a pickle describes."""
    match found:
        case Call(name, _, (_, shape, dtype, order, raw)) if name in _RECONSTRUCT:
            return _from_bytes(shape, dtype, raw, fortran=order is True)
        case Call(name, (raw, dtype, shape, ("C" | "F") as order), None) if name in _FROM_BUFFER:
            return _from_bytes(shape, dtype, raw, fortran=order == "F")
    raise StateFileError("expected an array (states, size) of numbers")


def _shape(found: object) -> tuple[int, int]:
    match found:
        case (int(rows), int(columns)):
            pass
        case (int(columns),):
            rows = 1
        case _:
            raise StateFileError("expected an array (states, size) of numbers")
    if min(rows, columns) < 1:
        raise StateFileError("an array without numbers")
    if max(rows, columns) > _MAX_EDGE or rows * columns > _MAX_NUMBERS:
        raise StateFileError(
            f"an array with an edge over {_MAX_EDGE:,}, or of more than {_MAX_NUMBERS:,} numbers in all"
        )
    return rows, columns


def _from_bytes(shape: object, dtype: object, raw: object, *, fortran: bool) -> np.ndarray:
    rows, columns = _shape(shape)
    kind = _dtype(dtype)
    content = _bytes(raw)
    if len(content) != rows * columns * kind.itemsize:
        raise StateFileError(f"{len(content)} bytes for {rows} x {columns} numbers")
    return np.frombuffer(content, kind).reshape((rows, columns), order="F" if fortran else "C")


def _dtype(found: object) -> np.dtype:
    match found:
        case Call("numpy.dtype", (str(code), *_), (_, ("<" | ">") as order, None, None, None, *_)):
            if code in _CODES:
                return np.dtype(order + code)
            raise StateFileError(f"an array of {shown(code)}; expected numbers of 4 or 8 bytes")
    raise StateFileError("an array of other values than numbers")


def _bytes(found: object) -> bytes | bytearray:
    """Return bytes; pickles of the second protocol write them as text."""
    match found:
        case bytes() | bytearray():
            return found
        case Call("_codecs.encode", (str(text), "latin1"), None):
            try:
                return text.encode("latin1")
            except UnicodeEncodeError:
                raise StateFileError("numbers that are not bytes") from None
    raise StateFileError("an array of other values than numbers")
