"""The contract of environments; one simulation and many give the same results."""

import dataclasses

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from libero_env import BatchEnv, LiberoEnv, LiberoError, get_suite
from libero_env.init_states.store import generate_init_states, load_init_states
from libero_env.sim.observations import NAMES
from libero_env.sim.scene import build_scene

pytestmark = pytest.mark.sim
TASK = "libero_object/2"
SMALL = {"camera_size": (32, 48)}


@pytest.fixture
def env(closing):
    return closing(LiberoEnv(TASK, cameras=()))


def same(a, b):
    assert a.keys() == b.keys()
    for key in a:
        np.testing.assert_array_equal(a[key], b[key], err_msg=key)


def test_gymnasium_checks_pass(closing):
    env = closing(LiberoEnv(TASK, **SMALL, render_mode="rgb_array"))
    check_env(env, skip_render_check=True)


def test_the_same_seed_gives_the_same_episode(env):
    first, _ = env.reset(seed=11)
    env.step(np.ones(7))
    same(env.reset(seed=11)[0], first)
    other, _ = env.reset(seed=12)
    assert not np.array_equal(env.reset(seed=11)[0]["joint_states"], other["joint_states"])


def test_an_init_state_depends_on_nothing_else(env):
    env.reset(options={"init_state": 7})
    expected = env.get_state()
    env.reset(seed=5)
    for _ in range(3):
        env.step(env.action_space.sample())
    env.reset(seed=99, options={"init_state": 7})
    np.testing.assert_array_equal(env.get_state(), expected)


def test_an_episode_continues_from_a_state_to_the_same_bits(env):
    env.reset(options={"init_state": 3})
    commands = np.random.default_rng(0).uniform(-1, 1, (20, 7))
    for command in commands[:10]:
        env.step(command)
    state = env.get_state()
    expected = [env.step(command) for command in commands[10:]]
    env.set_state(state)
    for command, (observation, *rest) in zip(commands[10:], expected, strict=True):
        again, *rest_again = env.step(command)
        same(again, observation)
        assert rest_again == rest


def test_states_of_the_original_are_accepted(closing, shared):
    with np.load(shared / "parity" / "libero_object-00-random.npz") as z:
        state = z["states"][0]
    env = closing(LiberoEnv("libero_object/0", cameras=()))
    env.set_state(state)
    np.testing.assert_array_equal(env.simulations.physics_state(0), state)


def test_reaching_the_goal_terminates(env):
    """With the target moved into the basket, the goal is true and the episode ends."""
    env.reset(options={"init_state": 0})
    state, scene = env.simulations.physics_state(0), env.scene
    address = 1 + scene.pose_address(scene.goal_atoms[0].args[0])
    state[address : address + 3] = env.view.site_pos("basket_1_contain_region") + [0, 0, 0.02]
    env.set_state(state)
    _, reward, terminated, truncated, info = env.step(np.zeros(7))
    assert (reward, terminated, truncated, info["success"]) == (1.0, True, False, True)
    assert all(info["progress"].values())


@pytest.mark.parametrize(("num", "threads"), [(1, 1), (3, 2)])
def test_a_batch_gives_the_bits_of_single_environments(closing, num, threads):
    observations = [name for name in NAMES if name not in ("segmentation_class", "segmentation_element")]
    options = {"observations": observations, "reward": "staged", "horizon": 8, **SMALL}
    batch = closing(BatchEnv(TASK, num, num_threads=threads, **options))
    env = closing(LiberoEnv(TASK, **options))
    commands = np.random.default_rng(1).uniform(-1, 1, (8, num, 7))
    for how in ({"options": {"init_state": np.arange(num) + 4}}, {"seed": 21}):
        seen = [batch.reset(**how)[0]]
        results = [batch.step(command) for command in commands]
        seen += [result[0] for result in results]
        for i in range(num):
            single = {"seed": 21 + i} if "seed" in how else {"options": {"init_state": i + 4}}
            same({k: v[i] for k, v in seen[0].items()}, env.reset(**single)[0])
            for t in range(8):
                observation, reward, terminated, truncated, _ = env.step(commands[t, i])
                same({k: v[i] for k, v in seen[t + 1].items()}, observation)
                assert (reward, terminated, truncated) == tuple(r[i] for r in results[t][1:4])
            np.testing.assert_array_equal(batch.get_state(i), env.get_state())


def test_finished_simulations_do_not_move_until_reset(closing):
    batch = closing(BatchEnv(TASK, 3, cameras=(), horizon=4))
    batch.reset(options={"init_state": 0})
    for _ in range(2):
        batch.step(np.zeros((3, 7)))
    batch.reset(options={"init_state": 1, "reset_mask": [False, True, False]})
    for _ in range(2):
        _, _, _, truncated, _ = batch.step(np.ones((3, 7)))
    assert truncated.tolist() == [True, False, True]
    before = batch.get_state(0)
    _, reward, _, truncated, _ = batch.step(np.ones((3, 7)))
    np.testing.assert_array_equal(batch.get_state(0), before)
    assert reward[0] == 0 and not truncated[0]


def test_a_reset_of_no_simulation_changes_nothing(closing):
    batch = closing(BatchEnv(TASK, 2, cameras=()))
    batch.reset(seed=0)
    before = batch.get_state(0), batch.get_state(1)
    for start in ({}, {"init_state": 0}):
        batch.reset(options={"reset_mask": [False, False], **start})
    np.testing.assert_array_equal((batch.get_state(0), batch.get_state(1)), before)


def test_stored_initial_states_are_reproducible():
    task = get_suite("libero_object").tasks[4]
    scene = build_scene(task.problem)
    np.testing.assert_array_equal(generate_init_states(task, scene, 2), load_init_states(task, scene)[:2])


def test_initial_states_of_another_model_are_an_error():
    task = get_suite("libero_object").tasks[4]
    scene = dataclasses.replace(build_scene(task.problem))
    vars(scene)["digest"] = "0" * 16
    with pytest.raises(LiberoError, match="libero tasks init-states libero_object"):
        load_init_states(task, scene)


def test_a_batch_reports_the_progress_of_each_atom(closing):
    env = closing(BatchEnv("libero_10/3", 2, cameras=()))
    _, info = env.reset(options={"init_state": [0, 1]})
    drawer = "white_cabinet_1_bottom_region"
    assert env.atoms == (f"(Close {drawer})", f"(In akita_black_bowl_1 {drawer})")
    np.testing.assert_array_equal(info["progress"], [[False, False], [False, False]])
    state = env.get_state(0)
    qpos = env.scene.model.joint("white_cabinet_1_bottom_level").qposadr[0]
    state[1 + qpos] = 0.0015  # pushed in, empty
    env.set_state(0, state)
    info = env.step(np.zeros((2, 7)))[-1]
    np.testing.assert_array_equal(info["progress"], [[True, False], [False, False]])
