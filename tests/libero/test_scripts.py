"""The original's command line scripts: results and error messages."""

import runpy
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from PIL import Image

from libero.libero.envs import ControlEnv
from libero.scripts import demonstrations, files, tasks
from libero_env.demos.read import Episode, read_demos
from libero_env.demos.write import DemoWriter, make_header
from libero_env.envs.batch import BatchEnv
from libero_env.tasks import bddl, get_task
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
    header = make_header(
        problem_name=task.problem.name,
        language=task.language,
        bddl_name=f"{task.suite}/{task.name}.bddl",
        bddl_text=task.bddl_text,
        env_kwargs={},
    )
    writer = DemoWriter(path, header)
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
    command = [sys.executable, str(ROOT / "benchmark_scripts" / "shasum_files.py"), str(tmp_path / "nothing")]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"error: shasum_files.py: no files in {tmp_path / 'nothing'}\n"


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
    assert (
        demonstrations.create_dataset([*argv, "--use-actions", "--no-proprio", "--dataset-name", "acted"])
        == 0
    )
    with h5py.File(tmp_path / "acted.hdf5") as acted, h5py.File(collected) as before:
        assert list(acted["data/demo_1/obs"]) == []
        assert "robot_states" not in acted["data/demo_1"]
        # the first actions act from the recorded state: positions to the bit, the arm's goals are forgotten between
        assert np.allclose(acted["data/demo_1/states"], before["data/demo_1/states"], atol=1e-6)
    assert demonstrations.create_dataset([*argv, "--use-depth"]) == 2
    assert "add --use_camera_obs" in capsys.readouterr().err
    assert demonstrations.create_dataset(["--demo-file", str(tmp_path / "none.hdf5")]) == 2
    assert "error: create_dataset.py: " in capsys.readouterr().err


def test_get_dataset_info(collected, tmp_path, capsys):
    assert demonstrations.get_dataset_info(["--dataset", str(collected), "--verbose"]) == 0
    out = capsys.readouterr().out
    assert "demos: 2" in out
    assert "length_mean: 6.0" in out
    assert "demo_1\n    actions: (6, 7)\n" in out
    assert "language_instruction" in out
    assert demonstrations.get_dataset_info(["--dataset", str(collected), "--filter_key", "train"]) == 2
    assert "no subset 'train'" in capsys.readouterr().err
    marked = tmp_path / "marked.hdf5"
    marked.write_bytes(collected.read_bytes())
    with h5py.File(marked, "r+") as file:
        file["mask/train"] = np.array([b"demo_1"])
        file["data/demo_1/actions"][0, 0] = 1.5
    assert demonstrations.get_dataset_info(["--dataset", str(marked), "--filter_key", "train"]) == 1
    assert "demos: 1" in (out := capsys.readouterr().out)
    assert "not in [-1, 1]" in out


def test_check_dataset_integrity(collected, tmp_path, capsys):
    assert demonstrations.check_dataset_integrity([str(collected), "--num-demos", "2"]) == 0
    assert "1 of 1 files are complete" in capsys.readouterr().out
    (tmp_path / "torn.hdf5").write_bytes(collected.read_bytes()[:1000])
    assert demonstrations.check_dataset_integrity([str(collected), str(tmp_path)]) == 1
    out = capsys.readouterr().out
    assert "2 demonstrations; expected 50" in out
    assert f"FAIL  {tmp_path / 'torn.hdf5'}" in out
    assert "0 of 2 files are complete" in out
    assert demonstrations.check_dataset_integrity([str(tmp_path / "empty")]) == 2


def test_get_affordance_info(capsys):
    assert tasks.get_affordance_info(["flat_stove", "basket", "milk"]) == 0
    assert capsys.readouterr().out == "flat_stove: cook_region\nbasket: contain_region\n"
    assert tasks.get_affordance_info(["flatstove"]) == 2
    assert "Did you mean 'flat_stove'" in capsys.readouterr().err


def test_create_libero_task_example(tmp_path, capsys):
    assert tasks.create_libero_task_example(["--folder", str(tmp_path)]) == 0
    paths = capsys.readouterr().out.split()
    assert len(paths) == len(tasks.EXAMPLES)
    assert [bddl.read(path).language for path in paths] == [t.language for t in tasks.EXAMPLES]


