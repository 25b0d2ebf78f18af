"""The LeRobot data set: its tables agree with each other, its videos with the pictures, and both with the files."""

import json
import os
import sys

import numpy as np
import pytest

from libero_env.curating.video import AV1, Mp4Writer
from libero_env.demos.read import read_demos
from libero_env.errors import DemoError, LiberoError
from libero_integrations.exports.demonstrations import ORIGIN, export_demos, export_published
from tests.harness.demos import episode, write

av = pytest.importorskip("av")
parquet = pytest.importorskip("pyarrow.parquet")
STEPS, SIZE = (9, 14, 11), 32


def smooth(seed, steps, size=SIZE):
    """Return an episode whose images change slowly, so that H.264 preserves them."""
    one = episode(seed, steps, size)
    ramp = np.linspace(0, 200, size)[:, None] * np.ones((1, size))
    for k, key in enumerate(("agentview_rgb", "eye_in_hand_rgb")):
        frames = np.stack([ramp + 4 * t + 10 * seed + 5 * k for t in range(steps)]) % 256
        one.obs[key] = np.repeat(np.minimum(frames, 255).astype(np.uint8)[..., None], 3, axis=3)
    return one


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demos")
    first = write(folder / "a.hdf5", [smooth(0, STEPS[0]), smooth(1, STEPS[1])])
    info = json.dumps({"language_instruction": "do something else"})
    return [first, write(folder / "b.hdf5", [smooth(2, STEPS[2])], problem_info=info)]


@pytest.fixture(scope="module")
def root(files, tmp_path_factory):
    out = tmp_path_factory.mktemp("lerobot") / "set"
    assert export_demos(files, out, progress=False) == (3, sum(STEPS))
    return out


@pytest.fixture(scope="module")
def info(root):
    return json.loads((root / "meta/info.json").read_text())


@pytest.fixture(scope="module")
def episodes(root):
    return parquet.read_table(root / "meta/episodes/chunk-000/file-000.parquet").to_pylist()


def test_numbers_equal_those_of_the_files(root, files):
    table = parquet.read_table(root / "data/chunk-000/file-000.parquet")
    demos = [demo for file in files for demo in read_demos(file)]
    action = np.array(table["action"].to_pylist())
    np.testing.assert_allclose(action, np.concatenate([demo.actions for demo in demos]), atol=1e-6)
    state = np.array(table["observation.state"].to_pylist())
    keys = ("ee_pos", "ee_ori", "gripper_states")
    whole = np.concatenate([np.concatenate([demo.obs[key] for key in keys], axis=1) for demo in demos])
    np.testing.assert_allclose(state, whole, atol=1e-6)
    assert table["index"].to_pylist() == list(range(sum(STEPS)))
    assert table["frame_index"].to_pylist() == [t for n in STEPS for t in range(n)]
    assert table["task_index"].to_pylist() == [0] * (STEPS[0] + STEPS[1]) + [1] * STEPS[2]
    assert sum(table["next.done"].to_pylist()) == 3
    np.testing.assert_allclose(table["timestamp"].to_numpy(), table["frame_index"].to_numpy() / 20, atol=1e-6)


def test_every_column_is_declared_and_every_declared_column_exists(root, info):
    schema = parquet.read_schema(root / "data/chunk-000/file-000.parquet")
    declared = {key: f for key, f in info["features"].items() if f["dtype"] != "video"}
    assert set(schema.names) == declared.keys()
    for key, feature in declared.items():
        kind, shape = schema.field(key).type, feature["shape"]
        inner = kind.value_type if shape != [1] else kind
        assert str(inner).replace("float", "float32").replace("float3232", "float32") == feature["dtype"]
        assert shape == [1] or kind.list_size == shape[0]
        assert feature["names"] is None or len(feature["names"]) == shape[0]


def test_totals_are_those_of_the_episodes(info, episodes):
    assert info["codebase_version"] == "v3.0" and info["fps"] == 20
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, sum(STEPS), 2)
    assert [e["length"] for e in episodes] == list(STEPS) and info["splits"] == {"train": "0:3"}
    ends = [(e["dataset_from_index"], e["dataset_to_index"]) for e in episodes]
    assert ends == [(0, 9), (9, 23), (23, 34)]


