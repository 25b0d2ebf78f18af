"""Selection of the pack, and download of the original's files."""

from pathlib import Path

import pytest

from libero_cli.main import main
from libero_env.assets import downloads
from libero_env.assets.downloads import REPO, REVISION, DownloadError, download, read_manifest
from libero_env.assets.original import FAMILIES, OriginalPack
from libero_env.assets.pack import BuiltinPack, chosen_assets, select_pack
from libero_env.errors import UnknownNameError
from tests.harness.hub import serve_hub

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


@pytest.fixture
def hub(monkeypatch):
    pytest.importorskip("huggingface_hub")
    with serve_hub(REPO, REVISION, FILES, STORED_LARGE) as server:
        monkeypatch.setenv("HF_ENDPOINT", server.url)
        yield server


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
