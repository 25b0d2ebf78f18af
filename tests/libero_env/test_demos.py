"""Demonstration files: what is written is read back; what is broken is named; what was recorded survives a kill."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from libero_env.demos import DemoWriter, demo_origin, read_demos
from libero_env.demos.generate import _recording_lock
from libero_env.errors import DemoError
from tests.harness.demos import episode, header, write


@pytest.fixture
def path(tmp_path):
    writer = DemoWriter(tmp_path / "butter_demo.hdf5", header())
    for i in range(3):
        writer.write(i, episode(i))
    return writer.finish()


def test_written_is_read_back_upright(path):
    demos = read_demos(path)
    assert [demo.name for demo in demos] == ["demo_0", "demo_1", "demo_2"]
    for i, demo in enumerate(demos):
        expected = episode(i)
        np.testing.assert_array_equal(demo.actions, expected.expert_actions)
        np.testing.assert_array_equal(demo.states, expected.states)
        for key, values in expected.obs.items():
            np.testing.assert_array_equal(demo.obs[key], values)
        assert demo.success and demo.pairing == "aligned"
    np.testing.assert_array_equal(read_demos(path, labels="executed")[1].actions, episode(1).actions)


def test_limit_and_keys_select(path):
    (demo,) = read_demos(path, obs_keys=["ee_states"], limit=1)
    assert list(demo.obs) == ["ee_states"]
    np.testing.assert_array_equal(demo.obs["ee_states"][:, 3:], episode(0).obs["ee_ori"])


def test_the_origin_names_what_is_learned_and_not_how_it_looks(path, tmp_path):
    assert demo_origin(path).generator == "", "the file does not say"
    with h5py.File(path, "r+") as handle:
        handle["data"].attrs["generator"] = "someone"
    origin = demo_origin(path)
    assert (origin.count, origin.generator) == (3, "someone")
    assert demo_origin(path, limit=2).digest not in ("", origin.digest)
    for key, same in (("obs/agentview_rgb", True), ("states", False), ("expert_actions", False)):
        copy = tmp_path / "copy.hdf5"
        shutil.copy(path, copy)
        with h5py.File(copy, "r+") as handle:
            handle["data/demo_2"][key][0] = 0
        assert (demo_origin(copy).digest == origin.digest) == same, key
        assert demo_origin(copy, limit=2) == demo_origin(path, limit=2)


def test_file_has_the_originals_layout(path):
    with h5py.File(path) as handle:
        data = handle["data"]
        assert {"macros_image_convention", "bddl_file_name", "bddl_file_content", "env_args"} <= {*data.attrs}
        assert data.attrs["num_demos"] == 3 and data.attrs["total"] == 33 and data.attrs["tag"] == "libero-v1"
        assert data.attrs["env_name"] == "Libero_Floor_Manipulation"
        info = json.loads(data.attrs["problem_info"])
        assert info["problem_name"] == "libero_floor_manipulation"
        assert "butter" in info["language_instruction"]
        demo = data["demo_0"]
        types = dict.fromkeys(("actions", "states", "robot_states", "obs/ee_states"), "float64")
        types |= dict.fromkeys(("rewards", "dones", "obs/agentview_rgb"), "uint8")
        assert {key: str(demo[key].dtype) for key in types} == types
        np.testing.assert_array_equal(demo["obs/agentview_rgb"][()], episode(0).obs["agentview_rgb"][:, ::-1])
        np.testing.assert_array_equal(demo.attrs["init_state"], demo["states"][0])
        assert demo.attrs["num_samples"] == 11


def test_files_of_the_original_are_read(tmp_path):
    path = tmp_path / "original.hdf5"
    with h5py.File(path, "w") as handle:
        for i in (10, 2):
            demo = handle.create_group(f"data/demo_{i}")
            demo["actions"] = np.full((5, 7), i / 10)
            demo["obs/agentview_rgb"] = np.zeros((5, 8, 8, 3), np.uint8)
            demo["obs/ee_pos"] = np.arange(15.0).reshape(5, 3)
    demos = read_demos(path)
    assert [demo.name for demo in demos] == ["demo_2", "demo_10"] and demos[0].states.shape == (5, 0)
    assert demos[0].pairing == "libero"
    shifted = demos[0].aligned()
    np.testing.assert_array_equal(shifted.obs["ee_pos"], demos[0].obs["ee_pos"][:-1])
    np.testing.assert_array_equal(shifted.actions, demos[0].actions[1:])
    assert read_demos(path, pairing="aligned")[0].pairing == "aligned"


def test_truncated_and_absent_files_are_named(path):
    whole = path.read_bytes()
    for size in (0, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(DemoError, match=path.name):
            read_demos(path)
    path.unlink()
    with pytest.raises(DemoError, match="no such file"):
        read_demos(path)


def test_an_interrupted_recording_is_resumed(path):
    writer = DemoWriter(path, header())
    assert writer.recorded() == {0, 1, 2}
    writer.write(3, episode(3))
    assert writer.recorded() == {0, 1, 2, 3} and len(read_demos(writer.parts)) == 1
    writer.finish()
    assert len(read_demos(path)) == 4 and not writer.parts.exists()


def test_a_file_of_another_configuration_is_refused(path):
    with pytest.raises(DemoError, match="seed = 1, not 2"):
        DemoWriter(path, header(seed=2)).recorded()


def test_a_broken_part_is_recorded_again(tmp_path):
    writer = DemoWriter(tmp_path / "x.hdf5", header())
    writer.write(0, episode(0))
    part = writer.write(1, episode(1))
    part.write_bytes(part.read_bytes()[:500])
    assert writer.recorded() == {0}


def test_a_recording_follows_no_link_out_of_its_folder(tmp_path):
    victim, path = tmp_path / "victim.hdf5", tmp_path / "own" / "x.hdf5"
    victim.write_text("precious, and no demonstration")
    path.parent.mkdir()
    writer = DemoWriter(path, {})
    writer.parts.symlink_to(tmp_path)
    for use in (writer.recorded, writer.finish, writer.discard_parts, lambda: writer.write(0, episode(0))):
        with pytest.raises(DemoError, match=r"x\.hdf5\.parts is a link, or is not a folder"):
            use()
    (path.parent / ".recording.lock").symlink_to(victim)
    with pytest.raises(DemoError, match="demonstrations cannot be recorded there"):
        _recording_lock(path.parent).__enter__()
    assert victim.read_text() == "precious, and no demonstration"


FULL_DISK = """
import resource, sys
from pathlib import Path
from tests.harness.demos import episode, write

path, limit = Path(sys.argv[1]), int(sys.argv[2])
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
try:
    write(path, [episode(k, size=64) for k in range(3)])
except Exception as error:
    print(f"{type(error).__name__}: {error}")
"""


@pytest.mark.parametrize("limit", [0, 3_000, 40_000, 300_000])
def test_a_disk_that_is_full_ends_in_one_line_and_loses_nothing(tmp_path, limit):
    path = tmp_path / "x.hdf5"
    command = [sys.executable, "-c", FULL_DISK, str(path), str(limit)]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True)
    assert done.returncode == 0 and not done.stderr
    assert done.stdout.startswith(f"DemoError: {path}") and done.stdout.count("\n") == 1
    assert str(path.parent / "x.hdf5.parts") in done.stdout
    assert not list(tmp_path.rglob("*.part")) and not path.exists()
    assert len(list(tmp_path.rglob("demo_*.hdf5"))) == (3 if limit == 300_000 else 0)
    write(path, [episode(k, size=64) for k in range(3)])
    assert len(read_demos(path)) == 3
