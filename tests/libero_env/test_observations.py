"""Observations: images agree with each other and with the state, and are rendered only on request."""

import gc
import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from libero_env.envs.batch import BatchEnv
from libero_env.envs.env import LiberoEnv
from libero_env.errors import LiberoError, UnknownNameError
from libero_env.geometry import quat_multiply, quat_rotate
from libero_env.registration import env_ids
from libero_env.sim.observations import NAMES, PROPRIOCEPTION
from libero_env.sim.predicates import glowing_sites
from libero_env.sim.rewards import Reward, atom_progress, joint_progress, staged_reward
from libero_env.tasks import get_suite, suite_names

pytestmark = pytest.mark.sim
TASK = "libero_object/2"
STOVE = "libero_goal/7"  # turn it on
EVERYTHING = [n for n in NAMES if n not in ("segmentation_class", "segmentation_element")]


@pytest.fixture(scope="module")
def kitchen():
    env = LiberoEnv(STOVE, camera_size=(96, 128), observations=EVERYTHING)
    env.reset(seed=0)
    yield env
    env.close()


def world_points(env, camera, depth):
    """Return the world position of each pixel's surface, (H, W, 3), from depth and camera parameters."""
    observer = env.observer
    rows, cols = np.indices(depth.shape)
    pixels = np.stack([cols + 0.5, rows + 0.5, np.ones(depth.shape)], -1)
    rays = pixels @ np.linalg.inv(observer.intrinsics(camera)).T
    pose = observer.camera_to_world(0, camera)
    return rays * depth[..., None] @ pose[:3, :3].T + pose[:3, 3]


def turned_on(env):
    state, model = env.get_state(), env.scene.model
    state[1 + model.joint("flat_stove_1_button").qposadr[0]] = 1.5
    return state


def test_the_page_on_state_and_action_has_the_limits_of_the_model(kitchen):
    """Rows such as | | 5 | `robot0_joint6` | | rad | -0.0175 ... 3.7525 |, in the order of qpos."""
    page = (Path(__file__).parents[2] / "docs" / "state-and-action.md").read_text()
    limits = r"(\S+)(?: \(\w+\))? \.\.\. (\S+)(?: \(\w+\))?"
    rows, model = re.findall(rf"\| (\d) \| `(\w+joint\d)` \|.*\| {limits} \|", page), kitchen.scene.model
    assert [name for _, name, _, _ in rows] == [model.joint(i).name for i in range(9)]
    assert [int(index) for index, _, _, _ in rows] == [*range(7), 0, 1]
    ranges = [sorted((float(low), float(high))) for _, _, low, high in rows]
    np.testing.assert_allclose(ranges, model.jnt_range[:9])


def test_each_name_gives_the_documented_entries(closing, kitchen):
    seen = kitchen.set_state(kitchen.get_state())
    assert kitchen.observation_space.contains(seen)
    assert seen["agentview_depth"].dtype == np.float32 and seen["agentview_segmentation"].dtype == np.int32
    assert seen["agentview_rgb"].shape == (96, 128, 3) and seen["eye_in_hand_depth"].shape == (96, 128)
    np.testing.assert_array_equal(seen["akita_black_bowl_1_pos"], kitchen.view.body_pos("akita_black_bowl_1"))
    assert seen["wooden_cabinet_1_joints"].shape == (3,) and seen["flat_stove_1_joints"].shape == (1,)
    few = closing(LiberoEnv(TASK, cameras=(), observations=["ee_quat", "objects"]))
    assert "joint_states" not in few.reset(seed=0)[0]


def test_default_observations_are_images_and_proprioception(closing):
    env = closing(LiberoEnv(TASK, camera_size=(8, 8)))
    assert list(env.reset(seed=0)[0]) == ["agentview_rgb", "eye_in_hand_rgb", *PROPRIOCEPTION]


