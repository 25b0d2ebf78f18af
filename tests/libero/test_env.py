"""Environments: observations, states, fixtures, success and cameras."""

import copy
import gc
import json
import re
import weakref
from xml.etree.ElementTree import Element

import mujoco
import numpy as np
import pytest

from libero._adapters.observations import Observable
from libero.libero import benchmark
from libero.libero.envs import TASK_MAPPING, ControlEnv, OffScreenRenderEnv, SegmentationRenderEnv, arenas
from libero.libero.envs.bddl_base_domain import BDDLBaseDomain, EpisodeOverError, register_problem
from libero.libero.envs.objects import TargetZone, get_object_fn
from libero_env import errors
from libero_env.assets.robot import REST_QPOS
from libero_env.errors import InvalidInputError, LiberoError, UnknownNameError
from libero_env.sim.render import Renderer

pytestmark = pytest.mark.sim
BLIND = {"use_camera_obs": False}
REST = [0.0] * 6 + [-1.0]


def test_observations_under_the_original_names(make_env, suite):
    env = make_env(OffScreenRenderEnv, camera_heights=32, camera_widths=48, camera_depths=True)
    obs = env.set_init_state(suite.get_task_init_states(0)[0])
    assert obs["robot0_proprio-state"].shape == (39,)
    assert obs["object-state"].shape == (7 * 14,)
    assert obs["agentview_image"].shape == (32, 48, 3)
    assert obs["agentview_image"].dtype == np.uint8
    assert obs["robot0_eye_in_hand_depth"].shape == (32, 48, 1)
    assert 0 <= obs["agentview_depth"].min() < obs["agentview_depth"].max() <= 1
    w, pos = obs["milk_1_quat"][3], obs["milk_1_pos"]
    assert np.isclose(w, env.sim.data.get_body_xquat("milk_1_main")[0])
    hand = env.sim.data.get_body_xmat("robot0_right_hand")
    assert np.allclose(hand @ obs["milk_1_to_robot0_eef_pos"] + obs["robot0_eef_pos"], pos)
    assert env.env.get_robot_state_vector(obs).shape == (9,)


def test_nothing_is_drawn_without_camera_observations(make_env, monkeypatch):
    monkeypatch.setattr(Renderer, "_open", lambda self: pytest.fail("a GL context was opened"))
    env = make_env(**BLIND)
    env.reset()
    assert "agentview_image" not in env.step(REST)[0]


def test_horizon(make_env):
    env = make_env(**BLIND, horizon=2)
    env.reset()
    for _ in range(2):
        assert env.step(REST)[1:] == (0.0, False, {"success": False})
    env.set_init_state(env.get_sim_state())  # not a reset, as in the original
    with pytest.raises(EpisodeOverError, match="2 steps"):
        env.step(REST)
    env.reset()
    env.step(REST)


def test_after_a_step_poses_are_of_the_substep_before_as_mj_step_leaves_them(make_env):
    env = make_env(**BLIND)
    env.reset()
    env.step([1.0] * 7)
    model, data = env.sim.model._model, env.sim.data
    left, end = data.xpos.copy(), data.qpos.copy()
    mujoco.mj_integratePos(model, data.qpos, data.qvel, -model.opt.timestep)
    env.sim.forward()
    assert np.allclose(data.xpos, left, rtol=0, atol=1e-12)
    data.qpos[:] = end
    env.sim.forward()
    assert np.abs(data.xpos - left).max() > 1e-5


@pytest.mark.parametrize("own", [3, None])
def test_the_seed_determines_the_placement_or_without_one_numpys(make_env, own):
    states = []
    for seed in (5, 5, 6):
        np.random.seed(seed)  # noqa: NPY002 - as scripts of the original do
        env = make_env(**BLIND)
        if own is not None:
            env.seed(own)
        env.reset()
        states.append(env.get_sim_state())
    assert (states[0] == states[1]).all() and (states[0] == states[2]).all() == (own is not None)
    env.reset()
    assert (env.get_sim_state() != states[2]).any()


def test_states_are_restored(make_env, suite):
    env = make_env(**BLIND)
    row = suite.get_task_init_states(0)[1]
    env.set_init_state(row)
    assert (env.get_sim_state() == row[: env.get_sim_state().size]).all()
    for _ in range(3):
        env.step(REST)
    state = env.get_sim_state()
    env.step(REST)
    obs = env.regenerate_obs_from_state(state)
    assert (env.get_sim_state() == state).all()
    assert (obs["robot0_joint_pos"] == state[1:8]).all()
    assert env.sim.get_state().flatten().tolist() == state.tolist()
    with pytest.raises(LiberoError, match="another task"):
        env.set_init_state(state[:-1])