@pytest.mark.sim
def test_templates_work_unchanged(tmp_path, capsys, monkeypatch):
    for kind, name in (
        ("problem_class", "MyProblem"), ("scene", "MyKitchenScene2"), ("object", "MyBox3"), ("arena", "MyRoom")
    ):  # fmt: skip
        assert files.create_template(["-t", kind, "-n", name, "-o", str(tmp_path)]) == 0
    made = capsys.readouterr().out.split()
    assert [Path(path).name for path in made] == [
        "my_problem.py", "my_kitchen_scene2.py", "my_box_3.py", "my_box_3.xml", "my_room.py"
    ]  # fmt: skip
    monkeypatch.chdir(tmp_path)
    spaces = {path: runpy.run_path(path, run_name="__main__") for path in made if path.endswith(".py")}
    task = capsys.readouterr().out
    assert "MY_KITCHEN_SCENE2_put_the_black_bowl_on_the_plate.bddl" in task
    text = (tmp_path / "MY_KITCHEN_SCENE2_put_the_black_bowl_on_the_plate.bddl").read_text()
    assert spaces[made[-1]]["MyRoom"]().spec.compile().geom("my_room_cupboard").id > 0
    # the scene's task, in the room, with the object instead of the bowl
    text = text.replace("akita_black_bowl_1", "my_box_3_1").replace("- akita_black_bowl", "- my_box_3")
    (tmp_path / "mine.bddl").write_text(
        text.replace("LIBERO_Kitchen_Tabletop_Manipulation", "MyRoom_Manipulation")
    )
    env = ControlEnv(bddl_file_name="mine.bddl", use_camera_obs=False)
    assert "my_box_3_1_pos" in env.reset()
    assert env.sim.model.geom_name2id("my_room_cupboard") > 0
    env.close()
    (tmp_path / "mine.bddl").write_text(text.replace("LIBERO_Kitchen_Tabletop_Manipulation", "MyProblem"))
    env = ControlEnv(bddl_file_name="mine.bddl", use_camera_obs=False)
    env.reset()
    assert not env.check_success()
    env.close()


def test_missing_options_of_templates_are_asked_for(tmp_path, monkeypatch, capsys):
    answers = iter(["object", "my box", "object", "MyBox"])
    monkeypatch.setattr("builtins.input", lambda question: next(answers))
    assert files.create_template(["--out", str(tmp_path)]) == 2
    assert "--template is missing" in capsys.readouterr().err
    monkeypatch.setattr(files.sys.stdin, "isatty", lambda: True, raising=False)
    assert files.create_template(["--out", str(tmp_path)]) == 2
    assert "'my box' is not a valid class name" in capsys.readouterr().err
    assert files.create_template(["--out", str(tmp_path)]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"my_box.py", "my_box.xml"}
    assert files.create_template(["-t", "object", "-n", "MyBox", "-o", str(tmp_path)]) == 2
    assert "my_box.py exists" in capsys.readouterr().err
    assert files.create_template(["-t", "object", "-n", "MyBox", "-o", str(tmp_path), "--overwrite"]) == 0


