"""Download of the demonstrations of the original; see `libero_env.demos.download`."""

import http.client
import os
import urllib.error
from pathlib import Path

from tqdm import tqdm

from libero._adapters.downloads import check_url, fetch, open_url, unpack
from libero._adapters.files import is_recording
from libero.libero import get_path_dict
from libero.libero.benchmark import get_benchmark
from libero_env.assets.downloads import REPO as HF_ASSETS_REPO_ID  # noqa: F401 - name of the original
from libero_env.assets.downloads import DownloadError, check_names
from libero_env.assets.downloads import download as _download_assets
from libero_env.demos.download import REPO as HF_REPO_ID  # noqa: F401 - name of the original
from libero_env.demos.download import download_demos
from libero_env.errors import require_known

# Archives of the demonstrations, without published checksums. That of LIBERO-100 holds libero_90 and libero_10.
DATASET_LINKS = {
    "libero_object": "https://utexas.box.com/shared/static/avkklgeq0e1dgzxz52x488whpu8mgspk.zip",
    "libero_goal": "https://utexas.box.com/shared/static/iv5e4dos8yy2b212pkzkpxu9wbdgjfeg.zip",
    "libero_spatial": "https://utexas.box.com/shared/static/04k94hyizn4huhbv5sz4ev9p2h1p6s7f.zip",
    "libero_100": "https://utexas.box.com/shared/static/cv73j8zschq8auh9npzt876fdc1akvmk.zip",
}
Dir = str | os.PathLike

_SUITES = ("libero_object", "libero_goal", "libero_spatial", "libero_10", "libero_90")


class DownloadProgressBar(tqdm):
    """Progress bar for `urllib.request.urlretrieve(url, file, reporthook=bar.update_to)`."""

    def update_to(self, b: int = 1, bsize: int = 1, tsize: int | None = None) -> None:
        """Show that `b` blocks of `bsize` bytes, of `tsize` bytes in total, have arrived."""
        if tsize is not None:
            self.total = tsize
        self.update(b * bsize - self.n)


def url_is_alive(url: str) -> bool:
    """Return whether a server answers for an address."""
    try:
        with open_url(url, method="HEAD"):
            return True
    except urllib.error.HTTPError as error:
        error.close()
        return False
    except (http.client.HTTPException, OSError, ValueError, DownloadError):
        return False


def download_url(url: str, download_dir: Dir, check_overwrite: bool = True, is_zipfile: bool = True) -> Path:
    """Download a file into a folder, see `libero._adapters.downloads.fetch`, and return it.

    With `is_zipfile` the archive is unpacked, see `libero._adapters.downloads.unpack`, and removed, and the folder is
    returned. With `check_overwrite` files that exist are kept, also those that the archive has too.
    """
    folder, name = Path(download_dir), check_url(url)
    check_names([name], url)
    file = folder / name
    exists = check_overwrite and file.is_file()
    if not exists:
        fetch(url, file)
    if not is_zipfile:
        return file
    try:
        skipped = unpack(file, folder, overwrite=not check_overwrite)
    except DownloadError as error:
        if exists:
            raise DownloadError(f"{error}; it was there before: remove it, and try again") from error
        file.unlink()
        raise DownloadError(f"{url}: {error}; it was removed, try again") from error
    if skipped:
        print(f"kept are {len(skipped)} files that exist, such as {skipped[0]}")
    if not exists:
        file.unlink()
    return folder


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
    """Download demonstrations; complete suites are skipped.

    Args:
        datasets: `all`, or a name in `DATASET_LINKS`.
        download_dir: Folder with one folder for each suite; by default `get_libero_path("datasets")`.
        check_overwrite: Whether files that exist are kept.
        use_huggingface: Whether verified files of the Hub are downloaded instead of archives.

    Raises:
        UnknownNameError: The data set does not exist.
        DownloadError: A file did not arrive.
    """
    require_known("data set", datasets, ("all", *DATASET_LINKS))
    folder = Path(download_dir) if download_dir is not None else datasets_folder()
    folder.mkdir(parents=True, exist_ok=True)
    for name in DATASET_LINKS if datasets == "all" else (datasets,):
        if check_overwrite and not use_huggingface and not _missing(folder, name):
            print(f"{name}: complete in {folder}")
            continue
        print(f"{name}: to {folder}")
        for file in filter(is_recording, (folder / missing for missing in _missing(folder, name))):
            file.unlink()  # or it would be kept
        if use_huggingface:
            download_from_huggingface(name, folder, check_overwrite)
        else:
            download_url(DATASET_LINKS[name], folder, check_overwrite)


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
