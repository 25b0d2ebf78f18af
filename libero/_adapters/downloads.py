"""Downloads of plain files and archives from addresses, and the unpacking of archives.

A download resumes after an interruption and never waits without a limit; nothing but http and https is followed. All
names and sizes of an archive are checked before its first file is written.
"""

import errno
import http.client
import os
import socket
import stat
import struct
import threading
import time
import urllib.error
import urllib.request
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urljoin, urlsplit

from tqdm import tqdm

from libero_env.assets.downloads import DownloadError, check_free_space, check_names
from libero_env.parallel import progress_bar
from libero_env.storage import atomic_path

TRIES = 5  # consecutive attempts that receive next to nothing
TIMEOUT = 60.0  # [s] without a byte
_ANSWER = 120.0  # [s] until all headers of an answer are there
_BLOCK = 1 << 18  # [bytes] read at a time
_PROGRESS = 1 << 16  # [bytes] that an attempt, and each interval, must receive
_INTERVAL = 300.0  # [s]
_MAX_FILES = 20_000  # of an archive
_MAX_RATIO = 100  # of all unpacked bytes to those of the archive; pictures pack to a tenth at best
_SMALL = 64 << 20  # [bytes] unpacked, up to which any ratio is fine


def fetch(url: str, target: Path, *, pause: float = 1.0) -> Path:
    """Download a file; an incomplete one is kept beside it as `<name>.partial`, from which a later call resumes.

    Args:
        url: Address, http or https.
        target: File to write; replaced when the download is complete.
        pause: Time before the first new attempt to connect, [s]; it doubles each time.

    Raises:
        DownloadError: The address is not valid, the server cannot be reached, refuses or stalls, or the disk is full.
    """
    partial = target.with_name(f"{target.name}.partial")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with progress_bar(unit="B", unit_scale=True, desc=target.name[:40]) as bar:
            _fetch_all(url, partial, bar, pause)
        partial.replace(target)
    except OSError as error:
        raise DownloadError(f"{error}; free some space, or give a folder that you can write to") from error
    return target


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

    Raises:
        DownloadError: The address is not valid, or redirects to one that is not.
    """
    check_url(url)
    head = {"User-Agent": "libero", "Accept-Encoding": "identity", **(headers or {})}
    request = urllib.request.Request(url, headers=head, method=method)
    opener = urllib.request.build_opener(_Redirects, _Http, _Https)
    response: http.client.HTTPResponse = opener.open(request, timeout=TIMEOUT)
    return response


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
            response = super().getresponse()
        finally:
            timer.cancel()
        if late.is_set():
            response.close()
            raise TimeoutError(f"no complete answer in {_ANSWER:.0f} s")
        return response


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


def _fetch_all(url: str, partial: Path, bar: tqdm, pause: float) -> None:
    """Connect until the file is complete."""
    failures = 0
    while True:
        before = _length(partial)
        try:
            if _fetch_rest(url, partial, bar):
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


def _fetch_rest(url: str, partial: Path, bar: tqdm) -> bool:
    """Append the missing bytes until the connection ends; return whether the file is complete."""
    start = _length(partial)
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
        total = start + int(announced) if announced.isdecimal() else None
        if total is None and not getattr(response, "chunked", False):
            raise http.client.HTTPException("the server does not say how long the file is")
        check_free_space(partial.parent, max((total or 0) - start, 0))
        bar.total, bar.n = total, start
        with partial.open("ab" if start else "wb") as file:
            _copy(response, file, bar)
    return total is None or _length(partial) == total


def _copy(response: http.client.HTTPResponse, file: Any, bar: tqdm) -> None:
    """Write what arrives; raise OSError where it comes too slowly to ever end."""
    arrived, mark, end = 0, 0, time.monotonic() + _INTERVAL
    while block := response.read1(_BLOCK):
        arrived += len(block)
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


def unpack(archive: Path, folder: Path, *, overwrite: bool = False) -> list[Path]:
    """Unpack a zip archive into a folder.

    Args:
        archive: File to read.
        overwrite: Whether to replace files that exist; otherwise they are kept.

    Returns:
        The files that were kept.

    Raises:
        DownloadError: The archive is damaged, encrypted, or has links, names that lead out of the folder, one name
            twice, or much more content than bytes; then nothing is written, or only complete files.
    """
    skipped: list[Path] = []
    try:
        with zipfile.ZipFile(archive) as source:
            entries = [entry for entry in source.infolist() if not entry.is_dir()]
            _check(archive, source)
            check_free_space(folder, sum(entry.file_size for entry in entries))
            for entry in entries:
                target = folder / entry.filename
                if target.exists() and not overwrite:
                    skipped.append(target)
                else:
                    _write(source, entry, target)
    except (zipfile.BadZipFile, zlib.error, EOFError, struct.error, UnicodeError, RuntimeError) as error:
        raise DownloadError(f"{archive}: the archive is damaged ({error})") from error
    except OSError as error:
        raise DownloadError(f"{archive}: it cannot be unpacked: {error}") from error
    return skipped


def _write(source: zipfile.ZipFile, entry: zipfile.ZipInfo, target: Path) -> None:
    with atomic_path(target) as temporary, source.open(entry) as packed, temporary.open("wb") as file:
        while block := packed.read(_BLOCK):
            file.write(block)


def _check(archive: Path, source: zipfile.ZipFile) -> None:
    """Check all entries of an archive by its directory."""
    everything = source.infolist()
    if len(everything) > _MAX_FILES:
        raise DownloadError(f"{archive}: more than {_MAX_FILES} files: do not trust it")
    for entry in everything:
        kind = stat.S_IFMT(entry.external_attr >> 16)
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR) or entry.compress_type > zipfile.ZIP_DEFLATED:
            what = "is a link or a device, or not packed with deflate"
            raise DownloadError(f"{archive}: {entry.filename!r} {what}: do not trust it")
    check_names([entry.orig_filename.removesuffix("/") for entry in everything], str(archive))
    unpacked, packed = sum(entry.file_size for entry in everything), archive.stat().st_size
    if unpacked > max(_SMALL, _MAX_RATIO * packed):
        raise DownloadError(
            f"{archive}: {packed >> 10} KiB would unpack to {unpacked >> 20} MiB, more than {_MAX_RATIO} times as "
            "much: do not trust it"
        )
