"""Download over HTTP that resumes after an interruption, verifies the result, and never waits without a limit."""

import errno
import http.client
import json
import os
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urljoin, urlsplit

from tqdm import tqdm

from libero_env.assets.hub import DownloadError, check_free_space
from libero_env.parallel import progress_bar

TRIES = 5  # consecutive attempts that receive next to nothing
TIMEOUT = 60.0  # [s] without a byte
_ANSWER = 120.0  # [s] until all headers of an answer are there
_BLOCK = 1 << 18  # [bytes] read at a time
_PROGRESS = 1 << 16  # [bytes] that an attempt, and each interval, must receive
_INTERVAL = 300.0  # [s]
_MAX_LISTING = 32 << 20  # [bytes]


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
        DownloadError: The address is not valid, the server cannot be reached, refuses or stalls, the disk is full, or
            the file is not valid; then it is removed.
    """
    partial = target.with_name(f"{target.name}.partial")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with progress_bar(
            total=size, unit="B", unit_scale=True, desc=target.name[:40], progress=progress
        ) as bar:
            _fetch_all(url, partial, size, bar, pause)
        if is_valid is not None and not is_valid(partial):
            partial.unlink()
            raise DownloadError(
                f"{url}: the downloaded file has the wrong checksum and was removed: the server or a "
                "proxy changes it, or the disk is failing; try again, or another server"
            )
        partial.replace(target)
    except OSError as error:
        raise DownloadError(f"{error}; free some space, or give a folder that you can write to") from error
    return target


def read_json(url: str) -> Any:
    """Return the JSON that a server answers.

    Raises:
        DownloadError: The server cannot be reached, refuses or stalls, or the answer is too large or no JSON.
    """
    try:
        with open_url(url) as response:
            data, start = bytearray(), time.monotonic()
            while block := response.read1(_BLOCK):
                data += block
                if len(data) > _MAX_LISTING or time.monotonic() - start > _INTERVAL:
                    raise DownloadError(
                        f"{url}: the answer is longer than {_MAX_LISTING >> 20} MiB, or takes too long"
                    )
        return json.loads(data)
    except urllib.error.HTTPError as error:
        error.close()
        raise DownloadError(f"{url}: the server answers {error.code} {_plain(error.reason)}") from error
    except (http.client.HTTPException, OSError, ValueError, RecursionError) as error:
        reason = _plain(getattr(error, "reason", error))
        raise DownloadError(f"{url}: {reason}; no network? HF_ENDPOINT names another server") from error


def check_url(url: str) -> str:
    """Return the name of the file that an address ends with; empty where it names none.

    Raises:
        DownloadError: It is not an http or https address.
    """
    try:
        parts = urlsplit(url)
        valid = parts.scheme in ("http", "https") and bool(parts.hostname) and (parts.port or 1) > 0
        (parts.hostname or "").encode("idna")
    except ValueError:
        valid = False
    if not valid or any(ord(character) <= 32 or ord(character) == 127 for character in url):
        raise DownloadError(f"{url!r}: not an http or https address, such as https://huggingface.co")
    return unquote(parts.path.rpartition("/")[2])


def open_url(
    url: str, headers: Mapping[str, str] | None = None, method: str = "GET"
) -> http.client.HTTPResponse:
    """Return the answer of a server; nothing but http and https is followed, and https stays https.

    Args:
        url: Address.
        headers: Further headers of the request.
        method: Method of the request.

    Raises:
        DownloadError: The address is not valid, or redirects to one that is not.
    """
    check_url(url)
    head = {"User-Agent": "libero", "Accept-Encoding": "identity", **(headers or {})}
    request = urllib.request.Request(url, headers=head, method=method)
    opener = urllib.request.OpenerDirector()
    for handler in (
        urllib.request.ProxyHandler(),
        urllib.request.HTTPDefaultErrorHandler(),
        urllib.request.HTTPErrorProcessor(),
        _Redirects(),
        _Http(),
        _Https(),
    ):
        opener.add_handler(handler)
    found: http.client.HTTPResponse = opener.open(request, timeout=TIMEOUT)
    return found


class _Redirects(urllib.request.HTTPRedirectHandler):
    """Redirects to http and https addresses, not from https to http."""

    def http_error_302(self, req: Any, fp: Any, code: int, msg: str, headers: Any) -> Any:
        """Return the answer of the new address."""
        try:
            location = urljoin(req.full_url, headers.get("Location", ""))
            check_url(location)
            if req.type == "https" and urlsplit(location).scheme != "https":
                raise DownloadError(f"{req.full_url}: it redirects to {location}, which is not encrypted")
        except (ValueError, DownloadError) as error:
            fp.close()
            raise DownloadError(f"{req.full_url}: a redirect that is not followed: {error}") from error
        return super().http_error_302(req, fp, code, msg, headers)

    http_error_301 = http_error_303 = http_error_307 = http_error_308 = http_error_302


class _LimitedAnswer(http.client.HTTPConnection):
    """Connection that ends when an answer's headers take too long: the timeout of a socket is for each byte."""

    def getresponse(self) -> http.client.HTTPResponse:
        """Return the answer."""
        late = threading.Event()
        timer = threading.Timer(_ANSWER, _shut, [self.sock, late])
        timer.daemon = True
        timer.start()
        try:
            found = super().getresponse()
        finally:
            timer.cancel()
        if late.is_set():
            found.close()
            raise TimeoutError(f"no complete answer in {_ANSWER:.0f} s")
        return found


