"""Common parts of downloads: the error, the check of free space, the verification of files."""

import hashlib
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from libero_env.errors import LiberoError

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
