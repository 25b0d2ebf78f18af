"""Demonstration files of strangers: what refers elsewhere, claims too much, or is no number is refused in one line."""

import resource
import time
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from libero_env import memory
from libero_env.curating.curate import describe, examine, filter_demos
from libero_env.curating.video import check_video_path, write_video
from libero_env.demos import DemoWriter, hdf5
from libero_env.demos.contents import read_header
from libero_env.demos.observe import recorded_robot, recorded_task
from libero_env.demos.read import demo_lengths, iter_demos, read_demos, read_episodes
from libero_env.demos.replay import rerun_actions
from libero_env.demos.stored_model import read_fixture_poses
from libero_env.errors import DemoError, LiberoError
from libero_integrations.exports.demonstrations import export_demos
from tests.harness.demos import episode, header, write


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    """Return the bytes of a valid file."""
    file = tmp_path_factory.mktemp("valid") / "x.hdf5"
    return write(file, [episode(k, steps=4, size=8) for k in range(2)]).read_bytes()


@pytest.fixture
def path(tmp_path, content):
    (tmp_path / "foreign.hdf5").write_bytes(content)
    return tmp_path / "foreign.hdf5"


def damaged(path, change):
    with h5py.File(path, "r+") as handle:
        change(handle)
    return path


def refused(path, *words, read=read_demos):
    with pytest.raises(DemoError) as caught:
        list(read(path) or ())
    message = str(caught.value)
    assert "\n" not in message and all(word in message for word in (path.name, *words)), message


def put(key, value):
    def change(handle):
        if key in handle:
            del handle[key]
        handle[key] = value

    return change


def created(key, *shape, **options):
    def change(handle):
        if key in handle:
            del handle[key]
        handle.create_dataset(key, *shape, **options)

    return change


def without(*keys):
    return lambda handle: [handle.__delitem__(key) for key in keys]


def attribute(key, value, group="data"):
    return lambda handle: handle[group].attrs.__setitem__(key, value)


def virtual(handle):
    layout = h5py.VirtualLayout((4, 7), np.float64)
    layout[:] = h5py.VirtualSource("elsewhere.hdf5", "x", (4, 7))
    handle.create_virtual_dataset("data/demo_0/x", layout)


@pytest.mark.parametrize(("change", "words"), [
    (put("data/demo_1", h5py.SoftLink("/nowhere")), ("data/demo_1", "soft link")),
    (put("mask", h5py.ExternalLink("other.hdf5", "/data")), ("mask", "another file")),
    (created("data/demo_0/x", (4, 8), np.uint8, external=[("/etc/passwd", 0, 32)]), ("demo_0/x", "other files")),
    (virtual, ("data/demo_0/x", "other files")),
    (lambda handle: handle["data"].__setitem__("again", handle["data"]), ("data/again", "within itself")),
    (lambda handle: handle.create_group("/".join(["x"] * 40)), ("too deep",)),
    (put("data/demo_0/kind", np.dtype("f8")), ("data/demo_0/kind", "named type")),
])  # fmt: skip
def test_a_file_stands_for_itself(path, change, words):
    damaged(path, change)
    for read in (read_demos, demo_lengths, read_header, read_episodes, describe):
        refused(path, *words, read=read)


