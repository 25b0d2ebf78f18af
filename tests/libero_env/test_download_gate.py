"""What servers list: nothing is written outside of the folder, and nobody's own files are replaced."""

import pytest

from libero_env.assets.downloads import DownloadError, checked_listing, download, read_manifest

FILE = ("a/b.hdf5", 3, "a" * 64)  # name, size, digest


@pytest.mark.parametrize(
    "name", ["../up", "/abs", "a/../../up", "a\\..\\b", "C:x", "a//b", "./a", "a\nb", "x" * 600]
)
def test_names_that_lead_elsewhere_are_refused(name):
    with pytest.raises(DownloadError, match="do not trust it"):
        checked_listing([(name, *FILE[1:])], "here")


@pytest.mark.parametrize(("files", "message"), [
    ([("a", -1, "a" * 64)], r"a\.size is -1; expected greater than or equal to 0"),
    ([("a", 1 << 60, "a" * 64)], "expected less than or equal to"),
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