def test_clients_can_move_fixtures(make_env, stove):
    env, other = make_env(file=stove, **BLIND), make_env(file=stove, **BLIND)
    env.reset()
    model, fixture = env.sim.model, env.env.fixtures_dict["flat_stove_1"]
    body = model.body_name2id(fixture.root_body)
    other.seed(0)
    other.reset()
    before = other.sim.data.get_body_xpos(fixture.root_body).copy()
    model.body_pos[body] = before + (0.01, 0.02, 0.0)
    mujoco.mj_forward(model._model, env.sim.data._data)
    expected = before + (0.01, 0.02, 0.0)
    assert np.allclose(env.env.object_states_dict["flat_stove_1"].get_geom_state()["pos"], expected)
    env.set_init_state(env.get_sim_state())
    env.step(REST)
    assert np.allclose(env.sim.data.get_body_xpos(fixture.root_body), expected)
    assert (other.sim.data.get_body_xpos(fixture.root_body) == before).all(), "models are not shared"
    xml = env.sim.model.get_xml()
    other.reset_from_xml_string(xml)
    assert np.allclose(other.sim.data.get_body_xpos(fixture.root_body), expected, atol=1e-5)


@pytest.fixture
def stove() -> str:
    goal = benchmark.get_benchmark("libero_goal")()
    return goal.get_task_bddl_file_path(goal.get_task_names().index("turn_on_the_stove"))


def test_a_model_is_built_again_from_its_text(make_env, stove):
    env = make_env(OffScreenRenderEnv, stove, camera_heights=64, camera_widths=64)
    env.seed(0)
    env.reset()
    state, xml = env.get_sim_state(), env.sim.model.get_xml()
    before = env.set_init_state(state)
    env.reset_from_xml_string(xml)
    assert np.allclose(env.get_sim_state()[1:8], REST_QPOS), "the arm is at rest"
    same = env.set_init_state(state)
    assert (env.get_sim_state() == state).all()
    assert np.allclose(same["object-state"], before["object-state"], atol=1e-6)
    images = {key: before[key].astype(int) for key in before if key.endswith("_image")}
    assert all(np.abs(same[key] - image).mean() < 0.1 for key, image in images.items()), "with its textures"
    moved = re.sub(r'(<camera[^>]*name="agentview"[^>]*pos=")[^"]*', r"\g<1>1 0.5 2", xml)
    assert moved != xml
    env.reset_from_xml_string(moved)
    assert env.sim.model.cam_pos[env.sim.model.camera_name2id("agentview")].tolist() == [1.0, 0.5, 2.0]
    assert np.abs(env.set_init_state(state)["agentview_image"] - images["agentview_image"]).mean() > 10
    assert 'pos="1 0.5 2"' in env.sim.model.get_xml(), "the edit is part of the model"
    env.step(np.zeros(7))
    with pytest.raises(errors.DemoError, match="not XML"):
        env.reset_from_xml_string("<mujoco")
    with pytest.warns(UserWarning, match="only the poses of the fixtures"):
        env.reset_from_xml_string('<mujoco><asset><mesh name="a" file="/absent/a.obj"/></asset></mujoco>')
    with pytest.raises(LiberoError, match="another task"):
        env.reset_from_xml_string("<mujoco/>")


def test_turning_a_stove_on_is_success(make_env, stove):
    env = make_env(file=stove, **BLIND)
    env.reset()
    env.env.object_states_dict["flat_stove_1"].set_joint(-0.004)
    assert env.env._eval_predicate(["Turnoff", "flat_stove_1"])
    env.env.object_states_dict["flat_stove_1"].set_joint(1.5)
    assert env.check_success()
    assert env.step(REST)[1:3] == (1.0, True)
    with pytest.raises(UnknownNameError, match="flat_stove_1"):
        env.env._eval_predicate(["turnon", "flat_stove_2"])


