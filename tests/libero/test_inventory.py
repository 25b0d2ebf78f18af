"""Every public name of the original exists, and those of its environment half work."""

import importlib
import inspect
import json
import re
from pathlib import Path

import numpy as np
import pytest

from libero.libero.envs import ControlEnv
from libero.libero.envs.base_object import OBJECTS_DICT
from libero_env.errors import LiberoError
from tests.harness.inventory import inventory

pytestmark = pytest.mark.sim

NAMES = {
    "libero.libero": """libero_config_path config_file get_default_path_dict get_libero_path get_assets_path
        set_libero_default_path""",
    "libero.libero.utils": "get_path_dict get_libero_path set_libero_path libero_config_path config_file",
    "libero.libero.utils.video_utils": "VideoWriter",
    "libero.libero.utils.time_utils": "Timer",
    "libero.libero.utils.dataset_utils": "get_dataset_info",
    "libero.libero.utils.log_utils": "get_logger get_project_logger",
    "libero.libero.utils.download_utils": """HF_REPO_ID libero_dataset_download download_from_huggingface
        download_assets_from_huggingface HF_ASSETS_REPO_ID check_libero_dataset""",
    "libero.libero.utils.mu_utils": """register_mu MU_DICT SCENE_DICT get_scene_dict get_scene_class
        InitialSceneTemplates""",
    "libero.libero.utils.task_generation_utils": """register_task_info get_task_info TASK_INFO TaskInfoTuple
        get_suite_generator_func generate_bddl_from_task_info""",
    "libero.libero.utils.object_utils": "get_affordance_regions update_exception_dict EXCEPTION_DICT",
    "libero.libero.utils.bddl_generation_utils": """Region ObjectDict get_fixtures get_objects get_xy_region
        get_object_affordance_region region_module
        get_init_state get_goal_state object_naming_mapping get_object_dict
        get_affordance_region_kwargs_list_from_fixture_info get_xy_region_kwargs_list_from_regions_info
        tabletop_task_suites_generator kitchen_table_task_suites_generator living_room_table_task_suites_generator
        study_table_task_suites_generator coffee_table_task_suites_generator floor_task_suites_generator
        print_result get_result save_to_file""",
    "libero.libero.benchmark.mu_creation": """KitchenScene1 KitchenScene10 LivingRoomScene1 LivingRoomScene6 StudyScene1
        StudyScene4""",
    "libero.libero.utils.utils": """postprocess_model_xml process_image_input reconstruct_image_output
        update_env_kwargs""",
    "libero.libero.benchmark": """BENCHMARK_MAPPING register_benchmark get_benchmark_dict get_benchmark print_benchmark
        Task grab_language_from_filename libero_suites task_maps task_orders Benchmark LIBERO_SPATIAL LIBERO_OBJECT
        LIBERO_GOAL LIBERO_90 LIBERO_10 LIBERO_100""",
    "libero.libero.benchmark.libero_suite_task_map": "libero_task_map",
    "libero.libero.envs": """ControlEnv OffScreenRenderEnv SegmentationRenderEnv BaseVectorEnv DummyVectorEnv
        SubprocVectorEnv TASK_MAPPING register_problem""",
    "libero.libero.envs.env_wrapper": "ControlEnv OffScreenRenderEnv DemoRenderEnv SegmentationRenderEnv",
    "libero.libero.envs.venv": """BaseVectorEnv DummyVectorEnv SubprocVectorEnv EnvWorker DummyEnvWorker
        SubprocEnvWorker CloudpickleWrapper GYM_RESERVED_KEYS""",
    "libero.libero.envs.bddl_utils": "get_problem_info robosuite_parse_problem get_regions get_scenes",
    "libero.libero.envs.bddl_base_domain": "BDDLBaseDomain TASK_MAPPING register_problem",
    "libero.libero.envs.problems": """Libero_Tabletop_Manipulation Libero_Kitchen_Tabletop_Manipulation
        Libero_Living_Room_Tabletop_Manipulation Libero_Study_Tabletop_Manipulation
        Libero_Coffee_Table_Manipulation Libero_Floor_Manipulation""",
    "libero.libero.envs.predicates": """Expression UnaryAtomic BinaryAtomic MultiarayAtomic InContactPredicateFn Stack
        eval_predicate_fn get_predicate_fn_dict get_predicate_fn update_predicate_fn_dict""",
    "libero.libero.envs.object_states": "BaseObjectState ObjectState SiteObjectState",
    "libero.libero.envs.base_object": """register_object register_visual_change_object OBJECTS_DICT
        VISUAL_CHANGE_OBJECTS_DICT get_object_fn get_object_dict""",
    "libero.libero.envs.objects": """HopeBaseObject GoogleScannedObject TurbosquidObjects ArticulatedObject SiteObject
        TargetZone AlphabetSoup Chefmate8Frypan BasinFaucet get_object_fn get_object_dict""",
    "libero.libero.envs.regions": "MultiRegionRandomSampler",
    "libero.libero.envs.utils": "MultiRegionRandomSampler postprocess_model_xml rectangle2xyrange",
    "libero.libero.envs.robots": "MountedPanda OnTheGroundPanda ROBOT_CLASS_MAPPING",
    "libero.libero.envs.arenas.style": "get_texture_filename STYLE_MAPPING FLOOR_STYLE WALL_STYLE",
    "libero.libero.envs.regions.base_region_sampler": "MultiRegionRandomSampler",
    "libero.lifelong.datasets": "get_dataset SequenceVLDataset GroupedTaskDataset TruncatedSequenceDataset",
    "libero.lifelong.algos": """Sequential SingleTask Multitask ER AGEM EWC PackNet get_algo_class get_algo_list
        REGISTERED_ALGOS""",
    "libero.lifelong.algos.base": "Sequential get_algo_class get_algo_list REGISTERED_ALGOS AlgoMeta register_algo",
    "libero.lifelong.models": """get_policy_class get_policy_list BCRNNPolicy BCTransformerPolicy BCViLTPolicy
        BasePolicy""",
    "libero.lifelong.models.base_policy": """BasePolicy PolicyMeta REGISTERED_POLICIES register_policy get_policy_class
        get_policy_list""",
    "libero.lifelong.models.bc_rnn_policy": "BCRNNPolicy ExtraModalities",
    "libero.lifelong.models.bc_transformer_policy": "BCTransformerPolicy ExtraModalityTokens",
    "libero.lifelong.models.bc_vilt_policy": "BCViLTPolicy ExtraModalityTokens",
    "libero.lifelong.models.policy_head": "GMMHead DeterministicHead",
    "libero.lifelong.models.policy": "BasePolicy ResnetEncoder MLPEncoder SinusoidalPositionEncoding GMMHead",
    "libero.lifelong.models.modules.rgb_modules": "ResnetEncoder PatchEncoder",
    "libero.lifelong.models.modules.language_modules": "IdentityEncoder MLPEncoder",
    "libero.lifelong.models.modules.transformer_modules": "SinusoidalPositionEncoding TransformerDecoder",
    "libero.lifelong.models.modules.data_augmentation": """IdentityAug TranslationAug ImgColorJitterAug
        BatchWiseImgColorJitterAug ImgColorJitterGroupAug DataAugGroup""",
    "libero.lifelong.metric": """evaluate_one_task_success evaluate_success evaluate_multitask_training_success
        evaluate_loss raw_obs_to_tensor_obs""",
    "libero.lifelong.utils": """control_seed safe_device NpEncoder torch_save_model torch_load_model
        create_experiment_dir compute_flops confidence_interval get_task_embs""",
    "libero.lifelong.main": "main",
    "libero.lifelong.evaluate": "main parse_args benchmark_map algo_map policy_map",
    "libero.lifelong.algos.er": "cycle merge_datas",
    "libero.libero.envs.textures": "TEXTURE_MAPPING get_texture_file_list",
}
# Parameters in the order in which the original takes them; ours may have more after these.
PARAMETERS = {
    "libero.lifelong.models.modules.language_modules.MLPEncoder": "input_size hidden_size output_size num_layers",
    "libero.lifelong.models.modules.transformer_modules.TransformerDecoder": """input_size num_layers num_heads
        head_output_size mlp_hidden_size dropout""",
    "libero.lifelong.models.modules.data_augmentation.TranslationAug": "input_shape translation",
    "libero.lifelong.models.modules.rgb_modules.ResnetEncoder": """input_shape output_size pretrained freeze
        remove_layer_num no_stride language_dim language_fusion""",
    "libero.lifelong.models.bc_rnn_policy.ExtraModalities": """use_joint use_gripper use_ee extra_hidden_size
        extra_embedding_size""",
    "libero.lifelong.models.bc_transformer_policy.ExtraModalityTokens": """use_joint use_gripper use_ee
        extra_num_layers extra_hidden_size extra_embedding_size""",
    "libero.lifelong.models.policy_head.GMMHead": """input_size output_size hidden_size num_layers min_std num_modes
        activation low_eval_noise loss_coef""",
    "libero.lifelong.datasets.get_dataset": """dataset_path obs_modality initialize_obs_utils seq_len frame_stack
        filter_key hdf5_cache_mode""",
    "libero.lifelong.metric.evaluate_one_task_success": "cfg algo task task_emb task_id sim_states task_str",
    "libero.lifelong.metric.evaluate_success": "cfg algo benchmark task_ids result_summary",
    "libero.libero.envs.ControlEnv": """bddl_file_name robots controller gripper_types initialization_noise
        use_camera_obs has_renderer has_offscreen_renderer render_camera render_collision_mesh render_visual_mesh
        render_gpu_device_id control_freq horizon ignore_done hard_reset camera_names camera_heights camera_widths
        camera_depths camera_segmentations renderer renderer_config""",
    "libero.libero.envs.regions.MultiRegionRandomSampler": """name mujoco_objects x_ranges y_ranges rotation
        rotation_axis ensure_object_boundary_in_range ensure_valid_placement reference_pos z_offset""",
    "libero.libero.envs.objects.SiteObject": "name parent_name joints size rgba site_type site_pos site_quat",
    "libero.libero.envs.objects.TargetZone": "name zone_height z_offset rgba joints zone_size zone_centroid_xy",
    "libero.libero.utils.bddl_generation_utils.object_naming_mapping": "category_name object_id",
    "libero.libero.utils.mu_utils.InitialSceneTemplates": "workspace_name fixture_num_info object_num_info",
    "libero.libero.utils.object_utils.update_exception_dict": "object_name site_name",
    "libero.libero.utils.video_utils.VideoWriter": "video_path save_video fps single_video",
}
CONTROL_ENV = """step reset check_success get_sim_state set_state set_init_state regenerate_obs_from_state
    reset_from_xml_string seed close _post_process _update_observables obj_of_interest robots sim _visualizations env
    problem_name domain_name language_instruction"""
