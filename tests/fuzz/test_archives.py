"""Archives and listings of servers: mutations of valid ones; nothing is written outside of the folder."""

import io
import shutil
import stat
import zipfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from libero._adapters.downloads import check_url, unpack
from libero_env.assets.downloads import checked_listing
from tests.harness.fuzz import examples, survive

PARTS = st.sampled_from(
    ["a", "b", "A", "..", ".", "", "c.hdf5", "con", "é", "x" * 300, "a b", "C:", "*", "\\", "\n", "~"]
)
NAMES = st.lists(PARTS, min_size=1, max_size=4).map("/".join)
MODES = st.sampled_from(
    [0, 0, 0, stat.S_IFREG | 0o666, stat.S_IFLNK | 0o777, stat.S_IFDIR | 0o777, stat.S_IFIFO, 0o7777]
)
CONTENTS = st.binary(max_size=50) | st.sampled_from([bytes(1 << 20), b"kept"])
ENTRIES = st.lists(st.tuples(NAMES, MODES, CONTENTS, st.sampled_from([0, 0, 8, 8, 12, 14])), max_size=5)
HEX = "0123456789abcdef"
ODD = st.sampled_from(
    [None, -1, 1 << 62, 1.5, "3", "", [], {}, True, "a" * 40, "b" * 64, float("nan"), "../x", "file"]
)


def archive_of(entries) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, mode, content, method in entries:
            info = zipfile.ZipInfo(name or "x")
            info.external_attr, info.compress_type = mode << 16, method
            archive.writestr(info, content)
    return buffer.getvalue()


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("archives")


@given(
    ENTRIES,
    st.lists(st.tuples(st.integers(0, 10**6), st.binary(min_size=1, max_size=4)), max_size=4),
    st.booleans(),
)
@pytest.mark.filterwarnings("ignore:Duplicate name")
@examples(short=80, long=4000)
def test_archives_are_unpacked_within_their_folder_or_refused(place, entries, flips, overwrite):
    shutil.rmtree(place)
    (place / "in" / "a").mkdir(parents=True)
    (place / "in" / "a" / "c.hdf5").write_text("recorded here")
    data = bytearray(archive_of(entries))
    for where, piece in flips:
        at = len(data) - 1 - where % min(len(data), 400)  # most are in the directory, at the end
        data[at : at + len(piece)] = piece
    (place / "x.zip").write_bytes(data)
    survive("archives", lambda: unpack(place / "x.zip", place / "in", overwrite=overwrite))
    assert {path.name for path in place.iterdir()} == {"in", "x.zip"}
    files = [path for path in (place / "in").rglob("*") if not path.is_dir()]
    assert sum(path.stat().st_size for path in files) <= 64 << 20
    assert all(not path.is_symlink() and path.stat().st_mode & 0o022 == 0 for path in files)
    assert not [path for path in files if path.name.endswith(".part")]
    if not overwrite:
        assert (place / "in" / "a" / "c.hdf5").read_text() == "recorded here"


FILE = st.tuples(
    NAMES | ODD,
    st.integers(0, 10**9) | ODD,
    st.text(HEX, min_size=40, max_size=40) | st.text(HEX, min_size=64, max_size=64) | ODD,
)


@given(st.lists(FILE, max_size=5))
@examples(short=80, long=4000)
def test_listings_name_files_of_one_folder_or_are_refused(files):
    found = survive("archives", lambda: checked_listing(files, "here"))
    for name, file in (found or {}).items():
        assert (Path("/folder") / name).resolve().is_relative_to("/folder") and ".." not in Path(name).parts
        assert file.size >= 0 and len(file.digest) in (40, 64)


ADDRESS = [
    "http", "https", "file", "ftp", "data", ":", "//", "/", "[", "]", "::1", "@", "127.0.0.1", "a", ".", "%2e", "#"
]  # fmt: skip
ADDRESS += [":99999", ":x", " ", "\n", "\0", "é", "\ud800", "?x=..", "..", "xn--", "-" * 70]


@given(st.lists(st.sampled_from(ADDRESS), max_size=8).map("".join))
@examples(short=80, long=4000)
def test_addresses_are_http_or_refused(url):
    if survive("archives", lambda: check_url(url)) is not None:
        assert url.startswith(("http://", "https://"))
