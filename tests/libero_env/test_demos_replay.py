"""Replaying and rendering again: fixtures are at their recorded poses, and states lead to the same images."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from libero_env import LiberoEnv, get_task, make_task
from libero_env.curating.curate import examine
from libero_env.curating.rendering import rerender
from libero_env.demos import DemoConfig, RecordingJob, RenderConfig, Variation, ensure_demos, make_demos
from libero_env.demos.contents import read_header
from libero_env.demos.observe import StateRenderer, fixture_poses, recorded_task
from libero_env.demos.read import Episode, read_demos, read_episodes
from libero_env.demos.replay import replay, rerun_actions
from libero_env.demos.write import DemoWriter
from libero_env.envs import EnvConfig
from libero_env.errors import DemoError
from libero_env.expert.expert import run_experts
from libero_env.storage import read_yaml
from libero_integrations.exports.demonstrations import export_demos, export_published
from lifelong.data import demonstrations
from tests.harness.demos import STEPS, generate, record_wander, wander

pytestmark = pytest.mark.sim
TASK, SIZE = "libero_goal/3", (24, 32)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return record_wander(tmp_path_factory.mktemp("demos") / "goal.hdf5", TASK, SIZE)


def test_poses_of_fixtures_are_recorded(path):
    scene = LiberoEnv(TASK, cameras=()).scene
    episodes = list(read_episodes(path))
    poses = [episode.fixtures for episode in episodes]
    assert not np.allclose(poses[0], poses[1], atol=1e-6)  # they differ from start to start
    for episode, pose in zip(episodes, poses, strict=True):
        np.testing.assert_array_equal(fixture_poses(episode, scene, ""), pose)
        rounded = replace(episode, fixtures=None)  # as in the original's files: in `model_file`
        np.testing.assert_allclose(fixture_poses(rounded, scene, ""), pose, atol=1e-5)
    bare = replace(episodes[0], fixtures=None, attrs={})
    np.testing.assert_array_equal(fixture_poses(bare, scene, ""), scene.fixture_poses)
    with pytest.raises(DemoError, match="no body"):
        fixture_poses(replace(bare, attrs={"model_file": "<mujoco/>"}), scene, "x")
    with pytest.raises(DemoError, match=r"attribute fixtures is \(1, 7\)"):
        fixture_poses(replace(bare, fixtures=np.zeros((1, 7))), scene, "x")


def test_actions_replay_to_the_same_states(path):
    for result in replay(path, by="action"):
        assert result.steps == STEPS and result.drift.shape == (STEPS,)
        assert result.drift.max() < 1e-9 and result.arm_drift.max() < 1e-9
        assert result.recorded and not result.success  # a random walk reaches nothing


def test_a_recording_longer_than_an_episode_is_replayed_to_its_end(path, tmp_path):
    writer, one = DemoWriter(tmp_path / "long.hdf5", read_header(path)), next(read_episodes(path))
    steps = np.zeros(EnvConfig.horizon + 2, int)
    still = {"actions": np.zeros((len(steps), 7)), "obs": {}, "expert_actions": None}
    writer.write(0, replace(one.select(steps), **still))
    (result,) = replay(writer.finish())
    assert result.steps == len(steps) and not result.success


STANDARD = read_yaml("demos/original_env.yaml")["controller_configs"]


def restated(path, target, change):
    """Copy a file, and change what it states of the environment that it was recorded in."""
    shutil.copy(path, target)
    with h5py.File(target, "a") as file:
        made = json.loads(file["data"].attrs["env_args"])
        change(made["env_kwargs"])
        file["data"].attrs["env_args"] = json.dumps(made)
    return target


@pytest.mark.parametrize("key", [*STANDARD, "position_limits", "orientation_limits", "robots", "unheard_of"])
def test_actions_of_another_controller_are_neither_run_nor_exported(path, tmp_path, key):
    """Whatever a file states otherwise is named by each that would run its actions as relative ones of OSC_POSE."""

    def change(stated):
        was = STANDARD.get(key)
        other = not was if isinstance(was, bool) else [2.0] * 6 if isinstance(was, list | int) else ["x"]
        (stated if key == "robots" else stated["controller_configs"])[key] = other

    other, out = restated(path, tmp_path / "other.hdf5", change), tmp_path / "set"
    uses = [lambda: next(replay(other)), lambda: next(replay(other, by="state"))]
    uses += [lambda: rerun_actions(other, tmp_path / "new.hdf5"), lambda: export_demos([other], out)]
    uses.append(lambda: export_demos([other], out, actions="absolute"))
    for call in [*uses, lambda: export_published([other], out, "lerobot/libero")]:
        with pytest.raises(
            DemoError, match=rf"other.hdf5 states .*{key} .*expected .*relative actions of OS"
        ):
            call()
        assert not out.exists()
    (note,) = [note for note in examine(other).notes if "neither learned from" in note]
    assert key in note


def test_a_recording_of_another_frequency_is_replayed_at_it_and_not_exported(path, tmp_path):
    slow = restated(path, tmp_path / "slow.hdf5", lambda stated: stated.update(control_freq=10))
    (first, *_), (same, *_) = replay(slow), replay(path)
    assert first.arm_drift[1] > 1e-3 > same.arm_drift[1]  # each action is held for 100 ms
    with pytest.raises(DemoError, match="was recorded at 10 Hz; the layout lerobot is for 20 Hz"):
        export_demos([slow], tmp_path / "set")
    settings = SimpleNamespace(robot="libero", image_size=32)
    assert demonstrations._misfit(slow, 1, settings) == "was recorded at 10 Hz; runs act at 20 Hz"
    wrong = restated(path, tmp_path / "wrong.hdf5", lambda stated: stated.update(control_freq=30))
    with pytest.raises(DemoError, match="control_freq is 30; expected one of 1, 2, 4"):
        next(iter(replay(wrong)))


def test_states_replay_with_images(path):
    views = {"cameras": ("agentview", "frontview"), "size": (16, 24)}
    (result,) = replay(path, by="state", demos=["demo_1"], **views)
    assert result.name == "demo_1" and result.drift.max() < 1e-12
    assert result.frames.shape == (STEPS, 16, 48, 3) and result.frames.std() > 1.0
    with pytest.raises(DemoError, match="no demonstration demo_7"):
        list(replay(path, demos=["demo_7"]))
    with pytest.raises(DemoError, match="valid: state, action"):
        list(replay(path, by="magic"))


def test_rendering_again_with_other_cameras_depth_and_segmentation(path, tmp_path):
    config = RenderConfig(("agentview", "frontview"), (16, 20), ("rgb", "depth", "segmentation_instance"))
    out = rerender(path, tmp_path / "other.hdf5", config, progress=False)
    demo = read_demos(out)[0]
    assert {"frontview_rgb", "frontview_depth", "agentview_segmentation"} <= demo.obs.keys()
    depth = demo.obs["frontview_depth"]
    assert depth.shape == (STEPS, 16, 20) and depth.dtype == np.float32
    assert len(np.unique(demo.obs["agentview_segmentation"])) > 3
    names = json.loads(read_header(out)["segmentation_names"])
    assert set(map(str, np.unique(demo.obs["agentview_segmentation"]))) <= names.keys()
    again = rerender(out, tmp_path / "plain.hdf5", RenderConfig(size=(8, 8)), progress=False)
    assert "segmentation_names" not in read_header(again)
    renderer = StateRenderer(get_task(TASK), config)
    episode = next(read_episodes(path))
    seen, _ = renderer.render_states(episode.states[:1], episode.fixtures)
    moved, _ = renderer.render_states(episode.states[:1], episode.fixtures + [0.1, 0, 0, 0, 0, 0, 0])
    renderer.close()
    for key in ("frontview_depth", "agentview_segmentation"):
        np.testing.assert_array_equal(demo.obs[key][0], seen[key][0])  # upright again when it is read
    assert np.abs(seen["agentview_rgb"].astype(int) - moved["agentview_rgb"]).mean() > 1.0
    with pytest.raises(DemoError, match="was recorded with camera_size"):
        rerender(path, out, RenderConfig(size=(8, 8)), progress=False)
    with pytest.raises(DemoError, match="choose another name"):
        rerender(path, path, RenderConfig(), progress=False)


def original(source, out):
    """Write states as the original does: observations after their action, and another path of the task file."""
    task = get_task(TASK)
    renderer = StateRenderer(task, RenderConfig(size=SIZE))
    with h5py.File(out, "w") as handle:
        data = handle.create_group("data")
        data.attrs["env_name"] = "Libero_Tabletop_Manipulation"
        data.attrs["problem_info"] = json.dumps({"language_instruction": task.language})
        data.attrs["bddl_file_name"] = f"chiliocosm/bddl_files/libero_goal/{task.name}.bddl"
        data.attrs["bddl_file_content"] = task.bddl_text
        data.attrs["macros_image_convention"], data.attrs["tag"] = "opengl", "libero-v1"
        data.attrs["num_demos"], data.attrs["total"] = 1, STEPS - 1
        episode: Episode = next(read_episodes(source))
        model, fixtures = renderer.scene.model, episode.fixtures
        obs, robot = renderer.render_states(episode.states[1:], fixtures)
        demo = data.create_group("demo_0")
        demo["actions"], demo["states"], demo["robot_states"] = (
            episode.actions[:-1],
            episode.states[:-1],
            robot,
        )
        demo["rewards"] = demo["dones"] = np.eye(STEPS - 1, dtype=np.uint8)[-1]
        for key, values in obs.items():
            demo[f"obs/{key}"] = values[:, ::-1] if key.endswith("_rgb") else values
        demo.attrs["num_samples"], demo.attrs["init_state"] = STEPS - 1, episode.states[0]
        bodies = [
            f'<body name="{model.body(body).name}" pos="{" ".join(map(str, pose[:3]))}" '
            f'quat="{" ".join(map(str, pose[3:]))}"/>'
            for body, pose in zip(renderer.scene.fixture_bodies, fixtures, strict=True)
        ]
        demo.attrs["model_file"] = f"<mujoco><worldbody>{''.join(bodies)}</worldbody></mujoco>"
    renderer.close()
    return out


def test_files_of_the_original_work_with_every_tool(path, tmp_path):
    file = original(path, tmp_path / "human_demo.hdf5")
    assert recorded_task(file) is get_task(TASK) and examine(file).lengths == (STEPS - 1,)
    (result,) = replay(file, by="action")
    assert result.drift.max() < 1e-9 and result.arm_drift.max() < 1e-9
    (ours,) = read_demos(path, limit=1)
    (theirs,) = read_demos(file)
    shown = theirs.obs["agentview_rgb"]
    np.testing.assert_array_equal(shown, ours.obs["agentview_rgb"][1:])  # upright, one later
    again = rerender(file, tmp_path / "aligned.hdf5", RenderConfig(size=SIZE), progress=False)
    (rendered,) = read_demos(again)
    assert rendered.pairing == "aligned"
    np.testing.assert_array_equal(rendered.obs["agentview_rgb"], ours.obs["agentview_rgb"][:-1])
    pytest.importorskip("av")
    pytest.importorskip("pyarrow")
    assert export_demos([file], tmp_path / "set", progress=False) == (1, STEPS - 2)


def test_a_task_that_the_expert_cannot_do_stops_no_other(tmp_path, monkeypatch):
    def partial(env, experts, noise, max_steps):
        return (run_experts if env.task is lift else wander)(env, experts, noise, max_steps=max_steps)

    monkeypatch.setattr("libero_env.demos.record.run_experts", partial)
    place = {"butter_1": (0.1, 0.2)}
    lift = make_task(scene="floor", objects=["butter"], place=place, goal="Up butter_1", language="lift it")
    tasks = (lift, "libero_goal/4")
    jobs = [RecordingJob(DemoConfig(t, (8, 8)), tmp_path / f"{i}.hdf5") for i, t in enumerate(tasks)]
    reports = list(make_demos(jobs, 2, workers=1, progress=False).values())
    assert "no skill reaches (Up butter_1)" in reports[0].error and not jobs[0].path.exists()
    assert reports[0].recorded == 0 and reports[0].attempts == sum(reports[0].failure_reasons.values()) == 20
    assert not reports[1].error and reports[1].recorded == reports[1].attempts == 2
    assert len(read_demos(jobs[1].path)) == 2
    with pytest.raises(DemoError, match=r"1 of 1 files are not complete.*no skill reaches"):
        ensure_demos([lift], 1, root=tmp_path, camera_size=(8, 8), workers=1, progress=False)


def test_reserved_starts_are_the_stored_ones(tmp_path, monkeypatch):
    monkeypatch.setattr("libero_env.demos.record.run_experts", wander)
    config = DemoConfig(TASK, (8, 8), variation=Variation(reserved=True))
    make_demos([RecordingJob(config, tmp_path / "a.hdf5")], 2, workers=1, progress=False)
    env = LiberoEnv(TASK, cameras=())
    for i, episode in enumerate(read_episodes(tmp_path / "a.hdf5")):
        env.reset(options={"init_state": i})
        np.testing.assert_array_equal(episode.states[0], env.simulations.physics_state(0))
        np.testing.assert_array_equal(episode.fixtures, env.simulations.fixtures[0])


def test_a_user_defined_task_file_is_recorded(tmp_path, monkeypatch):
    monkeypatch.setattr("libero_env.demos.record.run_experts", wander)
    file = tmp_path / "my_task.bddl"
    file.write_text(get_task("libero_object/9").bddl_text)
    path = generate(str(file), 1, path=tmp_path / "a.hdf5", camera_size=(8, 8), workers=1, progress=False)
    task = recorded_task(path)
    assert task.name == "my_task" and task.id == "file/0" and examine(path).lengths == (STEPS,)
    file.write_text(file.read_text().replace("(:language ", "(:language Kindly "))
    with pytest.raises(DemoError, match="bddl_file_content"):
        generate(str(file), 2, path=path, camera_size=(8, 8), workers=1, progress=False)
