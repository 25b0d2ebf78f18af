"""Selection of the pack, and download of the original's files, whose servers are not trusted."""

from pathlib import Path

import pytest

from libero_cli.main import main
from libero_env.assets import BuiltinPack, chosen_assets, downloads, select_pack
from libero_env.assets.downloads import DownloadError, checked_listing, download, read_manifest
from libero_env.assets.original import FAMILIES, OriginalPack
from tests.harness.hub import serve_hub

LARGE = bytes(range(256)) * 4096  # 1 MiB
FILES = {"README.md": b"# Assets\n", "scenes/room.xml": b"<mujoco/>\n"}
FILES |= {"articulated_objects/a.xml": b"<mujoco model='a'/>\n", "articulated_objects/mesh.msh": LARGE}
STORED_LARGE = {"articulated_objects/mesh.msh"}
FILE = ("a/b.hdf5", 3, "a" * 64)  # name, size, digest


@pytest.fixture(autouse=True)
def alone(monkeypatch, tmp_path):
    """No setting of the machine: its variables and configuration file are out of sight."""
    for variable in ("LIBERO_ASSETS", "HF_ENDPOINT", "HF_HUB_OFFLINE"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path))
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "cache"))


def _folder(path: Path) -> Path:
    for name in (*FAMILIES, "scenes"):
        (path / name).mkdir(parents=True)
    return path


def test_argument_then_variable_then_file_then_builtin(tmp_path, monkeypatch):
    argument, variable, file = (_folder(tmp_path / name) for name in ("argument", "variable", "file"))
    assert select_pack() == BuiltinPack()
    (tmp_path / "config.yaml").write_text(f"assets: {file}\nbddl_files: /nowhere\n")
    assert select_pack() == OriginalPack(str(file))
    monkeypatch.setenv("LIBERO_ASSETS", str(variable))
    assert select_pack() == OriginalPack(str(variable))
    assert select_pack(argument, lod=500) == OriginalPack(str(argument), 500)
    assert select_pack("builtin") == BuiltinPack()
    assert "LIBERO_ASSETS" in chosen_assets().reason


def test_a_folder_that_the_file_names_but_nobody_filled_means_builtin(tmp_path):
    (tmp_path / "config.yaml").write_text(f"assets: {tmp_path / 'never_made'}\n")
    assert select_pack() == BuiltinPack()


@pytest.fixture
def hub(monkeypatch):
    pytest.importorskip("huggingface_hub")
    with serve_hub(downloads.REPO, downloads.REVISION, FILES, STORED_LARGE) as server:
        monkeypatch.setenv("HF_ENDPOINT", server.url)
        yield server


def _contents(folder):
    return {name: (folder / name).read_bytes() for name in FILES}


def test_all_files_are_downloaded_and_recorded(hub, tmp_path):
    folder = download()
    assert folder == tmp_path / "cache" / "assets" and _contents(folder) == FILES
    revision, files = read_manifest(folder)
    assert revision == downloads.REVISION and set(files) == set(FILES)


def test_an_interrupted_download_resumes(hub, tmp_path, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.DOWNLOAD_CHUNK_SIZE", 1 << 16)
    name, half = "articulated_objects/mesh.msh", len(LARGE) // 2
    hub.cut_once[name] = half
    assert _contents(download(tmp_path / "there")) == FILES
    assert [asked for file, asked in hub.got if file == name] == [None, f"bytes={half}-"]


def test_a_file_that_arrives_changed_is_downloaded_again(hub, tmp_path):
    hub.corrupt["articulated_objects/a.xml"] = 1
    assert _contents(download(tmp_path / "there")) == FILES


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
    usage = downloads.shutil.disk_usage(tmp_path)._replace(free=1 << 20)
    monkeypatch.setattr(downloads.shutil, "disk_usage", lambda path: usage)
    with pytest.raises(DownloadError, match="MiB free"):
        download(tmp_path / "there")
    assert hub.got == []


def test_names_outside_the_folder_are_refused(hub, tmp_path):
    hub.files["../elsewhere.xml"] = b"<mujoco/>"
    with pytest.raises(DownloadError, match="outside the folder"):
        download(tmp_path / "there")
    assert not (tmp_path / "elsewhere.xml").exists()


def test_the_command_downloads_and_prints_how_to_use_it(hub, tmp_path, capsys):
    assert main(["assets", "download", "--dest", str(tmp_path / "there")]) == 0
    assert f"export LIBERO_ASSETS={tmp_path / 'there'}" in capsys.readouterr().out


def test_the_command_prints_which_models_are_used(tmp_path, monkeypatch, capsys):
    assert main(["assets", "info"]) == 0 and "builtin" in capsys.readouterr().out
    monkeypatch.setenv("LIBERO_ASSETS", str(_folder(tmp_path / "assets")))
    assert main(["assets", "info"]) == 0
    told = capsys.readouterr().out
    assert "original in" in told and "LIBERO_ASSETS" in told


def test_command_lists_what_is_missing(tmp_path, capsys):
    assert main(["assets", "check", str(_folder(tmp_path / "assets"))]) == 1
    told = capsys.readouterr().out
    assert "FAIL  milk:" in told and "libero assets download" in told


@pytest.mark.parametrize(
    "name", ["../up", "/abs", "a/../../up", "a\\..\\b", "C:x", "a//b", "a\nb", "x" * 600]
)
def test_names_that_lead_elsewhere_are_refused(name):
    with pytest.raises(DownloadError, match="do not trust it"):
        checked_listing([(name, *FILE[1:])], "here")


@pytest.mark.parametrize(("files", "message"), [
    ([("a", -1, "a" * 64)], r"a\.size is -1; expected greater than or equal to 0"),
    ([("a", 1 << 60, "a" * 64)], "expected less than or equal to"),
    ([("a", "3", "a" * 64)], "size is '3'"),
    ([("a", 3, "../x")], "digest is '../x'"),
    ([(3, 3, "a" * 64)], "name"),
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