DOMAIN = """_load_fixtures_in_arena _load_objects_in_arena _load_sites_in_arena _add_placement_initializer
    _check_success _eval_predicate _setup_camera _setup_references _check_grasp _gripper_to_target _observables
    _reset_internal _pre_action _setup_observables"""  # those that its inventory does not list
BENCHMARK = """get_num_tasks get_task_names get_task_problems get_task_bddl_files get_task_bddl_file_path
    get_task_demonstration get_task get_task_emb set_task_embs get_task_init_states tasks n_tasks name task_embs
    task_order_index"""
GROUPS = {
    "HopeBaseObject": """AlphabetSoup BbqSauce Butter Cherries ChocolatePudding Cookies Corn CreamCheese Ketchup
        MacaroniAndCheese Mayo Milk OrangeJuice Popcorn SaladDressing NewSaladDressing TomatoSauce""",
    "GoogleScannedObject": "Rack WhiteBowl AkitaBlackBowl Plate Basket Chefmate8Frypan GlazedRimPorcelainRamekin",
    "TurbosquidObjects": """WoodenTray WhiteStorageBox WoodenShelf WoodenTwoLayerShelf WineRack WineBottle
        DiningSetGroup BowlDrainer MokaPot BlackBook YellowBook RedCoffeeMug DeskCaddy PorcelainMug WhiteYellowMug""",
    "ArticulatedObject": """Microwave WoodenCabinet WhiteCabinet ShortCabinet ShortFridge FlatStove SlideCabinet
        Window Faucet BasinFaucet""",
    "TargetZone": "TargetZone",
}
SITES = {
    "Basket WoodenTray": "contain_region",
    "WhiteStorageBox": "top_side bottom_side right_side left_side",
    "WoodenShelf WoodenCabinet WhiteCabinet": "top_side top_region middle_region bottom_region",
    "WoodenTwoLayerShelf": "top_side top_region bottom_region",
    "WineRack": "top_region",
    "DiningSetGroup": "center_region",
    "BowlDrainer": "left_region right_region",
    "DeskCaddy": "left_contain_region right_contain_region front_contain_region back_contain_region",
    "Microwave": "top_side heating_region",
    "ShortCabinet": "top_region middle_region bottom_region",
    "ShortFridge": "upper_region middle_region lower_region",
    "FlatStove": "cook_region burner",
    "SlideCabinet": "slide_site",
    "Window": "handleOpenStart handleCloseStart",
    "Faucet": "handleStartClose handleStartOpen",
    "BasinFaucet": "hot_water cold_water",
}
JOINTS = {
    "Microwave": "microjoint",
    "WoodenCabinet WhiteCabinet": "top_level middle_level bottom_level",
    "ShortCabinet": "middle_level top_region bottom_region",
    "ShortFridge": "fridge_door_joint_0",
    "FlatStove": "button",
    "SlideCabinet": "slidedoor_joint",
    "Window": "window_slide",
    "Faucet": "knob_Joint_1",
    "BasinFaucet": "hinge",
}
ORIGINAL = json.loads((Path(__file__).parent / "data" / "original_names.json").read_text())
# Values that differ: of models, of what the page on migrating says, or of what the original gets wrong.
DIFFERENT = {
    "domain": """language_instruction obj_body_id observation_names enabled_observables _observables parsed_problem
        placement_initializer visualization_sites_list robot_configs""",
    "robot": "controller_config",
    "mount": "bodies top_offset",
    "model": "classes_to_ids instances_to_ids site_ids_to_classes site_ids_to_instances",
    "objects": "contact_geoms visual_geoms object_properties file folder",
    "fixtures": "contact_geoms visual_geoms object_properties sites",
    "object_sites": "joints object_properties pos quat rgba site_pos size",
    "elements": "camera site",
}
PREDICATES = "true false in on up printjointstate open close turnon turnoff"


