"""Arrays and records in files that carry a checksum, read without trust in what their headers say."""

import hashlib
import io
import json
import math
import stat
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from libero_env.errors import BrokenFileError
from libero_env.storage.files import atomic_path, open_for_owner
from libero_env.text import show_bytes

Arrays = dict[str, np.ndarray]

MAX_ARRAYS_BYTES = 1 << 30  # of a file of arrays, and of its arrays in memory
_MAX_RECORD_BYTES = 64 << 20
_SEAL = b"sha256:"  # 64 hexadecimal digits follow: the comment of the zip, which is the end of the file
_SEAL_BYTES = len(_SEAL) + 64
_ARRAY_ERRORS = (
    *(zipfile.BadZipFile, zlib.error, struct.error),
    *(EOFError, KeyError, NotImplementedError, OverflowError, RuntimeError, ValueError, UserWarning),
)


def atomic_write_npz(target: Path, arrays: Mapping[str, Any], *, fsync: bool = False) -> None:
    """Write arrays to a compressed npz file in one step; see `atomic_path`.

    The file ends with the SHA-256 of all before it, as the comment of the zip, which `np.load` ignores. It is never
    writable by others than its owner.
    """
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    content = bytearray(stream.getvalue())
    content[-2:] = _SEAL_BYTES.to_bytes(2, "little")  # length of the comment
    seal = _SEAL + hashlib.sha256(content).hexdigest().encode()
    with atomic_path(target, fsync=fsync) as temporary, open(temporary, "wb", opener=open_for_owner) as file:
        file.write(content)
        file.write(seal)


def read_npz(path: Path, *, needs_checksum: bool = False) -> Arrays:
    """Read the arrays of a file of `atomic_write_npz`, or of one without the checksum at its end.

    Args:
        needs_checksum: Whether a file without the checksum is broken.

    Raises:
        BrokenFileError: The checksums do not fit, or the file has something else than arrays of numbers and texts.
        OSError: The file cannot be read.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode) or status.st_size > MAX_ARRAYS_BYTES:
        raise BrokenFileError(f"{path} is not a file of at most {show_bytes(MAX_ARRAYS_BYTES)}")
    content = path.read_bytes()
    seal, digest = content[-_SEAL_BYTES:], hashlib.sha256(memoryview(content)[:-_SEAL_BYTES]).hexdigest()
    if (needs_checksum or seal.startswith(_SEAL)) and seal != _SEAL + digest.encode():
        raise BrokenFileError(f"{path} has another checksum than when it was written")
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = archive.infolist()
            if sum(entry.file_size for entry in entries) > MAX_ARRAYS_BYTES:
                raise ValueError(f"more than {show_bytes(MAX_ARRAYS_BYTES)} of arrays")
            if {entry.compress_type for entry in entries} - {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
                raise ValueError("an unusual compression")
            return {name.removesuffix(".npy"): _parse_npy(archive.read(name)) for name in archive.namelist()}
    except _ARRAY_ERRORS as error:
        raise BrokenFileError(f"{path} is not a file of arrays ({' '.join(str(error).split())})") from None


def read_packaged_npz(path: Path) -> Arrays:
    """Read the arrays of a file of this package.

    Raises:
        BrokenFileError: The file is damaged, missing, or has numbers that are not finite.
    """
    try:
        arrays = read_npz(path)
        if not are_finite(arrays):
            raise BrokenFileError(f"{path} has numbers that are not finite")
        return arrays
    except (BrokenFileError, OSError) as error:
        what = str(error) if isinstance(error, BrokenFileError) else f"{path}: {error.strerror or error}"
        raise BrokenFileError(f"{what}; it is a file of this package: install the package again") from None


def are_finite(arrays: Arrays) -> bool:
    """Return whether all numbers are finite."""
    return all(np.isfinite(array).all() for array in arrays.values() if array.dtype.kind == "f")


def _parse_npy(content: bytes) -> np.ndarray:
    """Return the array of an npy file, whose size must be that of its content."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    shape, fortran, dtype = read_header[version](stream)
    if dtype.kind not in "biufU" or math.prod(shape) * dtype.itemsize != len(content) - stream.tell():
        raise ValueError("an array of another size or kind")
    array = np.frombuffer(content, dtype, offset=stream.tell())
    return array.reshape(shape, order="F" if fortran else "C").copy(order="K")


def write_record(path: Path, record: Mapping[str, Any]) -> None:
    """Write plain data to a JSON file in one step, with a checksum; see `atomic_path`."""
    text = json.dumps({**record, "sha256": _record_digest(record)}, indent=1)
    with (
        atomic_path(path) as temporary,
        open(temporary, "w", encoding="utf-8", opener=open_for_owner) as file,
    ):
        file.write(text)


def read_record(path: Path) -> dict[str, Any] | None:
    """Return the data of a file of `write_record`; None where it does not exist, is broken, or has no checksum."""
    try:
        if path.stat().st_size > _MAX_RECORD_BYTES:
            return None
        record = json.loads(path.read_text(encoding="utf-8"))
        return record if record.pop("sha256") == _record_digest(record) else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None


def _record_digest(record: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
