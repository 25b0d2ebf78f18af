"""Download of one large file over HTTP that resumes after an interruption and verifies the result."""

import http.client
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlparse

from tqdm import tqdm

from libero_env.assets.hub import DownloadError
from libero_env.parallel import progress_bar

TRIES = 5  # consecutive attempts that receive no byte
TIMEOUT = 60.0  # [s] without a byte
_BLOCK = 1 << 18  # [bytes] read at a time


def fetch(
    url: str,
    target: Path,
    *,
    size: int | None = None,
    is_valid: Callable[[Path], bool] | None = None,
    progress: bool | None = None,
    pause: float = 1.0,
) -> Path:
    """Download a file; an incomplete one is kept beside it as `<name>.partial`, from which a later call resumes.

    Args:
        url: Address, http or https.
        target: File to write; replaced when the download is complete and valid.
        size: Expected number of bytes; None where it is not known.
        is_valid: Decides whether the downloaded file is valid, such as by its digest.
        progress: Whether to show a bar; None shows it where stderr is a terminal.
        pause: Time before the first new attempt to connect, [s]; it doubles each time.

    Raises:
        DownloadError: The server cannot be reached or refuses, or the file is not valid; then it is removed.
    """
    if urlparse(url).scheme not in ("http", "https"):
        raise DownloadError(f"{url}: not an http or https address")
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f"{target.name}.partial")
    with progress_bar(total=size, unit="B", unit_scale=True, desc=target.name[:40], progress=progress) as bar:
        _fetch_all(url, partial, size, bar, pause)
    if is_valid is not None and not is_valid(partial):
        partial.unlink()
        raise DownloadError(
            f"{url}: the downloaded file has the wrong checksum and was removed: the server or a "
            "proxy changes it, or the disk is failing; try again, or another server"
        )
    partial.replace(target)
    return target


def _fetch_all(url: str, partial: Path, size: int | None, bar: tqdm, pause: float) -> None:
    """Connect until the file is complete."""
    if size is not None and partial.is_file() and partial.stat().st_size > size:
        partial.unlink()
    failures = 0
    while True:
        before = _length(partial)
        try:
            if _fetch_rest(url, partial, size, bar):
                return
            reason = "the connection was closed early"
        except urllib.error.HTTPError as error:
            if error.code < 500 and error.code != 429:
                raise DownloadError(f"{url}: the server answers {error.code} {error.reason}") from error
            reason = f"the server answers {error.code} {error.reason}"
        except (http.client.HTTPException, OSError) as error:
            if getattr(error, "filename", None) is not None:  # an error of the disk, not of the network
                raise DownloadError(
                    f"{error}; free some space, or give a folder that you can write to"
                ) from error
            reason = str(getattr(error, "reason", error)) or type(error).__name__
        failures = 0 if _length(partial) > before else failures + 1
        if failures >= TRIES:
            raise DownloadError(
                f"{url}: {reason}; tried {TRIES} times. {before} bytes are kept: run it again to resume"
            )
        time.sleep(pause * 2 ** max(failures - 1, 0))


def _fetch_rest(url: str, partial: Path, size: int | None, bar: tqdm) -> bool:
    """Append the missing bytes until the connection ends; return whether the file is complete."""
    start = _length(partial)
    if size is not None and start == size:
        return True
    request = urllib.request.Request(url, headers={"User-Agent": "libero", "Accept-Encoding": "identity"})
    if start:
        request.add_header("Range", f"bytes={start}-")
    try:
        response = urllib.request.urlopen(request, timeout=TIMEOUT)
    except urllib.error.HTTPError as error:
        if error.code != 416:
            raise
        partial.unlink()  # the range does not exist: the partial file is of another file
        return False
    with response:
        start = start if response.status == 206 else 0  # a server without ranges starts at the beginning
        announced = response.headers.get("Content-Length")
        total = size if size is not None else start + int(announced) if announced else None
        bar.total = total
        bar.n = start
        with partial.open("ab" if start else "wb") as file:
            while block := response.read(_BLOCK):
                file.write(block)
                bar.update(len(block))
    return total is None or _length(partial) == total


def _length(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0
