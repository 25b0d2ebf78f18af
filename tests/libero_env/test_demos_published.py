"""Exports in the layouts of published sets: their metadata to the letter, turned images, no no-ops, successes only.

The expected metadata are those of the data set cards: `physical-intelligence/libero` as it is there, `lerobot/libero`
as LeRobot's conversion of `HuggingFaceVLA/libero` to videos writes it (run by tests/integration/test_exported_sets.py).
"""

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from libero_env.demos import DemoWriter, RenderConfig
from libero_env.demos.contents import read_header
from libero_env.demos.observe import StateRenderer, recorded_task
from libero_env.demos.read import read_demos, read_episodes
from libero_env.errors import DemoError
from libero_env.tasks import get_task
from libero_integrations.exports.demonstrations import ORIGIN, export_demos, export_published
from libero_integrations.exports.regeneration import Regeneration, published_noop_steps, regenerate
from libero_integrations.imports.demonstrations import lerobot_files
from libero_integrations.imports.lerobot import decode_images
from tests.harness.demos import generate

av = pytest.importorskip("av")
parquet = pytest.importorskip("pyarrow.parquet")
pytestmark = pytest.mark.sim

HOW = Regeneration(settle_steps=0, labels="executed", assets="builtin", drawing="fast")
SMALL = replace(HOW, size=(16, 16))
CHECKED = (0, 20, 40)  # frames that are compared
NUMBER = {"shape": [1], "names": None}
IMAGE = {"shape": [256, 256, 3], "names": ["height", "width", "channel"]}
INDICES = dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), {"dtype": "int64", **NUMBER})
VIDEO = {
    "dtype": "video",
    **IMAGE,
    "fps": 10.0,
    "info": {"video.height": 256, "video.width": 256, "video.codec": "av1", "video.pix_fmt": "yuv420p",
     "video.is_depth_map": False, "video.fps": 10, "video.channels": 3, "has_audio": False},
}  # fmt: skip
FEATURES = {
    "lerobot/libero": {"observation.images.image": VIDEO, "observation.images.image2": VIDEO,
     "observation.state": {"dtype": "float32", "shape": [8], "names": ["state"], "fps": 10.0},
     "action": {"dtype": "float32", "shape": [7], "names": ["actions"], "fps": 10.0},
     "timestamp": {"dtype": "float32", **NUMBER}, **INDICES},
    "physical-intelligence/libero": {"image": {"dtype": "image", **IMAGE}, "wrist_image": {"dtype": "image", **IMAGE},
     "state": {"dtype": "float32", "shape": [8], "names": ["state"]},
     "actions": {"dtype": "float32", "shape": [7], "names": ["actions"]}, "timestamp": {"dtype": "float32", **NUMBER},
     **INDICES},
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def builtin_models():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LIBERO_ASSETS", "builtin")
        yield


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    out = tmp_path_factory.mktemp("demos") / "pick_up_the_milk_and_place_it_in_the_basket_demo.hdf5"
    return generate("libero_object/7", 1, path=out, camera_size=(16, 16), workers=1, progress=False)


@pytest.fixture(scope="module")
def episode(file):
    return next(read_episodes(file))


@pytest.fixture(scope="module")
def expected(file, episode):
    """The recorded states as pictures of 256 pixels, upright and not mirrored."""
    renderer = StateRenderer(recorded_task(file), RenderConfig(size=(256, 256)), "builtin")
    obs, _ = renderer.render_states(episode.states[list(CHECKED)], episode.fixtures)
    renderer.close()
    return obs


@pytest.fixture(scope="module")
def exported(file, tmp_path_factory):
    folder, found = tmp_path_factory.mktemp("sets"), {}
    for name in FEATURES:
        found[name] = folder / name
        episodes, _, failed = export_published([file], found[name], name, HOW, progress=False)
        assert (episodes, failed) == (1, [])
    return found


def _rewrite(file, target, change):
    writer = DemoWriter(target, read_header(file))
    for i, one in enumerate(read_episodes(file)):
        writer.write(i, change(one))
    return writer.finish()


@pytest.mark.parametrize("name", FEATURES)
def test_features_are_the_published_ones(exported, name):
    info = json.loads((exported[name] / "meta/info.json").read_text())
    assert info["features"] == FEATURES[name] and list(info["features"]) == list(FEATURES[name])
    assert (info["robot_type"], info["fps"], info["chunks_size"]) == ("panda", 10, 1000)
    assert info["splits"] == {"train": "0:1"} and info["total_tasks"] == 1


def test_read_back_images_are_as_the_camera_sees_the_scene(exported, expected, tmp_path, monkeypatch):
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path))
    task = get_task("libero_object/7")
    (path,) = lerobot_files(exported["physical-intelligence/libero"], [task], {task.id: 1}, "executed")
    (read,) = read_demos(path)
    for key, images in expected.items():
        if key.endswith("_rgb"):
            np.testing.assert_array_equal(read.obs[key][0], images[0])