def test_goal_by_placing(make_env):
    env = make_env(**BLIND)
    env.reset()
    data, basket = env.sim.data, env.sim.data.get_body_xpos("basket_1_main")
    data.set_joint_qpos("alphabet_soup_1_joint0", [*(basket + (0, 0, 0.02)), 1, 0, 0, 0])
    env.sim.forward()
    assert env.check_success()
    states = env.env.object_states_dict
    assert states["basket_1_contain_region"].check_contain(states["alphabet_soup_1"])
    assert not env.env._eval_predicate(["not", ["in", "alphabet_soup_1", "basket_1_contain_region"]])


def test_segmentation(make_env, suite):
    env = make_env(SegmentationRenderEnv, camera_heights=96, camera_widths=96)
    env.reset()
    obs = env.set_init_state(suite.get_task_init_states(0)[0])
    image = obs["agentview_segmentation_instance"]
    assert image.shape == (96, 96, 1)
    assert set(np.unique(image)) >= {0, env.instance_to_id["basket_1"], env.segmentation_robot_id + 1}
    parts = env.get_segmentation_instances(image)
    assert (sum(np.minimum(part, 1) for part in parts.values()) == (image > 0)).all()
    interest = env.get_segmentation_of_interest(image)
    assert set(np.unique(interest)) == {-1, 0, 1}
    assert ((interest == 1) == np.isin(image, [env.instance_to_id[n] for n in env.obj_of_interest])).all()


def test_a_problem_class_may_load_everything_as_the_originals_do(suite):
    """They fill dictionaries of objects, append sites of regions, and keep settings of their own."""

    class Libero_Floor_Manipulation(TASK_MAPPING["libero_floor_manipulation"]):
        extra: tuple = ()

        def __init__(self, bddl_file_name, *args, **kwargs):
            self.workspace_name, self.visualization_sites_list, self.z_offset = "floor", [], -0.025
            kwargs |= {"workspace_offset": (0, 0, -0.035), "arena_type": "floor"}
            super().__init__(bddl_file_name, *args, **kwargs)

        def _load_objects_in_arena(self, mujoco_arena):
            for category, names in self.parsed_problem["objects"].items():
                for name in (*names, *self.extra):
                    self.objects_dict[name] = get_object_fn(category)(name=name)

        def _load_sites_in_arena(self, mujoco_arena):
            for name, region in self.parsed_problem["regions"].items():
                if region["ranges"]:
                    zone = TargetZone(name=name, zone_size=(0.1, 0.1))
                    mujoco_arena.floor_body.append(Element("site", name=zone.name, quat=str(zone.quat)))
                    self.object_sites_dict[name] = zone

        def _setup_references(self):
            super()._setup_references()
            self.is_set_up = True

        def set_visualization(self):
            for name in self.visualization_sites_list:
                assert self.get_object(name).object_properties["vis_site_names"] == {}

    env = Libero_Floor_Manipulation(suite.get_task_bddl_file_path(0), use_camera_obs=False)
    env.reset()
    assert env.is_set_up and not env.step(np.zeros(env.action_dim))[2]
    assert set(env.objects_dict) == set(env.scene.objects)
    env.close()
    Libero_Floor_Manipulation.extra = ("second_milk",)
    with pytest.raises(LiberoError, match="unknown object or fixture of the task file 'second_milk'"):
        Libero_Floor_Manipulation(suite.get_task_bddl_file_path(0), use_camera_obs=False)
    with pytest.raises(LiberoError, match="<geom name='box'> cannot be appended"):
        arenas.Arena(mujoco.MjSpec()).floor_body.append(Element("geom", name="box"))


def test_a_problem_class_can_move_a_camera(make_env):
    @register_problem
    class Libero_Floor_Manipulation(BDDLBaseDomain):
        def _setup_camera(self, mujoco_arena):
            mujoco_arena.set_camera("agentview", (2.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))

    env = make_env(**BLIND)
    for _ in range(2):
        assert env.sim.data.model.camera("agentview").pos.tolist() == [2.0, 0.0, 1.0]
        env.reset()


def test_observations_match_the_recordings(shared, make_env):
    with np.load(shared / "parity" / "libero_object-00-random.npz", allow_pickle=False) as stored:
        keys, states, actions, seen = (stored[k] for k in ("obs_keys", "states", "actions", "obs"))
    env = make_env(**BLIND)
    env.reset()
    env.set_init_state(states[0])
    env.robots[0].controller.update(force=True)  # as when it was recorded; the controller is of the reset
    env.robots[0].controller.reset_goal()
    for action, expected in zip(actions[:25], seen, strict=False):
        obs = env.step(action)[0]
        found = np.concatenate([np.ravel(obs[key]) for key in json.loads(str(keys))])
        assert np.abs(found - expected)[[*range(7), *range(14, 23)]].max() < 1e-6


