"""The original's command line scripts: results and error messages."""

import runpy
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from PIL import Image

from libero.scripts import demonstrations, tasks
from libero_env.demos.read import Episode, read_demos
from libero_env.demos.write import DemoWriter, make_header
from libero_env.envs.batch import BatchEnv
from libero_env.tasks import get_task
from libero_env.teleop import screens as teleop_screens
from libero_env.teleop.session import QUIT

ROOT = Path(__file__).parents[2]
TASK = "libero_goal/1"
THIN = sorted([*ROOT.glob("scripts/*.py"), *ROOT.glob("benchmark_scripts/*.py")])


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    """A file as collecting leaves it: states and actions, no observations; two random walks of six steps."""
    path, task = tmp_path_factory.mktemp("collected") / "demo.hdf5", get_task(TASK)
    env = BatchEnv(task, 2, num_threads=1, cameras=())
    env.reset(seed=0)
    fixtures, rng = env.simulations.fixtures.copy(), np.random.default_rng(0)
    states, actions = [[], []], rng.uniform(-1, 1, (6, 2, 7))
    for action in actions:
        for i in range(2):
            states[i].append(env.simulations.physics_state(i))
        env.step(action)
    env.close()
    names = {"language": task.language, "bddl_name": f"{task.suite}/{task.name}.bddl"}
    names |= {"problem_name": task.problem.name, "bddl_text": task.bddl_text}
    writer = DemoWriter(path, make_header(**names, env_kwargs={}))
    for i in range(2):
        attrs = {"fixtures": fixtures[i]}
        writer.write(i, Episode(actions[:, i], np.array(states[i]), None, {}, success=False, attrs=attrs))
    return writer.finish()


