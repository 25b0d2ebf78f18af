"""Cache files: whatever has happened to the bytes, the arrays are those that were made."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from libero_env.errors import BrokenFileError
from libero_env.storage import atomic_write_npz, cached_arrays, read_npz, read_record, write_record
from tests.harness.fuzz import examples, survive

RNG = np.random.default_rng(5)
ARRAYS = {
    "a": RNG.normal(size=(7, 9)),
    "b": RNG.integers(0, 9, (40, 3)).astype(np.int32),
    "texts": np.array(["one", "two é"]),
}
SHAPES = {name: (array.shape, array.dtype) for name, array in ARRAYS.items()}


def fits(found: dict[str, np.ndarray]) -> bool:
    return {name: (array.shape, array.dtype) for name, array in found.items()} == SHAPES


@st.composite
def changes(draw):
    """Return a function that changes the content of a file: bits, blocks, lengths."""
    steps = draw(
        st.lists(
            st.tuples(
                st.sampled_from(("flip", "zero", "cut", "double", "insert", "large", "swap")),
                st.floats(0, 1),
                st.integers(0, 255),
                st.booleans(),
            ),
            min_size=1,
            max_size=4,
        )
    )

    def change(content: bytes) -> bytes:
        data = bytearray(content)
        for kind, where, value, near_end in steps:
            length = len(data)
            at = max(length - 1 - int(where * 400), 0) if near_end else int(where * max(length - 1, 0))
            if kind == "flip":
                data[at : at + 1] = bytes([data[at] ^ (1 << value % 8)]) if data else b""
            elif kind == "zero":
                data[at : at + value + 1] = bytes(len(data[at : at + value + 1]))
            elif kind == "cut":
                del data[at:]
            elif kind == "double":
                data[at:at] = data[at : at + value]
            elif kind == "insert":
                data[at:at] = bytes([value])
            elif kind == "large":
                data[at : at + 4] = b"\xff" * len(data[at : at + 4])
            else:
                data[:] = data[at:] + data[:at]
        return bytes(data)

    return change


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("caches")


@given(change=changes())
@examples(short=120, long=4000)
def test_a_cache_gives_what_was_made_whatever_its_file_has(folder, change):
    path = folder / "kind" / "file.npz"
    atomic_write_npz(path, ARRAYS)
    path.write_bytes(change(path.read_bytes()))
    found = survive("caches", lambda: cached_arrays(path, lambda: dict(ARRAYS), fits))
    assert {name: array.tobytes() for name, array in found.items()} == {
        name: array.tobytes() for name, array in ARRAYS.items()
    }
    assert fits(read_npz(path))


@given(change=changes())
@examples(short=100, long=2000)
def test_a_file_of_arrays_has_the_same_arrays_or_is_refused(folder, change):
    path = folder / "file.npz"
    atomic_write_npz(path, ARRAYS)
    whole = path.read_bytes()
    changed = change(whole)
    path.write_bytes(changed)
    found = survive("caches", lambda: read_npz(path))
    if found is not None and fits(found):
        assert all(found[name].tobytes() == array.tobytes() for name, array in ARRAYS.items())
    if changed != whole and changed[-71:-64] == b"sha256:":
        with pytest.raises(BrokenFileError):
            read_npz(path)


@given(change=changes())
@examples(short=100, long=2000)
def test_a_record_is_the_same_or_none(folder, change):
    record = {"stamp": "0123", "missing": ["a", "b"], "nested": {"x": [1, 2.5, None, True]}}
    path = folder / "file.json"
    write_record(path, record)
    path.write_bytes(change(path.read_bytes()))
    assert survive("caches", lambda: read_record(path)) in (record, None)