def test_the_controller_is_of_the_reset_until_the_first_step(make_env):
    """As in the original: after `set_init_state` the first goal is relative to the pose that the reset left."""
    env = make_env(**BLIND)
    env.seed(0)
    env.reset()
    moved = env.get_sim_state()
    moved[1:8] += 0.05  # the arm's joints
    ends = []
    for measured in (False, True, None):
        env.reset()
        if measured is None:
            env.step([0.0] * 7)
        env.set_init_state(moved)
        if measured:
            env.robots[0].controller.update(force=True)
            env.robots[0].controller.reset_goal()
        for _ in range(10):
            obs = env.step([0.0] * 6 + [-1.0])[0]
        ends.append(obs["robot0_joint_pos"] - moved[1:8])
    kept, updated, stepped = (np.abs(end).max() for end in ends)
    assert kept > 0.03 and updated < 0.02 and stepped < 0.03


def test_contacts_and_grasps_have_robosuites_methods(make_env):
    env = make_env(**BLIND)
    env.reset()
    env.step(REST)
    domain, gripper = env.env, env.robots[0].gripper
    names = set(env.sim.model.geom_names)
    assert all(geom in names for geoms in gripper.important_geoms.values() for geom in geoms)
    assert set(gripper.important_geoms["left_finger"]) <= set(gripper.contact_geoms)
    soup = domain.get_object("alphabet_soup_1")
    floor = domain.get_contacts(soup)
    assert floor and domain.check_contact(soup) and domain.check_contact(soup, sorted(floor))
    assert not domain.check_contact(gripper, soup) and not domain._check_grasp(gripper, soup)
    away = domain._gripper_to_target(gripper, soup)
    data = env.sim.data
    expected = data.get_body_xpos("alphabet_soup_1_main") - data.get_site_xpos("gripper0_grip_site")
    assert np.allclose(away, expected)
    distance = domain._gripper_to_target(gripper, "alphabet_soup_1_main", return_distance=True)
    assert np.isclose(distance, np.linalg.norm(away))
    pads = [data.get_geom_xpos(gripper.important_geoms[f"{s}_fingerpad"][0]) for s in ("left", "right")]
    data.set_joint_qpos("alphabet_soup_1_joint0", [*np.mean(pads, axis=0), 1, 0, 0, 0])  # between them
    data.qpos[7:9] = 0.005, -0.005
    env.sim.forward()
    assert domain._check_grasp(gripper, soup) and domain.check_contact(gripper, soup)


def test_sites_are_shown_as_robosuite_shows_them(make_env):
    env = make_env(OffScreenRenderEnv, camera_heights=64, camera_widths=64)
    plain = env.reset()["robot0_eye_in_hand_image"]
    alpha = env.sim.model.site_rgba[:, 3]
    assert alpha.min() < 0 and alpha.max() == 0  # hidden

    def picture(**shown):
        env.env.visualize({"env": False, "robots": False, "grippers": False, **shown})
        return env.regenerate_obs_from_state(env.get_sim_state())["robot0_eye_in_hand_image"]

    assert (picture() == plain).all() and (picture(robots=True) == plain).all()
    assert (picture(grippers=True) != plain).mean() > 0.01
    assert (picture() == plain).all()


def test_robosuites_wrappers(suite, tmp_path):
    wrappers = pytest.importorskip("robosuite.wrappers")
    path = suite.get_task_bddl_file_path(0)
    env = TASK_MAPPING["libero_floor_manipulation"](
        path, controller_configs={"type": "OSC_POSE"}, camera_heights=64, camera_widths=64
    )
    env.reset()
    shown = wrappers.VisualizationWrapper(env, indicator_configs="default")
    shown.set_indicator_pos("indicator0", [0.3, 0.0, 0.3])
    picture = shown.step(np.zeros(7))[0]["agentview_image"].astype(int)
    assert (picture[..., 0] - picture[..., 1] > 80).sum() > 10, "a red ball"
    recorded = wrappers.DataCollectionWrapper(shown, str(tmp_path))
    recorded.reset()
    for _ in range(3):
        recorded.step(np.zeros(7))
    size = env.sim.get_state().flatten().size
    recorded.close()
    (file,) = tmp_path.glob("*/*.npz")
    with np.load(file, allow_pickle=True) as stored:
        assert stored["states"].shape == (4, size)


