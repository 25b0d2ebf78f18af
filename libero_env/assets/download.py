"""Download of the original's assets from the Hugging Face Hub, pinned and verified.

Files are compared with the digests that the Hub lists for the revision. They are stored beside the files: a later check
needs no network.
"""

import errno
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from libero_env.assets.hub import DownloadError, Remote, broken_files, check_free_space, listed_files
from libero_env.errors import MissingPackageError
from libero_env.paths import cache_dir
from libero_env.storage import atomic_write_text

REPO = "lerobot/libero-assets"  # a data set; CC BY 4.0
REVISION = "0b3ea86be5fe169d0fd036ae63d1070ec09e90f6"
MANIFEST = "libero-assets.json"  # written when all files are complete and verified


def default_folder() -> Path:
    """Return the folder that `download` writes to by default."""
    return cache_dir() / "assets"


def download(dest: Path | None = None, revision: str = REVISION) -> Path:
    """Download the assets, or those that are missing; `HF_ENDPOINT` selects another server than the Hub.

    Args:
        dest: Folder to write to; None is `default_folder()`.
        revision: Commit, tag or branch of the repository.

    Returns:
        Folder with all files, verified.

    Raises:
        DownloadError: There is no network, too little disk space, or files differ from what the Hub lists. The next
            call resumes where this one stopped.
        MissingPackageError: huggingface_hub is not installed.
    """
    folder = (dest or default_folder()).expanduser().absolute()
    with _hub(folder) as hub:
        endpoint = os.environ.get("HF_ENDPOINT")
        remote = _listing(hub.HfApi(endpoint=endpoint), revision)
        wrong = broken_files(folder, remote)
        _check_own(folder, wrong)
        for _ in range(2):  # the second time for files that arrived broken
            if not wrong:
                break
            check_free_space(folder, sum(remote[name].size for name in wrong))
            for name in wrong:
                (folder / name).unlink(missing_ok=True)
            # names of the checked listing: the library asks the server for another one
            options = {"local_dir": folder, "endpoint": endpoint, "allow_patterns": wrong}
            hub.snapshot_download(REPO, repo_type="dataset", revision=revision, **options)
            wrong = broken_files(folder, remote)
        if wrong:
            for name in wrong:
                (folder / name).unlink(missing_ok=True)
            raise DownloadError(
                f"{len(wrong)} files in {folder} differ from what the Hub lists, such as {wrong[0]}: the server or "
                "a proxy changes them, or the disk is failing; try again, or set HF_ENDPOINT to another server"
            )
        _write_manifest(folder, revision, remote)
    return folder


def read_manifest(folder: Path) -> tuple[str, dict[str, Remote]] | None:
    """Return revision and files of a completed download; None where there is no valid manifest."""
    try:
        record = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        return record["revision"], {name: Remote(**file) for name, file in record["files"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _check_own(folder: Path, wrong: Sequence[str]) -> None:
    """Check that no file of somebody else would be replaced: only those of an earlier download are."""
    own = folder == default_folder().absolute() or read_manifest(folder) is not None
    if not own and (existing := [name for name in wrong if (folder / name).exists()]):
        raise DownloadError(
            f"{folder / existing[0]} exists with other contents; name another folder with --dest, or remove the file"
        )


def _write_manifest(folder: Path, revision: str, remote: Mapping[str, Remote]) -> None:
    record = {
        "repo": REPO,
        "revision": revision,
        "files": {name: asdict(file) for name, file in remote.items()},
    }
    atomic_write_text(folder / MANIFEST, json.dumps(record, indent=1))


def _listing(api: Any, revision: str) -> dict[str, Remote]:
    source = f"{api.endpoint}: {REPO}"
    try:
        found = api.list_repo_tree(REPO, recursive=True, revision=revision, repo_type="dataset")
        files = [entry for entry in found if hasattr(entry, "blob_id")]  # entries without a blob are folders
        entries = [
            {
                "type": "file",
                "path": file.path,
                "size": file.size,
                "oid": file.blob_id,
                "lfs": file.lfs and {"oid": file.lfs.sha256, "size": file.lfs.size},
            }
            for file in files
        ]
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        if isinstance(error, OSError):
            raise  # some errors of the network are ValueErrors too
        raise DownloadError(f"{source}: the server's listing cannot be read ({error!r})") from error
    return listed_files(entries, source)


@contextmanager
def _hub(folder: Path) -> Iterator[Any]:
    """Yield huggingface_hub with plain HTTP, which resumes and which mirrors support; its errors become ours."""
    try:
        import huggingface_hub as hub
        from huggingface_hub import constants
        from huggingface_hub.errors import HfHubHTTPError
    except ImportError as error:
        raise MissingPackageError(
            "huggingface_hub, which downloads the assets, is not installed", "pip install huggingface_hub"
        ) from error
    errors: tuple[type[Exception], ...] = (
        OSError,
        HfHubHTTPError.__mro__[1],
    )
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
        raise DownloadError(f"downloading {REPO} from {where} failed: {reason}; {resume}") from error
    finally:
        constants.HF_HUB_DISABLE_XET = before
