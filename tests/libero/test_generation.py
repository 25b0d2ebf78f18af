"""Scenes and tasks as classes, and the task files written from them."""

import numpy as np
import pytest

from libero.libero.envs.bddl_utils import as_list
from libero.libero.utils import bddl_generation_utils as pieces
from libero.libero.utils import mu_utils, object_utils, task_generation_utils
from libero.libero.utils.bddl_generation_utils import get_xy_region_kwargs_list_from_regions_info
from libero.libero.utils.mu_utils import InitialSceneTemplates, get_scene_class, get_scene_dict, register_mu
from libero.libero.utils.task_generation_utils import (
    generate_bddl_from_task_info,
    get_suite_generator_func,
    get_task_info,
    register_task_info,
)
from libero_env.errors import BDDLError, LiberoError, UnknownNameError
from libero_env.tasks import bddl, get_suite
from libero_env.tasks.expression import And, Atom, Or
from libero_env.tasks.problem import differences


@pytest.fixture
def demo_scene():
    """As the procedural creation walkthrough defines a scene."""

    @register_mu(scene_type="kitchen")
    class KitchenDemoScene(InitialSceneTemplates):
        def __init__(self):
            super().__init__(
                workspace_name="kitchen_table",
                fixture_num_info={"kitchen_table": 1, "wooden_cabinet": 1},
                object_num_info={"akita_black_bowl": 1, "plate": 1},
            )

        def define_regions(self):
            for y, category, half, yaw in (
                (-0.30, "wooden_cabinet", 0.01, (np.pi, np.pi)),
                (0.0, "akita_black_bowl", 0.025, (0.0, 0.0)),
                (0.25, "plate", 0.025, (0.0, 0.0)),
            ):
                self.regions.update(
                    self.get_region_dict(
                        region_centroid_xy=[0.0, y],
                        region_name=f"{category}_init_region",
                        target_name=self.workspace_name,
                        region_half_len=half,
                        yaw_rotation=yaw,
                    )
                )
            self.xy_region_kwargs_list = get_xy_region_kwargs_list_from_regions_info(self.regions)

        @property
        def init_states(self):
            categories = ("akita_black_bowl", "plate", "wooden_cabinet")
            return [("On", f"{name}_1", f"kitchen_table_{name}_init_region") for name in categories]

    return KitchenDemoScene


def test_scenes_are_found_by_name_and_type(demo_scene):
    assert get_scene_class("kitchen_demo_scene") is get_scene_class("KitchenDemoScene") is demo_scene
    assert mu_utils.MU_DICT["kitchen_demo_scene"] is demo_scene
    assert {f"KitchenScene{i}" for i in range(1, 11)} < {cls.__name__ for cls in get_scene_dict("kitchen")}
    assert {kind: len(scenes) for kind, scenes in get_scene_dict().items()} == {
        "kitchen": 11,
        "living_room": 6,
        "study": 4,
    }
    assert get_scene_class("STUDY_SCENE3")().workspace_name == "study_table"
    with pytest.raises(UnknownNameError, match="kitchen_scene0.*kitchen_demo_scene"):
        get_scene_class("kitchen_scene0")
    with pytest.raises(UnknownNameError, match="living_room"):
        get_scene_dict("garage")


def test_properties_of_a_scene(demo_scene):
    scene = demo_scene()
    assert scene.movable_objects == ["akita_black_bowl_1", "plate_1"]
    assert scene.fixture_object_dict == {
        "kitchen_table": ["kitchen_table"],
        "wooden_cabinet": ["wooden_cabinet_1"],
    }
    assert scene.possible_objects_of_interest[:3] == ["akita_black_bowl_1", "plate_1", "wooden_cabinet_1"]
    assert "wooden_cabinet_1_top_region" in scene.possible_objects_of_interest
    assert {
        "region_name": "top_side",
        "target_name": "wooden_cabinet_1",
    } in scene.affordance_region_kwargs_list
    assert [k["region_name"] for k in scene.xy_region_kwargs_list] == list(scene.regions)
    with pytest.raises(LiberoError, match="defined twice"):
        scene.define_regions()
    with pytest.raises(UnknownNameError, match="kitchen_table"):
        InitialSceneTemplates("kitchen", {}, {})
    with pytest.raises(NotImplementedError, match="define_regions"):
        InitialSceneTemplates("floor", {}, {})