def test_observables_can_be_changed(make_env):
    env = make_env(**BLIND).env
    plain = env.reset()
    assert "robot0_eef_pos" in env.observation_names == env.active_observables
    env.modify_observable("robot0_eef_pos", "corrupter", lambda value: value + 1.0)
    env.modify_observable("milk_1_pos", "active", False)
    env.modify_observable("milk_1_quat", "enabled", False)
    env.add_observable(Observable("height", lambda seen: seen["robot0_eef_pos"][2], modality="object"))
    changed = env._get_observations(force_update=True)
    assert (changed["robot0_eef_pos"] == plain["robot0_eef_pos"] + 1.0).all()
    assert "milk_1_pos" not in changed and "milk_1_quat" not in changed
    assert changed["height"] == changed["robot0_eef_pos"][2]
    assert changed["object-state"].shape == (plain["object-state"].size - 7 + 1,)
    assert changed["robot0_proprio-state"].shape == plain["robot0_proprio-state"].shape
    with pytest.raises(UnknownNameError, match="corrupter"):
        env.modify_observable("height", "sampling_rate", 5)
    with pytest.raises(UnknownNameError, match="robot0_eef_pos"):
        env.modify_observable("robot0_eef_poss", "enabled", False)
    with pytest.raises(LiberoError, match="modify_observable"):
        env.add_observable(Observable("height"))


def test_a_domain_of_a_clients_own_changes_resets_actions_and_observables(suite):
    class Own(BDDLBaseDomain):
        acted = 0

        def _reset_internal(self):
            super()._reset_internal()
            self.sim.data.qpos[7:9] = 0.0

        def _pre_action(self, action, policy_step=False):
            super()._pre_action(action, policy_step=policy_step)
            self.acted += 1

        def _setup_observables(self):
            observables = super()._setup_observables()
            observables["two"] = Observable("two", lambda seen: 2.0)
            return observables

    env = Own(suite.get_task_bddl_file_path(0), controller_configs="OSC_POSE", **BLIND)
    obs = env.reset()
    assert obs["robot0_gripper_qpos"].tolist() == [0.0, 0.0] and obs["two"] == 2.0
    env.step(REST)
    assert env.acted == 1
    env.close()


def test_a_closed_environment_frees_its_model_at_once(suite):
    """A client that makes environments of many tasks has no call of the garbage collector between them."""
    env = ControlEnv(bddl_file_name=suite.get_task_bddl_file_path(0), use_camera_obs=False)
    env.reset()
    kept = [weakref.ref(env.env.simulations), weakref.ref(env.env.sim)]
    gc.disable()
    try:
        env.close()
        assert [one() for one in kept] == [None, None]
    finally:
        gc.enable()


def test_refused_calls_change_nothing_and_closed_environments_say_so(suite):
    options = {"bddl_file_name": suite.get_task_bddl_file_path(0), "use_camera_obs": False}
    for horizon in (0, -5, "a", None, True, 1j, float("nan")):
        with pytest.raises(InvalidInputError, match="horizon is"):
            ControlEnv(**options, horizon=horizon)
    env = ControlEnv(**options, horizon=np.inf)  # as robosuite takes it
    env.seed(0)
    env.reset()
    state = env.get_sim_state()
    for bad in (state * np.nan, state[:-1], "a", None, state * 1j, state + 1e12, [[1], [2, 3]]):
        for use in (env.set_state, env.set_init_state):
            with pytest.raises(InvalidInputError, match="a state of"):
                use(bad)
    for bad in (np.zeros(7) * 1j, ["1"] * 7, None, np.zeros(8), np.full(7, np.nan)):
        with pytest.raises(errors.ActionError):
            env.step(bad)
    np.testing.assert_array_equal(env.get_sim_state(), state)
    env.step([0, 0, 0, 1e-170, 0, 0, 0])
    with pytest.raises(InvalidInputError, match="cannot be copied"):
        copy.deepcopy(env)
    env.close()
    env.close()
    for use in (env.reset, lambda: env.step(np.zeros(7)), lambda: env.set_init_state(state), env.env.render):
        with pytest.raises(errors.ClosedEnvironmentError, match="closed; make another"):
            use()
