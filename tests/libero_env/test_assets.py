"""Selection of the pack, and download of the original's files."""

import hashlib
import json
import re
import sys
import threading
from collections import Counter
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from libero_env.assets import hub as hub_module
from libero_env.assets.download import REPO, REVISION, download, read_manifest
from libero_env.assets.hub import DownloadError
from libero_env.assets.original import FAMILIES, OriginalPack
from libero_env.assets.pack import BuiltinPack, chosen_assets, select_pack
from libero_env.cli.main import main
from libero_env.errors import LiberoError, UnknownNameError

pytestmark = pytest.mark.unit

LARGE = bytes(range(256)) * 4096  # 1 MiB
FILES = {
    "README.md": b"# Assets\n",
    "scenes/room.xml": b"<mujoco/>\n",
    "articulated_objects/a.xml": b"<mujoco model='a'/>\n",
    "articulated_objects/mesh.msh": LARGE,
}
STORED_LARGE = {"articulated_objects/mesh.msh"}


@pytest.fixture(autouse=True)
def alone(monkeypatch, tmp_path):
    """No setting of the machine: its variables and configuration file are out of sight."""
    for variable in ("LIBERO_ASSETS", "HF_ENDPOINT", "HF_HUB_OFFLINE"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path / "config"))
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "cache"))


def _folder(path: Path) -> Path:
    for name in (*FAMILIES, "scenes"):
        (path / name).mkdir(parents=True)
    return path


def _write_config(tmp_path, text):
    (tmp_path / "config").mkdir(exist_ok=True)
    (tmp_path / "config" / "config.yaml").write_text(text)


def test_argument_then_variable_then_file_then_builtin(tmp_path, monkeypatch):
    argument, variable, file = (_folder(tmp_path / name) for name in ("argument", "variable", "file"))
    assert select_pack() == BuiltinPack()
    _write_config(tmp_path, f"assets: {file}\nbddl_files: /nowhere\n")
    assert select_pack() == OriginalPack(str(file))
    monkeypatch.setenv("LIBERO_ASSETS", str(variable))
    assert select_pack() == OriginalPack(str(variable))
    assert select_pack(argument, lod=500) == OriginalPack(str(argument), 500)
    assert select_pack("builtin") == BuiltinPack()
    assert "LIBERO_ASSETS" in chosen_assets().reason


def test_a_folder_that_the_file_names_but_nobody_filled_means_builtin(tmp_path):
    _write_config(tmp_path, f"assets: {tmp_path / 'never_made'}\n")
    assert select_pack() == BuiltinPack()


@pytest.mark.parametrize("text", ["a: [", "- list\n"])
def test_a_broken_file_is_named(tmp_path, text):
    _write_config(tmp_path, text)
    with pytest.raises(LiberoError, match="config.yaml"):
        select_pack()


def test_a_folder_without_the_assets_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("LIBERO_ASSETS", str(tmp_path))
    with pytest.raises(LiberoError, match=r"LIBERO_ASSETS.*does not hold.*libero assets download"):
        select_pack()


def test_packs_are_hashable_and_named(tmp_path):
    packs = [BuiltinPack(), OriginalPack("/a"), OriginalPack("/a", 500), OriginalPack("/b")]
    assert len(set(packs)) == 4
    assert [pack.name for pack in packs] == ["builtin", "original", "original-lod500", "original"]


def test_builtin_builds_what_it_lists():
    pack = BuiltinPack()
    assert pack.build("milk").category == "milk"
    with pytest.raises(UnknownNameError):
        pack.build("nothing")


# --- download -------------------------------------------------------------------------------------------------------


class Hub(ThreadingHTTPServer):
    """As much of the Hub as a download needs: listing, file heads, files with ranges; and ways to go wrong."""

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), _Handler)
        self.files = dict(FILES)
        self.cut_once: dict[str, int] = {}  # file -> bytes after which the connection drops, the next time
        self.corrupt: Counter[str] = Counter()  # file -> how many more times its content arrives changed
        self.got: list[tuple[str, str | None]] = []  # file, range asked for

    @property
    def url(self):
        return f"http://127.0.0.1:{self.server_port}"