@pytest.mark.parametrize("module", NAMES)
def test_names(module):
    found = importlib.import_module(module)
    assert [name for name in NAMES[module].split() if not hasattr(found, name)] == []


@pytest.mark.parametrize("path", PARAMETERS)
def test_parameters_have_the_order_of_the_original(path):
    module, _, name = path.rpartition(".")
    parameters = list(inspect.signature(getattr(importlib.import_module(module), name)).parameters)
    expected = PARAMETERS[path].split()
    assert parameters[: len(expected)] == expected


@pytest.fixture(scope="module")
def env():
    from libero.libero import benchmark

    suite = benchmark.get_benchmark("libero_goal")()
    env = ControlEnv(bddl_file_name=suite.get_task_bddl_file_path(0), use_camera_obs=False)
    env.reset()
    yield env
    env.close()


def test_members(env):
    assert [name for name in CONTROL_ENV.split() if not hasattr(env, name)] == []
    assert [name for name in DOMAIN.split() if not hasattr(env.env, name)] == []
    assert env.env.language_instruction.lower() == env.language_instruction


@pytest.mark.parametrize("name", ["LIBERO_SPATIAL", "LIBERO_OBJECT", "LIBERO_GOAL", "LIBERO_90", "LIBERO_10"])
def test_benchmarks(name):
    from libero.libero import benchmark

    suite = benchmark.get_benchmark(name)()
    assert [member for member in BENCHMARK.split() if not hasattr(suite, member)] == []
    number = 90 if name == "LIBERO_90" else 10
    assert suite.get_num_tasks() == suite.n_tasks == len(suite.tasks) == number
    assert suite.get_task_bddl_files() == [f"{task}.bddl" for task in suite.get_task_names()]
    assert suite.get_task_problems() == ["Libero"] * number
    fields = ("name", "language", "problem", "problem_folder", "bddl_file", "init_states_file")
    assert suite.get_task(0)._fields == fields
    suite.set_task_embs(range(number))
    assert suite.get_task_emb(number - 1) == number - 1


