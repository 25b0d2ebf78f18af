"""Scenes and tasks as classes, and the task files written from them."""

import re

import numpy as np
import pytest

from libero.libero.envs.bddl_utils import as_list
from libero.libero.utils import bddl_generation_utils as pieces
from libero.libero.utils import mu_utils, object_utils, task_generation_utils
from libero.libero.utils.mu_utils import InitialSceneTemplates, get_scene_class, get_scene_dict
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
from tests.harness.scenes import register_scene


@pytest.fixture
def demo_scene():
    """As the procedural creation walkthrough defines a scene."""
    places = {"akita_black_bowl": (0.0, 0.0), "plate": (0.0, 0.25)}
    return register_scene("KitchenDemoScene", "wooden_cabinet", (np.pi, np.pi), **places)


def test_scenes_are_found_by_name_and_type(demo_scene):
    assert get_scene_class("kitchen_demo_scene") is get_scene_class("KitchenDemoScene") is demo_scene
    assert mu_utils.MU_DICT["kitchen_demo_scene"] is demo_scene
    numbers = {kind: len(scenes) for kind, scenes in get_scene_dict().items()}
    assert numbers == {"kitchen": 11, "living_room": 6, "study": 4}
    assert get_scene_class("STUDY_SCENE3")().workspace_name == "study_table"
    with pytest.raises(UnknownNameError, match="kitchen_scene0.*kitchen_demo_scene"):
        get_scene_class("kitchen_scene0")
    with pytest.raises(UnknownNameError, match="living_room"):
        get_scene_dict("garage")


def test_properties_of_a_scene(demo_scene):
    scene = demo_scene()
    assert scene.movable_objects == ["akita_black_bowl_1", "plate_1"]
    fixtures = {"kitchen_table": ["kitchen_table"], "wooden_cabinet": ["wooden_cabinet_1"]}
    assert scene.fixture_object_dict == fixtures
    assert scene.possible_objects_of_interest[:3] == ["akita_black_bowl_1", "plate_1", "wooden_cabinet_1"]
    assert "wooden_cabinet_1_top_region" in scene.possible_objects_of_interest
    top = {"region_name": "top_side", "target_name": "wooden_cabinet_1"}
    assert top in scene.affordance_region_kwargs_list
    assert [k["region_name"] for k in scene.xy_region_kwargs_list] == list(scene.regions)
    with pytest.raises(LiberoError, match="defined twice"):
        scene.define_regions()
    with pytest.raises(UnknownNameError, match="kitchen_table"):
        InitialSceneTemplates("kitchen", {}, {})
    with pytest.raises(NotImplementedError, match="define_regions"):
        InitialSceneTemplates("floor", {}, {})


@pytest.mark.usefixtures("demo_scene")
def test_tasks_by_function_call(tmp_path):
    bowl, drawer, scene = "akita_black_bowl_1", "wooden_cabinet_1_top_region", "kitchen_demo_scene"
    long, short = "open the top drawer and put the bowl in it", "put the bowl on the plate"
    states = [("Open", drawer), ("In", bowl, drawer)]
    register_task_info(long, scene, objects_of_interest=["wooden_cabinet_1", bowl], goal_states=states)
    for thing in ("plate_1", bowl):  # the second takes the place of the first
        register_task_info(short, scene, goal_states=[("On", thing, "plate_1")])
    assert [task.language for task in get_task_info(scene)] == [long, short]
    paths, failures = generate_bddl_from_task_info(folder=str(tmp_path / "pddl"))
    names = [f"KITCHEN_DEMO_SCENE_{words.replace(' ', '_')}.bddl" for words in (long, short)]
    assert failures == [] and [path.rpartition("/")[2] for path in paths] == names
    first, second = map(bddl.read, paths)
    assert first.goal == And((Atom("Open", (drawer,)), Atom("In", (bowl, drawer))))
    assert first.obj_of_interest == ("wooden_cabinet_1", bowl) and first.language == long
    region = first.region("kitchen_table_wooden_cabinet_init_region")
    assert np.allclose(region.ranges, [(-0.01, -0.31, 0.01, -0.29)])
    assert np.allclose(region.yaw, np.pi)
    assert second.obj_of_interest == (bowl, "plate_1")


@pytest.mark.usefixtures("demo_scene")
def test_tasks_as_classes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    @register_task_info
    class KitchenDemoScenePutBowlOnPlate:
        def __init__(self):
            self.task_name = "KITCHEN_DEMO_SCENE_put_the_black_bowl_on_the_plate"
            self.scene_name = "KitchenDemoScene"
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
    lifted = [("On", "akita_black_bowl_1", "plate_1")]
    register_task_info("lift it", "kitchen_demo_scene", ["nonsense"], goal_states=lifted)
    for language in ("put it there", "Put it THERE!"):
        register_task_info(language, "kitchen_demo_scene", goal_states=lifted)
    paths, failures = generate_bddl_from_task_info(folder=tmp_path)
    assert {failure.language for failure in failures} == {
        *wrong,
        "find the scene",
        "lift it",
        "Put it THERE!",
    }
    assert len(paths) == 1 and isinstance(failures[0].cause, BDDLError)
    causes = ("mug_1 is not declared", "Juggle is not a predicate", "On takes 2 names")
    causes += ("unknown object of interest 'nonsense'", "another task has this name", "kitchen_scene77")
    assert all(cause in str(failure.cause) for cause, failure in zip(causes, failures, strict=True))
    with pytest.raises(LiberoError, match="mug_1 is not declared"):
        generate_bddl_from_task_info(get_task_info("kitchen_demo_scene")[0], output_dir=tmp_path)
    with pytest.raises(LiberoError, match="no scene_name and no goal_states"):
        register_task_info("do nothing")
    with pytest.raises(UnknownNameError, match="kitchen_demo_scene"):
        get_task_info("kitchen_scene1")


@pytest.mark.parametrize("suite", ["libero_90", "libero_10"])
def test_the_benchmark_from_its_templates(suite):
    """Every task of LIBERO-100, written from its scene's template and its goal, means what the shipped one means."""
    for task in get_suite(suite).tasks:
        info = register_task_info(
            task.bddl_language,
            scene_name=re.match(r"[A-Z_]+\d+", task.name)[0],
            objects_of_interest=task.problem.obj_of_interest,
            goal_states=[tuple(as_list(part)) for part in task.problem.goal.parts],
        )
        text = task_generation_utils.bddl_text(info)
        assert differences(bddl.parse(text), task.problem) == [], task.name


def test_functions_of_bddl_generation_utils(tmp_path, capsys):
    names = pieces.get_object_dict({"main_table": 1, "flat_stove": 1, "plate": 2})
    assert names == {"table": ["main_table"], "flat_stove": ["flat_stove_1"], "plate": ["plate_1", "plate_2"]}
    assert pieces.get_fixtures(names)["plate_2"] == pieces.get_objects(names)["plate_1"] == "plate"
    assert isinstance(names, pieces.ObjectDict)
    given = (("table", 1), ("plate", 2), ("floor", 1))
    assert [pieces.object_naming_mapping(*one) for one in given] == ["main_table", "plate_2", "floor"]
    with pytest.raises(LiberoError, match="floor: 2 of them; a scene has one workspace"):
        pieces.object_naming_mapping("floor", 2)
    with pytest.raises(UnknownNameError, match="kitchen_table"):
        get_suite_generator_func("roof")
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
    assert workspace.removesuffix("_table").removeprefix("main") in problem.name.lower()
    assert problem.goal == And((Atom("Up", ("plate_1",)),))


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