def _git_digest(content):
    return hashlib.sha1(f"blob {len(content)}\0".encode() + content).hexdigest()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *args):
        pass

    def do_HEAD(self):
        self._answer(head=True)

    def do_GET(self):
        self._answer(head=False)

    def _answer(self, head):
        path = self.path.partition("?")[0]
        if path == f"/api/datasets/{REPO}/tree/{REVISION}":
            return self._json([_entry(*item) for item in self.server.files.items()])
        if path in (f"/api/datasets/{REPO}/revision/{REVISION}", f"/api/datasets/{REPO}"):
            siblings = [{"rfilename": name} for name in self.server.files]
            return self._json({"id": REPO, "sha": REVISION, "siblings": siblings})
        found = re.fullmatch(rf"/datasets/{REPO}/resolve/{REVISION}/(.*)", path)
        if not found or found[1] not in self.server.files:
            return self._send(404, b"", {"X-Error-Code": "EntryNotFound"})
        return self._file(found[1], head)

    def _file(self, name, head):
        content = self.server.files[name]
        etag = hashlib.sha256(content).hexdigest() if name in STORED_LARGE else _git_digest(content)
        headers = {"X-Repo-Commit": REVISION, "ETag": f'"{etag}"', "Accept-Ranges": "bytes"}
        if name in STORED_LARGE:
            headers |= {"X-Linked-Etag": f'"{etag}"', "X-Linked-Size": str(len(content))}
        if head:
            return self._send(200, content, headers, head=True)
        asked = self.headers.get("Range")
        self.server.got.append((name, asked))
        if self.server.corrupt[name]:
            self.server.corrupt[name] -= 1
            content = bytes([content[0] ^ 1]) + content[1:]
        start = int(re.fullmatch(r"bytes=(\d+)-.*", asked)[1]) if asked else 0
        if start:
            headers["Content-Range"] = f"bytes {start}-{len(content) - 1}/{len(content)}"
        return self._send(
            206 if start else 200, content[start:], headers, cut=self.server.cut_once.pop(name, None)
        )

    def _json(self, value):
        self._send(200, json.dumps(value).encode(), {"Content-Type": "application/json"})

    def _send(self, status, body, headers=None, head=False, cut=None):
        self.send_response(status)
        for key, value in (headers or {}).items():
            self.send_header(key, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if not head:
            self.wfile.write(body if cut is None else body[:cut])
        if cut is not None:
            self.close_connection = True


def _entry(name, content):
    entry = {"type": "file", "path": name, "size": len(content), "oid": _git_digest(content)}
    if name in STORED_LARGE:
        entry["lfs"] = {"oid": hashlib.sha256(content).hexdigest(), "size": len(content), "pointerSize": 130}
    return entry


@pytest.fixture
def hub(monkeypatch):
    pytest.importorskip("huggingface_hub")
    server = Hub()
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    monkeypatch.setenv("HF_ENDPOINT", server.url)
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


def _contents(folder):
    return {name: (folder / name).read_bytes() for name in FILES}


def test_all_files_are_downloaded_and_recorded(hub, tmp_path):
    folder = download()
    assert folder == tmp_path / "cache" / "assets"
    assert _contents(folder) == FILES
    revision, files = read_manifest(folder)
    assert revision == REVISION and set(files) == set(FILES)


def test_complete_files_are_not_downloaded_again(hub, tmp_path):
    folder = download(tmp_path / "there")
    hub.got.clear()
    assert download(folder) == folder
    assert hub.got == []


def test_an_interrupted_download_resumes(hub, tmp_path, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.DOWNLOAD_CHUNK_SIZE", 1 << 16)
    name, half = "articulated_objects/mesh.msh", len(LARGE) // 2
    hub.cut_once[name] = half
    assert _contents(download(tmp_path / "there")) == FILES
    assert [asked for file, asked in hub.got if file == name] == [None, f"bytes={half}-"]


def test_a_file_that_arrives_changed_is_downloaded_again(hub, tmp_path):
    hub.corrupt["articulated_objects/a.xml"] = 1
    folder = download(tmp_path / "there")
    assert _contents(folder) == FILES


def test_a_server_that_changes_files_is_found_out(hub, tmp_path):
    hub.corrupt["articulated_objects/mesh.msh"] = 100
    with pytest.raises(DownloadError, match=r"differ.*mesh\.msh"):
        download(tmp_path / "there")
    assert read_manifest(tmp_path / "there") is None


def test_a_file_broken_afterwards_is_replaced(hub, tmp_path):
    folder = download(tmp_path / "there")
    (folder / "scenes/room.xml").write_bytes(b"<mujock/>\n")
    hub.got.clear()
    assert _contents(download(folder)) == FILES
    assert [name for name, _ in hub.got] == ["scenes/room.xml"]


def test_too_little_space_is_reported_before_the_download(hub, tmp_path, monkeypatch):
    usage = hub_module.shutil.disk_usage(tmp_path)._replace(free=1 << 20)
    monkeypatch.setattr(hub_module.shutil, "disk_usage", lambda path: usage)
    with pytest.raises(DownloadError, match="MiB free"):
        download(tmp_path / "there")
    assert hub.got == []


def test_names_outside_the_folder_are_refused(hub, tmp_path):
    hub.files["../elsewhere.xml"] = b"<mujoco/>"
    with pytest.raises(DownloadError, match="outside the folder"):
        download(tmp_path / "there")
    assert not (tmp_path / "elsewhere.xml").exists()


def test_without_network_the_message_states_how_to_resume(hub, tmp_path, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(DownloadError, match="failed: .*again to resume"):
        download(tmp_path / "there")


def test_a_revision_that_does_not_exist_is_named(hub, tmp_path):
    with pytest.raises(DownloadError, match=f"{re.escape(hub.url)} failed: "):
        download(tmp_path / "there", revision="f" * 40)


def test_without_the_library_the_message_states_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(LiberoError, match="pip install huggingface_hub"):
        download(tmp_path / "there")


def test_the_command_downloads_and_prints_how_to_use_it(hub, tmp_path, capsys):
    assert main(["assets", "download", "--dest", str(tmp_path / "there")]) == 0
    assert f"export LIBERO_ASSETS={tmp_path / 'there'}" in capsys.readouterr().out


def test_the_command_prints_which_models_are_used(tmp_path, monkeypatch, capsys):
    assert main(["assets", "info"]) == 0
    assert "builtin" in capsys.readouterr().out
    monkeypatch.setenv("LIBERO_ASSETS", str(_folder(tmp_path / "assets")))
    assert main(["assets", "info"]) == 0
    told = capsys.readouterr().out
    assert "original in" in told and "LIBERO_ASSETS" in told


def test_command_lists_what_is_missing(tmp_path, capsys):
    assert main(["assets", "check", str(_folder(tmp_path / "assets"))]) == 1
    told = capsys.readouterr().out
    assert "FAIL  milk:" in told and "libero assets download" in told