def test_object_states(env):
    for state in env.env.object_states_dict.values():
        assert state.get_geom_state()["pos"].shape == (3,)
        assert state.get_geom_state()["quat"].shape == (4,)
        for question in ("is_open", "is_close", "turn_on", "turn_off"):
            try:
                assert getattr(state, question)() in (True, False)
            except LiberoError as error:
                assert state.get_joint_state(), "without joints there is always an answer"  # noqa: PT017
                assert "no joint range" in str(error)  # noqa: PT017
    cabinet, region = (env.env.object_states_dict[f"wooden_cabinet_1{n}"] for n in ("", "_top_region"))
    region.set_joint(-0.15)
    assert region.is_open()
    assert cabinet.is_open()
    assert not env.env.object_states_dict["wooden_cabinet_1_bottom_region"].is_open()
    assert env.env.object_states_dict["plate_1"].check_contact(cabinet) is False


def test_predicates(env, capsys):
    from libero.libero.envs import predicates

    states = env.env.object_states_dict
    assert set(PREDICATES.split()) <= set(predicates.get_predicate_fn_dict())
    assert predicates.eval_predicate_fn("true", states["plate_1"])
    assert not predicates.eval_predicate_fn("false")
    assert predicates.eval_predicate_fn("printjointstate", states["flat_stove_1"])
    assert capsys.readouterr().out.startswith("[")
    for name in ("in", "on", "stack"):
        fn = predicates.get_predicate_fn(name.upper())
        for other in ("wooden_cabinet_1_top_region", "wine_bottle_1", "wooden_cabinet_1"):
            assert fn(states["plate_1"], states[other]) is False
    assert predicates.eval_predicate_fn("up", states["plate_1"]) is False
    assert predicates.InContactPredicateFn()(states["plate_1"], states["akita_black_bowl_1"]) in (True, False)
    predicates.update_predicate_fn_dict("Level", lambda state: bool(state.get_geom_state()["pos"][2] > 0))
    assert env.env._eval_predicate(["level", "plate_1"])
    with pytest.raises(LiberoError, match="turnon"):
        predicates.eval_predicate_fn("turn_on", states["flat_stove_1"])


