"""Reading and writing of files: YAML, files that are replaced in one step, arrays and caches of them with checksums."""

import glob
import hashlib
import io
import json
import logging
import math
import os
import secrets
import shutil
import stat
import struct
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from libero_env.errors import BrokenFileError, LiberoError

Arrays = dict[str, np.ndarray]

MAX_ARRAYS_BYTES = 1 << 30  # of a file of arrays, and of its arrays in memory
_MAX_RECORD_BYTES = 64 << 20
_SEAL = b"sha256:"  # 64 hexadecimal digits follow: the comment of the zip, which is the end of the file
_SEAL_BYTES = len(_SEAL) + 64
_MAKING_SECONDS = 900.0  # that a process waits for another one, and after which a part of a file is left over
_ARRAY_ERRORS = (
    *(zipfile.BadZipFile, zlib.error, struct.error),
    *(EOFError, KeyError, NotImplementedError, OverflowError, RuntimeError, ValueError, UserWarning),
)
_log = logging.getLogger(__name__)
PART_SUFFIX = ".part"  # of files and folders that are not yet complete
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # eight times as fast, where PyYAML has it


def parse_yaml(text: str) -> Any:
    """Return the content of a YAML text; nothing in it is executed."""
    return yaml.load(text, Loader=_LOADER)


def read_yaml(path: str) -> Any:
    """Return the content of one of the package's YAML files; the path is relative to `libero_env`."""
    return parse_yaml(resources.files("libero_env").joinpath(*path.split("/")).read_text(encoding="utf-8"))


