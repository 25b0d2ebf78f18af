"""Initial states in the original's files: pickled arrays in a zip, read without executing anything.

`torch.load` would call every function that a pickle names. Here each name that is allowed in a pickle is replaced by a
small class of this module that only stores its arguments, and any other name is an error.
"""

import io
import pickle
import zipfile
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from libero_env.errors import LiberoError
from libero_env.storage import atomic_path

_MAX_BYTES = 1 << 28  # largest part of a file
_EPOCH = (1980, 1, 1, 0, 0, 0)  # date of all parts, so that equal states give equal files


class StateFileError(LiberoError, ValueError):
    """A file of initial states that is broken or has other content than arrays; the message names the file."""


def read_states(path: str | Path) -> np.ndarray:
    """Read a `.pruned_init` or `.init` file.

    Args:
        path: File to read.

    Returns:
        Rows [time, qpos, qvel], (n, size) float64.

    Raises:
        StateFileError: The file does not exist, has no array of two dimensions, or its pickle calls other functions.
    """
    try:
        with open(path, "rb") as file:
            zipped = zipfile.is_zipfile(file)
            file.seek(0)
            found = _read_zip(file) if zipped else _Reader(file).load()
    except StateFileError as error:
        raise StateFileError(f"{path}: {error}") from None
    except OSError as error:
        raise StateFileError(
            f"{path}: {error.strerror or error}; see `init_states` in the config file"
        ) from error
    except Exception as error:  # noqa: BLE001 - a broken pickle may raise any error
        raise StateFileError(
            f"{path} is not a file of initial states ({type(error).__name__}: {error})"
        ) from error
    array = found.array() if isinstance(found, _Array) else found
    if not isinstance(array, np.ndarray) or array.ndim != 2 or not np.isfinite(array).all():
        raise StateFileError(f"{path}: expected an array (states, size) of finite numbers")
    return np.ascontiguousarray(array, np.float64)


def write_states(path: str | Path, rows: np.ndarray) -> None:
    """Write rows (n, size) in the original's format, which `torch.load` and `read_states` read."""
    path = Path(path)
    # Names of the older NumPy, which all versions read.
    content = pickle.dumps(np.ascontiguousarray(rows, np.float64), protocol=2)
    content = content.replace(b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n")
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, data in (("data.pkl", content), ("version", b"3\n")):
            archive.writestr(zipfile.ZipInfo(f"{path.stem}/{name}", _EPOCH), data)


def _read_zip(file: Any) -> object:
    with zipfile.ZipFile(file) as archive:
        root = next((n.removesuffix("data.pkl") for n in archive.namelist() if n.endswith("data.pkl")), None)
        if root is None:
            raise StateFileError("a zip without data.pkl; expected what torch.save writes")
        return _Reader(io.BytesIO(_part(archive, f"{root}data.pkl")), archive, root).load()


def _part(archive: zipfile.ZipFile, name: str) -> bytes:
    if archive.getinfo(name).file_size > _MAX_BYTES:
        raise StateFileError(f"{name} is larger than {_MAX_BYTES >> 20} MiB")
    return archive.read(name)


class _Dtype:
    """Replacement of `numpy.dtype`."""

    def __init__(self, code: str, *_: object):
        if code not in ("f8", "f4", "i8", "i4"):
            raise StateFileError(f"an array of {code!r}; expected numbers of 4 or 8 bytes")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: tuple) -> None:
        if state[1] == ">":
            self.dtype = self.dtype.newbyteorder(">")


class _Array:
    """Replacement of `numpy.ndarray`."""

    def __init__(self, *_: object):
        self._state: tuple[object, ...] = ()

    def __setstate__(self, state: tuple) -> None:
        self._state = state

    def array(self) -> np.ndarray:
        """Return the described array."""
        _, shape, dtype, fortran, raw = self._state
        if not (isinstance(dtype, _Dtype) and isinstance(raw, bytes) and isinstance(shape, tuple)):
            raise StateFileError("an array of other values than numbers")
        return np.frombuffer(raw, dtype.dtype).reshape(shape, order="F" if fortran else "C")


class _Storage:
    """Replacement of a storage class of torch: the type of the numbers."""

    def __init__(self, code: str):
        self.dtype = np.dtype(code)


def _bytes(text: str, encoding: str) -> bytes:
    """Return the bytes that pickles of the second protocol write as text."""
    if encoding != "latin1":
        raise StateFileError(f"bytes in the encoding {encoding!r}; expected latin1")
    return text.encode("latin1")


def _tensor(storage: np.ndarray, offset: int, shape: tuple, stride: tuple, *_: object) -> np.ndarray:
    """Return a tensor of a storage as an array, after a check of its bounds."""
    last = offset + sum((n - 1) * s for n, s in zip(shape, stride, strict=True))
    if offset < 0 or min(stride, default=0) < 0 or min(shape, default=1) < 1 or last >= storage.size:
        raise StateFileError("a tensor that is larger than its storage")
    steps = [s * storage.itemsize for s in stride]
    return np.lib.stride_tricks.as_strided(storage[offset:], shape, steps, writeable=False).copy()


_KNOWN: dict[tuple[str, str], object] = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
    ("numpy.core.multiarray", "_reconstruct"): _Array,
    ("numpy._core.multiarray", "_reconstruct"): _Array,
    ("_codecs", "encode"): _bytes,
    ("collections", "OrderedDict"): dict,
    ("torch._utils", "_rebuild_tensor_v2"): _tensor,
    ("torch", "DoubleStorage"): _Storage("f8"),
    ("torch", "FloatStorage"): _Storage("f4"),
}


class _Reader(pickle.Unpickler):
    """An unpickler that accepts the names above and no others."""

    def __init__(self, file: Any, archive: zipfile.ZipFile | None = None, root: str = ""):
        super().__init__(file)
        self._archive, self._root = archive, root

    def find_class(self, module: str, name: str) -> Any:
        """Return the replacement of a name in the pickle."""
        if (module, name) not in _KNOWN:
            self._refuse(f"{module}.{name}")
        return _KNOWN[module, name]

    def persistent_load(self, pid: Any) -> np.ndarray:
        """Return the numbers of a tensor, from another part of the zip."""
        kind, storage, key, *_ = pid
        if kind != "storage" or not isinstance(storage, _Storage) or self._archive is None:
            self._refuse(f"a {kind!r} outside the pickle")
        return np.frombuffer(_part(self._archive, f"{self._root}data/{key}"), storage.dtype)

    def _refuse(self, what: str) -> NoReturn:
        raise StateFileError(f"the pickle names {what}; only arrays of numbers are read, nothing is executed")