def test_depth_and_segmentation_agree_with_object_positions(kitchen):
    seen = kitchen.render_cameras()
    labels = kitchen.observer.labels()
    points = world_points(kitchen, "agentview", seen["agentview_depth"])
    found = 0
    for number, name in labels.items():
        pixels = points[seen["agentview_segmentation"] == number]
        if kitchen.view.is_entity(name) and len(pixels):
            low, high = kitchen.view.bounds(name)
            inside = ((pixels > low - 0.02) & (pixels < high + 0.02)).all(1)
            assert inside.mean() > 0.95, name
            found += 1
    assert found >= 5
    assert {labels[n] for n in (0, 1, 2)} == {"arena", "robot", "gripper"}


def test_kinds_of_segmentation_agree(kitchen):
    kinds, render = ("instance", "class", "element"), kitchen.observer.render
    of = {kind: render(0, "agentview", f"segmentation_{kind}") for kind in kinds}
    names = {kind: kitchen.observer.labels(kind) for kind in of}
    scene = kitchen.scene
    for instance, category, element in {*zip(*(of[kind].ravel().tolist() for kind in of), strict=True)}:
        name = names["instance"][instance]
        expected = scene.entities[name].category if name in scene.entities else name
        assert names["class"][category] == expected
        if name in scene.entities:
            assert scene.model.geom_bodyid[element - 1] in scene.bodies[name]
    with pytest.raises(LiberoError, match="one kind"):
        LiberoEnv(TASK, observations=["segmentation_class", "segmentation_element"])


def test_poses_in_the_hand_frame_transform_back_to_the_world(kitchen):
    seen = kitchen.set_state(kitchen.get_state())
    for name in kitchen.scene.entities:
        back = quat_rotate(seen["ee_quat"][None], seen[f"{name}_to_ee_pos"][None])[0] + seen["ee_pos"]
        np.testing.assert_allclose(back, seen[f"{name}_pos"], atol=1e-9)
        quat = quat_multiply(seen["ee_quat"][None], seen[f"{name}_to_ee_quat"][None])[0]
        assert abs(quat @ seen[f"{name}_quat"]) == pytest.approx(1.0)


def test_a_glowing_site_is_visible_only_while_turned_on(kitchen):
    before = kitchen.get_state()
    off = kitchen.set_state(before)
    assert not glowing_sites(kitchen.view)
    on = kitchen.set_state(turned_on(kitchen))
    assert glowing_sites(kitchen.view)
    redder = on["agentview_rgb"].astype(int)[..., 0] - off["agentview_rgb"].astype(int)[..., 0]
    assert (redder > 100).sum() > 5
    element = kitchen.observer.render(0, "agentview", "segmentation_element")
    site = 1 + kitchen.scene.model.ngeom + next(iter(glowing_sites(kitchen.view)))
    assert (element == site).any()
    again = kitchen.set_state(before)
    np.testing.assert_array_equal(again["agentview_rgb"], off["agentview_rgb"])


@pytest.mark.parametrize("make", [LiberoEnv, lambda *args, **kwargs: BatchEnv(*args, 2, **kwargs)])
def test_images_are_rendered_only_on_request(make, monkeypatch):
    env = make(TASK, camera_size=(16, 16))
    drawn = []
    renderer = env.observer.renderer
    render = renderer.render
    monkeypatch.setattr(renderer, "render", lambda *args: drawn.append(1) or render(*args))
    env.render_images = False
    seen, _ = env.reset(options={"init_state": 0})
    still = np.zeros(env.action_space.shape)
    for _ in range(3):
        seen = env.step(still)[0]
    assert not drawn and not seen["agentview_rgb"].any()
    frames = env.render_cameras()
    env.render_images = True
    state = env.get_state() if make is LiberoEnv else env.get_state(0)
    seen = env.step(still)[0]
    assert drawn and seen["agentview_rgb"].any()
    if make is LiberoEnv:
        np.testing.assert_array_equal(env.set_state(state)["agentview_rgb"], frames["agentview_rgb"])
    env.close()