@contextmanager
def atomic_path(target: Path, *, fsync: bool = False) -> Iterator[Path]:
    """Yield a temporary path beside `target`, which replaces `target` when the block ends without an error.

    Readers see the old file or the new one, never a part of it. After an error the temporary file is removed
    and `target` is as it was. Only a process that is killed leaves one behind: `.<name>.<random>.part`.

    Args:
        target: File to write; its folder is created.
        fsync: Whether the content must have reached the disk before the file gets its name, and the name before
            the block ends, so that it survives a power failure.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}{PART_SUFFIX}")
    try:
        yield temporary
        if fsync:
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
        os.replace(temporary, target)
        if fsync:
            sync_folder(target.parent)
    finally:
        temporary.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Wait until the names of a folder's files have reached the disk, where the file system can."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # some network file systems sync no folders
            os.fsync(handle)
    finally:
        os.close(handle)


def atomic_write_text(target: Path, text: str, *, fsync: bool = False) -> None:
    """Write a UTF-8 text file in one step; see `atomic_path`."""
    with atomic_path(target, fsync=fsync) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")  # half a character of UTF-16


def create_text(target: Path, text: str) -> bool:
    """Write a UTF-8 text file in one step unless it exists; of several processes that try, the first one wins.

    The content has reached the disk before the file gets its name.

    Args:
        target: File to write; its folder is created.
        text: Content of the file.

    Returns:
        Whether this call wrote the file. On file systems without hard links two calls at the same moment may both
        write it; then the last one wins.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    if target.exists():
        return False
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}{PART_SUFFIX}")
    try:
        with open(temporary, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        try:
            os.link(temporary, target)
        except FileExistsError:
            return False
        except OSError:
            os.replace(temporary, target)
        return True
    finally:
        temporary.unlink(missing_ok=True)


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
    with (
        atomic_path(target, fsync=fsync) as temporary,
        open(temporary, "wb", opener=open_for_owner) as file,
    ):
        file.write(content)
        file.write(seal)


def open_for_owner(path: str, flags: int) -> int:
    """Open a new file that others may read at most, whatever the user's mask is."""
    return os.open(path, flags, 0o644)


def read_npz(path: Path) -> Arrays:
    """Read the arrays of a file of `atomic_write_npz`, or of one without the checksum at its end.

    Raises:
        BrokenFileError: The checksums do not fit, or the file has something else than arrays of numbers and texts.
        OSError: The file cannot be read.
    """
    return _read_npz(path)[0]


def read_packaged_npz(path: Path) -> Arrays:
    """Read the arrays of a file of this package.

    Raises:
        BrokenFileError: The file is damaged, missing, or has numbers that are not finite.
    """
    try:
        arrays = read_npz(path)
        if not _are_finite(arrays):
            raise BrokenFileError(f"{path} has numbers that are not finite")
        return arrays
    except (BrokenFileError, OSError) as error:
        what = str(error) if isinstance(error, BrokenFileError) else f"{path}: {error.strerror or error}"
        raise BrokenFileError(f"{what}; it is a file of this package: install the package again") from None


def _are_finite(arrays: Arrays) -> bool:
    return all(np.isfinite(array).all() for array in arrays.values() if array.dtype.kind == "f")


def _read_npz(path: Path) -> tuple[Arrays, bool]:
    """Return the arrays of a file and whether it has the checksum at its end."""
    found = path.stat()
    if not stat.S_ISREG(found.st_mode) or found.st_size > MAX_ARRAYS_BYTES:
        raise BrokenFileError(f"{path} is no file of at most {show_bytes(MAX_ARRAYS_BYTES)}")
    content = path.read_bytes()
    seal = content[-_SEAL_BYTES:]
    sealed = seal.startswith(_SEAL)
    if (
        sealed
        and hashlib.sha256(memoryview(content)[:-_SEAL_BYTES]).hexdigest().encode() != seal[len(_SEAL) :]
    ):
        raise BrokenFileError(f"{path} has another checksum than when it was written")
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if sum(info.file_size for info in archive.infolist()) > MAX_ARRAYS_BYTES:
                raise ValueError(f"more than {show_bytes(MAX_ARRAYS_BYTES)} of arrays")
            if {info.compress_type for info in archive.infolist()} - {
                zipfile.ZIP_STORED,
                zipfile.ZIP_DEFLATED,
            }:
                raise ValueError("an unusual compression")
            names = archive.namelist()
            return {name.removesuffix(".npy"): _parse_npy(archive.read(name)) for name in names}, sealed
    except _ARRAY_ERRORS as error:
        raise BrokenFileError(f"{path} is no file of arrays ({' '.join(str(error).split())})") from None


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


def cached_arrays(path: Path, make: Callable[[], Arrays], fits: Callable[[Arrays], bool]) -> Arrays:
    """Return the arrays of a cache file; where there is none that is intact, make them and write it.

    Args:
        path: File, in a folder of the cache folder.
        make: Function that makes the arrays.
        fits: Function that returns whether arrays are of the names, shapes and types that are expected. That they are
            finite is checked besides.

    Returns:
        The same arrays with a cache or without: what is wrong with it is one line of the log, never an error.
    """
    if (found := read_cache(path, fits)) is None:
        found = make()
        write_cache(path, found)
    return found


def read_cache(path: Path, fits: Callable[[Arrays], bool]) -> Arrays | None:
    """Return the arrays of a cache file; None where it does not exist, is broken, or is not to be trusted.

    Files of earlier versions, without the checksum at their end, are checked by those of their parts, and get one.

    Args:
        path: File, in a folder of the cache folder.
        fits: As for `cached_arrays`.
    """
    if not _is_trusted(path.parent):
        return None
    try:
        arrays, sealed = _read_npz(path)
    except BrokenFileError as error:
        _log.warning("%s; it is made again", error)
        return None
    except OSError:
        return None
    if not fits(arrays) or not _are_finite(arrays):
        _log.warning("%s has other arrays than expected; it is made again", path)
        return None
    if not sealed:
        write_cache(path, arrays)
    return arrays


def write_cache(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays to a cache file; where that is not possible, one line of the log says so."""
    _write_cached(path, lambda: atomic_write_npz(path, arrays, fsync=True))


def _remove_parts(path: Path) -> None:
    """Remove what processes that were killed have left of a file; those that write it now are younger."""
    for part in path.parent.glob(f".{glob.escape(path.name)}.*{PART_SUFFIX}"):
        with suppress(OSError):
            if time.time() - part.stat().st_mtime > _MAKING_SECONDS:
                part.unlink()


def read_cached_record(path: Path) -> dict[str, Any] | None:
    """Return the data of a cache file of `write_cached_record`; None where there is none that is intact and trusted."""
    return read_record(path) if _is_trusted(path.parent) else None


def write_cached_record(path: Path, record: Mapping[str, Any]) -> None:
    """Write plain data to a cache file; where that is not possible, one line of the log says so."""
    _write_cached(path, lambda: write_record(path, record))


def _write_cached(path: Path, write: Callable[[], None]) -> None:
    try:
        make_cache_folder(path.parent)
        if _is_trusted(path.parent):
            _remove_parts(path)
            write()
    except OSError as error:
        _warn_once(path.parent, error.strerror or str(error))


def cached_folder(directory: Path, make: Callable[[], object]) -> None:
    """Make a folder of the cache, unless it is there with all files as they were when it was made.

    Of several processes one makes it and the others wait; the lock of a process that is killed is free.

    Args:
        directory: Folder, two levels below the cache folder.
        make: Function that makes it, in one step; a folder that is there has been removed.

    Raises:
        LiberoError: Other users can write there, it cannot be written, or another process takes longer than 15 minutes.
    """
    from filelock import FileLock, Timeout

    check_trusted(directory.parent.parent)
    record = directory.with_name(f"{directory.name}.json")
    if _is_intact(directory, record):
        return
    try:
        make_cache_folder(directory.parent)
        with FileLock(directory.with_name(f".{directory.name}.lock"), timeout=_MAKING_SECONDS):
            if _is_intact(directory, record):
                return
            if directory.exists():
                _log.warning("%s has other files than when it was made; it is made again", directory)
                shutil.rmtree(directory)
            make()
            write_record(record, {file.name: _file_digest(file) for file in directory.iterdir()})
    except Timeout:
        raise LiberoError(
            f"{directory}: another process makes it and does not end; end that process"
        ) from None
    except OSError as error:
        raise LiberoError(
            f"{directory} cannot be made ({error.strerror or error}); set LIBERO_CACHE to another folder"
        ) from error


def _is_intact(directory: Path, record: Path) -> bool:
    digests = read_record(record) or {}
    try:
        return bool(digests) and all(_file_digest(directory / name) == sha for name, sha in digests.items())
    except OSError:
        return False


def _file_digest(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def make_cache_folder(folder: Path) -> None:
    """Make a folder and those above it, as the user's mask says, but never such that others may write there."""
    missing = [one for one in (folder, *folder.parents) if not one.exists()]
    for one in reversed(missing):
        one.mkdir(mode=0o755, exist_ok=True)


def check_trusted(folder: Path) -> None:
    """Check that no other user can have written the files of a folder of the cache.

    A folder that does not exist is fine. In a cache folder where everybody may write, as `/tmp`, it must belong to this
    user; elsewhere also to the owner of the cache folder.

    Raises:
        LiberoError: Another user can.
    """
    try:
        found, root = folder.stat(), folder.parent.stat()
    except OSError:
        return
    remedy = "set LIBERO_CACHE to a folder of your own"
    if found.st_mode & stat.S_IWOTH:
        raise LiberoError(f"{folder} is writable by every user: chmod -R o-w {folder.parent}, or {remedy}")
    owners = {0, os.geteuid(), *(() if root.st_mode & stat.S_IWOTH else (root.st_uid,))}
    if found.st_uid not in owners:
        raise LiberoError(f"{folder} belongs to another user, who may have put anything there: {remedy}")


def _is_trusted(folder: Path) -> bool:
    try:
        check_trusted(folder)
    except LiberoError as error:
        _warn_once(folder, str(error))
        return False
    return True


@lru_cache(maxsize=64)
def _warn_once(folder: Path, reason: str) -> None:
    remedy = "" if "LIBERO_CACHE" in reason else ". Set LIBERO_CACHE to a folder that you can write to"
    _log.warning("nothing is cached in %s: %s%s", folder, reason, remedy)


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


@contextmanager
def atomic_folder(target: Path) -> Iterator[Path]:
    """Yield an empty temporary folder `.<name>.part` beside `target`, which is renamed to `target` at the end.

    After an error it is removed, and so is one that a killed process left behind. Two processes must not write
    the same folder at the same time.

    Args:
        target: Folder to make. It must not exist when the block ends.
    """
    temporary = target.with_name(f".{target.name}{PART_SUFFIX}")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    try:
        yield temporary
        os.rename(temporary, target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def show_bytes(count: float) -> str:
    """Return a number of bytes as text, such as `1.5 GB`."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"
