"""Files of initial states: valid ones with parts changed, and what a hostile pickle or zip would try."""

import io
import pickle
import pickletools
import struct
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from libero_env.init_states.pickles import read_states, write_states
from tests.harness.fuzz import examples, survive
from tests.harness.mutations import damaged

ROWS = np.random.default_rng(3).normal(size=(4, 6))
NUMBERS = st.sampled_from((0, 1, -1, 2, 7, 255, 1 << 15, (1 << 31) - 1, 1 << 40, 1 << 200, -(1 << 63)))
NAMES = st.sampled_from(
    ("torch DoubleStorage", "torch FloatStorage", "numpy ndarray", "numpy dtype", "collections OrderedDict")
    + ("_codecs encode", "posix system", "builtins eval", "numpy.core.multiarray _reconstruct")
    + ("torch._utils _rebuild_tensor_v2", "numpy.core.numeric _frombuffer", "libero_env.storage atomic_path")
)
# whole operations that are put between those of a valid pickle
INSERTED = st.sampled_from(
    (
        b"}", b"]", b"(", b"t", b"b", b"R", b"0", b"1", b"2", b"N", b"Q", b"\x81", b"\x85", b"\x94", b"}b", b")R"
    )
    + (
        b"}X\x05\x00\x00\x00dtypeK\x01sb",
        b"r\xff\xff\xff\xff",
        b"j\xff\xff\xff\xff",
        b"h\x00",
        b"h\x03",
        b"h\x0e",
    )
    + (
        b"\x8e" + struct.pack("<Q", 1 << 40),
        b"\x8b" + struct.pack("<i", 1 << 30),
        b"(" * 3000,
        b"\x85" * 3000,
    )
)  # fmt: skip


def pickled(protocol: int) -> bytes:
    return pickle.dumps(ROWS, protocol)


def zipped(content: bytes, compression: int = zipfile.ZIP_STORED, root: str = "archive") -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compression) as archive:
        archive.writestr(f"{root}/data.pkl", content)
    return stream.getvalue()


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """Return a file with the rows that it has."""
    folder = tmp_path_factory.mktemp("states")
    write_states(folder / "array", ROWS)
    return {folder / "array": ROWS}


def check(good, folder, content: bytes) -> None:
    """Read a file, and then the good ones, which must have the same bits as ever."""
    (folder / "file").write_bytes(content)
    found = survive("initial states", lambda: read_states(folder / "file"))
    if found is not None:
        assert found.dtype == np.float64 and found.ndim == 2 and np.isfinite(found).all()
        assert 0 < found.nbytes <= 8 << 24
    for path, rows in good.items():
        assert read_states(path).tobytes() == rows.tobytes()


@pytest.mark.parametrize("protocol", range(6))
def test_arrays_of_every_protocol_are_read(tmp_path, protocol):
    for rows in (ROWS, np.asfortranarray(ROWS), ROWS.astype(">f8"), ROWS.astype("f4"), ROWS.astype("i8")):
        (tmp_path / "bare").write_bytes(pickle.dumps(rows, protocol))
        (tmp_path / "zip").write_bytes(zipped(pickle.dumps(rows, protocol)))
        for name in ("bare", "zip"):
            assert (read_states(tmp_path / name) == rows).all()


@st.composite
def changed_pickles(draw):
    """Return a valid pickle with operations that are changed, dropped, doubled, swapped or put in between."""
    content = draw(st.sampled_from([pickled(protocol) for protocol in range(6)]))
    starts = [at for _, _, at in pickletools.genops(content)]
    parts = [content[a:b] for a, b in zip(starts, [*starts[1:], len(content)], strict=True)]
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(parts) - 1))
        kind = draw(st.sampled_from(("drop", "double", "swap", "insert", "number", "name", "flip")))
        if kind == "drop":
            parts[at] = b""
        elif kind == "double":
            parts[at] *= 2
        elif kind == "swap":
            other = draw(st.integers(0, len(parts) - 1))
            parts[at], parts[other] = parts[other], parts[at]
        elif kind == "insert":
            parts[at] += draw(INSERTED)
        elif kind == "number":
            parts[at] = pickle.dumps(draw(NUMBERS), 2)[2:-1]
        elif kind == "name":
            parts[at] = b"c" + draw(NAMES).replace(" ", "\n").encode() + b"\n"
        elif parts[at]:
            i = draw(st.integers(0, len(parts[at]) - 1))
            parts[at] = parts[at][:i] + bytes([draw(st.integers(0, 255))]) + parts[at][i + 1 :]
    return b"".join(parts)


@given(content=changed_pickles(), wrapped=st.booleans())
@examples(short=150, long=2500)
def test_changed_pickles_are_read_or_refused(good, tmp_path_factory, content, wrapped):
    check(good, tmp_path_factory.getbasetemp(), zipped(content) if wrapped else content)


COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA)


@given(content=st.sampled_from(COMPRESSIONS).flatmap(lambda kind: damaged(zipped(pickled(2), kind))))
@examples(short=100, long=2000)
def test_changed_zips_are_read_or_refused(good, tmp_path_factory, content):
    check(good, tmp_path_factory.getbasetemp(), content)
