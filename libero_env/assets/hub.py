"""Downloads from the Hugging Face Hub: retries, free space, verification of files."""

import hashlib
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from libero_env.errors import LiberoError

_PAUSE_BYTES = 1 << 20


_SPARE_BYTES = 64 << 20  # left free on the disk


class DownloadError(LiberoError):
    """Files did not arrive; what did is kept, and the message says how to go on."""


@dataclass(frozen=True)
class Remote:
    """What the Hub says of a file: bytes, and a digest: `sha256`, or `git` for what git calls a blob."""

    size: int
    kind: str
    digest: str

    def matches(self, path: Path) -> bool:
        """Whether a file is this one."""
        if not path.is_file() or path.stat().st_size != self.size:
            return False
        digest = hashlib.sha256() if self.kind == "sha256" else hashlib.sha1(f"blob {self.size}\0".encode())
        with path.open("rb") as file:
            while block := file.read(_PAUSE_BYTES):
                digest.update(block)
        return digest.hexdigest() == self.digest


def broken_files(folder: Path, remote: Mapping[str, Remote]) -> list[str]:
    """Names of the files that are missing or different."""
    return [name for name, file in remote.items() if not file.matches(folder / name)]


def check_room(folder: Path, needed: int) -> None:
    """Look whether so many bytes fit on the disk.

    Raises:
        DownloadError: they do not.
    """
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    free = shutil.disk_usage(existing).free
    if free < needed + _SPARE_BYTES:
        raise DownloadError(
            f"{existing}: {free >> 20} MiB free, {(needed + _SPARE_BYTES) >> 20} MiB needed; make room, or name "
            "another folder with --dest"
        )