def test_pictures_do_not_depend_on_environments_that_were_not_closed(closing):
    left = LiberoEnv(TASK, camera_size=(16, 16))
    left.reset(options={"init_state": 0})
    env = closing(LiberoEnv(STOVE, camera_size=(16, 16)))
    first, _ = env.reset(options={"init_state": 0})
    del left
    gc.collect()
    again, _ = env.reset(options={"init_state": 0})
    for camera in ("agentview_rgb", "eye_in_hand_rgb"):
        np.testing.assert_array_equal(first[camera], again[camera])


def test_observations_are_copies(closing):
    env = closing(LiberoEnv(TASK, camera_size=(8, 8)))
    first, _ = env.reset(seed=0)
    copy = {key: value.copy() for key, value in first.items()}
    env.step(np.ones(7))
    for key in first:
        np.testing.assert_array_equal(first[key], copy[key])


def test_staged_rewards_increase_towards_the_goal_and_only_success_gives_one(closing, kitchen):
    env = closing(LiberoEnv(STOVE, cameras=(), reward="staged", reward_scale=2.0))
    env.reset(seed=0)
    _, reward, *_ = env.step(np.zeros(7))
    assert 0 < reward < 2
    atom, address = env.batch.goals.atoms[0], 1 + env.scene.model.joint("flat_stove_1_button").qposadr[0]
    state, shares = env.get_state(), []
    for angle in (0.0, 0.1, 0.3, 0.45):
        state[address] = angle
        env.set_state(state)
        shares.append((joint_progress(env.view, "flat_stove_1", "turnon"), atom_progress(env.view, atom)))
    assert shares == sorted(shares) and shares[-1][0] < 1 and shares[0][1] < shares[-1][1] < 0.9
    env.set_state(turned_on(env))
    _, reward, terminated, *_ = env.step(np.zeros(7))
    assert terminated and reward == 2.0
    assert staged_reward(env.view, [atom], [True]) == 0.99  # atoms hold, the goal does not
    with pytest.raises(UnknownNameError, match="staged"):
        Reward("dense")


@pytest.mark.parametrize("suite", suite_names())
def test_every_goal_has_a_staged_reward(suite):
    for task in get_suite(suite).tasks[:: max(1, len(get_suite(suite)) // 3)]:
        env = LiberoEnv(task, cameras=(), reward="staged", observations=["ee_pos"])
        scene = env.scene
        env.simulations.reset([0], scene.model.qpos0[None], np.zeros((1, scene.model.nv)))
        for atom in env.batch.goals.atoms:
            assert 0 < atom_progress(env.view, atom) <= 0.9, (task.name, atom)
        assert len(env.batch.goals.atoms) == len(env.batch.check_goal(0)[1]) > 0
        env.close()


def test_gymnasium_makes_every_task_by_name():
    ids = env_ids()
    assert set(ids) <= set(gymnasium.registry)
    assert ids["libero/libero_object-3"] == "libero_object/3"
    assert {name.split("-")[0].removeprefix("libero/") for name in ids} == set(suite_names())
    assert all(f"libero/{name}-{len(get_suite(name)) - 1}" in ids for name in suite_names())
    env = gymnasium.make("libero/libero_object-3", camera_size=(16, 16), render_mode="rgb_array")
    check_env(env.unwrapped, skip_render_check=True)  # it opens windows
    assert env.unwrapped.render().shape == (16, 16, 3)
    env.close()
    many = gymnasium.make_vec("libero/libero_object-3", num_envs=2, camera_size=(16, 16))
    assert isinstance(many, BatchEnv) and many.spec.id == "libero/libero_object-3"
    seen, _ = many.reset(seed=1)
    assert many.observation_space.contains(seen)
    seen, rewards, terminated, truncated, _ = many.step(many.action_space.sample())
    assert many.observation_space.contains(seen)
    assert rewards.shape == terminated.shape == truncated.shape == (2,)
    many.close()
