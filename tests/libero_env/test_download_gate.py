"""What servers and archives send: nothing is written outside of the folder, nothing waits or grows without a limit."""

import io
import stat
import time
import zipfile
from pathlib import Path

import pytest

from libero._adapters import downloads as http
from libero._adapters.downloads import check_url, fetch, unpack
from libero.libero.utils import download_utils
from libero_env.assets.downloads import DownloadError, checked_listing, download, read_manifest
from tests.harness.answers import answer, serve

FILE = ("a/b.hdf5", 3, "a" * 64)  # name, size, digest


def zipped(*files, names=("a/b.txt",)) -> bytes:
    """An archive of files that all contain `hello`; of `ZipInfo` where more is to be said."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in files or names:
            archive.writestr(name, b"hello")
    return buffer.getvalue()


def info(name: str, mode: int) -> zipfile.ZipInfo:
    found = zipfile.ZipInfo(name)
    found.external_attr = mode << 16
    return found


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setattr(http, "TRIES", 2)
    (tmp_path / "in").mkdir()
    return tmp_path / "in"


def entries(place: Path) -> list[str]:
    """All files of the folder and beside it."""
    return sorted(str(p.relative_to(place.parent)) for p in place.parent.rglob("*") if p.is_file())


@pytest.mark.parametrize(
    "name", ["../up", "/abs", "a/../../up", "a\\..\\b", "C:x", "a//b", "./a", "a\nb", "x" * 600]
)
def test_names_that_lead_elsewhere_are_refused(place, name):
    (place.parent / "a.zip").write_bytes(zipped("fine", name))
    with pytest.raises(DownloadError, match="do not trust it"):
        unpack(place.parent / "a.zip", place)
    with pytest.raises(DownloadError, match="do not trust it"):
        checked_listing([(name, *FILE[1:])], "here")
    assert entries(place) == ["a.zip"]


@pytest.mark.parametrize(("files", "message"), [
    ((info("link", stat.S_IFLNK | 0o777),), "'link' is a link or a device"),
    ((info("pipe", stat.S_IFIFO | 0o666),), "'pipe' is a link or a device"),
    (("a", "A"), "A and a are the same file"),
    (("a", "a/b"), "a is both a file and a folder"),
])  # fmt: skip
def test_archives_with_more_than_plain_files_are_refused(place, files, message):
    (place.parent / "a.zip").write_bytes(zipped(*files))
    with pytest.raises(DownloadError, match=message):
        unpack(place.parent / "a.zip", place)
    assert entries(place) == ["a.zip"]


def test_an_archive_that_unpacks_to_far_more_is_refused(place):
    with zipfile.ZipFile(place.parent / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("zeros", bytes(100 << 20))
    with pytest.raises(DownloadError, match="99 KiB would unpack to 100 MiB"):
        unpack(place.parent / "a.zip", place)


def _bits(data: bytes, flag: bool = False, overlap: bool = False, method: int | None = None) -> bytes:
    """An archive whose directory says something else about its last file."""
    at, changed = data.rindex(b"PK\x01\x02"), bytearray(data)
    if flag:
        changed[at + 8] |= 1
    if overlap:
        changed[at + 42 : at + 46] = bytes(4)
    if method is not None:
        changed[at + 10] = method
    return bytes(changed)


@pytest.mark.parametrize(("data", "message"), [
    (_bits(zipped(), flag=True), "the archive is damaged .File .* is encrypted"),
    (_bits(zipped("a", "b"), overlap=True), "the archive is damaged"),
    (_bits(zipped(), method=97), "not packed with deflate"),
    (zipped()[:-10], "the archive is damaged"),
    (zipped().replace(b"\x00\x00\x00a/b.txt\xcb", b"\x00\x00\x00a/b.txt\xff", 1), "the archive is damaged"),
    (b"", "the archive is damaged"),
])  # fmt: skip
def test_damaged_archives_are_one_line(place, data, message):
    (place.parent / "a.zip").write_bytes(data)
    with pytest.raises(DownloadError, match=message) as caught:
        unpack(place.parent / "a.zip", place)
    assert "\n" not in str(caught.value)
    assert set(entries(place)) <= {"a.zip", "in/a"}  # and complete files that come before the fault


def test_recorded_demonstrations_are_kept_beside_an_archive(place, capsys):
    """Only `overwrite` replaces them."""
    (place / "a").mkdir()
    (place / "a" / "b.txt").write_text("recorded here")
    with serve(answer(zipped("a/b.txt", "a/c.txt"))) as url:
        download_utils.download_url(f"{url}/x.zip", place)
        assert (place / "a" / "b.txt").read_text() == "recorded here"
        assert (place / "a" / "c.txt").read_text() == "hello"
        assert "kept are 1 files" in capsys.readouterr().out
        download_utils.download_url(f"{url}/x.zip", place, check_overwrite=False)
    assert (place / "a" / "b.txt").read_text() == "hello"
    assert entries(place) == ["in/a/b.txt", "in/a/c.txt"]
    assert all(path.stat().st_mode & 0o002 == 0 for path in place.parent.rglob("*"))


def test_an_archive_of_the_users_own_is_not_removed(place):
    (place / "x.zip").write_bytes(b"mine")
    with pytest.raises(DownloadError, match="it was there before"):
        download_utils.download_url("http://127.0.0.1:9/x.zip", place)
    assert (place / "x.zip").read_bytes() == b"mine"


@pytest.mark.parametrize("url", [
    "file:///etc/passwd", "ftp://127.0.0.1/x", "http://[::1", "http:///x", "127.0.0.1/x", "", "http://a b/",
    "http://127.0.0.1:99999/x", "http://127.0.0.1:x/y", "http://a..b/x", "http://x\r\nHost: y/",
    "data:text/plain,hello"
])  # fmt: skip
def test_addresses_that_are_none(place, url):
    for attempt in (lambda: fetch(url, place / "x"), lambda: check_url(url)):
        with pytest.raises(DownloadError, match="not an http or https address"):
            attempt()
    assert not download_utils.url_is_alive(url)


@pytest.mark.parametrize(
    "url", ["http://127.0.0.1:9/", "http://127.0.0.1:9/..", "http://127.0.0.1:9/%2e%2e%2fx"]
)
def test_addresses_without_a_name_of_a_file(place, url):
    with pytest.raises(DownloadError, match="leads outside"):
        download_utils.download_url(url, place)


@pytest.mark.parametrize("location", ["file:///etc/passwd", "ftp://127.0.0.1/x", "http://[::1"])
def test_redirects_to_anything_but_http_are_refused(place, location):
    refused = pytest.raises(DownloadError, match="a redirect that is not followed")
    with serve(answer(b"", f"Location: {location}", status="302 Found")) as url, refused:
        fetch(f"{url}/x", place / "x", pause=0.0)
    assert entries(place) == []


def test_an_encrypted_address_stays_encrypted():
    request = http.urllib.request.Request("https://127.0.0.1/x")
    with pytest.raises(DownloadError, match="is not encrypted"):
        http._Redirects().http_error_302(request, io.BytesIO(), 302, "", {"Location": "http://127.0.0.1/x"})


@pytest.mark.parametrize(("found", "message"), [
    (b"", "tried 2 times"),
    (b"\x00\xff\r\n\r\n", "tried 2 times"),
    (b"HTTP/1.1 200 OK\r\nContent-Length: -5\r\n\r\n", "does not say how long the file is"),
    (b"HTTP/1.1 200 OK\r\nContent-Length: abc\r\n\r\nhello", "does not say how long the file is"),
    (b"HTTP/1.1 200 OK\r\nConte", "does not say how long the file is"),
    (b"HTTP/1.1 200 OK\r\nContent-Length: 99999999999999999999\r\n\r\nhello", "MiB free"),
    (answer(b"hello", status="418 no"), "the server answers 418 no"),
])  # fmt: skip
def test_answers_that_are_odd_end_in_one_line(place, found, message):
    with serve(found) as url, pytest.raises(DownloadError, match=message) as caught:
        fetch(f"{url}/x", place / "x", pause=0.0)
    assert "\n" not in str(caught.value)
    assert not (place / "x").exists()


def test_a_server_that_drips_is_given_up(place, monkeypatch):
    monkeypatch.setattr(http, "_INTERVAL", 0.3)
    with serve([answer(b"x" * 1000)[:-1000], *[b"x"] * 1000]) as url:
        start = time.monotonic()
        with pytest.raises(DownloadError, match="fewer than 64 KiB arrived"):
            fetch(f"{url}/x", place / "x", pause=0.0)
        assert time.monotonic() - start < 5


def test_headers_that_never_end_are_given_up(place, monkeypatch):
    monkeypatch.setattr(http, "_ANSWER", 0.3)
    with serve([b"HTTP/1.1 200 OK\r\nX: ", *[b"x"] * 1000]) as url:
        start = time.monotonic()
        with pytest.raises(DownloadError, match="tried 2 times"):
            fetch(f"{url}/x", place / "x", pause=0.0)
        assert time.monotonic() - start < 5


def test_a_range_of_another_place_starts_again(place):
    (place / "x.partial").write_bytes(b"hel")
    with serve(answer(b"hello", "Content-Range: bytes 0-4/5", status="206 Partial")) as url:
        assert fetch(f"{url}/x", place / "x", pause=0.0).read_bytes() == b"hello"


@pytest.mark.parametrize(("files", "message"), [
    ([("a", -1, "a" * 64)], r"a\.size is -1; expected at least 0"),
    ([("a", 1 << 60, "a" * 64)], "expected at most"),
    ([("a", "3", "a" * 64)], "size is '3'"),
    ([("a", 3, "../x")], "digest is '../x'"),
    ([("a", 3, "0")], "digest is '0'"),
    ([(3, 3, "a" * 64)], "name"),
    ([FILE, FILE], "are the same file"),
    ([FILE, ("A/B.HDF5", *FILE[1:])], "are the same file"),
    ([FILE, ("a", *FILE[1:])], "both a file and a folder"),
    ([FILE] * 100_001, "more than 100000"),
])  # fmt: skip
def test_listings_that_lie_are_refused(files, message):
    with pytest.raises(DownloadError, match=message) as caught:
        checked_listing(files, "here")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 600


def test_models_of_ones_own_are_not_replaced_by_a_download(tmp_path, monkeypatch):
    """Only those of an earlier download are, which a record beside them shows."""
    pytest.importorskip("huggingface_hub")
    monkeypatch.setattr("libero_env.assets.downloads._list_files", lambda *_: checked_listing([FILE], "here"))
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b.hdf5").write_text("my own")
    with pytest.raises(DownloadError, match="exists with other contents"):
        download(tmp_path)
    assert (tmp_path / "a" / "b.hdf5").read_text() == "my own" and read_manifest(tmp_path) is None
