"""Verified downloads of data sets from the Hugging Face Hub, and the download of the original's models.

huggingface_hub (the extra `assets`) transfers; here names, sizes and digests that the Hub lists for a revision are
checked. Those of the models are stored beside the files: a later check needs no network.
"""

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

from pydantic import Field

from libero_env.errors import LiberoError, need
from libero_env.paths import cache_dir
from libero_env.storage import write_json
from libero_env.validation import validate

REPO = "lerobot/libero-assets"  # a data set; CC BY 4.0
REVISION = "0b3ea86be5fe169d0fd036ae63d1070ec09e90f6"
MANIFEST = "libero-assets.json"  # written when all files are complete and verified
_MAX_FILES = 100_000  # of a listing
_MAX_NAME = 500  # characters
_MAX_SIZE = 1 << 42  # [bytes]
_SPARE_BYTES = 64 << 20  # [bytes] to leave free on the disk


class DownloadError(LiberoError):
    """A download failed; what was downloaded is kept, and the message says how to resume."""


@dataclass(frozen=True)
class Remote:
    """A file as the Hub lists it.

    Attributes:
        size: Number of bytes.
        digest: Its SHA-256, 64 hexadecimal digits, or its id as a git blob, 40 digits.
    """

    size: Annotated[int, Field(ge=0, le=_MAX_SIZE)]
    digest: Annotated[str, Field(pattern="^([0-9a-f]{40}|[0-9a-f]{64})$")]

    def matches(self, path: Path) -> bool:
        """Return whether a file exists and has this size and digest."""
        if not path.is_file() or path.stat().st_size != self.size:
            return False
        if len(self.digest) == 40:
            return git_digest(path) == self.digest
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest() == self.digest


def git_digest(path: Path) -> str:
    """Return the id that a file has as a git blob, 40 hexadecimal digits."""
    digest = hashlib.sha1(f"blob {path.stat().st_size}\0".encode(), usedforsecurity=False)
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: digest).hexdigest()


def broken_files(folder: Path, remote: Mapping[str, Remote]) -> list[str]:
    """Return the names of the files that are missing or different."""
    return [name for name, file in remote.items() if not file.matches(folder / name)]


