"""Download of the human demonstrations of the original benchmark: HDF5 files, pinned and verified."""

from collections.abc import Sequence
from pathlib import Path

from libero_env.assets.downloads import download_files
from libero_env.paths import demos_dir
from libero_env.tasks import find_tasks

REPO = "yifengzhu-hf/LIBERO-datasets"  # a data set on the Hugging Face Hub; CC BY 4.0
REVISION = "e329580e402fb5f07ae3b1f18475fc3b63783b91"


def remote_files(names: Sequence[str]) -> list[str]:
    """Return the paths of files in the data set: `libero_object/<task>_demo.hdf5`.

    Args:
        names: Suites such as `libero_object`, or tasks such as `libero_object/3`.

    Raises:
        UnknownNameError: A suite or task does not exist.
    """
    return [f"{task.suite}/{task.name}_demo.hdf5" for task in find_tasks(names)]


def download_demos(
    names: Sequence[str], dest: Path | None = None, *, revision: str = REVISION, overwrite: bool = False
) -> list[Path]:
    """Download demonstrations, or what is missing of them; `HF_ENDPOINT` names another server than the Hub.

    An interrupted download can be repeated: it resumes where it stopped.

    Args:
        names: As for `remote_files`.
        dest: Folder to write; files go to `<dest>/<suite>/`. None for the folder where demonstrations are kept.
        revision: Commit, tag or branch of the data set.
        overwrite: Whether to replace existing files of other contents.

    Returns:
        The files, complete and verified.

    Raises:
        DownloadError: As for `libero_env.assets.downloads.download_files`.
        UnknownNameError: A suite or task does not exist.
        MissingPackageError: huggingface_hub is not installed.
    """
    folder = (dest or demos_dir()).expanduser().absolute()
    remedy = "perhaps recorded here: name another folder with --dest, or replace it with --overwrite"
    files = remote_files(names)
    download_files(REPO, revision, folder, files, replace=overwrite, remedy=remedy)
    return [folder / file for file in files]
