"""Common parts of downloads: the error, names and listings of files, the check of free space, verification."""

import hashlib
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

from pydantic import Field

from libero_env.errors import LiberoError
from libero_env.validation import validate

_MAX_FILES = 100_000  # of a listing or an archive
_MAX_NAME = 500  # characters
_MAX_SIZE = 1 << 42  # [bytes]
_BLOCK = 1 << 20  # [bytes] read at a time
_SPARE_BYTES = 64 << 20  # [bytes] to leave free on the disk


class DownloadError(LiberoError):
    """A download failed; what was downloaded is kept, and the message says how to resume."""


@dataclass(frozen=True)
class Remote:
    """A file as the Hub lists it.

    Attributes:
        size: Number of bytes.
        kind: Kind of digest: `sha256`, or `git` for the id of a git blob.
        digest: Digest, in hexadecimal digits.
    """

    size: int
    kind: str
    digest: str

    def matches(self, path: Path) -> bool:
        """Return whether a file exists and has this size and digest."""
        if not path.is_file() or path.stat().st_size != self.size:
            return False
        return (_sha256(path) if self.kind == "sha256" else git_digest(path)) == self.digest


@dataclass(frozen=True)
class _Large:
    oid: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    size: Annotated[int, Field(ge=0, le=_MAX_SIZE)]


@dataclass(frozen=True)
class _Listed:
    type: Literal["file", "directory"]
    path: str
    size: Annotated[int, Field(ge=0, le=_MAX_SIZE)] = 0
    oid: str = ""
    lfs: _Large | None = None


def listed_files(entries: Any, source: str) -> dict[str, Remote]:
    """Return the files of a listing with their sizes and digests.

    Args:
        entries: Entries as the Hub's interface has them: type, path, size, oid, and lfs for large files. Nothing about
            them is trusted.
        source: Where they come from, for messages.

    Raises:
        DownloadError: They are not as expected, or a name leads out of the folder or names two files.
    """
    if not isinstance(entries, list) or len(entries) > _MAX_FILES:
        raise DownloadError(
            f"{source}: no list of files, or more than {_MAX_FILES}: do not trust this server"
        )
    plain = [_known(entry, _Listed) for entry in entries]
    for entry in plain:
        if isinstance(entry, dict) and "lfs" in entry:
            entry["lfs"] = _known(entry["lfs"], _Large)
    found: list[_Listed] = validate(list[_Listed], plain, source=source, error=DownloadError)
    files = [entry for entry in found if entry.type == "file"]
    check_names([entry.path for entry in files], source)
    for entry in files:
        if entry.lfs is None and (len(entry.oid) != 40 or set(entry.oid) - set("0123456789abcdef")):
            raise DownloadError(
                f"{source}: {entry.path} has the digest {entry.oid[:80]!r}; expected 40 hex digits"
            )
    return {
        entry.path: Remote(entry.lfs.size, "sha256", entry.lfs.oid)
        if entry.lfs
        else Remote(entry.size, "git", entry.oid)
        for entry in files
    }


def _known(entry: Any, kind: type) -> Any:
    """Return the keys of an entry that are used; servers add others."""
    known = kind.__dataclass_fields__  # type: ignore[attr-defined]
    return {key: value for key, value in entry.items() if key in known} if isinstance(entry, dict) else entry


def check_names(names: Sequence[str], source: str) -> None:
    """Check that names from a server or an archive are those of different files in one folder or below.

    Args:
        names: Names with `/` between folders.
        source: Where they come from, for messages.

    Raises:
        DownloadError: A name is absolute, leads out of the folder, is not portable, or two are the same file.
    """
    seen: dict[str, str] = {}
    folders: set[str] = set()
    for name in names:
        parts = name.split("/")
        odd = len(name) > _MAX_NAME or not name.isprintable() or set(name) & set('\\:*?"<>|[]')
        if odd or any(part in ("", ".", "..") for part in parts):
            raise DownloadError(
                f"{source}: the name {name[:80]!r} leads outside the folder or is not portable: do not trust it"
            )
        if (key := name.casefold()) in seen:
            raise DownloadError(f"{source}: {name} and {seen[key]} are the same file: do not trust it")
        seen[key] = name
        folders |= {str(folder).casefold() for folder in PurePosixPath(name).parents}
    if both := sorted(folders & seen.keys()):
        raise DownloadError(f"{source}: {seen[both[0]]} is both a file and a folder: do not trust it")


def git_digest(path: Path) -> str:
    """Return the id that a file has as a git blob, 40 hexadecimal digits."""
    return _update(hashlib.sha1(f"blob {path.stat().st_size}\0".encode(), usedforsecurity=False), path)


def _sha256(path: Path) -> str:
    return _update(hashlib.sha256(), path)


def _update(digest: Any, path: Path) -> str:
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def broken_files(folder: Path, remote: Mapping[str, Remote]) -> list[str]:
    """Return the names of the files that are missing or different."""
    return [name for name, file in remote.items() if not file.matches(folder / name)]


def check_free_space(folder: Path, needed: int) -> None:
    """Check that a number of bytes fits on the disk.

    Args:
        folder: Folder to write to; it need not exist.
        needed: Number of bytes.

    Raises:
        DownloadError: The disk has too little free space.
    """
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    free = shutil.disk_usage(existing).free
    if free < needed + _SPARE_BYTES:
        raise DownloadError(
            f"{existing}: {free >> 20} MiB free, {(needed + _SPARE_BYTES) >> 20} MiB needed; free some space, or give "
            "another folder with --dest"
        )
