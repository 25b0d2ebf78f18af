"""LeRobot, openpi and TensorFlow Datasets read what is exported; LeRobot merges it with the metadata of published sets.

They need environments of their own, which variables name. `LIBERO_LEROBOT`: a Python with lerobot 0.4 or newer, by
default that of tests/harness/peers.py. `LIBERO_LEROBOT_V2`: one with lerobot 0.3, the last that reads version 2.0.
`LIBERO_OPENPI`: openpi's file src/openpi/policies/libero_policy.py. `LIBERO_TFDS`: a Python with tensorflow-cpu and
tensorflow-datasets. experiments/lerobot/exports.md states how they are
made and what came out.
"""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from libero_env.demos.read import read_demos, read_episodes
from libero_env.tasks import get_suite
from libero_integrations.exports.demonstrations import export_demos, export_published
from libero_integrations.exports.regeneration import Regeneration
from libero_integrations.imports.demonstrations import rlds_files
from tests.harness.demos import episode, generate
from tests.harness.peers import ROOT, lerobot

pytest.importorskip("av")
parquet = pytest.importorskip("pyarrow.parquet")
pytestmark = [pytest.mark.sim, pytest.mark.slow]
READ_RLDS = ROOT / "tests/harness/peer_scripts/read_rlds.py"
WRITE_RLDS = READ_RLDS.with_name("write_rlds.py")
DRIVER = Path(__file__).with_name("lerobot_driver.py")
HOW = Regeneration(settle_steps=0, assets="builtin", drawing="fast")
LANGUAGE = "pick up the milk and place it in the basket"


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LIBERO_ASSETS", "builtin")
        out = tmp_path_factory.mktemp("demos") / "pick_up_the_milk_and_place_it_in_the_basket_demo.hdf5"
        return generate("libero_object/7", 1, path=out, camera_size=(16, 16), workers=1, progress=False)


def _named(variable):
    value = os.environ.get(variable)
    if not value or not Path(value).exists():
        pytest.skip(f"{variable} names nothing; see experiments/lerobot/exports.md")
    return value


def _lerobot():
    return _named("LIBERO_LEROBOT") if "LIBERO_LEROBOT" in os.environ else str(lerobot().python)


def _run(python, home, *arguments, script=DRIVER):
    env = os.environ | {"HF_HUB_OFFLINE": "1", "HF_HOME": str(home)}
    command = [python, str(script), *map(str, arguments)]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=600)
    result = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
    assert done.returncode == 0 and result, done.stderr[-4000:]
    return json.loads(result[0].removeprefix("RESULT "))


def test_lerobot_merges_ours_with_the_published_metadata(file, tmp_path):
    python = _lerobot()
    ours = tmp_path / "ours"
    _, frames, _ = export_published([file], ours, "lerobot/libero", HOW, progress=False)
    found = _run(python, tmp_path / "hf", "merge", ours, tmp_path)
    assert (found["fps"], found["robot_type"]) == (10, "panda")
    assert (found["episodes"], found["frames"]) == (2 + 1, 2 * 5 + frames)
    assert found["tasks"] == ["put the bowl on the plate", LANGUAGE]
    features = json.loads((ours / "meta/info.json").read_text())["features"]
    for key, feature in found["converted"].items():  # `info` is worded otherwise by newer versions
        assert {**feature, "info": None} == {**features[key], "info": None}
    merged = sorted(Path(found["merged"]).glob("data/*/*.parquet"))
    rows = [row for path in merged for row in parquet.read_table(path).to_pylist()]
    table = parquet.read_table(ours / "data/chunk-000/file-000.parquet")
    last = [row["action"] for row in rows if row["episode_index"] == 2]
    np.testing.assert_array_equal(last, table["action"].to_pylist())


def test_lerobot_refuses_to_merge_the_unturned_export(file, tmp_path):
    python = _lerobot()
    export_demos([file], tmp_path / "own", progress=False)
    with pytest.raises(AssertionError, match="ValueError: Same f"):
        _run(python, tmp_path / "hf", "merge", tmp_path / "own", tmp_path)