@pytest.mark.parametrize(("change", "words"), [
    (created("data/demo_0/obs/agentview_rgb", (4, 1 << 19, 1 << 19, 3), np.uint8, chunks=(1, 64, 64, 3)),
     ("obs/agentview_rgb", "3.3 TB", "not complete")),
    (created("data/demo_0/states", (4, 1 << 40), float, chunks=(4, 16), fillvalue=7.0),
     ("demo_0/states", "35.2 TB", "not complete")),
    (created("data/demo_0/states", (4, 9), float, maxshape=(4, None), chunks=(4, 1 << 26)),
     ("demo_0/states", "chunks of 2.1 GB")),
    (lambda handle: put("data/demo_0/actions", np.full((4, 7), handle["data"].ref, h5py.ref_dtype))(handle),
     ("demo_0/actions", "float")),
    (created("data/demo_0/actions", (4, 7), h5py.vlen_dtype(float)), ("demo_0/actions", "float")),
    (put("data/demo_0/actions", np.zeros((4, 7), np.longdouble)), ("demo_0/actions", "64 bits")),
    (put("data/demo_0/actions", h5py.Empty("f8")), ("demo_0/actions", "empty")),
    (put("data/demo_0/obs/agentview_rgb", np.zeros((4, 8, 8, 3), np.uint16)), ("agentview_rgb", "8 bits")),
    (put("data/demo_01", h5py.Empty("f8")), ("demo_01", "demo_1", "same number")),
    (without("data"), ("data", "missing")),
    (without("data/demo_1/obs/agentview_rgb"), ("demo_1/obs/agentview_rgb", "missing", "eye_in_hand_rgb")),
    (without("data/demo_0", "data/demo_1"), ("no demonstrations",)),
    (put("data/demo_1/states", np.zeros((3, 30))), ("demo_1/states", "(3, 30)", "(4, any)")),
    (put("data/demo_1/obs/eye_in_hand_rgb", np.zeros((4, 4, 4, 3), np.uint8)), ("demo_1", "(8, 8, 3)")),
])  # fmt: skip
def test_shapes_types_and_sizes_are_checked_before_memory_is_asked_for(path, change, words):
    damaged(path, change)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 30), hard))
    try:
        refused(path, *words)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def test_a_filter_of_a_plugin_is_refused(path):
    def change(handle):
        del handle["data/demo_0/actions"]
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((4, 7))
        plist.set_filter(32001, h5py.h5z.FLAG_OPTIONAL, ())  # blosc
        space = h5py.h5s.create_simple((4, 7))
        h5py.h5d.create(handle["data/demo_0"].id, b"actions", h5py.h5t.NATIVE_DOUBLE, space, plist)

    refused(damaged(path, change), "demo_0/actions", "filter 32001", "h5repack")


@pytest.mark.parametrize("name", ["demo_\u00b2", "demo_x", "demo_1_", "demo_" + "9" * 5000, "other"])
def test_groups_of_other_names_are_no_demonstrations(path, name):
    damaged(path, lambda handle: handle["data"].create_group(name))
    assert [demo.name for demo in read_demos(path)] == ["demo_0", "demo_1"] and demo_lengths(path) == [4, 4]


def test_thousands_of_demonstrations_are_read_in_the_order_of_their_numbers(tmp_path):
    path = tmp_path / "many.hdf5"
    with h5py.File(path, "w") as handle:
        for k in reversed(range(1200)):
            handle[f"data/demo_{k}/actions"] = np.zeros((1 + k % 3, 7))
    start = time.process_time()
    assert demo_lengths(path) == [1 + k % 3 for k in range(1200)] and time.process_time() - start < 10


@pytest.mark.parametrize("bad", [np.nan, -np.inf, 1e30])
@pytest.mark.parametrize("key", ["actions", "expert_actions", "states", "obs/ee_pos", "obs/ee_states"])
def test_values_that_are_no_measurements_name_file_demonstration_key_and_step(path, key, bad):
    damaged(path, lambda handle: handle[f"data/demo_1/{key}"].__setitem__((2, 1), bad))
    labels = "executed" if key == "actions" else "expert"
    refused(path, f"demo_1/{key}", "step 2", "expected", read=lambda p: read_demos(p, labels=labels))
    refused(path, f"demo_1/{key}", "step 2", read=read_episodes)
    assert any(f"demo_1/{key}" in fault and "step 2" in fault for fault in examine(path).faults)


