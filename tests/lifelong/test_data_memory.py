"""Wherever frames are held, batches are the same to the bit; robomimic reads the same."""

import itertools
import multiprocessing
import os
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from libero_env.demos.read import Episode, demo_lengths, read_demos
from libero_env.errors import LiberoError
from lifelong.data import DemoSource, ReplayMemory, frame_cache, loading, open_windows
from lifelong.data.frame_cache import FrameFile, cache_root
from lifelong.data.loading import choose_memory
from lifelong.data.windows import JoinedWindows, WindowSubset, batches_in_order
from lifelong.errors import DataError
from lifelong.streams import StageWindows
from lifelong.types import Batch, PolicySpec

SPEC = PolicySpec(image_size=(6, 8), language_dim=4, seq_len=5)
LENGTHS = (7, 2, 4, 12)
LANGUAGE = torch.arange(4.0)
CPU, GPU = torch.device("cpu"), torch.device("cuda")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def write_file(
    path: Path,
    seed: int = 0,
    lengths: tuple[int, ...] = LENGTHS,
    pairing: str = "libero",
    expert: bool = False,
) -> Path:
    """Write a demonstration file in the original's layout, with images upside down."""
    rng = np.random.default_rng(seed)
    with h5py.File(path, "w") as file:
        file.create_group("data").attrs["pairing"] = pairing
        for number, steps in enumerate(lengths):
            group = file.create_group(f"data/demo_{number}")
            group.attrs["num_samples"] = steps
            group["actions"] = rng.uniform(-1, 1, (steps, 7))
            if expert:
                group["expert_actions"] = rng.uniform(-1, 1, (steps, 7))
            for view in SPEC.views:
                group[f"obs/{view}"] = rng.integers(0, 256, (steps, *SPEC.image_size, 3), dtype=np.uint8)
            for key, size in SPEC.proprio.items():
                group[f"obs/{key}"] = rng.normal(size=(steps, size))
    return path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write_file(tmp_path / "task_demo.hdf5")


def assert_same(one: Batch, other: Batch) -> None:
    one, other = one.to("cpu"), other.to("cpu")
    assert torch.equal(one.observation.images, other.observation.images)
    assert one.observation.images.dtype == other.observation.images.dtype == torch.uint8
    assert torch.equal(one.observation.language, other.observation.language)
    assert one.observation.proprio.keys() == other.observation.proprio.keys()
    for name, values in one.observation.proprio.items():
        assert torch.equal(values, other.observation.proprio[name])
    for name in ("actions", "task_ids", "window_ids"):
        assert torch.equal(getattr(one, name), getattr(other, name))


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
    expert = write_file(path.with_name("other_demo.hdf5"), expert=True)
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
    write_file(path, seed=1)
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


def test_replay_memory_accepts_windows_held_on_disk(path: Path) -> None:
    def drawn(memory: str) -> Batch:
        replay, draws = ReplayMemory(9), torch.Generator().manual_seed(0)
        replay.add(open_windows(DemoSource(path, SPEC), language=LANGUAGE, memory=memory), draws)
        return replay.sample(6, draws)

    assert_same(drawn("disk"), drawn("host"))


def test_lengths_are_those_of_the_demonstrations(path: Path) -> None:
    for pairing in ("stored", "aligned"):
        for limit in (None, 2):
            found: list[Episode] = read_demos(path, [], limit, pairing=pairing)
            assert demo_lengths(path, limit, pairing=pairing) == [len(demo) for demo in found]