def test_bddl_utils(env):
    from libero.libero.envs import bddl_utils

    parsed = bddl_utils.robosuite_parse_problem(env.env.bddl_file_name)
    assert parsed["goal_state"] == [["open", "wooden_cabinet_1_middle_region"]]
    assert ["main_table"] in parsed["fixtures"].values()
    assert all(len(atom) in (2, 3) for atom in parsed["initial_state"])
    assert bddl_utils.get_regions(env.env.bddl_file_name) == parsed["regions"]
    assert bddl_utils.get_scenes(env.env.bddl_file_name) == {}
    goal = ["or", ["open", "a_1"], ["not", ["on", "b_1", "c_1"]]]
    assert bddl_utils.as_list(bddl_utils.as_expression(goal)) == goal


@pytest.mark.parametrize("category", sorted(OBJECTS_DICT))
def test_objects(category):
    item = OBJECTS_DICT[category](name=f"{category}_1")
    assert item.category_name == category
    assert item.root_body == f"{category}_1_main"
    assert f"{category}_1_main" in item.bodies
    assert item.object_properties["vis_site_names"] == {}
    ranges = {f"default_{s}_ranges" for s in ("open", "close", "turnon", "turnoff")}
    assert set(item.object_properties["articulation"]) == ranges
    assert item.bottom_offset.shape == item.top_offset.shape == (3,)
    opens = item.object_properties["articulation"]["default_open_ranges"]
    if opens:
        assert item.is_open(np.mean(opens))
        assert not item.is_close(np.mean(opens))