@pytest.mark.parametrize("path", THIN, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_files_run_their_modules(path, capsys, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    if path.stem == "init_path":
        runpy.run_path(str(path))
        assert sys.path[0] == str(ROOT)
    else:
        namespace = runpy.run_path(str(path))
        with pytest.raises(SystemExit) as stopped:
            namespace[path.stem](["--help"])
        assert stopped.value.code == 0
        assert "--help" in capsys.readouterr().out


def test_a_script_as_a_process(tmp_path):
    script = ROOT / "benchmark_scripts" / "render_single_task.py"
    command = [sys.executable, str(script), "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: render_single_task.py: which task? ")
    assert done.stderr.count("\n") == 1


@pytest.mark.sim
def test_create_dataset(collected, tmp_path, capsys):
    argv = ["--demo-file", str(collected), "--dataset-path", str(tmp_path), "--size", "16"]
    assert demonstrations.create_dataset([*argv, "--use-camera-obs", "--use-depth"]) == 0
    made = tmp_path / "libero_goal" / f"{get_task(TASK).name}_demo.hdf5"
    assert f"{made}\ndemos: 2\ntransitions: 12\n" in capsys.readouterr().out
    first = read_demos(made)[0]
    assert {key: value.shape[1:] for key, value in first.obs.items()} == {
        "agentview_rgb": (16, 16, 3), "agentview_depth": (16, 16), "eye_in_hand_rgb": (16, 16, 3),
        "eye_in_hand_depth": (16, 16), "joint_states": (7,), "gripper_states": (2,), "ee_pos": (3,), "ee_ori": (3,),
        "ee_states": (6,)
    }  # fmt: skip
    assert demonstrations.create_dataset([*argv, "--use-actions", "--dataset-name", "acted"]) == 0
    with h5py.File(tmp_path / "acted.hdf5") as acted, h5py.File(collected) as before:
        assert not [key for key in acted["data/demo_1/obs"] if key.endswith("_rgb")]
        # the first actions act from the recorded state: positions to the bit, the arm's goals are forgotten between
        assert np.allclose(acted["data/demo_1/states"], before["data/demo_1/states"], atol=1e-6)
    assert demonstrations.create_dataset([*argv, "--use-depth"]) == 2
    assert "add --use_camera_obs" in capsys.readouterr().err
    assert demonstrations.create_dataset(["--demo-file", str(tmp_path / "none.hdf5")]) == 2
    assert "error: create_dataset.py: " in capsys.readouterr().err


def test_download_libero_datasets(tmp_path, monkeypatch, capsys):
    asked, name = [], "libero_dataset_download"
    monkeypatch.setattr(demonstrations, name, lambda *args, **kwargs: asked.append((args, kwargs)))
    argv = ["--download-dir", str(tmp_path), "--datasets", "libero_goal", "--use-huggingface"]
    assert demonstrations.download_libero_datasets(argv) == 0
    assert asked == [(("libero_goal", tmp_path), {"use_huggingface": True})]
    assert "libero_goal: 0 of 10 files" in capsys.readouterr().out
    assert demonstrations.download_libero_datasets(["--download-dir", str(tmp_path)]) == 1


def test_check_task_suites(capsys):
    assert tasks.check_task_suites(["libero_goal"]) == 0
    assert "10 tasks" in capsys.readouterr().out
    assert tasks.check_task_suites(["libero_gaol"]) == 2


@pytest.mark.sim
def test_render_single_task(tmp_path, capsys):
    argv = ["--num", "2", "--size", "32", "--out", str(tmp_path)]
    assert tasks.render_single_task([*argv, "--benchmark_name", "LIBERO_GOAL", "--task_id", "1"]) == 0
    stored = np.asarray(Image.open(tmp_path / "libero_goal_1.png")).astype(int)
    assert stored.shape[0] >= 64 and stored.std() > 10
    named = ["--benchmark_name", "libero_goal", "--task_id"]
    assert tasks.render_single_task([*argv, *named, "1", "--bddl_file", "a.bddl"]) == 2
    assert "which task?" in capsys.readouterr().err
    assert tasks.render_single_task([*argv, *named, "10"]) == 2
    assert "'10'. Valid: 0 to 9" in capsys.readouterr().err


class Leaver:
    """A user who quits at once."""

    def __init__(self, keyboard):
        self.keyboard = keyboard

    def poll(self, env):
        self.keyboard.press(QUIT)

    def show(self, *_):
        """Nothing."""

    close = show


@pytest.mark.sim
def test_collecting_scripts(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(teleop_screens, "open_screen", lambda kind, keyboard, *_: Leaver(keyboard))
    (tmp_path / "mine.bddl").write_text(get_task(TASK).bddl_text)
    argv = ["--bddl-file", str(tmp_path / "mine.bddl"), "--directory", str(tmp_path / "data")]
    more = ["--num-demonstration", "3", "--device", "keyboard"]
    assert demonstrations.collect_demonstration([*argv, *more]) == 1
    out = capsys.readouterr().out
    assert "space: open or close the gripper" in out
    target = tmp_path / "data" / "libero_tabletop_manipulation_mine" / "demo.hdf5"
    assert f"{target}: 0 of 3 demonstrations" in out
    for option, value, valid in (("--controller", "IK_POSE", "OSC_POSE"), ("--num-demonstration", "0", "1")):
        with pytest.raises(SystemExit) as ended:
            demonstrations.collect_demonstration([*argv, option, value])
        assert ended.value.code == 2 and valid in capsys.readouterr().err


@pytest.mark.parametrize(("folder", "named"), [("libero_goal", TASK), ("libero_10", None), ("mine", None)])
def test_a_file_of_the_benchmark_is_recorded_as_its_task(folder, named, tmp_path, monkeypatch):
    """Its data set is then where `get_task_demonstration` says, `<suite>/<task>_demo.hdf5`."""
    asked, task = [], get_task(TASK)
    monkeypatch.setattr(demonstrations, "teleop", asked.append)
    file = tmp_path / folder / f"{task.name}.bddl"
    file.parent.mkdir()
    file.write_text(task.bddl_text)
    demonstrations.collect_demonstration(["--bddl-file", str(file), "--directory", str(tmp_path)])
    assert [(request.task, request.bddl) for request in asked] == [(named, None if named else file)]
    file.write_text(get_task("libero_goal/2").bddl_text)  # another goal under its name
    demonstrations.collect_demonstration(["--bddl-file", str(file), "--directory", str(tmp_path)])
    assert asked[1].task is None


def test_an_arm_that_is_not_recorded_by_hand_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path))
    (tmp_path / "config.yaml").write_text("robot: robosuite-1.4.1\n")
    (tmp_path / "mine.bddl").write_text(get_task(TASK).bddl_text)
    assert demonstrations.collect_demonstration(["--bddl-file", str(tmp_path / "mine.bddl")]) == 2
    assert "config.yaml names the robot robosuite-1.4.1; by hand only libero" in capsys.readouterr().err


def test_videos(tmp_path, recwarn):
    """Success tints the last picture green; odd sizes, which MP4 has no room for, become a GIF."""
    from libero.libero.utils.video_utils import VideoWriter

    dark = {"agentview_image": np.zeros((3, 4, 3), np.uint8)}
    writer = VideoWriter(tmp_path, save_video=True, fps=10)
    upright = np.full((3, 4, 3), 200, np.uint8)
    upright[-1] = 90
    writer.append_image(upright)
    writer.append_obs({"agentview_image": upright[::-1]}, False)
    assert [image[:, 0, 1].tolist() for image in writer.image_buffer.pop(0)] == [[200, 200, 90]] * 2
    writer.append_image(upright)
    writer.append_obs(dark, False)
    writer.append_vector_obs([dark], [True])
    assert [int(image[0, 0, 1]) for image in writer.image_buffer[0]] == [200, 0, 51]
    (film,) = writer.save()
    with Image.open(film) as pictures:
        assert (film.suffix, pictures.n_frames) == (".gif", 3)
    assert "writing GIF" in str(recwarn.pop(UserWarning).message)
    with VideoWriter(tmp_path / "each", save_video=True, single_video=False) as writer:
        writer.append_vector_obs([dark, dark], [True, False])
    assert {path.stem for path in (tmp_path / "each").iterdir()} == {"0", "1"}
    with VideoWriter(tmp_path / "none") as writer:
        writer.append_obs(dark, False)
    assert not (tmp_path / "none").exists()


def test_small_functions():
    from libero.libero.utils import Timer
    from libero.libero.utils.utils import postprocess_model_xml, process_image_input

    with Timer() as timer:
        pass
    assert timer.get_elapsed_time() == timer.value >= 0.0
    assert process_image_input(np.array([255])) == 1.0
    xml = (
        '<mujoco><asset><mesh file="/elsewhere/robosuite/models/assets/robots/panda/meshes/link0.stl"/></asset>'
        '<worldbody><camera name="agentview" mode="track" pos="0 0 0"/></worldbody></mujoco>'
    )
    processed = postprocess_model_xml(xml, {"agentview": {"pos": (1, 2, 3)}})
    assert 'pos="1 2 3"' in processed and 'mode="fixed"' in processed
    assert Path(processed.partition('file="')[2].partition('"')[0]).parent.parent.is_dir()