@pytest.mark.parametrize("dtype", [">f8", "<f4", ">f4", "<f2"])
def test_floats_of_other_widths_and_byte_orders_are_the_same_numbers(path, dtype):
    values = np.linspace(-1, 1, 28).reshape(4, 7).astype(dtype)
    for key in ("actions", "expert_actions", "obs/joint_states"):
        damaged(path, put(f"data/demo_0/{key}", values))
    demo = read_demos(path)[0]
    for found in (demo.actions, demo.obs["joint_states"]):
        assert found.dtype.isnative
        np.testing.assert_array_equal(found, values.astype(float))


@pytest.mark.parametrize("stated", [b"aligned", np.bytes_(b"libero"), "libero"])
def test_a_pairing_may_be_stored_as_bytes(path, stated):
    damaged(path, attribute("pairing", stated))
    expected = stated if isinstance(stated, str) else stated.decode()
    assert {demo.pairing for demo in read_demos(path)} == {expected}


@pytest.mark.parametrize("stated", ["bogus", "", b"\xff\xfe", 1, ["aligned"], h5py.Empty("f8")])
def test_an_unknown_pairing_is_refused(path, stated):
    damaged(path, attribute("pairing", stated))
    for read in (read_demos, iter_demos, read_header, lambda p: demo_lengths(p, pairing="aligned")):
        refused(path, "pairing", read=read)


@pytest.mark.parametrize(("key", "value", "words"), [
    ("robot", "sawyer", ("robot", "sawyer", "libero")),
    ("drawing", "crayon", ("drawing", "crayon")),
    ("total", "many", ("total", "many")),
    ("models", np.zeros(3), ("models",)),
    ("anything", h5py.Reference(), ("anything", "neither text nor numbers")),
    ("anything", b"\xff\xfe", ("anything", "damaged")),
])  # fmt: skip
def test_attributes_of_other_types_are_named(path, key, value, words):
    damaged(path, attribute(key, value))
    for read in (read_header, examine, recorded_robot, describe):
        refused(path, *words, read=lambda p, read=read: [read(p)])


@pytest.mark.parametrize("text", ["{", "[]", "[" * 100_000, "7"])
def test_attributes_of_json_are_checked(path, text, tmp_path):
    pytest.importorskip("pyarrow"), pytest.importorskip("av")
    damaged(path, attribute("problem_info", text))
    refused(path, "problem_info", "JSON", read=lambda p: export_demos([p], tmp_path / "out"))
    assert not (tmp_path / "out").exists()
    damaged(path, attribute("models", text))
    refused(path, "models", "JSON", read=describe)


@pytest.mark.parametrize(("key", "value"), [
    ("success", "no"), ("success", 2), ("success", np.nan), ("fixtures", np.full((2, 7), np.nan)),
    ("fixtures", np.zeros((2, 7))), ("fixtures", np.zeros(7)), ("fixtures", "there"), ("failed_attempts", "many"),
    ("failed_attempts", -1), ("model_file", 3.0)
])  # fmt: skip
def test_attributes_of_a_demonstration_are_checked(path, key, value):
    damaged(path, attribute(key, value, "data/demo_1"))
    refused(path, "demo_1", key, read=read_episodes)


@pytest.mark.parametrize(("xml", "words"), [
    ("<mujoco", "not XML"),
    ('<x><body name="stove_main" pos="a b c"/></x>', "expected numbers"),
    ('<x><body name="stove_main" pos="1 2"/></x>', "3 and 4 numbers"),
    ('<x><body name="stove_main" pos="nan 2 3"/></x>', "3 and 4 numbers"),
    ('<x><body name="stove_main" quat="0 0 0 0"/></x>', "expected a rotation"),
    ('<x><replicate count="100000"/></x>', "element <replicate>"),
    ("<x>" + "<geom/>" * 20_001 + "</x>", "over 20000 elements"),
    ('<x><size nkey="1000000000"/></x>', "reserves nkey"),
])  # fmt: skip
def test_fixtures_of_a_stored_model_are_poses(xml, words):
    with pytest.raises(DemoError, match=words):
        read_fixture_poses(xml, SimpleNamespace(fixtures=("stove",)), "x.hdf5: demo_0/model_file")