def test_a_first_episode_without_images_forbids_others_with_them(file, tmp_path):
    (bare := tmp_path / "bare").mkdir()

    def blind(one):
        return replace(one, obs={k: v for k, v in one.obs.items() if not k.endswith("_rgb")})

    _rewrite(file, bare / file.name, blind)
    with pytest.raises(DemoError, match="as in the first"):
        export_demos([bare / file.name, file], tmp_path / "set")


def test_images_that_would_not_fit_into_memory_are_refused_before_they_are_read():
    buffer = io.BytesIO()
    Image.new("L", (4000, 4000)).save(buffer, format="png")
    with pytest.raises(DemoError, match=r"its images needs about .* of memory"):
        decode_images([buffer.getvalue()] * 10**6, "here")


def test_paths_are_those_of_the_two_versions(exported, episode):
    new = json.loads((exported["lerobot/libero"] / "meta/info.json").read_text())
    assert new["codebase_version"] == "v3.0" and new["video_files_size_in_mb"] == 500
    assert new["data_path"] == "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    assert new["video_path"] == "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    root = exported["physical-intelligence/libero"]
    old = json.loads((root / "meta/info.json").read_text())
    assert (old["codebase_version"], old["total_chunks"], old["total_videos"]) == ("v2.0", 1, 0)
    assert old["data_path"] == "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    line = json.loads((root / "meta/episodes.jsonl").read_text())
    language = "pick up the milk and place it in the basket"
    assert line == {"episode_index": 0, "tasks": [language], "length": len(episode)}
    assert json.loads((root / "meta/tasks.jsonl").read_text()) == {"task_index": 0, "task": language}
    assert json.loads((root / "meta/stats.json").read_text()).keys() == old["features"].keys()


@pytest.mark.parametrize("name, path, state, action", [
    ("lerobot/libero", "data/chunk-000/file-000.parquet", "observation.state", "action"),
    ("physical-intelligence/libero", "data/chunk-000/episode_000000.parquet", "state", "actions"),
])  # fmt: skip
def test_numbers_are_those_of_the_recording(exported, episode, name, path, state, action):
    table = parquet.read_table(exported[name] / path)
    np.testing.assert_array_equal(table[action].to_pylist(), episode.actions.astype(np.float32))
    obs = np.concatenate([episode.obs[key] for key in ("ee_pos", "ee_ori", "gripper_states")], axis=1)
    np.testing.assert_allclose(table[state].to_pylist(), obs, atol=1e-6)
    np.testing.assert_allclose(table["timestamp"].to_numpy(), np.arange(len(episode)) / 10, atol=1e-5)
    declared = {key for key, feature in FEATURES[name].items() if feature["dtype"] != "video"}
    assert set(table.schema.names) == declared  # nothing else, such as next.reward


def test_png_images_are_the_recorded_ones_in_a_mirror(exported, expected):
    root = exported["physical-intelligence/libero"]
    table = parquet.read_table(root / "data/chunk-000/episode_000000.parquet")
    for feature, key in (("image", "agentview_rgb"), ("wrist_image", "eye_in_hand_rgb")):
        for i, t in enumerate(CHECKED):
            cell = table[feature][t].as_py()
            assert cell["path"] == f"frame_{t:06d}.png"
            picture = np.array(Image.open(io.BytesIO(cell["bytes"])))
            # Half a turn of the original's bottom-up picture.
            np.testing.assert_array_equal(picture, expected[key][i][::-1][::-1, ::-1])


def test_videos_show_the_same_at_ten_frames_per_second(exported, expected):
    for feature, key in (("image", "agentview_rgb"), ("image2", "eye_in_hand_rgb")):
        path = f"videos/observation.images.{feature}/chunk-000/file-000.mp4"
        with av.open(str(exported["lerobot/libero"] / path)) as video:
            assert video.streams.video[0].codec.canonical_name == "av1"
            frames = {round(f.time, 4): f.to_ndarray(format="rgb24") for f in video.decode(video=0)}
        for i, t in enumerate(CHECKED):
            seen = frames[round(t / 10, 4)].astype(int)
            error, unturned = (np.abs(seen - e).mean() for e in (expected[key][i][:, ::-1], expected[key][i]))
            assert error < 6.0 and error < unturned / 2