@pytest.mark.usefixtures("demo_scene")
def test_tasks_by_function_call(tmp_path):
    register_task_info(
        "open the top drawer and put the bowl in it",
        scene_name="kitchen_demo_scene",
        objects_of_interest=["wooden_cabinet_1", "akita_black_bowl_1"],
        goal_states=[
            ("Open", "wooden_cabinet_1_top_region"),
            ("In", "akita_black_bowl_1", "wooden_cabinet_1_top_region"),
        ],
    )
    register_task_info(
        "put the bowl on the plate", "kitchen_demo_scene", goal_states=[("On", "plate_1", "plate_1")]
    )
    register_task_info(
        "put the bowl on the plate",
        "kitchen_demo_scene",
        goal_states=[("On", "akita_black_bowl_1", "plate_1")],
    )
    assert [task.language for task in get_task_info("kitchen_demo_scene")] == [
        "open the top drawer and put the bowl in it",
        "put the bowl on the plate",
    ]
    paths, failures = generate_bddl_from_task_info(folder=str(tmp_path / "pddl"))
    assert failures == []
    assert [path.rpartition("/")[2] for path in paths] == [
        "KITCHEN_DEMO_SCENE_open_the_top_drawer_and_put_the_bowl_in_it.bddl",
        "KITCHEN_DEMO_SCENE_put_the_bowl_on_the_plate.bddl",
    ]
    first, second = map(bddl.read, paths)
    bowl, drawer = "akita_black_bowl_1", "wooden_cabinet_1_top_region"
    assert first.goal == And((Atom("Open", (drawer,)), Atom("In", (bowl, drawer))))
    assert first.obj_of_interest == ("wooden_cabinet_1", bowl)
    assert first.language == "open the top drawer and put the bowl in it"
    region = first.region("kitchen_table_wooden_cabinet_init_region")
    assert np.allclose(region.ranges, [(-0.01, -0.31, 0.01, -0.29)])
    assert np.allclose(region.yaw, np.pi)
    assert second.obj_of_interest == (bowl, "plate_1")
    same = get_suite("libero_90").tasks[9].problem  # KITCHEN_SCENE1_put_the_black_bowl_on_the_plate
    assert [line for line in differences(second, same) if not line.startswith("language")] == []


@pytest.mark.usefixtures("demo_scene")
def test_tasks_as_classes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    @register_task_info
    class KitchenDemoScenePutBowlOnPlate:
        def __init__(self):
            self.task_name = "KITCHEN_DEMO_SCENE_put_the_black_bowl_on_the_plate"
            self.scene_name = "KitchenDemoScene"
            self.task_description = "put the black bowl on the plate"
            self.language_instruction = "put the black bowl on the plate"

        @property
        def goal(self):
            return [("On", "akita_black_bowl_1", "plate_1")]

    task_info = KitchenDemoScenePutBowlOnPlate()
    bddl_file_path = generate_bddl_from_task_info(task_info, output_dir="./custom_pddl")
    assert bddl_file_path == "custom_pddl/KITCHEN_DEMO_SCENE_put_the_black_bowl_on_the_plate.bddl"
    same = get_suite("libero_90").tasks[9].problem
    assert differences(bddl.read(bddl_file_path), same) == []
    assert get_task_info()["kitchen_demo_scene"][0].language == "put the black bowl on the plate"
    paths, _ = generate_bddl_from_task_info(folder="all")
    assert paths == ["all/KITCHEN_DEMO_SCENE_put_the_black_bowl_on_the_plate.bddl"]


@pytest.mark.usefixtures("demo_scene")
def test_failures_keep_their_cause(tmp_path):
    wrong = {
        "lift the mug": [("Up", "mug_1")],
        "juggle the plate": [("Juggle", "plate_1")],
        "put the plate away": [("On", "plate_1")],
    }
    for language, goal in wrong.items():
        register_task_info(language, "kitchen_demo_scene", goal_states=goal)
    register_task_info("find the scene", "kitchen_scene77", goal_states=[("Up", "plate_1")])
    paths, failures = generate_bddl_from_task_info(folder=tmp_path)
    assert [failure.language for failure in failures] == [*wrong, "find the scene"]
    assert paths == []
    assert isinstance(failures[0].cause, BDDLError)
    assert "mug_1 is not declared" in str(failures[0].cause)
    assert "Juggle is not a predicate" in str(failures[1].cause)
    assert "On takes 2 names" in str(failures[2].cause)
    assert "kitchen_scene77" in str(failures[3].cause)
    with pytest.raises(LiberoError, match="mug_1 is not declared"):
        generate_bddl_from_task_info(get_task_info("kitchen_demo_scene")[0], output_dir=tmp_path)
    with pytest.raises(LiberoError, match="no scene_name and no goal_states"):
        register_task_info("do nothing")
    with pytest.raises(UnknownNameError, match="kitchen_demo_scene"):
        get_task_info("kitchen_scene1")


