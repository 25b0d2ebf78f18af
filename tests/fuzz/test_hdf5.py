"""Demonstration files, altered in their structure or in their bytes, read in every way that training and tools do."""

from functools import lru_cache

import h5py
import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from libero_env.curating.curate import describe, examine
from libero_env.demos.contents import read_header
from libero_env.demos.observe import recorded_robot
from libero_env.demos.read import demo_lengths, read_demos, read_episodes
from lifelong.data import DemoSource, SequenceVLDataset
from lifelong.types import PolicySpec
from tests.harness.fuzz import examples, survive
from tests.harness.mutations import damaged

SPEC = PolicySpec(
    views=("agentview_rgb",), image_size=(4, 4), proprio={"ee_pos": 3}, language_dim=2, seq_len=3
)
ARRAYS = ("actions", "expert_actions", "states", "rewards", "dones", "obs", "obs/agentview_rgb", "obs/ee_pos")
PLACES = ("data", "data/demo_0", "data/demo_1", *(f"data/demo_{k}/{key}" for k in (0, 1) for key in ARRAYS))
NAMES = ("demo_0", "demo_01", "demo_2", "demo_\u00b2", "demo_-1", "..", "a b", "x" * 300, "obs", "caf\u00e9")
NUMBERS = (0, 1, -1, 255, 1e-320, 1e30, np.nan, np.inf, -np.inf, 3.5)
TEXTS = (
    "", "aligned", "libero", "bogus", "{", "[" * 5000, "../../etc/passwd", "a\nb", "\u202e", "$x$", "NaN"
)  # fmt: skip
SHAPES = (
    (), (0,), (3,), (3, 7), (4, 7), (0, 7), (3, 7, 1), (3, 4, 4, 3), (1 << 40,), (3, 1 << 30), (1 << 62, 7)
)  # fmt: skip
TYPES = ("f8", ">f8", "f4", "f2", "i8", "u1", ">u2", "c16", "?", "S3", "g", "i1")
OBJECTS = (h5py.Reference, h5py.RegionReference)


@lru_cache
def valid(libver: str, chunked: bool) -> bytes:
    """Return a small valid file: two demonstrations of three and four steps."""
    rng = np.random.default_rng(0)
    options = {"chunks": True, "compression": "gzip", "shuffle": True} if chunked else {}
    with h5py.File("memory", "w", driver="core", backing_store=False, libver=libver) as handle:
        data = handle.create_group("data")
        data.attrs.update(
            pairing="libero", num_demos=2, total=7, problem_info="{}", bddl_file_content="(define)"
        )
        for k, steps in enumerate((3, 4)):
            demo = data.create_group(f"demo_{k}")
            demo.attrs.update(num_samples=steps, success=True, model_file="<mujoco/>" * 30)
            for key, width in (("actions", 7), ("expert_actions", 7), ("states", 9), ("obs/ee_pos", 3)):
                demo.create_dataset(key, data=rng.uniform(-1, 1, (steps, width)), **options)
            demo.create_dataset(
                "obs/agentview_rgb", data=rng.integers(0, 256, (steps, 4, 4, 3), np.uint8), **options
            )
            demo["rewards"] = demo["dones"] = np.eye(steps, dtype=np.uint8)[-1]
        handle.flush()
        return handle.id.get_file_image()


FILES = st.tuples(st.sampled_from(("earliest", "latest")), st.booleans())  # arguments of `valid`


def read_all(path):
    """Read a file as training and the tools do; each may refuse it."""
    tools = (read_demos, demo_lengths, read_header, examine, recorded_robot, describe)
    for read in (*tools, lambda p: list(read_episodes(p)), windows):
        survive("hdf5", lambda read=read: read(path))


def windows(path):
    dataset = SequenceVLDataset.from_source(DemoSource(path, SPEC), language=torch.zeros(2))
    batch = dataset.batch(torch.arange(len(dataset)))
    assert batch.actions.isfinite().all() and batch.observation.proprio["ee_pos"].isfinite().all()
    return batch


def replace(handle, place, value, **options):
    if place in handle:
        del handle[place]
    if isinstance(value, h5py.SoftLink | h5py.ExternalLink):
        handle[place] = value
    else:
        handle.create_dataset(place, data=value, **options)


@st.composite
def changes(draw):
    """Draw one change of a file's structure."""
    place, kind = draw(st.sampled_from(PLACES)), draw(st.integers(0, 11))
    name = f"data/{draw(st.sampled_from(NAMES))}"
    number, text = draw(st.sampled_from(NUMBERS)), draw(st.sampled_from(TEXTS))
    shape, dtype = draw(st.sampled_from(SHAPES)), draw(st.sampled_from(TYPES))
    key = draw(
        st.sampled_from(
            ("pairing", "success", "total", "models", "fixtures", "robot", "failed_attempts", "x")
        )
    )
    target = draw(st.sampled_from((place, "/", name, "/data", "/data/demo_0")))

    def apply(handle):
        small = np.prod([float(n) for n in shape]) < 1e4
        match kind:
            case 0:
                replace(handle, place, h5py.SoftLink(target))
            case 1:
                replace(handle, place, h5py.ExternalLink("/etc/passwd", target))
            case 2:
                handle[name] = handle[place]
            case 3:
                del handle[place]
            case 4:
                replace(handle, place, np.full(shape if small else (3, 7), number, "f8").astype(dtype))
            case 5:
                if place in handle:
                    del handle[place]
                handle.create_dataset(place, shape, dtype, chunks=True if shape and 0 not in shape else None)
            case 6:
                handle[place][...] = number
            case 7:
                handle[place].attrs[key] = text
            case 8:
                handle[place].attrs[key] = np.full(shape if small else 3, number)
            case 9:
                handle[place].attrs[key] = text.encode() + b"\xff"
            case 10:
                handle[place].attrs.create(key, handle.ref, dtype=h5py.ref_dtype)
            case 11:
                if place in handle:
                    del handle[place]
                handle.create_dataset(place, (3, 7), "f8", external=[("/etc/passwd", 0, 168)])

    return apply


@given(FILES, st.lists(changes(), min_size=1, max_size=3))
@examples(short=40, long=1000)
def test_other_structures_are_read_or_refused(tmp_path_factory, kind, applied):
    path = tmp_path_factory.mktemp("fuzz") / "x.hdf5"
    path.write_bytes(valid(*kind))
    with h5py.File(path, "r+") as handle, np.errstate(all="ignore"):
        for change in applied:
            try:
                change(handle)
            except (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError, OverflowError):
                continue  # this file cannot be changed in this way
    read_all(path)
    path.unlink()


@given(FILES.flatmap(lambda kind: damaged(valid(*kind))))
@examples(short=60, long=2000)
def test_other_bytes_are_read_or_refused(tmp_path_factory, altered):
    path = tmp_path_factory.mktemp("fuzz") / "x.hdf5"
    path.write_bytes(altered)
    read_all(path)
    path.unlink()
