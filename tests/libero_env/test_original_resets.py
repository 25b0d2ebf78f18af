"""Fixtures stand where the original's resets draw them; its controller starts as outdated as the original's.

`data/original_resets.json` was recorded with hf-libero 0.1.4 and robosuite 1.4.0: for a task and a seed,
`env.seed(seed)` and six times `env.reset()`; after each the poses of the fixtures, and a digest of NumPy's generator.
`data/original_start.npz`: `env.seed(7)`, `env.reset()`, `set_init_state(states[0])`, ten waiting steps, 20 random ones.
"""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from libero_env.envs import BatchEnv
from libero_env.errors import LiberoError
from libero_env.init_states.original_resets import OriginalResets, drawn_fixtures
from libero_env.sim.scene import build_scene
from libero_env.tasks import get_task

pytestmark = pytest.mark.sim
DATA = Path(__file__).parent / "data"
RECORDED = json.loads((DATA / "original_resets.json").read_text())


@pytest.mark.parametrize("task", RECORDED)
def test_resets_draw_what_the_original_draws(task):
    scene = build_scene(get_task(task).problem)
    for seed, rows in RECORDED[task].items():
        resets = OriginalResets(scene, int(seed))
        for row in rows:
            poses = resets.reset()
            expected = np.array([row["fixtures"][name] for name in scene.fixtures]).reshape(-1, 7)
            np.testing.assert_allclose(poses, expected, rtol=0, atol=1e-15)
            _, keys, position, has_gauss, _ = resets._rng.get_state(legacy=True)
            digest = hashlib.sha256(keys.tobytes() + bytes([position % 256, has_gauss])).hexdigest()[:16]
            assert digest == row["rng"], "rejected placements have drawn as many numbers"


def test_fixtures_of_the_facade_stand_where_the_original_draws_them(monkeypatch, tmp_path):
    from libero.libero import benchmark
    from libero.libero.envs.env_wrapper import ControlEnv

    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path))
    task = next(name for name in RECORDED if name.startswith("libero_goal/"))
    suite = benchmark.get_benchmark("libero_goal")()
    path = suite.get_task_bddl_file_path(int(task.partition("/")[2]))
    env = ControlEnv(bddl_file_name=path, use_camera_obs=False)
    env.seed(7)
    for row in RECORDED[task]["7"][:3]:
        env.reset()
        for name, pose in row["fixtures"].items():
            body = env.sim.model.body_name2id(env.env.fixtures_dict[name].root_body)
            found = np.concatenate([env.sim.model.body_pos[body], env.sim.model.body_quat[body]])
            np.testing.assert_allclose(found, pose, rtol=0, atol=1e-15)
    env.close()


def test_an_environment_that_was_loaded_more_often_draws_more_joints():
    scene = build_scene(get_task("libero_10/3").problem)  # a drawer is open at the start
    first, second = (next(iter(drawn_fixtures(scene, 7, 1, loads))) for loads in (1, 2))
    assert not np.array_equal(first, second)


@pytest.mark.parametrize("num_envs", [1, 2])
def test_the_first_steps_are_those_of_the_original(closing, num_envs):
    with np.load(DATA / "original_start.npz") as recorded:
        actions, qpos, start = recorded["actions"], recorded["qpos"], recorded["start"]
    task = "libero_goal/3"
    env = closing(BatchEnv(task, num_envs, cameras=()))
    (fixtures,) = drawn_fixtures(env.scene, 7, 1)
    rows = np.tile(np.concatenate([start, fixtures.ravel()]), (num_envs, 1))
    env.reset(options={"start": rows, "outdated_controller": True})
    far = env.simulations.fields["qpos"][-1, :9].copy()
    for action, expected in zip(actions, qpos[1:], strict=True):
        env.step(np.tile(action, (num_envs, 1)))
        np.testing.assert_allclose(env.simulations.fields["qpos"][-1, :9], expected, rtol=0, atol=1e-7)
    env.reset(options={"start": rows})
    np.testing.assert_array_equal(env.simulations.fields["qpos"][-1, :9], far)
    env.step(np.tile(actions[0], (num_envs, 1)))
    other = np.abs(env.simulations.fields["qpos"][-1, :9] - qpos[1]).max()
    assert other > 1e-3, "a controller that knows the arm's pose starts otherwise"


def test_starts_of_another_task_are_refused(closing):
    env = closing(BatchEnv("libero_goal/3", 2, cameras=()))
    with pytest.raises(LiberoError, match=r"libero_goal/3: a start has \d+ numbers.*3 fixtures; got 5"):
        env.reset(options={"start": np.zeros((2, 5))})
    with pytest.raises(LiberoError, match="start: expected 2 rows"):
        env.reset(options={"start": np.zeros((1, 5))})
