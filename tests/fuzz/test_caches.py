"""Cache files: whatever has happened to the bytes, the arrays are those that were made."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from libero_env.errors import BrokenFileError
from libero_env.storage import atomic_write_npz, cached_arrays, read_npz, read_record, write_record
from tests.harness.fuzz import examples, survive
from tests.harness.mutations import damaged

RNG = np.random.default_rng(5)
ARRAYS = {
    "a": RNG.normal(size=(7, 9)),
    "b": RNG.integers(0, 9, (40, 3)).astype(np.int32),
    "texts": np.array(["one", "two é"]),
}
SHAPES = {name: (array.shape, array.dtype) for name, array in ARRAYS.items()}


def fits(found: dict[str, np.ndarray]) -> bool:
    return {name: (array.shape, array.dtype) for name, array in found.items()} == SHAPES


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("caches")


@given(data=st.data())
@examples(short=120, long=4000)
def test_a_cache_gives_what_was_made_whatever_its_file_has(folder, data):
    path = folder / "kind" / "file.npz"
    atomic_write_npz(path, ARRAYS)
    path.write_bytes(data.draw(damaged(path.read_bytes())))
    found = survive("caches", lambda: cached_arrays(path, lambda: dict(ARRAYS), fits))
    assert {name: array.tobytes() for name, array in found.items()} == {
        name: array.tobytes() for name, array in ARRAYS.items()
    }
    assert fits(read_npz(path))


@given(data=st.data())
@examples(short=100, long=2000)
def test_a_file_of_arrays_has_the_same_arrays_or_is_refused(folder, data):
    path = folder / "file.npz"
    atomic_write_npz(path, ARRAYS)
    whole = path.read_bytes()
    changed = data.draw(damaged(whole))
    path.write_bytes(changed)
    found = survive("caches", lambda: read_npz(path))
    if found is not None and fits(found):
        assert all(found[name].tobytes() == array.tobytes() for name, array in ARRAYS.items())
    if changed != whole and changed[-71:-64] == b"sha256:":
        with pytest.raises(BrokenFileError):
            read_npz(path)


@given(data=st.data())
@examples(short=100, long=2000)
def test_a_record_is_the_same_or_none(folder, data):
    record = {"stamp": "0123", "missing": ["a", "b"], "nested": {"x": [1, 2.5, None, True]}}
    path = folder / "file.json"
    write_record(path, record)
    path.write_bytes(data.draw(damaged(path.read_bytes())))
    assert survive("caches", lambda: read_record(path)) in (record, None)