def _scene_of(name):
    head, _, rest = name.partition("_SCENE")
    return f"{head}_SCENE{rest.partition('_')[0]}"


@pytest.mark.parametrize("suite", ["libero_90", "libero_10"])
def test_the_benchmark_from_its_templates(suite):
    """Every task of LIBERO-100, written from its scene's template and its goal, means what the shipped one means."""
    for task in get_suite(suite).tasks:
        info = register_task_info(
            task.bddl_language,
            scene_name=_scene_of(task.name),
            objects_of_interest=task.problem.obj_of_interest,
            goal_states=[tuple(as_list(part)) for part in task.problem.goal.parts],
        )
        text = task_generation_utils.bddl_text(info)
        assert differences(bddl.parse(text), task.problem) == [], task.name


def test_the_originals_files_from_the_templates(shared):
    folder = shared / "official" / "bddl_files" / "libero_90"
    for path in sorted(folder.glob("*.bddl"))[::9]:
        original = bddl.read(path)
        info = register_task_info(
            original.language,
            _scene_of(path.stem),
            original.obj_of_interest,
            [tuple(as_list(part)) for part in original.goal.parts],
        )
        assert differences(bddl.parse(task_generation_utils.bddl_text(info)), original) == [], path.name


def test_functions_of_bddl_generation_utils(tmp_path, capsys):
    names = pieces.get_object_dict({"main_table": 1, "flat_stove": 1, "plate": 2})
    assert names == {"table": ["main_table"], "flat_stove": ["flat_stove_1"], "plate": ["plate_1", "plate_2"]}
    assert pieces.get_fixtures(names)["plate_2"] == pieces.get_objects(names)["plate_1"] == "plate"
    assert isinstance(names, pieces.ObjectDict)
    assert pieces.get_object_dict({"table": 1}) == {"table": ["main_table"]}
    given = (("table", 1), ("plate", 2), ("floor", 1))
    assert [pieces.object_naming_mapping(*one) for one in given] == ["main_table", "plate_2", "floor"]
    with pytest.raises(LiberoError, match="floor: 2 of them; a scene has one workspace"):
        pieces.object_naming_mapping("floor", 2)
    zones = pieces.get_xy_region("zone", "main_table", [[0.0, 0.1], [0.2, 0.3]], (0.01, 0.02))
    assert np.allclose(zones.ranges, [(-0.01, 0.08, 0.01, 0.12), (0.19, 0.28, 0.21, 0.32)])
    cook = pieces.get_object_affordance_region("cook_region", "flat_stove_1")
    assert (cook.address, cook.ranges) == ("flat_stove_1_cook_region", ())
    assert isinstance(cook, pieces.Region)
    places = pieces.get_affordance_region_kwargs_list_from_fixture_info({"main_table": 1, "flat_stove": 1})
    assert places == [{"region_name": "cook_region", "target_name": "flat_stove_1"}]
    rectangles = [{"region_name": "zone", "target_name": "main_table", "region_centroid_xy": (0.0, 0.0)}]
    assert [r.name for r in pieces.region_module(rectangles, places)] == ["zone", "cook_region"]
    assert pieces.get_init_state([("TurnOn", "flat_stove_1")]) == (Atom("Turnon", ("flat_stove_1",)),)
    assert pieces.get_goal_state(("On", "plate_1", cook.address)) == And(
        (Atom("On", ("plate_1", cook.address)),)
    )
    either = pieces.get_goal_state([("Or", ("Up", "plate_1"), ("Up", "plate_2"))])
    assert either == Or((Atom("Up", ("plate_1",)), Atom("Up", ("plate_2",))))
    text = pieces.floor_task_suites_generator(
        " lift\n it ",
        fixture_object_dict={"floor": ["floor"]},
        movable_object_dict={"plate": ["plate_1"]},
        objects_of_interest=["plate_1", "plate_1"],
        goal_states=("Up", "plate_1"),
    )
    problem = bddl.parse(text)
    assert (problem.language, problem.obj_of_interest) == ("lift it", ("plate_1",))
    assert problem.goal == And((Atom("Up", ("plate_1",)),))
    pieces.print_result(text)
    assert capsys.readouterr().out.strip() == pieces.get_result(text.splitlines()).strip()
    path = pieces.save_to_file(text, "my_scene", "Lift it!", tmp_path / "new")
    assert path.endswith("/new/MY_SCENE_lift_it.bddl")
    assert bddl.read(path) == bddl.parse(text)


