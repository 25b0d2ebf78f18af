"""Downloads from a local server that closes connections, sends wrong bytes, or does not support ranges."""

import io
import os
import threading
import urllib.request
import zipfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from libero._adapters.downloads import fetch
from libero.libero.utils import download_utils
from libero_env.assets.downloads import DownloadError
from libero_env.cli.main import main
from libero_env.demos import download as demos_download
from libero_env.demos.download import REPO, REVISION, download_demos, remote_files
from libero_env.errors import UnknownNameError
from tests.harness.hub import serve_hub

FILE = "libero_object/pick_up_the_alphabet_soup_and_place_it_in_the_basket_demo.hdf5"
CONTENT = bytes(range(256)) * 4000


class Server(ThreadingHTTPServer):
    """Serves `files`; counts on its way to each: `breaks` broken connections after half of what was asked for."""

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.files, self.requests, self.breaks, self.ranges = {}, [], 0, True

    @property
    def url(self):
        return f"http://127.0.0.1:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    def do_HEAD(self):
        self.send_response(200 if self.path in self.server.files else 404)
        self.end_headers()

    def do_GET(self):
        server, content = self.server, self.server.files.get(self.path)
        asked = self.headers.get("Range")
        server.requests.append((self.path.rpartition("/")[2], asked))
        if content is None:
            return self.send_error(404)
        start = int(asked.removeprefix("bytes=").rstrip("-")) if asked and server.ranges else 0
        if start and start >= len(content):
            return self.send_error(416)
        rest = content[start:]
        self.send_response(206 if start else 200)
        self.send_header("Content-Length", str(len(rest)))
        self.end_headers()
        if server.breaks:
            server.breaks -= 1
            rest = rest[: len(rest) // 2]
        self.wfile.write(rest)
        return None

    def log_message(self, *_):
        """Nothing."""


@pytest.fixture
def server(monkeypatch):
    with Server() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        monkeypatch.setenv("NO_PROXY", "127.0.0.1")
        yield server
        server.shutdown()
        thread.join()


def test_an_interrupted_connection_is_resumed(server, tmp_path):
    server.files["/big.bin"], server.breaks = CONTENT, 2
    path = fetch(f"{server.url}/big.bin", tmp_path / "big.bin", pause=0.0)
    assert path.read_bytes() == CONTENT
    half, three_quarters = len(CONTENT) // 2, len(CONTENT) * 3 // 4
    assert [asked for _, asked in server.requests] == [None, f"bytes={half}-", f"bytes={three_quarters}-"]
    assert list(tmp_path.iterdir()) == [path]


def test_a_later_run_resumes(server, tmp_path):
    server.files["/big.bin"] = CONTENT
    (tmp_path / "big.bin.partial").write_bytes(CONTENT[:1000])
    fetch(f"{server.url}/big.bin", tmp_path / "big.bin")
    assert (tmp_path / "big.bin").read_bytes() == CONTENT
    assert server.requests == [("big.bin", "bytes=1000-")]


def test_a_server_without_ranges_starts_from_the_beginning(server, tmp_path):
    server.files["/big.bin"], server.ranges = CONTENT, False
    (tmp_path / "big.bin.partial").write_bytes(b"x" * 1000)
    assert fetch(f"{server.url}/big.bin", tmp_path / "big.bin").read_bytes() == CONTENT


def test_a_partial_file_that_is_too_long_is_discarded(server, tmp_path):
    server.files["/big.bin"] = CONTENT
    (tmp_path / "big.bin.partial").write_bytes(CONTENT + b"more")
    assert fetch(f"{server.url}/big.bin", tmp_path / "big.bin", pause=0.0).read_bytes() == CONTENT


def test_attempts_are_bounded_and_partial_files_are_kept(server, tmp_path):
    server.files["/big.bin"], server.breaks = CONTENT, 10**6
    with pytest.raises(
        DownloadError, match=r"the connection was closed early; tried 5 times.*are kept: run it again"
    ):
        fetch(f"{server.url}/big.bin", tmp_path / "big.bin", pause=0.0)
    kept = (tmp_path / "big.bin.partial").read_bytes()
    assert len(kept) > len(CONTENT) * 0.99
    assert kept == CONTENT[: len(kept)]
    with pytest.raises(DownloadError, match="404"):
        fetch(f"{server.url}/small.bin", tmp_path / "small.bin", pause=0.0)
    with pytest.raises(DownloadError, match="not an http"):
        fetch("file:///etc/hosts", tmp_path / "hosts")


@pytest.fixture
def hub(monkeypatch):
    pytest.importorskip("huggingface_hub")
    files = {
        file: file.encode() for suite in ("libero_object", "libero_goal") for file in remote_files([suite])
    }
    with serve_hub(REPO, REVISION, files | {FILE: CONTENT}, {FILE}) as server:
        monkeypatch.setenv("HF_ENDPOINT", server.url)
        monkeypatch.setenv("NO_PROXY", "127.0.0.1")
        yield server


def test_demonstrations_are_verified(hub, tmp_path, capsys):
    hub.cut_once[FILE] = 1000
    assert main(["demos", "download", "libero_object/0", "--dest", str(tmp_path)]) == 0
    assert (tmp_path / FILE).read_bytes() == CONTENT
    assert (
        capsys.readouterr().out == f"{tmp_path / FILE}: complete; it has the digest that the server lists\n"
    )
    hub.got.clear()
    assert download_demos(["libero_object/0"], tmp_path) == [tmp_path / FILE]
    assert hub.got == []


def test_a_wrong_checksum_is_refused(hub, tmp_path, capsys):
    hub.corrupt[FILE] = 10
    assert main(["demos", "download", "libero_object/0", "--dest", str(tmp_path)]) == 2
    assert "differ from what the Hub lists" in capsys.readouterr().err
    assert list((tmp_path / "libero_object").iterdir()) == []


def test_different_files_are_not_replaced_by_default(hub, tmp_path):
    (tmp_path / FILE).parent.mkdir()
    (tmp_path / FILE).write_bytes(b"recorded here")
    with pytest.raises(DownloadError, match="exists with other contents"):
        download_demos(["libero_object/0"], tmp_path)
    assert (tmp_path / FILE).read_bytes() == b"recorded here"
    download_demos(["libero_object/0"], tmp_path, overwrite=True)
    assert (tmp_path / FILE).read_bytes() == CONTENT


def test_errors_name_the_remedy(hub, tmp_path, monkeypatch):
    with pytest.raises(DownloadError, match="has no libero_spatial/"):
        download_demos(["libero_spatial"], tmp_path)
    with pytest.raises(UnknownNameError, match="libero_object"):
        download_demos(["libero_objects"], tmp_path)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(DownloadError, match="HF_ENDPOINT names another server"):
        download_demos(["libero_object"], tmp_path)


def test_every_task_has_a_file():
    assert len(remote_files(["libero_100"])) == 100
    assert remote_files(["libero_10", "libero_10/3"]) == remote_files(["libero_10"])
    assert all(file.endswith("_demo.hdf5") for file in remote_files(["libero_spatial"]))


def test_the_facade_downloads_from_the_hub(hub, tmp_path, capsys):
    download_utils.libero_dataset_download("libero_goal", tmp_path, use_huggingface=True)
    assert len(list((tmp_path / "libero_goal").glob("*_demo.hdf5"))) == 10
    assert not download_utils.check_libero_dataset(tmp_path)
    out = capsys.readouterr().out
    assert "libero_goal: 10 of 10 files\n" in out
    assert "libero_object: 0 of 10 files, no libero_object/pick_up_the_alphabet_soup" in out
    with pytest.raises(UnknownNameError, match="libero_goal"):
        download_utils.libero_dataset_download("libero_gaol", tmp_path)
    assert download_utils.HF_REPO_ID == demos_download.REPO
    assert len(download_utils.download_from_huggingface("libero_goal", tmp_path)) == 10


def _archive(suites):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for file in remote_files(suites):
            archive.writestr(file, b"demonstrations")
    return buffer.getvalue()


def test_the_facade_downloads_archives(server, tmp_path, monkeypatch, capsys):
    links = {name: f"{server.url}/{name}.zip" for name in download_utils.DATASET_LINKS}
    monkeypatch.setattr(download_utils, "DATASET_LINKS", links)
    for name in links:
        server.files[f"/{name}.zip"] = _archive([name])
    server.breaks = 1
    download_utils.libero_dataset_download("all", tmp_path)
    assert download_utils.check_libero_dataset(tmp_path)
    assert not list(tmp_path.glob("*.zip*"))
    requests = len(server.requests)
    download_utils.libero_dataset_download("libero_100", tmp_path)
    assert len(server.requests) == requests
    assert "libero_100: complete" in capsys.readouterr().out
    (first, second) = remote_files(["libero_goal"])[:2]
    recorded, mine = tmp_path / "libero_goal" / "128x128-seed0-expert9" / "a.hdf5", tmp_path / "mine.hdf5"
    recorded.parent.mkdir()
    for name, target in {first: recorded, second: mine}.items():
        target.write_text("other demonstrations")
        (tmp_path / name).unlink()
        (tmp_path / name).symlink_to(os.path.relpath(target, (tmp_path / name).parent))
    assert not download_utils.check_libero_dataset(tmp_path)
    assert f"9 of 10 files, no {first}" in capsys.readouterr().out, (
        "what was recorded here is not the original's"
    )
    download_utils.libero_dataset_download("libero_goal", tmp_path)
    assert (tmp_path / first).read_bytes() == b"demonstrations"
    assert recorded.read_text() == (tmp_path / second).read_text() == "other demonstrations"


def test_download_functions(server, tmp_path):
    server.files["/notes.txt"] = b"hello"
    assert download_utils.url_is_alive(f"{server.url}/notes.txt")
    assert not download_utils.url_is_alive(f"{server.url}/nothing.txt")
    assert not download_utils.url_is_alive("http://127.0.0.1:9/")
    path = download_utils.download_url(f"{server.url}/notes.txt", tmp_path, is_zipfile=False)
    assert path.read_bytes() == b"hello"
    with pytest.raises(DownloadError, match="archive is damaged"):
        download_utils.download_url(f"{server.url}/notes.txt", tmp_path)
    with download_utils.DownloadProgressBar(unit="B", disable=False) as bar:
        urllib.request.urlretrieve(
            f"{server.url}/notes.txt", tmp_path / "again.txt", reporthook=bar.update_to
        )
        assert bar.total == 5
        assert bar.n >= 5