def test_classes_of_objects():
    from libero.libero.envs import objects

    kinds = {name: group for group, names in GROUPS.items() for name in names.split()}
    assert sorted(kinds) == sorted(cls.__name__ for cls in OBJECTS_DICT.values())
    for name, group in kinds.items():
        cls = getattr(objects, name)
        assert issubclass(cls, getattr(objects, group)), name
        assert objects.get_object_fn(cls(name="it").category_name) is cls


@pytest.mark.parametrize("part, table", [("sites", SITES), ("joints", JOINTS)])
def test_parts_of_objects(part, table):
    from libero.libero.envs import objects

    for names, parts in table.items():
        for name in names.split():
            found = getattr(getattr(objects, name)(name="it"), part)
            assert {f"it_{p}" for p in parts.split()} <= set(found), name


def test_site_objects_and_zones():
    from libero.libero.envs.objects import SiteObject, TargetZone

    site, eye = SiteObject("bin_region", size=(0.1, 0.1, 0.02)), np.eye(3)
    assert site.in_box(np.zeros(3), eye, np.array([0.05, 0.0, -0.025]))
    assert not site.in_box(np.zeros(3), eye, np.array([0.15, 0.0, 0.0]))
    assert site.under(np.zeros(3), eye, np.array([0.05, 0.0, 0.05]))
    zone = TargetZone(zone_size=(0.1, 0.05))
    assert zone.in_box(np.zeros(3), eye, np.array([0.05, 0.0, 0.0]))
    assert not zone.in_box(np.zeros(3), eye, np.array([0.15, 0.0, 0.0]))
    assert zone.on_top(np.zeros(3), eye, np.array([0.15, 0.1, 0.1]))


def test_sampler():
    from libero.libero.envs.regions import MultiRegionRandomSampler

    items, ranges = [OBJECTS_DICT[name](name=f"{name}_1") for name in ("milk", "butter")], [(-0.2, 0.2)]
    placed = MultiRegionRandomSampler("floor", items, ranges, ranges, rng=np.random.default_rng(0)).sample()
    (a, quat, _), (b, _, _) = placed.values()
    assert np.hypot(a[0] - b[0], a[1] - b[1]) > sum(item.horizontal_radius for item in items)
    assert np.linalg.norm(quat) == pytest.approx(1.0)
    plate, cup = OBJECTS_DICT["plate"](name="plate_1"), OBJECTS_DICT["porcelain_mug"](name="mug_1")
    sampler = MultiRegionRandomSampler("m", plate, rotation=0.2, z_offset=0.01)
    found = sampler.sample(fixtures=placed)
    assert list(found) == ["milk_1", "butter_1", "plate_1"], "fixtures are among the placements"
    assert np.allclose(found["plate_1"][1][3], np.sin(0.1))
    assert found["plate_1"][0][2] == pytest.approx(0.01 - plate.bottom_offset[2])
    assert sampler.sample(on_top=False)["plate_1"][0][2] == 0.01
    drawn = []
    for seed in (1, 1, 2):
        np.random.seed(seed)  # noqa: NPY002 - the original's generator
        drawn.append(MultiRegionRandomSampler("m", plate).sample()["plate_1"][1].tolist())
    assert drawn[0] == drawn[1] != drawn[2]
    found = MultiRegionRandomSampler("on", cup).sample(fixtures=placed, reference="milk_1")
    assert found["mug_1"][0][2] > found["milk_1"][0][2]
    with pytest.raises(LiberoError, match="no free placement"):
        MultiRegionRandomSampler("small", items).sample()


