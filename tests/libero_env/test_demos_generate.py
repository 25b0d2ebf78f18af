"""Recording with the expert: what a demonstration depends on, interruption, and files that are found again."""

import os
import signal
import subprocess
import sys
import textwrap
import time

import h5py
import mujoco
import numpy as np
import pytest

from libero_env import LiberoEnv, get_task, read_demos
from libero_env.assets.robot import DEFAULT_ROBOT
from libero_env.demos.config import GENERATOR, DemoConfig, Variation, model_digest
from libero_env.demos.contents import read_header
from libero_env.demos.generate import LaterDemos, demo_path, ensure_demos
from libero_env.demos.record import DemoRecorder
from libero_env.demos.write import DemoWriter
from libero_env.expert.expert import run_experts
from libero_env.progress import ProgressBar
from tests.harness.demos import generate, wander

pytestmark = pytest.mark.sim
TASK = "libero_object/9"  # the shortest
SIZE = (16, 16)
KINDS = {"camera_size": SIZE, "progress": False}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Three demonstrations recorded without interruption."""
    return generate(TASK, 3, path=tmp_path_factory.mktemp("demos") / "whole.hdf5", workers=1, **KINDS)


def check_same(a, b):
    """Check that two files hold the same demonstrations."""
    for x, y in zip(read_demos(a), read_demos(b), strict=True):
        assert x.name == y.name
        np.testing.assert_array_equal(x.states, y.states)
        np.testing.assert_array_equal(x.actions, y.actions)
        for key in x.obs:
            np.testing.assert_array_equal(x.obs[key], y.obs[key])


def test_observations_are_those_of_the_environment(whole):
    """Each is the observation before its action, and replaying the executed actions leads through the same states."""
    demo = read_demos(whole, limit=1, labels="executed")[0]
    env = LiberoEnv(TASK, camera_size=SIZE)
    obs = env.set_state(demo.states[0])
    for t, action in enumerate(demo.actions):
        np.testing.assert_allclose(env.simulations.physics_state(0)[1:], demo.states[t][1:], atol=1e-6)
        for key in ("joint_states", "gripper_states", "ee_pos", "ee_ori"):
            np.testing.assert_allclose(obs[key], demo.obs[key][t], atol=1e-6)
        for key in ("agentview_rgb", "eye_in_hand_rgb"):
            assert np.abs(obs[key].astype(int) - demo.obs[key][t]).mean() < 0.5
        obs, _, terminated, _, _ = env.step(action)
    env.close()
    assert terminated and demo.success


def test_the_file_states_how_it_was_recorded(whole):
    with h5py.File(whole) as handle:
        attrs, demo = handle["data"].attrs, handle["data/demo_0"]
        assert attrs["seed"] == 0 and attrs["camera_size"].tolist() == [*SIZE]
        assert "define (problem" in attrs["bddl_file_content"] and attrs["num_failed_attempts"] >= 0
        model = demo.attrs["model_file"]
        assert model.startswith("<mujoco") and "orange_juice_1_main" in model
        joints = LiberoEnv(TASK, cameras=()).scene.model
        assert all(f'name="{joints.joint(j).name}"' in model for j in range(joints.njnt))
        assert demo["robot_states"].shape[1] == 9
        np.testing.assert_allclose(np.linalg.norm(demo["robot_states"][:, 5:], axis=1), 1.0, atol=1e-6)


def test_demonstrations_differ_and_are_disturbed(whole):
    demos = read_demos(whole)
    executed = read_demos(whole, labels="executed")
    assert not np.array_equal(demos[0].states[0], demos[1].states[0])
    assert all(np.abs(a.actions - b.actions).max() > 0.05 for a, b in zip(demos, executed, strict=True))


def test_the_libero_pairing_stores_observations_after_the_action():
    recorder = DemoRecorder(DemoConfig(TASK, SIZE, pairing="libero"))
    ((_, attempt),) = recorder.attempt([(0, 0)])
    after = recorder.episode(attempt)
    recorder.close()
    np.testing.assert_array_equal(after.states, attempt.states[:-1])
    np.testing.assert_allclose(after.obs["joint_states"], attempt.states[1:, 1:8], atol=1e-12)


def test_a_killed_recording_is_resumed_to_the_same_file(whole, tmp_path):
    script = f"""
        import pathlib, sys
        from tests.harness.demos import generate
        generate({TASK!r}, 30, path=pathlib.Path(sys.argv[1]), workers=1, camera_size={SIZE}, progress=False)
    """
    path = tmp_path / "killed.hdf5"
    child = subprocess.Popen([sys.executable, "-c", textwrap.dedent(script), str(path)])
    parts = DemoWriter(path, {}).parts
    deadline = time.monotonic() + 120
    while not (parts / "demo_00000.hdf5").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    child.send_signal(signal.SIGKILL)
    child.wait()
    assert not path.exists() and len(read_demos(parts)) >= 1
    for part in sorted(parts.glob("demo_*.hdf5"))[3:]:
        part.unlink()
    check_same(generate(TASK, 3, path=path, workers=1, **KINDS), whole)


def test_files_are_recorded_once_and_found_again(whole, tmp_path):
    kept = demo_path(tmp_path, DemoConfig(TASK, SIZE))
    kept.parent.mkdir(parents=True)
    os.link(whole, kept)
    before = kept.stat().st_mtime_ns
    assert ensure_demos([get_task(TASK)], 2, root=tmp_path, workers=1, **KINDS) == [kept]
    assert kept.stat().st_mtime_ns == before


def test_a_faithful_drawing_is_recorded(tmp_path, monkeypatch):
    monkeypatch.setattr("libero_env.demos.record.run_experts", wander)
    paths = {drawing: tmp_path / f"{drawing}.hdf5" for drawing in (None, "faithful")}
    for drawing, path in paths.items():
        generate(TASK, 1, path=path, drawing=drawing, workers=1, **KINDS)
    fast, faithful = (read_demos(file)[0] for file in paths.values())
    assert np.array_equal(fast.actions, faithful.actions)
    assert (fast.obs["agentview_rgb"] != faithful.obs["agentview_rgb"]).any()
    assert [read_header(file).get("drawing") for file in paths.values()] == [None, "faithful"]


def test_the_folder_names_every_option_that_is_not_the_default(tmp_path):
    def folder(size=(64, 64), **options):
        return demo_path(tmp_path, DemoConfig("libero_object/0", size, **options)).parent.name

    assert folder() == folder(drawing="fast") == f"64x64-seed0-{GENERATOR}"
    options = [{"seed": 3}, {"pairing": "libero"}, {"disturb": False}, {"cameras": ("agentview",)}]
    options += [{"size": (32, 32)}, {"modalities": ("rgb", "depth")}, {"drawing": "faithful"}]
    options += [{"robot": "robosuite-1.4.1"}, {"variation": Variation(style=False)}]
    options.append({"variation": Variation(noise=0.2)})
    assert len({folder(), *(folder(**one) for one in options)}) == 1 + len(options)


def test_the_digest_of_models_does_not_depend_on_where_they_are_installed(tmp_path):
    def digest(folder, height):
        folder.mkdir(parents=True, exist_ok=True)
        points = f"v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 {height}\n"
        (folder / "m.obj").write_text(points + "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
        mesh = f"<asset><mesh name='m' file='{folder / 'm.obj'}'/></asset>"
        body = "<worldbody><geom type='mesh' mesh='m'/></worldbody>"
        return model_digest(mujoco.MjModel.from_xml_string(f"<mujoco>{mesh}{body}</mujoco>"))

    here, there = tmp_path / "a", tmp_path / "another_environment" / "lib"
    assert digest(here, 0.1) == digest(there, 0.1) != digest(tmp_path / "b", 0.2)


def test_a_file_of_an_older_scene_is_recorded_again(whole, tmp_path, capsys):
    kept = demo_path(tmp_path, DemoConfig(TASK, SIZE))
    kept.parent.mkdir(parents=True)
    kept.write_bytes(whole.read_bytes())
    with h5py.File(kept, "r+") as handle:
        handle["data"].attrs["model_digest"] = "another"
    ensure_demos([get_task(TASK)], 1, root=tmp_path, workers=1, **KINDS)
    assert len(read_demos(kept)) == 1
    assert "was recorded with other models: recording again" in capsys.readouterr().err


def test_the_number_of_processes_does_not_matter_and_each_demonstration_is_told(whole, tmp_path, monkeypatch):
    monkeypatch.setattr(DemoConfig, "batch", 2)  # of each process
    told = []
    monkeypatch.setattr(ProgressBar, "update", lambda bar, n: told.append(n))
    check_same(generate(TASK, 3, path=tmp_path / "two.hdf5", workers=2, **KINDS), whole)
    assert [n for n in told if n] == [1, 1, 1]


def test_those_of_later_tasks_are_recorded_meanwhile_and_are_the_same(whole, tmp_path):
    tasks = [get_task("libero_object/8"), get_task(TASK)]
    options = {"root": tmp_path, "seed": 0, "drawing": None, "robot": DEFAULT_ROBOT, **KINDS}
    with LaterDemos(tasks[:1]) as later:
        first, second = later.ensure(tasks, 3, **options)
        assert len(read_demos(first)) == 3 and not later.done
        later.wait(second)
        assert later.done
    check_same(second, whole)
    with LaterDemos(tasks[:1]) as later:
        assert later.ensure(tasks, 3, **options) == [first, second]
        assert later.done


def test_a_script_without_a_main_guard_is_told_so_and_does_not_wait_for_itself(tmp_path):
    file = tmp_path / "record.py"
    file.write_text(
        "from pathlib import Path\nfrom tests.harness.demos import generate\n"
        f"generate({TASK!r}, 10, path=Path({str(tmp_path / 'x.hdf5')!r}), workers=2, camera_size={SIZE})\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, str(file)], stderr=subprocess.PIPE, text=True, env=environment)
    assert done.returncode == 1
    assert 'if __name__ == "__main__":' in done.stderr and "a worker process ended" in done.stderr


def test_failed_attempts_are_counted_and_left_out(tmp_path, monkeypatch):
    calls = []

    def fail_first(env, experts, noise, max_steps):
        calls.append(len(experts))
        first = len(calls) == 1
        return run_experts(env, experts, noise, max_steps=5 if first else max_steps)

    monkeypatch.setattr("libero_env.demos.record.run_experts", fail_first)
    path = generate(TASK, 1, path=tmp_path / "x.hdf5", seed=3, workers=1, **KINDS)
    with h5py.File(path) as handle:
        assert handle["data"].attrs["num_failed_attempts"] == 1 and handle["data"].attrs["num_demos"] == 1
