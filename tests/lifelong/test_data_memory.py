"""However frames are read and held, batches are the same to the bit, as robomimic reads them; or one line."""

import itertools
import multiprocessing
import os
from dataclasses import asdict, replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from libero_env.errors import LiberoError
from lifelong.data import DemoSource, SequenceVLDataset, dataset, frame_cache, loading, open_windows
from lifelong.data.frame_cache import FrameFile, cache_root
from lifelong.data.loading import choose_memory
from lifelong.data.windows import JoinedWindows, WindowSubset, batches_in_order
from lifelong.errors import DataError
from lifelong.streams import StageWindows
from lifelong.types import Batch, PolicySpec
from tests.harness import sequences
from tests.harness.demos import write_noise
from tests.harness.fuzz import examples
from tests.harness.robomimic_windows import read_with_robomimic

SPEC = PolicySpec(image_size=(6, 8), language_dim=4, seq_len=5)
LENGTHS = (7, 2, 4, 12)
LANGUAGE = torch.arange(4.0)
CPU, GPU = torch.device("cpu"), torch.device("cuda")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write_noise(tmp_path / "task_demo.hdf5", SPEC, LENGTHS)


def assert_same(one: Batch, other: Batch) -> None:
    sequences.assert_same(
        *(asdict(replace(batch.to("cpu"), is_pad=batch.padding().cpu())) for batch in (one, other))
    )


def everything(dataset) -> Batch:
    """Return all windows, in another order than that of the file."""
    return dataset.batch(torch.randperm(len(dataset), generator=torch.Generator().manual_seed(1)))


@pytest.mark.gpu
@pytest.mark.parametrize("memory", ["auto", "host", "pinned", "device", "disk"])
def test_batches_are_the_same_on_a_gpu(path: Path, memory: str) -> None:
    if not torch.cuda.is_available():
        pytest.skip("no GPU")
    source = DemoSource(path, SPEC)
    held = open_windows(source, language=LANGUAGE, device="cuda", memory=memory)
    batches = [held.batch(torch.arange(4) + k % 8) for k in range(64)]  # page-locked memory is used again
    assert all(b.actions.is_cuda and b.observation.images.is_cuda for b in batches)
    plain = open_windows(source, language=LANGUAGE, memory="host")
    for k, batch in enumerate(batches):
        assert_same(batch, plain.batch(torch.arange(4) + k % 8))


def test_batches_are_on_the_requested_device(path: Path) -> None:
    held = open_windows(DemoSource(path, SPEC), language=LANGUAGE, device="meta", memory="host")
    batch = held.batch(torch.arange(3))
    assert held.images.device == CPU and held.images.nbytes == DemoSource(path, SPEC).nbytes()
    assert batch.observation.images.device == batch.actions.device == torch.device("meta")


def test_frames_are_written_once_and_found_again(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = DemoSource(path, SPEC)
    first = open_windows(source, language=LANGUAGE, memory="disk")
    monkeypatch.setattr(frame_cache, "_write_arrays", lambda *_: pytest.fail("written again"))
    again = open_windows(
        DemoSource(path, PolicySpec(image_size=(6, 8), language_dim=4, seq_len=2)),
        language=LANGUAGE,
        memory="disk",
    )
    assert torch.equal(again.images.to(CPU), first.images.to(CPU))
    assert again.batch(torch.arange(3)).actions.shape == (3, 2, 7)
    assert not list(cache_root().glob("*.part")) and not list(cache_root().glob(".*.part"))


def test_other_settings_have_other_frames(path: Path) -> None:
    expert = write_noise(path.with_name("other_demo.hdf5"), SPEC, LENGTHS, labels=True)
    kinds = [{}, {"limit": 2}, {"pairing": "stored"}, {"labels": "executed"}]
    for kind in kinds:
        source = DemoSource(expert, SPEC, **kind)
        plain = open_windows(source, language=LANGUAGE, memory="host")
        assert_same(everything(open_windows(source, language=LANGUAGE, memory="disk")), everything(plain))
    assert len([one for one in cache_root().glob("other_demo-*") if one.is_dir()]) == len(kinds)


def test_a_file_that_was_recorded_again_is_read_again(path: Path) -> None:
    source = DemoSource(path, SPEC)
    before = open_windows(source, language=LANGUAGE, memory="disk")
    kept, stat = before.images.to(CPU), path.stat()
    write_noise(path, SPEC, LENGTHS, seed=1)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))  # not even its time tells
    assert path.stat().st_size == stat.st_size
    after = open_windows(source, language=LANGUAGE, memory="disk")
    assert_same(everything(after), everything(open_windows(source, language=LANGUAGE, memory="host")))
    assert not torch.equal(after.images.to(CPU), kept)
    assert torch.equal(before.images.to(CPU), kept)  # whoever has the old frames open keeps them
    assert len([one for one in cache_root().glob("task_demo-*") if one.is_dir()]) == 1