class _LimitedSecureAnswer(_LimitedAnswer, http.client.HTTPSConnection):
    """The same over TLS."""


class _Http(urllib.request.HTTPHandler):
    def http_open(self, req: Any) -> Any:
        """Open an http address."""
        return self.do_open(_LimitedAnswer, req)


class _Https(urllib.request.HTTPSHandler):
    def https_open(self, req: Any) -> Any:
        """Open an https address."""
        return self.do_open(_LimitedSecureAnswer, req)


def _shut(connection: socket.socket | None, late: threading.Event) -> None:
    late.set()
    if connection is not None:
        connection.shutdown(socket.SHUT_RDWR)


def _fetch_all(url: str, partial: Path, size: int | None, bar: tqdm, pause: float) -> None:
    """Connect until the file is complete."""
    if size is not None and _length(partial) > size:
        partial.unlink()
    failures = 0
    while True:
        before = _length(partial)
        try:
            if _fetch_rest(url, partial, size, bar):
                return
            reason = "the connection was closed early"
        except urllib.error.HTTPError as error:
            error.close()
            reason = f"the server answers {error.code} {_plain(error.reason)}"
            if error.code < 500 and error.code != 429:
                raise DownloadError(f"{url}: {reason}") from error
        except http.client.InvalidURL as error:
            raise DownloadError(f"{url}: {error}") from error
        except (http.client.HTTPException, OSError) as error:
            on_disk = error.errno in (errno.ENOSPC, errno.EDQUOT) if isinstance(error, OSError) else False
            if on_disk or getattr(error, "filename", None) is not None:
                raise
            reason = _plain(getattr(error, "reason", error)) or type(error).__name__
        failures = 0 if _length(partial) - before >= _PROGRESS else failures + 1
        if failures >= TRIES:
            raise DownloadError(
                f"{url}: {reason}; tried {TRIES} times. {_length(partial)} bytes are kept: run it again to resume"
            )
        time.sleep(pause * 2 ** max(failures - 1, 0))


def _fetch_rest(url: str, partial: Path, size: int | None, bar: tqdm) -> bool:
    """Append the missing bytes until the connection ends; return whether the file is complete."""
    start = _length(partial)
    if size is not None and start == size:
        partial.touch()  # an empty file is complete from the beginning
        return True
    try:
        response = open_url(url, {"Range": f"bytes={start}-"} if start else None)
    except urllib.error.HTTPError as error:
        if error.code != 416:
            raise
        error.close()
        partial.unlink()  # the range does not exist: the partial file is of another file
        return False
    with response:
        resumed = response.status == 206 and _range_start(response) in (start, None)
        start = start if resumed else 0  # a server without ranges starts at the beginning
        announced = response.headers.get("Content-Length", "")
        total = size if size is not None else start + int(announced) if announced.isdecimal() else None
        if total is None and not getattr(response, "chunked", False):
            raise http.client.HTTPException("the server does not say how long the file is")
        check_free_space(partial.parent, max((total or 0) - start, 0))
        bar.total, bar.n = total, start
        with partial.open("ab" if start else "wb") as file:
            _copy(response, file, None if total is None else total - start, bar)
    return total is None or _length(partial) == total


def _copy(response: http.client.HTTPResponse, file: Any, wanted: int | None, bar: tqdm) -> None:
    """Write what arrives; raise where it is more than announced, or comes too slowly to ever end."""
    arrived, mark, end = 0, 0, time.monotonic() + _INTERVAL
    while block := response.read1(_BLOCK):
        arrived += len(block)
        if wanted is not None and arrived > wanted:
            raise DownloadError("the server sends more than it announces: do not trust it")
        file.write(block)
        bar.update(len(block))
        if time.monotonic() > end:
            if arrived - mark < _PROGRESS:
                raise OSError(f"fewer than {_PROGRESS >> 10} KiB arrived in {_INTERVAL:.0f} s")
            mark, end = arrived, time.monotonic() + _INTERVAL


def _range_start(response: http.client.HTTPResponse) -> int | None:
    """Return the first byte of a partial answer; None where it does not say."""
    first = response.headers.get("Content-Range", "").removeprefix("bytes ").partition("-")[0]
    return int(first) if first.isdecimal() else None


def _plain(reason: object) -> str:
    """Return what a server or the network says in one short line."""
    return " ".join("".join(c if c.isprintable() else " " for c in str(reason)).split())[:200]


def _length(path: Path) -> int:
    return os.path.getsize(path) if path.is_file() else 0
