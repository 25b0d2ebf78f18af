"""Fetching the demonstrations that people recorded for the original benchmark: HDF5 files, pinned and verified."""

import json
import os
import urllib.error
import urllib.request
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from urllib.parse import quote

from libero_env.assets.http import TIMEOUT, fetch
from libero_env.assets.hub import DownloadError, Remote, check_room
from libero_env.paths import demos_dir
from libero_env.tasks import get_suite, get_task

REPO = "yifengzhu-hf/LIBERO-datasets"  # a data set on the Hugging Face Hub; CC BY 4.0
REVISION = "e329580e402fb5f07ae3b1f18475fc3b63783b91"
HUB = "https://huggingface.co"


def demo_files(names: Sequence[str]) -> list[str]:
    """Files of suites and tasks below the data set: `libero_object/<task>_demo.hdf5`.

    Args:
        names: suites such as `libero_object`, or tasks of them such as `libero_object/3`.

    Raises:
        UnknownNameError: no such suite or task.
    """
    found: dict[str, None] = {}
    for name in names:
        wanted = [get_task(name)] if "/" in name else get_suite(name).tasks
        found |= {f"{task.suite}/{task.name}_demo.hdf5": None for task in wanted}
    return list(found)


def download_demos(
    names: Sequence[str],
    dest: Path | None = None,
    *,
    revision: str = REVISION,
    overwrite: bool = False,
    progress: bool | None = None,
) -> list[Path]:
    """Fetch demonstrations, or what is missing of them; `HF_ENDPOINT` names another server than the Hub.

    Args:
        names: as in `demo_files`.
        dest: the folder; files go to `<dest>/<suite>/`. Where demonstrations are kept by default.
        revision: commit, tag or branch of the data set.
        overwrite: replace files that are there and are others.
        progress: show bars; None where stderr is a terminal.

    Returns:
        The files, complete and verified.

    Raises:
        DownloadError: no network, no room, a file that is in the way, or one that arrives different from what the
            server announces. Running it again goes on where it stopped.
        UnknownNameError: no such suite or task.
    """
    folder = (dest or demos_dir()).expanduser().absolute()
    files = demo_files(names)
    remote: dict[str, Remote] = {}
    for suite in dict.fromkeys(file.partition("/")[0] for file in files):
        remote |= dict(_listing(suite, revision))
    if absent := [file for file in files if file not in remote]:
        raise DownloadError(f"{REPO} at revision {revision} has no {absent[0]}")
    missing = [file for file in files if not remote[file].matches(folder / file)]
    in_the_way = [file for file in missing if (folder / file).exists()]
    if in_the_way and not overwrite:
        raise DownloadError(
            f"{folder / in_the_way[0]} is there and is another file (recorded here, perhaps); name another folder "
            "with --dest, or replace it with --overwrite"
        )
    arrived = sum(_partial_size(folder / file) for file in missing)
    check_room(folder, sum(remote[file].size for file in missing) - arrived)
    for file in missing:
        url = f"{_endpoint()}/datasets/{REPO}/resolve/{quote(revision, safe='')}/{quote(file)}"
        fetch(url, folder / file, size=remote[file].size, is_right=remote[file].matches, progress=progress)
    return [folder / file for file in files]


def _endpoint() -> str:
    return os.environ.get("HF_ENDPOINT", HUB).rstrip("/")


def _partial_size(path: Path) -> int:
    partial = path.with_name(f"{path.name}.partial")
    return partial.stat().st_size if partial.is_file() else 0


def _listing(suite: str, revision: str) -> Iterator[tuple[str, Remote]]:
    """What the server has of a suite, with its digests."""
    url = f"{_endpoint()}/api/datasets/{REPO}/tree/{quote(revision, safe='')}/{suite}?recursive=true"
    try:
        with urllib.request.urlopen(url, timeout=TIMEOUT) as response:
            entries = json.load(response)
    except urllib.error.HTTPError as error:
        raise DownloadError(f"{url}: the server answers {error.code} {error.reason}") from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "reason", error)
        raise DownloadError(f"{url}: {reason}; no network? HF_ENDPOINT names another server") from error
    for entry in entries:
        path, lfs = PurePosixPath(entry["path"]), entry.get("lfs")
        if path.is_absolute() or ".." in path.parts:
            raise DownloadError(f"the server lists files outside the folder, such as {path}: do not trust it")
        if entry["type"] == "file":
            digest = ("sha256", lfs["oid"]) if lfs else ("git", entry["oid"])
            yield str(path), Remote(entry["size"], *digest)
