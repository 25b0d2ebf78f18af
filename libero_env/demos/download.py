"""Download of the human demonstrations of the original benchmark: HDF5 files, pinned and verified."""

import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from libero_env.assets.http import fetch, read_json
from libero_env.assets.hub import DownloadError, Remote, check_free_space, listed_files
from libero_env.paths import demos_dir
from libero_env.tasks import get_suite, get_task

REPO = "yifengzhu-hf/LIBERO-datasets"  # a data set on the Hugging Face Hub; CC BY 4.0
REVISION = "e329580e402fb5f07ae3b1f18475fc3b63783b91"
HUB = "https://huggingface.co"


def remote_files(names: Sequence[str]) -> list[str]:
    """Return the paths of files in the data set: `libero_object/<task>_demo.hdf5`.

    Args:
        names: Suites such as `libero_object`, or tasks such as `libero_object/3`.

    Raises:
        UnknownNameError: A suite or task does not exist.
    """
    found: dict[str, None] = {}
    for name in names:
        tasks = [get_task(name)] if "/" in name else get_suite(name).tasks
        found |= {f"{task.suite}/{task.name}_demo.hdf5": None for task in tasks}
    return list(found)


def download_demos(
    names: Sequence[str],
    dest: Path | None = None,
    *,
    revision: str = REVISION,
    overwrite: bool = False,
    progress: bool | None = None,
) -> list[Path]:
    """Download demonstrations, or what is missing of them; `HF_ENDPOINT` names another server than the Hub.

    An interrupted download can be repeated: it resumes where it stopped.

    Args:
        names: As for `remote_files`.
        dest: Folder to write; files go to `<dest>/<suite>/`. None for the folder where demonstrations are kept.
        revision: Commit, tag or branch of the data set.
        overwrite: Whether to replace existing files of other contents.
        progress: Whether to show progress bars. None shows them if stderr is a terminal.

    Returns:
        The files, complete and verified.

    Raises:
        DownloadError: There is no network or not enough space, a file of other contents exists, or a file arrives
            different from what the server announces.
        UnknownNameError: A suite or task does not exist.
    """
    folder = (dest or demos_dir()).expanduser().absolute()
    files = remote_files(names)
    remote: dict[str, Remote] = {}
    for suite in dict.fromkeys(file.partition("/")[0] for file in files):
        remote |= _list_suite(suite, revision)
    if absent := [file for file in files if file not in remote]:
        raise DownloadError(f"{REPO} at revision {revision} has no {absent[0]}")
    missing = [file for file in files if not remote[file].matches(folder / file)]
    conflicting = [file for file in missing if (folder / file).exists()]
    if conflicting and not overwrite:
        raise DownloadError(
            f"{folder / conflicting[0]} exists with other contents (perhaps recorded here); name another folder "
            "with --dest, or replace it with --overwrite"
        )
    downloaded = sum(_partial_size(folder / file) for file in missing)
    check_free_space(folder, sum(remote[file].size for file in missing) - downloaded)
    for file in missing:
        url = f"{_endpoint()}/datasets/{REPO}/resolve/{quote(revision, safe='')}/{quote(file)}"
        fetch(url, folder / file, size=remote[file].size, is_valid=remote[file].matches, progress=progress)
    return [folder / file for file in files]


def _endpoint() -> str:
    return os.environ.get("HF_ENDPOINT", HUB).rstrip("/")


def _partial_size(path: Path) -> int:
    partial = path.with_name(f"{path.name}.partial")
    return partial.stat().st_size if partial.is_file() else 0


def _list_suite(suite: str, revision: str) -> dict[str, Remote]:
    """Return the files that the server has of a suite, with their sizes and digests."""
    url = f"{_endpoint()}/api/datasets/{REPO}/tree/{quote(revision, safe='')}/{suite}?recursive=true"
    return listed_files(read_json(url), url)