def test_config_copy(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert files.config_copy([]) == 0
    assert (tmp_path / "configs" / "config.yaml").read_text() == (
        ROOT / "libero/configs/config.yaml"
    ).read_text()
    assert files.config_copy([]) == 2
    assert "configs exists" in capsys.readouterr().err
    assert files.config_copy(["elsewhere"]) == files.config_copy(["--overwrite"]) == 0


def test_download_libero_datasets(tmp_path, monkeypatch, capsys):
    asked = []
    monkeypatch.setattr(
        demonstrations, "libero_dataset_download", lambda *args, **kwargs: asked.append((args, kwargs))
    )
    argv = ["--download-dir", str(tmp_path), "--datasets", "libero_goal", "--use-huggingface"]
    assert demonstrations.download_libero_datasets(argv) == 0
    assert asked == [(("libero_goal", tmp_path), {"use_huggingface": True})]
    assert "libero_goal: 0 of 10 files" in capsys.readouterr().out
    assert demonstrations.download_libero_datasets(["--download-dir", str(tmp_path)]) == 1


def test_check_task_suites(monkeypatch, capsys, tmp_path):
    assert tasks.check_task_suites(["libero_goal"]) == 0
    assert capsys.readouterr().out == "libero_goal: 10 tasks, 0 faults\n"
    monkeypatch.setattr(tasks, "get_libero_path", lambda key: str(tmp_path))
    assert tasks.check_task_suites(["libero_goal"]) == 1
    assert "libero_goal: 10 tasks, 10 faults\n" in capsys.readouterr().out
    assert tasks.check_task_suites(["libero_gaol"]) == 2


@pytest.mark.sim
def test_render_single_task(collected, tmp_path, capsys):
    argv = [
        "--benchmark_name", "libero_goal", "--task_id", "1", "--num", "2", "--size", "32", "--out", str(tmp_path)
    ]  # fmt: skip
    assert tasks.render_single_task(argv) == 0
    (path,) = capsys.readouterr().out.split()
    stored = np.asarray(Image.open(path)).astype(int)
    assert stored.shape == (32, 64, 3)
    assert stored.std() > 10
    assert tasks.render_single_task([*argv, "--demo_file", str(collected)]) == 0
    assert (np.asarray(Image.open(path)) != stored).any()
    assert tasks.render_single_task([*argv, "--bddl_file", "mine.bddl"]) == 2
    assert "give one of them" in capsys.readouterr().err
    assert tasks.render_single_task(["--task_id", "1"]) == 2
    assert "which task?" in capsys.readouterr().err
    assert tasks.render_single_task(["--benchmark_name", "libero_goal", "--task_id", "10"]) == 2
    assert "libero_goal has 0 to 9" in capsys.readouterr().err


def test_shasum_files(tmp_path, capsys):
    (tmp_path / "a.txt").write_text("hello")
    assert files.shasum_files([str(tmp_path)]) == 0
    line = capsys.readouterr().out
    assert line == f"2cf24dba5fb0a30e26e83b2ac5b9e29e1b161e5c1fa7425e73043362938b9824  {tmp_path / 'a.txt'}\n"
    (tmp_path / "sums").write_text(line)
    assert files.shasum_files(["--check", str(tmp_path / "sums")]) == 0
    assert files.shasum_files([str(tmp_path / "b.txt"), "--check", str(tmp_path / "sums")]) == 2
    (tmp_path / "a.txt").write_text("goodbye")
    assert files.shasum_files(["--check", str(tmp_path / "sums")]) == 1
    assert "a.txt: FAILED" in capsys.readouterr().out
    (tmp_path / "sums").write_text("nonsense")
    assert files.shasum_files(["--check", str(tmp_path / "sums")]) == 2


class Leaver:
    """A user who quits at once."""

    def __init__(self, keyboard):
        self.keyboard = keyboard

    def poll(self, env):
        self.keyboard.press(QUIT)

    def show(self, env, status):
        """Nothing."""

    def close(self):
        """Nothing."""


@pytest.mark.sim
def test_collecting_scripts(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(teleop_screens, "open_screen", lambda kind, keyboard, *_: Leaver(keyboard))
    (tmp_path / "mine.bddl").write_text(get_task(TASK).bddl_text)
    argv = ["--bddl-file", str(tmp_path / "mine.bddl"), "--directory", str(tmp_path / "data")]
    assert (
        demonstrations.collect_demonstration([*argv, "--num-demonstration", "3", "--device", "keyboard"]) == 1
    )
    out = capsys.readouterr().out
    assert "space: open or close the gripper" in out
    target = tmp_path / "data" / "libero_tabletop_manipulation_mine" / "demo.hdf5"
    assert f"{target}: 0 of 3 demonstrations" in out
    for option, value, valid in (
        ("--controller", "IK_POSE", "OSC_POSE"),
        ("--robots", "Sawyer", "Panda"),
        ("--arm", "left", "right"),
        ("--config", "bimanual", "single-arm-opposed"),
        ("--num-demonstration", "0", "1"),
    ):
        with pytest.raises(SystemExit) as ended:
            demonstrations.collect_demonstration([*argv, option, value])
        assert ended.value.code == 2 and valid in capsys.readouterr().err
    assert (
        demonstrations.libero_100_collect_demonstrations(
            ["--task-id", "99", "--directory", str(tmp_path / "data")]
        )
        == 1
    )
    assert get_task("libero_10/9").language in capsys.readouterr().out
    assert demonstrations.libero_100_collect_demonstrations(["--task-id", "100"]) == 2
    assert "LIBERO-100 has 0 to 99" in capsys.readouterr().err


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
    assert demonstrations.libero_100_collect_demonstrations(["--task-id", "0"]) == 2
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


def test_small_functions():
    from libero.libero.utils import Timer
    from libero.libero.utils.utils import postprocess_model_xml, process_image_input, update_env_kwargs

    with Timer() as timer:
        pass
    assert timer.get_elapsed_time() == timer.value >= 0.0
    assert process_image_input(np.array([255])) == 1.0
    kwargs = {"a": 1}
    update_env_kwargs(kwargs, b=2)
    assert kwargs == {"a": 1, "b": 2}
    xml = (
        '<mujoco><asset><mesh file="/elsewhere/robosuite/models/assets/robots/panda/meshes/link0.stl"/></asset>'
        '<worldbody><camera name="agentview" mode="track" pos="0 0 0"/></worldbody></mujoco>'
    )
    processed = postprocess_model_xml(xml, {"agentview": {"pos": (1, 2, 3)}})
    assert 'pos="1 2 3"' in processed and 'mode="fixed"' in processed
    assert Path(processed.partition('file="')[2].partition('"')[0]).parent.parent.is_dir()