def test_small_functions(tmp_path):
    from libero.libero.envs.arenas.style import get_texture_filename
    from libero.libero.envs.robots import MountedPanda, OnTheGroundPanda
    from libero.libero.envs.textures import TEXTURE_MAPPING, get_texture_file_list
    from libero.libero.envs.utils import rectangle2xyrange
    from libero.libero.utils.utils import process_image_input, reconstruct_image_output

    assert rectangle2xyrange([(0, 1, 2, 3)]) == ([[0, 2]], [[1, 3]])
    assert len(TEXTURE_MAPPING) == 35
    assert get_texture_filename("floor", "dark") in TEXTURE_MAPPING.values()
    assert TEXTURE_MAPPING["Gray_Floor_1"] == "gray_floor.png"
    walls = dict(get_texture_file_list("wall", tmp_path))
    assert walls["White_Wall_1"] == str(tmp_path / "textures" / "white_wall.png")
    assert "Gray_Plaster_1" in walls and not any("Floor" in name or "Table" in name for name in walls)
    assert OBJECTS_DICT["milk"](name="milk_1", joints=None).joints == []
    assert (MountedPanda().default_mount, OnTheGroundPanda().default_mount) == ("RethinkMount", None)
    assert (reconstruct_image_output(process_image_input(np.arange(3))) == np.arange(3)).all()


def test_sim_by_name(env):
    sim = env.sim
    assert sim.model.body_id2name(sim.model.body_name2id("plate_1_main")) == "plate_1_main"
    assert sim.model.joint_names[0] == "robot0_joint1"
    assert sim.model.get_joint_qpos_addr("robot0_joint3") == 2
    start, end = sim.model.get_joint_qpos_addr("plate_1_joint0")
    assert (sim.data.get_joint_qpos("plate_1_joint0") == sim.data.qpos[start:end]).all()
    assert np.allclose(sim.data.get_site_xvelp("gripper0_grip_site"), 0.0, atol=1e-6)
    assert sim.data.get_body_xmat("plate_1_main").shape == (3, 3)
    with pytest.raises(LiberoError, match="plate_1_main"):
        sim.model.body_name2id("plate_one")
    sim.step()
    sim.set_state(sim.get_state())
    sim.forward()


def test_names_and_values_behind_an_environment_are_the_originals(monkeypatch):
    monkeypatch.setenv("LIBERO_DRAWING", "faithful")
    docs = Path(__file__).parents[2] / "docs"
    page = (docs / "migrating.md").read_text() + (docs / "not_offered.yaml").read_text()
    named = set(re.findall(r"\w+", " ".join(page.split("`")[1::2])))
    for task, theirs in ORIGINAL.items():
        ours = inventory(f"{task}.bddl", theirs)
        for part, names in theirs.items():
            missing = [n for n in names if n not in {*ours[part], *named}]
            assert not missing, f"{part} lacks {missing}: add them, or say on the page on migrating why not"
            known = DIFFERENT.get(part, "").split()
            both = [n for n in names if n in ours[part] and n not in known]
            wrong = {n: (ours[part][n], names[n]) for n in both if not same(ours[part][n], names[n])}
            assert not wrong


def same(ours, theirs):
    """Return whether two values of inventories agree: numbers to 1e-5, everything else exactly."""
    if isinstance(ours, dict) and isinstance(theirs, dict):
        return ours.keys() == theirs.keys() and all(same(ours[key], theirs[key]) for key in ours)
    if isinstance(ours, list) and isinstance(theirs, list):
        return len(ours) == len(theirs) and all(map(same, ours, theirs))
    if type(ours) in (int, float) and type(theirs) in (int, float):
        return abs(ours - theirs) < 1e-5
    return ours == theirs