def test_steps_that_do_nothing_are_left_out(file, episode, exported, tmp_path):
    """An idle robot holds its pose, so the recording with pauses is the one without them."""

    def pause(one):
        idle = np.concatenate([np.full(6, 1e-6), one.actions[30, 6:]])
        repeat = np.insert(np.arange(len(one)), [31, 31], 30)
        paused = one.select(repeat)
        return replace(paused, actions=np.insert(one.actions, [31, 31], idle, axis=0), expert_actions=None)

    paused, name = _rewrite(file, tmp_path / file.name, pause), "physical-intelligence/libero"
    _, frames, _ = export_published([paused], tmp_path / "set", name, SMALL, progress=False)
    assert frames == len(episode)
    where = "data/chunk-000/episode_000000.parquet"
    one, other = (parquet.read_table(root / where) for root in (exported[name], tmp_path / "set"))
    for key in ("state", "actions"):
        assert one[key].to_pylist() == other[key].to_pylist()


def test_the_rule_of_no_ops():
    """The norm decides, not the largest entry, and the gripper of the last action that is kept."""
    motions = np.zeros((7, 6))
    motions[4], motions[5] = 5e-5, 3e-5  # norms 1.2e-4 and 7e-5
    gripper = np.array([[-1.0], [-1.0], [1.0], [1.0], [1.0], [1.0], [-1.0]])
    dropped = published_noop_steps(np.concatenate([motions, gripper], axis=1))
    # Before the first motion nothing is kept, closing neither: there is no action to compare its gripper with.
    assert dropped.tolist() == [True, True, True, True, False, True, False]


def test_failures_are_left_out_and_named(file, tmp_path):
    lost = _rewrite(file, tmp_path / f"lost_{file.name}", lambda one: replace(one, actions=one.actions * 0.5))
    name = "physical-intelligence/libero"
    episodes, _, failed = export_published([lost, file], tmp_path / "set", name, SMALL, progress=False)
    assert episodes == 1 and failed == [f"{lost}: demo_0"]
    assert json.loads((tmp_path / "set" / ORIGIN).read_text())["left_out"] == 1
    with pytest.raises(DemoError, match=r"lost_.*demo_0: neither this demonstration nor any other"):
        export_published([lost], tmp_path / "none", name, SMALL, progress=False)
    assert not (tmp_path / "none").exists()


def test_each_set_says_which_way_round_its_images_are(file, exported, tmp_path):
    export_demos([file], tmp_path / "own", progress=False)
    info = json.loads((tmp_path / "own/meta/info.json").read_text())
    stated = info["features"]["observation.images.image"]["info"]
    assert (stated["image.first_row"], stated["image.mirrored"]) == ("top", False)
    own = json.loads((tmp_path / "own" / ORIGIN).read_text())
    assert own["images"]["mirrored"] is False and own["models"][0]["pack"] == "builtin"
    origin = json.loads((exported["lerobot/libero"] / ORIGIN).read_text())
    assert origin["images"]["mirrored"] is True and origin["control_hz"] == 20
    assert origin["models"]["pack"] == "builtin" and origin["drawing"] == "fast"


def test_a_recording_that_ends_too_early_is_continued(file, episode, tmp_path):
    """The expert's last action, letting go, is repeated until the goal holds; in other files nothing is added."""
    steps = len(episode) - 3
    short = _rewrite(file, tmp_path / "short.hdf5", lambda one: one.select(np.arange(steps)))
    (continued,) = regenerate(short, SMALL)
    assert continued.success and steps < len(continued.actions) <= steps + 10
    (stopped,) = regenerate(short, replace(SMALL, extra_steps=0))
    assert not stopped.success and len(stopped.actions) == steps
    original = {k: v for k, v in read_header(short).items() if k != "generator"}
    for name, header in {"original": original, "by_hand": original | {"generator": "teleoperation"}}.items():
        human = DemoWriter(tmp_path / f"{name}.hdf5", header)
        human.write(0, next(read_episodes(short)))
        (left,) = regenerate(human.finish(), SMALL)
        assert not left.success and len(left.actions) == steps


def test_a_task_that_the_states_do_not_fit_is_refused(file, tmp_path):
    with pytest.raises(DemoError, match=r"demo_0/states is .*expected \(T, \d+\) for"):
        export_demos([file], tmp_path / "set", task=get_task("libero_goal/3"), progress=False)