def test_a_damaged_heap_of_texts_is_refused_instead_of_read_for_ever(path):
    content = bytearray(path.read_bytes())
    start = content.index(b"GCOL")
    content[start + 16 : start + 48] = bytes(32)  # the first object of the heap
    path.write_bytes(content)
    refused(path, "texts", "damaged")


def test_a_heap_within_data_is_no_heap(path):
    damaged(path, lambda handle: handle["data/demo_0/obs/agentview_rgb"].attrs.create("x", "text"))
    values = np.frombuffer((b"GCOL\x01\0\0\0" + bytes(40)) * 16, np.uint8).reshape(4, 8, 8, 3)
    damaged(path, put("data/demo_0/obs/agentview_rgb", values))
    assert (read_demos(path)[0].obs["agentview_rgb"][:, ::-1] == values).all()


def test_more_than_the_free_memory_is_refused(path, monkeypatch):
    monkeypatch.setattr(memory, "host_memory", lambda: (3000, 10_000))
    refused(path, "2 demonstrations", "3.0 kB are free")
    refused(path, "longest demonstration", "are free", read=iter_demos)
    refused(path, "demo_0", "are free", read=read_episodes)


def denied(*_):
    raise PermissionError(13, "denied")


def test_a_file_that_cannot_be_opened_now_is_not_called_broken(path, monkeypatch):
    monkeypatch.setattr(h5py, "File", denied)
    with pytest.raises(DemoError, match="being written") as caught:
        read_demos(path)
    assert not isinstance(caught.value, hdf5.BrokenDemoError)


def test_a_part_that_cannot_be_opened_now_is_kept(tmp_path, monkeypatch):
    writer = DemoWriter(tmp_path / "x.hdf5", header())
    part = writer.write(0, episode(0))
    with monkeypatch.context() as patch:
        patch.setattr(h5py, "File", denied)
        with pytest.raises(DemoError, match="denied"):
            writer.recorded()
    assert part.exists() and writer.recorded() == {0}


def test_parts_of_another_file_do_not_get_into_a_filtered_one(path, tmp_path):
    target = tmp_path / "filtered.hdf5"
    stale = DemoWriter(target, {**read_header(path), "filter": "without nothing"})
    for k in range(5):
        stale.write(k, episode(10 + k))
    assert len(filter_demos(path, target).lengths) == 2
    with pytest.raises(DemoError, match="exists"):
        rerun_actions(path, target)


@pytest.mark.parametrize("name", ["file/x.gif", "x.mp3", "x.hdf5"])
def test_videos_that_cannot_be_written_are_one_line_before_the_work(tmp_path, name):
    (tmp_path / "file").touch()
    with pytest.raises(LiberoError, match=r"x\.(gif cannot be written|(mp3|hdf5): videos are)"):
        check_video_path(tmp_path / name)
    with pytest.raises(LiberoError):
        write_video(tmp_path / name, np.zeros((2, 8, 8, 3), np.uint8), 20)


def test_what_no_reader_would_take_is_not_written(tmp_path):
    bad = episode(0)
    bad.states[3, 2] = np.nan
    with pytest.raises(DemoError, match=r"demo_7/states .*step 3.*not written"):
        DemoWriter(tmp_path / "x.hdf5", header()).write(7, bad)
    assert not (tmp_path / "x.hdf5.parts").exists()


def test_a_file_that_is_joined_again_keeps_its_permissions(path):
    path.chmod(0o640)
    writer = DemoWriter(path, header())
    writer.write(2, episode(2, steps=4, size=8))
    assert len(read_demos(writer.finish())) == 3 and path.stat().st_mode & 0o777 == 0o640


def test_the_task_of_a_stranger_may_be_named_anything(path):
    damaged(path, attribute("bddl_file_content", ""))
    for name in ("../../../etc/passwd", "\u202e", "x" * 10_000, "/", "libero_object/none.bddl"):
        damaged(path, attribute("bddl_file_name", name))
        refused(path, "bddl", read=recorded_task)
