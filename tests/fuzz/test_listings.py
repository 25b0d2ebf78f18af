"""Listings of servers: mutations of valid ones; nothing leads outside of the folder."""

from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from libero_env.assets.downloads import checked_listing
from tests.harness.fuzz import examples, survive

PARTS = st.sampled_from(
    ["a", "b", "A", "..", ".", "", "c.hdf5", "con", "é", "x" * 300, "a b", "C:", "*", "\\", "\n", "~"]
)
NAMES = st.lists(PARTS, min_size=1, max_size=4).map("/".join)
HEX = "0123456789abcdef"
ODD = st.sampled_from(
    [None, -1, 1 << 62, 1.5, "3", "", [], {}, True, "a" * 40, "b" * 64, float("nan"), "../x", "file"]
)
FILE = st.tuples(
    NAMES | ODD,
    st.integers(0, 10**9) | ODD,
    st.text(HEX, min_size=40, max_size=40) | st.text(HEX, min_size=64, max_size=64) | ODD,
)


@given(st.lists(FILE, max_size=5))
@examples(short=80, long=4000)
def test_listings_name_files_of_one_folder_or_are_refused(files):
    found = survive("listings", lambda: checked_listing(files, "here"))
    for name, file in (found or {}).items():
        assert (Path("/folder") / name).resolve().is_relative_to("/folder") and ".." not in Path(name).parts
        assert file.size >= 0 and len(file.digest) in (40, 64)
