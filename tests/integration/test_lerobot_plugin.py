"""The distribution `lerobot_env_libero_lifelong`: the vector environment that it gives LeRobot."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from libero_env.envs.env import LiberoEnv
from libero_env.errors import ActionError, LiberoError, SimulationError, UnknownNameError
from libero_env.geometry import quat_to_axis_angle
from libero_env.tasks import get_suite
from tests.harness.recorded import OPEN, write_actions

pytestmark = pytest.mark.sim

PLUGIN = Path(__file__).parents[2] / "integrations" / "lerobot_env_libero_lifelong"
CAMERAS = {"agentview_image": "image", "robot0_eye_in_hand_image": "image2"}


@pytest.fixture
def plugin(monkeypatch):
    """The modules of the distribution that need no LeRobot; its package itself imports LeRobot."""
    package = ModuleType("lerobot_env_libero_lifelong")
    package.__path__ = [str(PLUGIN / "lerobot_env_libero_lifelong")]
    monkeypatch.setitem(sys.modules, package.__name__, package)
    for name in ("settings", "vector"):
        full = f"{package.__name__}.{name}"
        monkeypatch.delitem(sys.modules, full, raising=False)
        setattr(package, name, importlib.import_module(full))
    yield package
    for name in ("settings", "vector"):
        del sys.modules[f"{package.__name__}.{name}"]


@pytest.fixture
def envs(plugin):
    opened = []

    def make(num_envs=2, task="libero_object", index=0, processes=False, **options):
        settings = plugin.settings.Settings(
            **{"cameras": CAMERAS, "size": (32, 32), "assets": "builtin", **options}
        )
        (found,) = plugin.settings.selected_tasks(task, [index])[task]
        opened.append(plugin.vector.TaskEnvs(found, num_envs, settings, processes=processes))
        return opened[-1]

    yield make
    for env in opened:
        env.close()


def test_starts_follow_from_two_options_that_do_not_contradict_each_other(plugin):
    chosen = plugin.settings.chosen_starts
    assert [chosen(True, False), chosen(True, True), chosen(False, False)] == ["stored", "original", "new"]
    with pytest.raises(LiberoError, match="init_states is false"):
        chosen(False, True)


def test_observations_are_those_of_our_environment_as_lerobot_lays_them_out(envs):
    env = envs(2)
    observed, info = env.reset(seed=[1000, 1001])
    ours = LiberoEnv(
        "libero_object/0",
        camera_size=(32, 32),
        assets="builtin",
        observations=("rgb", "proprioception", "ee_quat"),
        observed="substep",
    )
    obs, _ = ours.reset(options={"init_state": 1})
    for _ in range(10):
        obs, *_ = ours.step(OPEN)
    state = observed["robot_state"]
    assert env.observation_space.contains(observed)
    np.testing.assert_array_equal(observed["pixels"]["image"][1], obs["agentview_rgb"][::-1])
    np.testing.assert_array_equal(observed["pixels"]["image2"][1], obs["eye_in_hand_rgb"][::-1])
    np.testing.assert_array_equal(state["joints"]["pos"][1], obs["joint_states"])
    np.testing.assert_array_equal(state["eef"]["pos"][1], obs["ee_pos"])
    quats = np.roll(state["eef"]["quat"], 1, axis=1)
    np.testing.assert_array_equal(quat_to_axis_angle(quats)[1], obs["ee_ori"])
    np.testing.assert_allclose(state["eef"]["mat"][1], ours.view.eef_mat, atol=1e-2)  # 2 ms later
    np.testing.assert_array_equal(env.call("render")[1], obs["agentview_rgb"][:, ::-1])
    assert info["is_success"].tolist() == [False, False]
    assert env.call("task_description") == (ours.task.language,) * 2
    assert env.call("_max_episode_steps") == (280, 280)
    ours.close()


def test_starts_go_round_and_only_new_episodes_use_them_up(envs):
    env, once = envs(2, with_state=False), envs(1, with_state=False)
    first, _ = env.reset(seed=[0, 1])
    second, _ = env.reset(seed=[2, 3])
    assert set(first) == {"pixels"}
    one = [once.reset(seed=[i])[0]["pixels"]["image"][0] for i in range(4)]
    two = [*first["pixels"]["image"], *second["pixels"]["image"]]
    for i in range(4):
        np.testing.assert_array_equal(one[i], two[i])
    assert not np.array_equal(one[0], one[1])
    env.close()
    again, _ = env.reset(seed=[4, 5])  # built again; states 4 and 5 are next
    assert not np.array_equal(again["pixels"]["image"], first["pixels"]["image"])


def test_an_episode_that_is_over_stays_as_it_is(envs, tmp_path):
    recorded = np.load(write_actions(tmp_path / "actions.npz", "libero_object/0", 0))["actions"]
    env = envs(1)
    env.reset(seed=[0])
    for action in recorded:
        observed, reward, terminated, truncated, info = env.step(action[None])
    assert (
        reward.tolist() == [1.0] and terminated.tolist() == [True] and info["is_success"].tolist() == [True]
    )
    for _ in range(2):
        later, reward, terminated, _, info = env.step(recorded[:1])
        now = later["robot_state"]["joints"]["pos"]
        np.testing.assert_allclose(now, observed["robot_state"]["joints"]["pos"], atol=1e-3)  # 2 ms
    np.testing.assert_array_equal(env.step(recorded[:1])[0]["robot_state"]["joints"]["pos"], now)
    assert (
        reward.tolist() == [0.0] and terminated.tolist() == [True] and info["is_success"].tolist() == [True]
    )


@pytest.mark.slow
def test_processes_give_the_same_bits(envs):
    one, many = envs(2), envs(2, processes=True)
    observed = [env.reset(seed=[0, 1])[0] for env in (one, many)]
    action = np.random.default_rng(0).uniform(-1, 1, (2, 7)).astype(np.float32)
    for _ in range(2):
        a, b = observed
        for name in CAMERAS.values():
            np.testing.assert_array_equal(a["pixels"][name], b["pixels"][name])
        for group, entries in a["robot_state"].items():
            for name, value in entries.items():
                np.testing.assert_array_equal(value, b["robot_state"][group][name])
        observed = [env.step(action)[0] for env in (one, many)]


def test_absolute_actions_start_from_the_same_state(envs):
    relative, absolute = envs(1), envs(1, control_mode="absolute")
    before, after = (env.reset(seed=[0])[0]["robot_state"] for env in (relative, absolute))
    np.testing.assert_array_equal(before["joints"]["pos"], after["joints"]["pos"])
    pos, rotation = after["eef"]["pos"][0], np.zeros(3)
    goal = pos + [0.05, 0.0, 0.0]
    rotation = np.array([np.pi, 0.0, 0.0])
    for _ in range(30):
        after = absolute.step(np.concatenate([goal, rotation, [-1.0]])[None])[0]["robot_state"]
    np.testing.assert_allclose(after["eef"]["pos"][0], goal, atol=0.01)


def test_bad_settings_are_named(plugin, envs):
    make = plugin.settings.Settings
    with pytest.raises(UnknownNameError, match="fps"):
        make(cameras=CAMERAS, size=(32, 32), fps=30)
    slow = make(cameras=CAMERAS, size=(32, 32), fps=10)
    assert slow.env_config(get_suite("libero_goal").tasks[0]).control_freq == 10
    with pytest.raises(UnknownNameError, match="absolute, relative"):
        make(cameras=CAMERAS, size=(32, 32), control_mode="delta")
    with pytest.raises(LiberoError, match="agentview_image"):
        make(cameras={"agentview": "image"}, size=(32, 32))
    with pytest.raises(LiberoError, match="two cameras one name"):
        make(cameras={"agentview_image": "image", "robot0_eye_in_hand_image": "image"}, size=(32, 32))
    with pytest.raises(LiberoError, match="episode_length 0"):
        make(cameras=CAMERAS, size=(32, 32), max_steps=0)
    with pytest.raises(LiberoError, match=r"task_ids \[10\] do not exist: libero_goal has 0 to 9"):
        plugin.settings.selected_tasks("libero_goal", [10])
    with pytest.raises(LiberoError, match="no suite"):
        plugin.settings.selected_tasks(" , ")
    env = envs(1)
    with pytest.raises(LiberoError, match="no image before the first reset"):
        env.render()
    with pytest.raises(AttributeError, match="task_description"):
        env.call("instruction")
    env.reset(seed=[0])
    with pytest.raises(ActionError, match="finite"):
        env.step(np.full((1, 7), np.nan))


def test_a_simulation_that_fails_is_no_failure_of_the_policy(envs):
    env = envs(2)
    env.reset(seed=[0, 1])
    env._envs.simulations.fields["qvel"][1, 12] = np.nan
    with pytest.raises(SimulationError, match="simulation 1: it has diverged"):
        env.step(np.zeros((2, 7)))