@pytest.mark.parametrize(("camera", "key"), [("image", "agentview_rgb"), ("image2", "eye_in_hand_rgb")])
def test_frames_are_where_the_episode_table_says(root, info, episodes, files, camera, key):
    demos, feature = [demo for file in files for demo in read_demos(file)], f"observation.images.{camera}"
    assert info["features"][feature]["shape"] == [SIZE, SIZE, 3]
    for one, demo in zip(episodes, demos, strict=True):
        where = {k: one[f"videos/{feature}/{k}"] for k in ("chunk_index", "file_index")}
        with av.open(str(root / info["video_path"].format(video_key=feature, **where))) as video:
            frames = {round(f.time, 6): f.to_ndarray(format="rgb24") for f in video.decode(video=0)}
        start = one[f"videos/{feature}/from_timestamp"]
        assert one[f"videos/{feature}/to_timestamp"] == pytest.approx(start + len(demo) / 20)
        for t in range(len(demo)):
            assert np.abs(frames[round(start + t / 20, 6)].astype(int) - demo.obs[key][t]).mean() < 4.0


def test_a_full_video_is_continued_in_the_next_file(files, tmp_path):
    export_demos(files, tmp_path / "set", video_mb=0.0, progress=False)
    assert json.loads((tmp_path / "set/meta/info.json").read_text())["video_files_size_in_mb"] == 0.0
    key, begins = "videos/observation.images.image", {}
    for row in parquet.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").to_pylist():
        begins.setdefault(row[f"{key}/file_index"], []).append(row[f"{key}/from_timestamp"])
    videos = sorted(path.name for path in (tmp_path / "set" / key / "chunk-000").iterdir())
    assert videos == [f"file-{i:03d}.mp4" for i in sorted(begins)] and len(videos) > 1
    assert all(times[0] == 0.0 and times == sorted(times) for times in begins.values())


@pytest.mark.skipif(sys.platform != "linux", reason="priorities of Linux")
def test_an_encoder_takes_no_real_time_from_the_machine(tmp_path):
    """As root, SVT-AV1 makes the thread that opens it, and its own, real-time ones."""
    before = os.sched_getscheduler(0)
    with Mp4Writer(tmp_path / "film.mp4", 20, AV1) as film:
        film.add(np.zeros((2, 64, 64, 3), np.uint8))
        assert {os.sched_getscheduler(int(thread)) for thread in os.listdir("/proc/self/task")} == {before}
    assert os.sched_getscheduler(0) == before


def test_statistics_cover_every_feature(root, info, episodes):
    stats = json.loads((root / "meta/stats.json").read_text())
    assert stats.keys() == info["features"].keys()
    for key, found in stats.items():
        per_episode = {name for name in episodes[0] if name.startswith(f"stats/{key}/")}
        assert per_episode == {f"stats/{key}/{name}" for name in found}
        assert found["count"] == [sum(STEPS)]
    actions = parquet.read_table(root / "data/chunk-000/file-000.parquet")["action"].to_pylist()
    np.testing.assert_allclose(stats["action"]["mean"], np.mean(actions, axis=0), atol=1e-6)


def test_pandas_sees_tasks_as_the_index(root):
    pandas = pytest.importorskip("pandas")
    tasks = pandas.read_parquet(root / "meta/tasks.parquet")
    assert tasks.loc["do something else"].task_index == 1 and tasks.index.name == "task"