@pytest.mark.parametrize("workspace", list(pieces.SUITE_GENERATORS))
def test_generators_of_all_workspaces(workspace):
    generate = get_suite_generator_func(workspace)
    rectangle = {"region_name": "plate_region", "target_name": workspace, "region_centroid_xy": (0.0, 0.1)}
    text = generate(
        language="lift the plate",
        xy_region_kwargs_list=[rectangle],
        affordance_region_kwargs_list=[],
        fixture_object_dict=pieces.get_object_dict({workspace: 1}),
        movable_object_dict=pieces.get_object_dict({"plate": 1}),
        objects_of_interest=["plate_1"],
        init_states=[("On", "plate_1", f"{workspace}_plate_region")],
        goal_states=[("And", ("Up", "plate_1"))],
    )
    problem = bddl.parse(text)
    words = workspace.removesuffix("_table").removeprefix("main")
    assert words in problem.name.lower()
    assert problem.goal == And((Atom("Up", ("plate_1",)),))


def test_generators_know_their_workspaces():
    names = ("tabletop", "kitchen_table", "living_room_table", "study_table", "coffee_table", "floor")
    found = [getattr(pieces, f"{name}_task_suites_generator") for name in names]
    assert found == list(pieces.SUITE_GENERATORS.values())
    with pytest.raises(UnknownNameError, match="kitchen_table"):
        get_suite_generator_func("roof")


def test_regions_of_objects(capsys):
    from libero.libero.envs.objects import get_object_dict

    regions = object_utils.get_affordance_regions(get_object_dict())
    assert regions["basket"] == ["contain_region"]
    assert set(regions["wooden_cabinet"]) == {"top_side", "top_region", "middle_region", "bottom_region"}
    assert regions["flat_stove"] == ["cook_region"]
    assert "plate" not in regions
    assert object_utils.get_affordance_regions(["basket", "milk"], verbose=True) == {
        "basket": ["contain_region"]
    }
    assert capsys.readouterr().out == "basket: contain_region\n"
    object_utils.update_exception_dict("basket", "basket_contain_region")
    assert object_utils.get_affordance_regions(["basket"]) == {}
    with pytest.raises(UnknownNameError, match="plate"):
        object_utils.get_affordance_regions(["plates"])


@pytest.mark.sim
@pytest.mark.usefixtures("demo_scene")
def test_generated_tasks_simulate(tmp_path):
    from libero.libero.envs import OffScreenRenderEnv
    from libero_env.envs.env import LiberoEnv
    from libero_env.tasks import read_task

    register_task_info(
        "put the bowl on the plate",
        "kitchen_demo_scene",
        goal_states=[("On", "akita_black_bowl_1", "plate_1")],
    )
    (path,), _ = generate_bddl_from_task_info(folder=tmp_path)
    env = OffScreenRenderEnv(bddl_file_name=path, camera_heights=32, camera_widths=32)
    env.seed(0)
    obs = env.reset()
    obs, _, done, _ = env.step([0.0] * 7)
    assert obs["agentview_image"].std() > 10
    assert not done
    # the goal is what was asked for: it holds once the bowl is on the plate
    bowl, plate = obs["akita_black_bowl_1_pos"], obs["plate_1_pos"]
    assert np.abs(bowl[:2]).max() < 0.1
    start = env.sim.model.get_joint_qpos_addr("akita_black_bowl_1_joint0")[0]
    env.sim.data.qpos[start : start + 3] = plate + (0.0, 0.0, 0.02)
    env.sim.forward()
    for _ in range(10):
        *_, done, _ = env.step([0.0] * 7)
    assert done
    env.close()
    native = LiberoEnv(read_task(path), cameras=())
    native.reset(seed=0)
    assert not native.step(np.zeros(7))[-1]["success"]
    native.close()
