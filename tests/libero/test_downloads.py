"""Downloads from a local server in place of the Hub, which closes connections or sends wrong bytes."""

import os

import pytest

from libero.libero.utils import download_utils
from libero_cli.main import main
from libero_env.assets.downloads import DownloadError
from libero_env.demos.download import REPO, REVISION, download_demos, remote_files
from tests.harness.hub import serve_hub

FILE = "libero_object/pick_up_the_alphabet_soup_and_place_it_in_the_basket_demo.hdf5"
CONTENT = bytes(range(256)) * 4000


@pytest.fixture
def hub(monkeypatch):
    pytest.importorskip("huggingface_hub")
    files = {file: file.encode() for file in remote_files(["libero_object", "libero_goal"])}
    with serve_hub(REPO, REVISION, files | {FILE: CONTENT}, {FILE}) as server:
        monkeypatch.setenv("HF_ENDPOINT", server.url)
        monkeypatch.setenv("NO_PROXY", "127.0.0.1")
        yield server


def test_demonstrations_are_verified(hub, tmp_path, capsys):
    hub.cut_once[FILE] = 1000
    assert main(["demos", "download", "libero_object/0", "--dest", str(tmp_path)]) == 0
    assert (tmp_path / FILE).read_bytes() == CONTENT
    assert f"{tmp_path / FILE}: complete" in capsys.readouterr().out
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
    assert len(download_utils.download_from_huggingface("libero_goal", tmp_path)) == 10


def test_what_was_recorded_here_is_no_demonstration_of_the_original(hub, tmp_path, capsys):
    first, second = remote_files(["libero_goal"])[:2]
    recorded, mine = tmp_path / "libero_goal" / "128x128-seed0-expert9" / "a.hdf5", tmp_path / "mine.hdf5"
    recorded.parent.mkdir(parents=True)
    for name, target in {first: recorded, second: mine}.items():
        target.write_text("other demonstrations")
        (tmp_path / name).symlink_to(os.path.relpath(target, (tmp_path / name).parent))
    with pytest.raises(DownloadError, match="exists with other contents"):
        download_utils.libero_dataset_download("libero_goal", tmp_path)
    (tmp_path / second).unlink()
    download_utils.libero_dataset_download("libero_goal", tmp_path)
    assert (tmp_path / first).read_bytes() == first.encode()
    assert recorded.read_text() == mine.read_text() == "other demonstrations"
    hub.got.clear()
    download_utils.libero_dataset_download("libero_goal", tmp_path)
    assert hub.got == [] and "libero_goal: complete" in capsys.readouterr().out