def test_groots_form_says_where_the_parts_are(files, tmp_path):
    root = tmp_path / "set"
    assert export_demos(files, root, "gr00t", progress=False) == (3, sum(STEPS))
    info = json.loads((root / "meta/info.json").read_text())
    assert (info["codebase_version"], info["total_videos"], info["fps"]) == ("v2.1", 6, 20)
    modality = json.loads((root / "meta/modality.json").read_text())
    demos = [demo for file in files for demo in read_demos(file)]
    lines = [json.loads(line) for line in (root / "meta/episodes_stats.jsonl").read_text().splitlines()]
    for number, demo in enumerate(demos):
        file = {"episode_chunk": 0, "episode_index": number}
        table = parquet.read_table(root / info["data_path"].format(**file))
        state = np.array(table["observation.state"].to_pylist())
        action = np.array(table["action"].to_pylist())

        opens = 1.0 - np.clip(demo.actions[:, 6:], 0.0, 1.0)  # 1 opens, 0 closes
        parts = [("state", "z", demo.obs["ee_pos"][:, 2:]), ("state", "yaw", demo.obs["ee_ori"][:, 2:])]
        parts += [("state", "gripper", demo.obs["gripper_states"]), ("action", "gripper", opens)]
        for of, key, expected in [*parts, ("action", "roll", demo.actions[:, 3:4])]:
            place = slice(modality[of][key]["start"], modality[of][key]["end"])
            found = {"state": state, "action": action}[of][:, place]
            np.testing.assert_allclose(found, expected, atol=1e-6, err_msg=f"{of} {key}")
        key = modality["annotation"]["human.action.task_description"]["original_key"]
        assert table[key].to_pylist() == [int(number == 2)] * len(demo)
        for name, feature in (("agentview_rgb", "image"), ("eye_in_hand_rgb", "wrist_image")):
            video = info["video_path"].format(video_key=modality["video"][feature]["original_key"], **file)
            with av.open(str(root / video)) as opened:
                frames = [frame.to_ndarray(format="rgb24") for frame in opened.decode(video=0)]
            assert np.abs(np.array(frames, int) - demo.obs[name]).mean() < 4.0
        assert lines[number]["episode_index"] == number
        np.testing.assert_allclose(lines[number]["stats"]["action"]["max"], action.max(axis=0), atol=1e-6)
    assert json.loads((root / "meta/stats.json").read_text()).keys() == info["features"].keys()


def test_files_that_do_not_fit_leave_no_data_set(files, tmp_path):
    other = write(tmp_path / "other.hdf5", [smooth(0, 5, 16)])
    with pytest.raises(DemoError, match=r"other.hdf5: demo_0 has images .*16"):
        export_demos([files[0], other], tmp_path / "set", progress=False)
    assert not (tmp_path / "set").exists()
    odd = write(tmp_path / "odd.hdf5", [smooth(0, 5, 15)])
    with pytest.raises(LiberoError, match=r"odd.hdf5: demo_0 has images of 15x15 .*rerender --size"):
        export_demos([odd], tmp_path / "set", progress=False)
    (tmp_path / "set").mkdir()
    with pytest.raises(DemoError, match="exists"):
        export_demos(files, tmp_path / "set", progress=False)


@pytest.mark.parametrize(
    ("form", "camera"), [("lerobot", "image2"), ("gr00t", "wrist_image"), ("rlds", "state")]
)
def test_a_camera_with_the_name_of_another_feature_is_refused(form, camera, tmp_path):
    one = episode(0, 5)
    one.obs[f"{camera}_rgb"] = one.obs["agentview_rgb"]
    file = write(tmp_path / "more.hdf5", [one])
    with pytest.raises(DemoError, match=rf"more.hdf5: demo_0 has a camera '{camera}'.*another name"):
        export_demos([file], tmp_path / "set", form, progress=False)


def test_robots_drawings_and_perturbations_are_stated(files, tmp_path):
    stated = {"generator": "x", "robot": "robosuite-1.4.1", "perturb": "light=0.5"}
    other = write(tmp_path / "b.hdf5", [smooth(2, 5)], **stated)
    with pytest.raises(DemoError, match=r"differ in expert: not stated of .*, x of .*b.hdf5.*--despite exp"):
        export_demos([files[0], other], tmp_path / "set", progress=False)
    export_demos([files[0], other], tmp_path / "set", progress=False, despite=["expert"])
    origin = json.loads((tmp_path / "set" / ORIGIN).read_text())
    assert origin["robot"] == "libero, robosuite-1.4.1" and origin["perturb"] == "light=0.5; none"
    assert origin["drawing"] == "fast; not stated"
    assert origin["expert"] == "not stated; x" and origin["actions_are"] == "intended"
    with pytest.raises(DemoError, match=r"b.hdf5 was rendered under light=0.5"):
        export_published([other], tmp_path / "none", "lerobot/libero", progress=False)
