"""The published files of the original's models, and whether a folder holds them, unchanged.

`original_files.txt` lists the files below `libero/libero/assets` of commit 8f1084e of the original's repository
(github.com/Lifelong-Robot-Learning/LIBERO): the id of the git blob, the size in bytes, the name. All files of a folder
are read once; the result is kept in the cache for as long as no size and no time of modification changes.
"""

import hashlib
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache, lru_cache
from pathlib import Path
from types import MappingProxyType

from libero_env.assets.hub import Remote, git_digest
from libero_env.errors import LiberoError
from libero_env.paths import cache_dir
from libero_env.storage import read_cached_record, write_cached_record

COMMIT = "8f1084e3132a39270c3a13ebe37270a43ece2a01"
ALLOW = "LIBERO_ASSETS_MODIFIED"
_LIST = Path(__file__).with_name("original_files.txt")
_READERS = 8  # threads that read files
_SHOWN = 3  # files that a message names


class ChangedAssetsError(LiberoError):
    """Files of the original's models are missing or are not the published ones."""


@dataclass(frozen=True)
class FolderCheck:
    """A folder compared with the published files.

    Attributes:
        digest: 16 hexadecimal digits for the published files; otherwise `modified-` and 16 digits that change with
            any file of the folder.
        missing: Published files that the folder does not have.
        replaced: Files of another size than the published ones: somebody's own.
        damaged: Files of the published size with other bytes.
    """

    digest: str
    missing: tuple[str, ...] = ()
    replaced: tuple[str, ...] = ()
    damaged: tuple[str, ...] = ()

    @property
    def differences(self) -> tuple[str, ...]:
        """A line for each file that is not the published one."""
        kinds = {
            "missing": self.missing,
            "of another size than the published file": self.replaced,
            "of the published size, but with other bytes": self.damaged,
        }
        return tuple(f"{name}: {kind}" for kind, names in kinds.items() for name in names)

    @property
    def summary(self) -> str:
        """The result in a few words."""
        if not self.differences:
            return f"the {len(published_files())} published files (commit {COMMIT[:7]}), unchanged"
        counts = {"missing": self.missing, "replaced": self.replaced, "damaged": self.damaged}
        found = ", ".join(f"{len(names)} {kind}" for kind, names in counts.items() if names)
        return f"modified: of {len(published_files())} published files {found}"


@cache
def published_files() -> Mapping[str, Remote]:
    """Return name -> size and digest of the published files."""
    lines = (line.split(" ", 2) for line in _LIST.read_text(encoding="utf-8").splitlines())
    return MappingProxyType({name: Remote(int(size), "git", blob) for blob, size, name in lines})


@cache
def published_digest() -> str:
    """Return the digest of the published files."""
    return _digest({name: file.digest for name, file in published_files().items()})


def require_published(root: Path, remedy: str) -> None:
    """Check that a folder holds all published files, unchanged.

    Args:
        root: Folder that contains `articulated_objects`, `scenes`, ...
        remedy: What to do if it does not.

    Raises:
        ChangedAssetsError: It does not; the message names the files.
    """
    if differences := check_folder(root).differences:
        raise ChangedAssetsError(f"{root}: {_some(differences)}. {remedy}")


def require_undamaged(root: Path) -> None:
    """Check that no file of a folder has the published size but other bytes; `LIBERO_ASSETS_MODIFIED=1` allows it.

    A folder with models of one's own is valid, and results state that it is modified; a changed byte is damage.

    Raises:
        ChangedAssetsError: There are such files; the message names them.
    """
    damaged = check_folder(root).damaged
    if damaged and os.environ.get(ALLOW, "0") in ("", "0"):
        raise ChangedAssetsError(
            f"{root}: {_some(damaged)}: of the published size, but with other bytes: the disk or the copy is broken. "
            f"Copy the files again (`libero assets install` brings them); if the change is yours, set {ALLOW}=1, and "
            "results will state that the models are modified"
        )


@lru_cache(maxsize=16)
def check_folder(root: Path) -> FolderCheck:
    """Compare a folder with the published files, once in a process, and with the result in the cache if it is there."""
    stamps = {name: (stat.st_size, stat.st_mtime_ns) for name, stat in _walk(root)}
    stamp = hashlib.sha256(repr(([(n, *stamps[n]) for n in sorted(stamps)], published_digest())).encode())
    stored = cache_dir() / "assets_checked" / f"{hashlib.sha256(str(root).encode()).hexdigest()[:16]}.json"
    if (record := read_cached_record(stored)) is not None and record.get("stamp") == stamp.hexdigest():
        fields = ("missing", "replaced", "damaged")
        return FolderCheck(record["digest"], *(tuple(record[field]) for field in fields))
    found = _compare(root, {name: size for name, (size, _) in stamps.items()})
    write_cached_record(stored, {"folder": str(root), "stamp": stamp.hexdigest(), **asdict(found)})
    return found


def _compare(root: Path, sizes: Mapping[str, int]) -> FolderCheck:
    published = published_files()
    missing = tuple(name for name in published if name not in sizes)
    replaced = tuple(
        name for name in published if sizes.get(name, published[name].size) != published[name].size
    )
    same_size = [name for name in published if sizes.get(name) == published[name].size]
    digests = _digests(root, same_size)
    damaged = tuple(name for name in same_size if digests[name] != published[name].digest)
    if not (missing or replaced or damaged):
        return FolderCheck(published_digest())  # files beside the published ones are used by none of them
    digests |= _digests(root, [name for name in sizes if name not in digests])
    return FolderCheck(f"modified-{_digest(digests)}", missing, replaced, damaged)


def _digests(root: Path, names: list[str]) -> dict[str, str]:
    with ThreadPoolExecutor(_READERS) as pool:
        return dict(zip(names, pool.map(lambda name: git_digest(root / name), names), strict=True))


def _digest(digests: Mapping[str, str]) -> str:
    text = "".join(f"{digests[name]} {name}\n" for name in sorted(digests))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _walk(root: Path) -> list[tuple[str, os.stat_result]]:
    found = []
    for folder, _, names in os.walk(root, followlinks=True):
        for name in names:
            path = Path(folder, name)
            with suppress(OSError):  # a link that leads nowhere
                found.append((path.relative_to(root).as_posix(), path.stat()))
    return found


def _some(names: tuple[str, ...]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return "; ".join(names[:_SHOWN]) + more
