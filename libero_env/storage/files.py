"""Files and folders that are replaced in one step."""

import errno
import fnmatch
import json
import os
import secrets
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from libero_env.errors import InvalidInputError, LiberoError
from libero_env.text import to_json

if TYPE_CHECKING:
    from filelock import FileLock

MAX_JSON_BYTES = 1 << 30
PART_SUFFIX = ".part"  # of files and folders that are not yet complete


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
    except OSError as error:
        if error.filename is None and error.errno is not None:
            error.filename = str(target)  # such as of a full disk
        raise
    else:
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
    with suppress(OSError):  # Windows opens no folders, and some network file systems sync none
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def atomic_write_text(target: Path, text: str, *, fsync: bool = False) -> None:
    """Write a UTF-8 text file in one step; see `atomic_path`."""
    with atomic_path(target, fsync=fsync) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")  # half a character of UTF-16


def write_json(target: Path, value: Any, *, fsync: bool = False) -> None:
    """Write data to a JSON file in one step; see `libero_env.text.to_json` and `atomic_path`."""
    atomic_write_text(target, to_json(value), fsync=fsync)


def read_json(path: Path, error: type[LiberoError] = InvalidInputError, *, most: int = MAX_JSON_BYTES) -> Any:
    """Return the content of a JSON file.

    Raises:
        LiberoError: The file cannot be read, or is not JSON, in one line; of the type `error`.
    """
    try:
        return json.loads(read_bounded(path, most))
    except OSError as failure:
        raise error(f"{path}: {failure.strerror or failure}") from failure
    except (ValueError, RecursionError) as failure:
        raise error(f"{path} is not JSON ({failure}): it is broken or incomplete") from None


def read_bounded(path: Path, most: int, *, within: Path | None = None) -> bytes:
    """Return the content of a file that may be somebody else's.

    Args:
        most: Largest size, [bytes].
        within: Folder that a link must not lead out of; None for any.

    Raises:
        OSError: It cannot be read, is a folder, a pipe or a device, is too large, or lies outside of the folder.
    """
    if within is not None and leads_out(path, within):
        raise OSError(f"it is a link that leads out of {within}")
    with open(path, "rb", opener=regular_file(most)) as file:
        return file.read(min(most, os.fstat(file.fileno()).st_size))  # a buffer of that size is made before


def own_folder(root: Path, *parts: str, error: type[LiberoError] = InvalidInputError) -> Path:
    """Return a folder in one that may be somebody else's, into which something is to be written.

    Nothing is written behind a link there: this is the one place that decides it.

    Args:
        root: Folder that the user has named; it may be a link itself.
        parts: Relative path of the folder in it, which need not exist.

    Raises:
        LiberoError: A part of the path is a link, or is not a folder; of the type `error`.
    """
    folder = root
    for name in Path(*parts).parts:
        folder /= name
        if name in ("..", folder.anchor) or folder.is_symlink() or (folder.exists() and not folder.is_dir()):
            raise error(f"{folder} is a link, or is not a folder, and nothing is written there; remove it")
    return folder


def files_below(folder: Path, pattern: str) -> Iterator[Path]:
    """Yield files whose names match, in a folder and all below, such as `*.hdf5`; what vanishes meanwhile is none."""
    for root, _, names in os.walk(folder):
        yield from (Path(root, name) for name in fnmatch.filter(names, pattern))


def leads_out(path: Path, folder: Path) -> bool:
    """Return whether a path ends outside of a folder, by links."""
    try:
        return not path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # links in a circle
        return True


def regular_file(most: int, *, links: bool = True) -> Callable[[str, int], int]:
    """Return an opener, as for `open`, of files that may be somebody else's: it never waits.

    It raises an OSError for a folder, a pipe or a device, and for what is too large.

    Args:
        most: Largest size, [bytes].
        links: Whether a link is followed; else it is an OSError, too.
    """

    def opener(path: str, flags: int) -> int:
        flags |= getattr(os, "O_NONBLOCK", 0) | (0 if links else getattr(os, "O_NOFOLLOW", 0))
        file = os.open(path, flags, 0o666)
        status = os.fstat(file)
        if stat.S_ISREG(status.st_mode) and status.st_size <= most:
            return file
        os.close(file)
        if stat.S_ISREG(status.st_mode):
            raise OSError(f"it is larger than {most >> 20} MiB")
        raise OSError("it is a folder, a pipe or a device; expected a file")

    return opener


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


def system_lock(path: Path) -> "FileLock":
    """Take the system's lock of a file, which ends with the process, however that ends.

    Raises:
        filelock.Timeout: Another process holds it.
        OSError: The file system cannot lock files.
    """
    from filelock import FileLock, SoftFileLock, Timeout  # which import asyncio

    lock = FileLock(path)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        if not isinstance(lock, SoftFileLock):
            raise
    if isinstance(lock, SoftFileLock):  # what it becomes: a marker, which stays where a machine is lost
        lock.release()
        raise OSError(errno.ENOLCK, "its file system cannot lock files", str(path))
    return lock


def open_for_owner(path: str, flags: int) -> int:
    """Open a new file that others may read at most, whatever the user's mask is."""
    return os.open(path, flags, 0o644)


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