def test_lerobot_reads_the_set_of_version_2(file, tmp_path):
    python = _named("LIBERO_LEROBOT_V2")
    _, frames, _ = export_published(
        [file], tmp_path / "ours", "physical-intelligence/libero", HOW, progress=False
    )
    found = _run(python, tmp_path / "hf", "read", tmp_path / "ours")
    assert (found["episodes"], found["frames"], found["task"]) == (1, frames, LANGUAGE)
    shapes = {"image": [3, 256, 256], "wrist_image": [3, 256, 256], "state": [8], "actions": [7]}
    assert shapes.items() <= found["shapes"].items() and 0.5 < found["largest"] <= 1.0
    table = parquet.read_table(tmp_path / "ours/data/chunk-000/episode_000000.parquet")
    np.testing.assert_allclose(found["actions"], table["actions"][-1].as_py(), atol=1e-6)


def test_the_inputs_of_openpi_read_it(file, tmp_path):
    python, policy = _named("LIBERO_LEROBOT_V2"), _named("LIBERO_OPENPI")
    export_published([file], tmp_path / "ours", "physical-intelligence/libero", HOW, progress=False)
    found = _run(python, tmp_path / "hf", "openpi", tmp_path / "ours", policy)
    for camera in ("base_0_rgb", "left_wrist_0_rgb"):
        shape, kind, largest = found["images"][camera]
        assert (shape, kind) == ([256, 256, 3], "uint8") and largest > 100
    assert (found["state"], found["actions"], found["prompt"]) == ([8], [7], LANGUAGE)


def test_tensorflow_datasets_reads_ours(file, tmp_path):
    root = tmp_path / "milk_no_noops"
    export_demos([file], root, "rlds", labels="executed", progress=False)
    found = _run(_named("LIBERO_TFDS"), tmp_path, root / "1.0.0", script=READ_RLDS)
    assert (found["name"], found["episodes"]) == ("milk_no_noops/1.0.0", 1)
    (one,), recorded = found["read"], next(read_episodes(file)).aligned()
    assert one["language"] == [LANGUAGE] and one["file"] == f"{file.name}: {recorded.name}"
    np.testing.assert_array_equal(np.float32(one["actions"]), recorded.actions.astype(np.float32))
    images, drawn = np.array(one["images"], float), recorded.obs["agentview_rgb"]
    assert images.shape == drawn.shape and abs(images - drawn).mean() < 5.0  # JPEG
    last = [False] * (len(recorded) - 1) + [True]
    assert one["ends"] == last and one["rewards"] == [float(end) for end in last]


def test_what_tensorflow_datasets_writes_is_read(tmp_path, monkeypatch):
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "cache"))
    tasks, episodes = get_suite("libero_object").tasks[:2], [episode(k, 9, 32) for k in range(3)]
    arrays: dict = {"count": len(episodes)}
    for k, one in enumerate(episodes):
        state = np.concatenate([one.obs[key] for key in ("ee_pos", "ee_ori", "gripper_states")], axis=1)
        smooth = (np.linspace(0, 180, 32)[None, :, None] + np.zeros((9, 32, 32, 3)) + 10 * k).astype(np.uint8)
        numbers = {"state": state, "joint_state": one.obs["joint_states"], "action": one.actions}
        columns = {key: values.astype(np.float32) for key, values in numbers.items()}
        columns |= {"image": smooth, "wrist_image": smooth, "language": np.array(tasks[k % 2].language)}
        arrays |= {f"{k}/{key}": values for key, values in columns.items()}
    np.savez(tmp_path / "episodes.npz", **arrays)
    _run(_named("LIBERO_TFDS"), tmp_path, tmp_path / "episodes.npz", tmp_path / "sets", script=WRITE_RLDS)
    counts = {tasks[0].id: 2, tasks[1].id: 1}
    paths = rlds_files(tmp_path / "sets/mine", tasks, counts, "executed")
    read = [demo for path in paths for demo in read_demos(path)]
    order = [k for k, _ in sorted(enumerate(read), key=lambda one: one[1].actions.tobytes())]
    written = sorted(range(3), key=lambda k: episodes[k].actions.astype(np.float32).astype(float).tobytes())
    for k, number in zip(order, written, strict=True):  # TensorFlow Datasets shuffles them
        np.testing.assert_array_equal(read[k].actions, arrays[f"{number}/action"])
        np.testing.assert_array_equal(read[k].obs["joint_states"], arrays[f"{number}/joint_state"])
        apart = read[k].obs["agentview_rgb"].astype(int) - arrays[f"{number}/image"][:, :, ::-1]
        assert np.abs(apart).max() <= 6 and read[k].success