def check_names(names: Sequence[str], source: str) -> None:
    """Check that names from a server are those of different files in one folder or below.

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


def checked_listing(files: Sequence[tuple[Any, Any, Any]], source: str) -> dict[str, Remote]:
    """Return the files of a listing with their sizes and digests.

    Args:
        files: Name, size and digest of each, of which nothing is trusted.
        source: Where they come from, for messages.

    Raises:
        DownloadError: They are not as expected, or a name leads out of the folder or names two files.
    """
    if len(files) > _MAX_FILES:
        raise DownloadError(f"{source}: more than {_MAX_FILES} files: do not trust this server")
    names = validate(list[str], [name for name, _, _ in files], source=f"{source}: name", error=DownloadError)
    check_names(names, source)
    plain = {name: {"size": size, "digest": digest} for name, size, digest in files}
    remote: dict[str, Remote] = validate(dict[str, Remote], plain, source=source, error=DownloadError)
    return remote


def download_files(
    repo: str,
    revision: str,
    folder: Path,
    names: Sequence[str] | None = None,
    *,
    replace: bool = False,
    remedy: str,
) -> dict[str, Remote]:
    """Download files of a data set, or what is missing of them; `HF_ENDPOINT` selects another server than the Hub.

    Args:
        repo: Data set on the Hub.
        revision: Commit, tag or branch of the data set.
        names: Files to download; None for all.
        replace: Whether to replace existing files of other contents.
        remedy: What to do where such a file exists and is not replaced.

    Returns:
        The files, complete and verified.

    Raises:
        DownloadError: There is no network, too little disk space, a file of other contents exists, or files differ
            from what the Hub lists. The next call resumes where this one stopped.
        MissingPackageError: huggingface_hub is not installed.
    """
    with _hub(repo, folder) as hub:
        endpoint = os.environ.get("HF_ENDPOINT")
        remote = _list_files(hub.HfApi(endpoint=endpoint), repo, revision)
        if absent := [name for name in names or () if name not in remote]:
            raise DownloadError(f"{repo} at revision {revision} has no {absent[0]}")
        remote = remote if names is None else {name: remote[name] for name in names}
        wrong = broken_files(folder, remote)
        if not replace and (existing := [name for name in wrong if (folder / name).exists()]):
            raise DownloadError(f"{folder / existing[0]} exists with other contents; {remedy}")
        for _ in range(2):  # the second time for files that arrived broken
            if not wrong:
                break
            check_free_space(folder, sum(remote[name].size for name in wrong))
            for name in wrong:
                (folder / name).unlink(missing_ok=True)
            # names of the checked listing: the library asks the server for another one
            options = {"local_dir": folder, "endpoint": endpoint, "allow_patterns": wrong}
            hub.snapshot_download(repo, repo_type="dataset", revision=revision, **options)
            wrong = broken_files(folder, remote)
        if wrong:
            for name in wrong:
                (folder / name).unlink(missing_ok=True)
            raise DownloadError(
                f"{len(wrong)} files in {folder} differ from what the Hub lists, such as {wrong[0]}: the server or "
                "a proxy changes them, or the disk is failing; try again, or set HF_ENDPOINT to another server"
            )
    return remote


def _list_files(api: Any, repo: str, revision: str) -> dict[str, Remote]:
    source = f"{api.endpoint}: {repo}"
    try:
        tree = api.list_repo_tree(repo, recursive=True, revision=revision, repo_type="dataset")
        files = [entry for entry in tree if hasattr(entry, "blob_id")]  # entries without a blob are folders
        listed = [
            (file.path, file.lfs.size, file.lfs.sha256) if file.lfs else (file.path, file.size, file.blob_id)
            for file in files
        ]
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        if isinstance(error, OSError):
            raise  # some errors of the network are ValueErrors too
        raise DownloadError(f"{source}: the server's listing cannot be read ({error!r})") from error
    return checked_listing(listed, source)


@contextmanager
def _hub(repo: str, folder: Path) -> Iterator[Any]:
    """Yield huggingface_hub with plain HTTP, which resumes and which mirrors support; its errors become ours."""
    hub, constants = need("huggingface_hub"), need("huggingface_hub.constants")
    errors: tuple[type[Exception], ...] = (OSError, need("huggingface_hub.errors").HfHubHTTPError.__mro__[1])
    before = constants.HF_HUB_DISABLE_XET
    constants.HF_HUB_DISABLE_XET = True
    resume = f"what was downloaded is kept in {folder}: run it again to resume"
    try:
        yield hub
    except errors as error:
        where = os.environ.get("HF_ENDPOINT", constants.ENDPOINT)
        if getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT):
            raise DownloadError(f"{folder}: the disk is full; free some space. {resume}") from error
        if isinstance(error, PermissionError):
            raise DownloadError(f"{error}; give a folder that you can write to with --dest") from error
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DownloadError(
            f"downloading {repo} from {where} failed: {reason}; {resume}. HF_ENDPOINT names another server"
        ) from error
    finally:
        constants.HF_HUB_DISABLE_XET = before


def default_folder() -> Path:
    """Return the folder that `download` writes to by default."""
    return cache_dir() / "assets"


def download(dest: Path | None = None, revision: str = REVISION) -> Path:
    """Download the original's models, or those that are missing.

    Args:
        dest: Folder to write to; None is `default_folder()`.
        revision: Commit, tag or branch of the data set.

    Returns:
        Folder with all files, verified.

    Raises:
        DownloadError: As for `download_files`; only files of an earlier download are replaced.
        MissingPackageError: huggingface_hub is not installed.
    """
    folder = (dest or default_folder()).expanduser().absolute()
    replace = folder == default_folder().absolute() or read_manifest(folder) is not None
    remedy = "name another folder with --dest, or remove the file"
    remote = download_files(REPO, revision, folder, replace=replace, remedy=remedy)
    files = {name: asdict(file) for name, file in remote.items()}
    record = {"repo": REPO, "revision": revision, "files": files}
    write_json(folder / MANIFEST, record)
    return folder


def read_manifest(folder: Path) -> tuple[str, dict[str, Remote]] | None:
    """Return revision and files of a completed download; None where there is no valid manifest."""
    try:
        record = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        return record["revision"], {name: Remote(**file) for name, file in record["files"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
