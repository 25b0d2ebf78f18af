"""Fetching one large file over HTTP: goes on where it was broken off, and refuses what is not what was announced."""

import http.client
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlparse

from tqdm import tqdm

from libero_env.assets.hub import DownloadError

TRIES = 5  # in a row without a byte
TIMEOUT = 60.0  # s, without a byte
_BLOCK = 1 << 18


def fetch(
    url: str,
    target: Path,
    *,
    size: int | None = None,
    is_right: Callable[[Path], bool] | None = None,
    progress: bool | None = None,
    pause: float = 1.0,
) -> Path:
    """Fetch a file; what has arrived so far is kept beside it as `<name>.partial`, and a later call goes on from there.

    Args:
        url: http or https.
        target: where it goes; replaced when all of it has arrived and is right.
        size: bytes, where they are known.
        is_right: judges what arrived, such as by its digest.
        progress: show a bar; None where stderr is a terminal.
        pause: seconds before the connection is tried again, twice as long each time.

    Raises:
        DownloadError: no connection, the server says no, or what arrived is not right; then it is removed.
    """
    if urlparse(url).scheme not in ("http", "https"):
        raise DownloadError(f"{url}: not an http or https address")
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f"{target.name}.partial")
    hidden = None if progress is None else not progress
    with tqdm(total=size, unit="B", unit_scale=True, desc=target.name[:40], disable=hidden) as bar:
        _fetch_all(url, partial, size, bar, pause)
    if is_right is not None and not is_right(partial):
        partial.unlink()
        raise DownloadError(
            f"{url}: what arrived is not the announced file (its checksum differs) and was removed: the server or a "
            "proxy changes it, or the disk is failing; try again, or another server"
        )
    partial.replace(target)
    return target


def _fetch_all(url: str, partial: Path, size: int | None, bar: tqdm, pause: float) -> None:
    """Connect until everything is there."""
    if size is not None and partial.is_file() and partial.stat().st_size > size:
        partial.unlink()
    failures = 0
    while True:
        before = _length(partial)
        try:
            if _fetch_rest(url, partial, size, bar):
                return
            reason = "the connection was broken off"
        except urllib.error.HTTPError as error:
            if error.code < 500 and error.code != 429:
                raise DownloadError(f"{url}: the server answers {error.code} {error.reason}") from error
            reason = f"the server answers {error.code} {error.reason}"
        except (http.client.HTTPException, OSError) as error:
            if getattr(error, "filename", None) is not None:  # the disk, not the network
                raise DownloadError(f"{error}; make room, or name a folder that you may write") from error
            reason = str(getattr(error, "reason", error)) or type(error).__name__
        failures = 0 if _length(partial) > before else failures + 1
        if failures >= TRIES:
            raise DownloadError(
                f"{url}: {reason}; tried {TRIES} times. {before} bytes are kept: run it again to go on"
            )
        time.sleep(pause * 2 ** max(failures - 1, 0))


def _fetch_rest(url: str, partial: Path, size: int | None, bar: tqdm) -> bool:
    """Append what is missing, as far as it comes; whether that was all."""
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
        partial.unlink()  # there is no such rest: it was another file
        return False
    with response:
        start = start if response.status == 206 else 0  # a server without ranges begins again
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
