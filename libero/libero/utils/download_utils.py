"""Download of demonstrations and models of the original from the Hub; see `libero_env.demos.download`."""

import os
from pathlib import Path

from libero._adapters.files import is_recording
from libero.libero import get_path_dict
from libero.libero.benchmark import get_benchmark
from libero_env.assets.downloads import REPO as HF_ASSETS_REPO_ID  # noqa: F401 - name of the original
from libero_env.assets.downloads import download as _download_assets
from libero_env.demos.download import REPO as HF_REPO_ID  # noqa: F401 - name of the original
from libero_env.demos.download import download_demos
from libero_env.errors import require_known

Dir = str | os.PathLike

DATASETS = (
    "libero_object",
    "libero_goal",
    "libero_spatial",
    "libero_100",
)  # the last: libero_90 and libero_10
_SUITES = ("libero_object", "libero_goal", "libero_spatial", "libero_10", "libero_90")


def download_from_huggingface(
    dataset_name: str, download_dir: Dir, check_overwrite: bool = True
) -> list[Path]:
    """Download and verify the files of a suite, see `libero_env.demos.download.download_demos`, and return them.

    With `check_overwrite`, different files of the same names are kept, and a DownloadError names one.
    """
    return download_demos([dataset_name], Path(download_dir), overwrite=not check_overwrite)


def download_assets_from_huggingface(download_dir: Dir | None = None) -> str:
    """Download and verify the original's models, see `libero_env.assets.downloads`, and return their folder."""
    return str(_download_assets(None if download_dir is None else Path(download_dir)))


def libero_dataset_download(
    datasets: str = "all",
    download_dir: Dir | None = None,
    check_overwrite: bool = True,
    use_huggingface: bool = False,
) -> None:
    """Download demonstrations, verified; complete suites are skipped.

    Args:
        datasets: `all`, or a name in `DATASETS`.
        download_dir: Folder with one folder for each suite; by default `get_libero_path("datasets")`.
        check_overwrite: Whether files that exist are kept.
        use_huggingface: Without effect: the files are those of the Hub in either case.

    Raises:
        UnknownNameError: The data set does not exist.
        DownloadError: A file did not arrive, or one of other contents exists.
    """
    require_known("data set", datasets, ("all", *DATASETS))
    folder = Path(download_dir) if download_dir is not None else datasets_folder()
    for name in DATASETS if datasets == "all" else (datasets,):
        missing = _missing(folder, name)
        if check_overwrite and not missing:
            print(f"{name}: complete in {folder}")
            continue
        print(f"{name}: to {folder}")
        for file in filter(is_recording, (folder / path for path in missing)):
            file.unlink()  # or it would be kept
        download_from_huggingface(name, folder, check_overwrite)


def check_libero_dataset(download_dir: Dir | None = None) -> bool:
    """Print how many files of each suite exist, and return whether all do; see `libero_dataset_download`."""
    folder = Path(download_dir) if download_dir is not None else datasets_folder()
    absent = {name: _missing(folder, name) for name in _SUITES}
    for name, files in absent.items():
        total = get_benchmark(name)().n_tasks
        print(f"{name}: {total - len(files)} of {total} files" + (f", no {files[0]}" if files else ""))
    return not any(absent.values())


def datasets_folder() -> Path:
    """Return the folder of demonstrations; it need not exist."""
    return Path(get_path_dict()["datasets"])


def _missing(folder: Path, suite: str) -> list[str]:
    """Return the demonstration files of a suite that do not exist, or are links to what was recorded here."""
    benchmark = get_benchmark(suite)()
    names = [benchmark.get_task_demonstration(i) for i in range(benchmark.n_tasks)]
    return [name for name in names if not (folder / name).is_file() or is_recording(folder / name)]
