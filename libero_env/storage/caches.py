"""Files and folders of the cache, which decide how soon something is there, and never what."""

import glob
import hashlib
import logging
import os
import shutil
import stat
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from libero_env.errors import BrokenFileError, LiberoError
from libero_env.storage.arrays import (
    Arrays,
    are_finite,
    atomic_write_npz,
    read_npz,
    read_record,
    write_record,
)
from libero_env.storage.files import PART_SUFFIX

_MAKING_SECONDS = 900.0  # that a process waits for another one, and after which a part of a file is left over
_log = logging.getLogger(__name__)


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
    if (arrays := read_cache(path, fits)) is None:
        arrays = make()
        write_cache(path, arrays)
    return arrays


def read_cache(path: Path, fits: Callable[[Arrays], bool]) -> Arrays | None:
    """Return the arrays of a cache file; None where it does not exist, is broken, or is not to be trusted.

    Args:
        path: File, in a folder of the cache folder.
        fits: As for `cached_arrays`.
    """
    if not _is_trusted(path.parent):
        return None
    try:
        arrays = read_npz(path, needs_checksum=True)
    except BrokenFileError as error:
        _log.warning("%s; it is made again", error)
        return None
    except OSError:
        return None
    if not fits(arrays) or not are_finite(arrays):
        _log.warning("%s has other arrays than expected; it is made again", path)
        return None
    return arrays


def write_cache(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays to a cache file; where that is not possible, one line of the log says so."""
    _write_cached(path, lambda: atomic_write_npz(path, arrays, fsync=True))


def cached_record(
    path: Path, make: Callable[[], Mapping[str, Any]], fits: Callable[[Mapping[str, Any]], bool]
) -> Mapping[str, Any]:
    """Return the plain data of a cache file; where there is none that is intact and fits, make it and write it."""
    record = read_record(path) if _is_trusted(path.parent) else None
    if record is not None and fits(record):
        return record
    made = make()
    _write_cached(path, lambda: write_record(path, made))
    return made


def _write_cached(path: Path, write: Callable[[], None]) -> None:
    try:
        make_cache_folder(path.parent)
        if _is_trusted(path.parent):
            _remove_parts(path)
            write()
    except OSError as error:
        _warn_once(path.parent, error.strerror or str(error))


def _remove_parts(path: Path) -> None:
    """Remove what processes that were killed have left of a file; those that write it now are younger."""
    for part in path.parent.glob(f".{glob.escape(path.name)}.*{PART_SUFFIX}"):
        with suppress(OSError):
            if time.time() - part.stat().st_mtime > _MAKING_SECONDS:
                part.unlink()


def cached_folder(directory: Path, make: Callable[[], object], made_from: str = "") -> None:
    """Make a folder of the cache, unless it is there with all files as they were when it was made.

    Of several processes one makes it and the others wait; the lock of a process that is killed is free.

    Args:
        directory: Folder, two levels below the cache folder.
        make: Function that makes it, in one step; a folder that is there has been removed.
        made_from: What it is made from; where that is another, it is made again.

    Raises:
        LiberoError: Other users can write there, it cannot be written, or another process takes longer than 15 minutes.
    """
    from filelock import FileLock, Timeout

    for folder in (directory.parent.parent, directory.parent):
        check_trusted(folder)
    record = directory.with_name(f"{directory.name}.json")
    if _is_intact(directory, record, made_from):
        return
    try:
        make_cache_folder(directory.parent)
        with FileLock(directory.with_name(f".{directory.name}.lock"), timeout=_MAKING_SECONDS):
            if _is_intact(directory, record, made_from):
                return
            if directory.exists():
                _log.warning("%s is not as it was made, or of something else; it is made again", directory)
                shutil.rmtree(directory)
            make()
            files = sorted(file for file in directory.rglob("*") if file.is_file())
            digests = {file.relative_to(directory).as_posix(): _file_digest(file) for file in files}
            write_record(record, digests | ({"": made_from} if made_from else {}))
    except Timeout:
        raise LiberoError(
            f"{directory}: another process makes it and does not end; end that process"
        ) from None
    except OSError as error:
        raise LiberoError(
            f"{directory} cannot be made ({error.strerror or error}); set LIBERO_CACHE to another folder"
        ) from error


def _is_intact(directory: Path, record: Path, made_from: str) -> bool:
    digests = read_record(record) or {}
    if digests.pop("", "") != made_from:
        return False
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

    A folder that does not exist is fine, and so is any on Windows, where profiles are private. In a cache folder where
    everybody may write, as `/tmp`, it must belong to this user; elsewhere also to the owner of the cache folder.

    Raises:
        LiberoError: Another user can.
    """
    try:
        status, root = folder.stat(), folder.parent.stat()
    except OSError:
        return
    if not hasattr(os, "geteuid"):
        return
    remedy = "set LIBERO_CACHE to a folder of your own"
    if status.st_mode & stat.S_IWOTH:
        raise LiberoError(f"{folder} is writable by every user: chmod -R o-w {folder.parent}, or {remedy}")
    owners = {0, os.geteuid(), *(() if root.st_mode & stat.S_IWOTH else (root.st_uid,))}
    if status.st_uid not in owners:
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