def test_files_of_a_killed_process_are_not_taken_as_complete(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = DemoSource(path, SPEC)

    def killed(source: DemoSource, folder: Path) -> None:
        (folder / "images.u8").write_bytes(b"half")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(frame_cache, "_write_arrays", killed)
        patch.setattr(frame_cache.shutil, "rmtree", lambda *_, **__: None)  # a dead process cleans nothing up
        with pytest.raises(KeyboardInterrupt):
            open_windows(source, language=LANGUAGE, memory="disk")
    (left,) = cache_root().glob(".*.part")
    held = open_windows(source, language=LANGUAGE, memory="disk")
    assert_same(everything(held), everything(open_windows(source, language=LANGUAGE, memory="host")))
    assert not left.exists()


@pytest.mark.parametrize(
    ("name", "how"),
    [*itertools.product(["images.u8", "arrays.npz"], ["truncated", "changed"]), ("images.u8", "missing")],
)
def test_frames_that_are_broken_are_written_again(path: Path, caplog, name: str, how: str) -> None:
    source = DemoSource(path, SPEC)
    expected = everything(open_windows(source, language=LANGUAGE, memory="disk"))
    (file,) = cache_root().glob(f"task_demo-*/{name}")
    content = file.read_bytes()
    half = len(content) // 2
    file.unlink()  # the frames that are open keep it
    if how == "truncated":
        file.write_bytes(content[:half])
    elif how == "changed":
        file.write_bytes(content[:half] + bytes([content[half] ^ 4]) + content[half + 1 :])
    assert_same(everything(open_windows(source, language=LANGUAGE, memory="disk")), expected)
    (line,) = [m for m in caplog.messages if "made again" in m]
    assert line.startswith(str(file.parent)) and file.exists()


@pytest.fixture
def frames(tmp_path: Path) -> tuple[FrameFile, np.ndarray]:
    values = np.random.default_rng(0).integers(0, 256, (30, 2, 3), dtype=np.uint8)
    values.tofile(tmp_path / "frames")
    return FrameFile(tmp_path / "frames", values.shape), values


@pytest.mark.parametrize(
    "indices", [[], [0], [3, 4, 5, 5, 5], [29, 0, 1, 7, 6], list(range(30)), [4, 5, 4, 5, 6]]
)
def test_any_frames_are_read_from_a_file(frames, indices: list[int], monkeypatch) -> None:
    file, values = frames
    file.expect(torch.tensor(indices, dtype=torch.int64))  # changes nothing
    found = file.rows(torch.tensor(indices, dtype=torch.int64))
    assert found.dtype == torch.uint8 and np.array_equal(found.numpy(), values[indices])
    monkeypatch.delattr(os, "preadv")  # as on Windows
    assert torch.equal(file[torch.tensor(indices, dtype=torch.int64)], found)


def test_a_file_of_frames_that_is_cut_off_while_it_is_open_is_named(frames, tmp_path: Path) -> None:
    file, values = frames
    os.truncate(tmp_path / "frames", 6 * 20 + 3)
    assert np.array_equal(file.rows(torch.arange(20)).numpy(), values[:20])
    with pytest.raises(DataError, match=r"frames ends before frame 20 of 30.*same command again"):
        file.rows(torch.tensor([5, 20]))


def test_frames_on_disk_do_not_count_as_memory(tmp_path: Path) -> None:
    shape = (4000, 2, 64, 64, 3)
    (tmp_path / "frames").touch()
    os.truncate(tmp_path / "frames", int(np.prod(shape)))  # 98 MB of zeros, which take no space
    file, out = FrameFile(tmp_path / "frames", shape), torch.empty(40, *shape[1:], dtype=torch.uint8)

    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    before = resident()
    for indices in torch.randperm(4000, generator=torch.Generator().manual_seed(0)).split(40):
        assert not file.rows(indices, out).any()
    assert resident() - before < 20e6


def test_the_next_batch_is_read_ahead_in_every_kind_of_dataset(path: Path, monkeypatch) -> None:
    held = open_windows(DemoSource(path, SPEC), language=LANGUAGE, memory="disk")
    plain = open_windows(DemoSource(path, SPEC), language=LANGUAGE, memory="host")
    expected: list[list[int]] = []
    monkeypatch.setattr(FrameFile, "expect", lambda self, found: expected.append(found.tolist()))

    def joined(one):
        return JoinedWindows([one, WindowSubset(one, torch.tensor([4, 2]))])

    for wrap in (lambda one: one, joined, lambda one: StageWindows([one, one], 1)):
        expected.clear()
        size = len(wrap(plain))
        chunks = torch.randperm(size, generator=torch.Generator().manual_seed(1))[:6].split(2)
        both = [list(batches_in_order(wrap(dataset), chunks)) for dataset in (held, plain)]
        for one, other in zip(*both, strict=True):
            assert_same(one, other)
        assert len(both[0]) == 3 and len(expected) >= 2
    first, second = torch.arange(2), torch.arange(2, 4)
    expected.clear()
    list(batches_in_order(held, [first, second]))
    assert expected == [held.frames(second).flatten().tolist()]


def build(path: Path, counter: Path) -> None:
    """Open the frames, in another process, and report if they had to be written."""
    write = frame_cache._write_arrays

    def counted(source: DemoSource, folder: Path) -> None:
        with open(counter, "a") as file:
            file.write("written\n")
        write(source, folder)

    frame_cache._write_arrays = counted
    held = open_windows(DemoSource(path, SPEC), language=LANGUAGE, memory="disk")
    assert_same(everything(held), everything(open_windows(DemoSource(path, SPEC), language=LANGUAGE)))


@pytest.mark.slow
def test_one_of_several_processes_writes(path: Path, tmp_path: Path) -> None:
    counter, context = tmp_path / "written", multiprocessing.get_context("spawn")
    processes = [context.Process(target=build, args=(path, counter)) for _ in range(2)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(120)
    assert [p.exitcode for p in processes] == [0, 0]
    assert counter.read_text() == "written\n"


def test_a_full_disk_is_reported_and_leaves_nothing(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = type("Usage", (), {"free": 10})
    monkeypatch.setattr(frame_cache.shutil, "disk_usage", lambda _: usage)
    with pytest.raises(LiberoError, match=r"cannot be made.*free.*LIBERO_CACHE"):
        open_windows(DemoSource(path, SPEC), language=LANGUAGE, memory="disk")
    assert [p.suffix for p in cache_root().iterdir()] == [".lock"]


@pytest.mark.parametrize(("gpu", "host", "expected"), [
    ((90, 100), (90, 100), "device"),
    ((60, 100), (90, 100), "pinned"),  # 40 % of the GPU is left to training
    ((60, 100), (44, 100), "disk"), (None, (90, 100), "host"), (None, (44, 100), "disk"),
])  # fmt: skip
def test_auto_chooses_by_what_is_free(monkeypatch, gpu, host, expected) -> None:
    gib = 2**30
    monkeypatch.setattr(loading, "host_memory", lambda: tuple(gib * n for n in host))
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _: tuple(gib * n for n in gpu))
    assert choose_memory(21 * gib, GPU if gpu else CPU) == expected


@given(
    st.lists(st.integers(1, 6), min_size=1, max_size=4),
    st.sampled_from([None, "libero", b"libero", "aligned", b"aligned"]),
    st.sampled_from(["aligned", "stored"]),
    st.sampled_from(["expert", "executed"]),
    st.booleans(),
    st.none() | st.integers(1, 5),
)
@examples(short=25, long=400)
def test_windows_do_not_depend_on_how_they_are_read_and_held(
    tmp_path_factory, lengths, stated, pairing, read, labels, limit
):
    pytest.importorskip("robomimic.utils.dataset")
    path = write_noise(
        tmp_path_factory.mktemp("x") / "x_demo.hdf5",
        SPEC,
        lengths,
        pairing=stated,
        labels=labels,
        seed=sum(lengths),
    )
    shifted = pairing == "aligned" and stated in (None, "libero", b"libero")
    frames = sum(n - shifted for n in lengths[:limit])
    source = DemoSource(path, SPEC, limit, pairing, read)
    ways = [{"memory": memory} for memory in ("host", "disk", "device", "auto")]
    if not frames:
        for how in ways:
            with pytest.raises(DataError, match="demonstration"):
                open_windows(source, language=LANGUAGE, **how)
        return
    first, *others = (
        open_windows(source, language=LANGUAGE, **how).batch(torch.arange(frames)) for how in ways
    )
    others.append(read_with_robomimic(source, LANGUAGE))
    assert len(others[-1]) == frames
    for other in others:
        assert_same(first, other)
    with h5py.File(path) as file:  # written out: observation t with action t + 1, or with action t
        key = "expert_actions" if labels and read == "expert" else "actions"
        expected = np.concatenate(
            [file[f"data/demo_{k}/{key}"][shifted:] for k in range(len(lengths))][:limit]
        )
    assert torch.equal(first.actions[:, 0], torch.from_numpy(expected.astype(np.float32)))


def test_rows_that_were_never_filled_are_refused(tmp_path, monkeypatch):
    source = DemoSource(write_noise(tmp_path / "x_demo.hdf5", SPEC, (4, 3)), SPEC, pairing="stored")
    for wrong in ([4, 4], [4, 2], [4], [4, 3, 1]):
        monkeypatch.setattr(DemoSource, "lengths", wrong)
        with pytest.raises(DataError, match="changed meanwhile"):
            SequenceVLDataset.from_source(source, language=LANGUAGE)


def test_frames_that_do_not_fit_into_memory_are_refused_before_they_are_read(tmp_path, monkeypatch):
    path = write_noise(tmp_path / "x_demo.hdf5", SPEC, (4, 3))
    monkeypatch.setattr(loading, "host_memory", lambda: (100, 1000))
    monkeypatch.setattr(dataset.torch, "empty", None)
    with pytest.raises(
        DataError, match=r"needs 1\.4 kB of host memory and 100 B are free; set data\.memory=disk"
    ):
        open_windows(DemoSource(path, SPEC), language=LANGUAGE, memory="host")
