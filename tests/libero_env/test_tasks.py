"""The tasks as data: they mean what the original task files mean, and wrong names are answered."""

import hashlib
import json
import pickle
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from libero_env.errors import UnknownNameError
from libero_env.tasks import bddl, get_suite, get_task, read_task, suite_names
from libero_env.tasks.builder import build_problem
from libero_env.tasks.expression import Atom, Not, Or
from libero_env.tasks.problem import differences

# every task once, whatever number of suites has it
ALL_TASKS = list({task.id: task for name in suite_names() for task in get_suite(name).tasks}.values())
SCENE = {
    "problem": "LIBERO_Kitchen_Tabletop_Manipulation",
    "fixtures": {"kitchen_table": "kitchen_table", "stove_1": "flat_stove"},
    "objects": [{"black_bowl": 2}, "$thing"],
    "regions": {"kitchen_table": {"stove_region": {"at": [0.1, 0.2], "half": [0.01, 0.02], "yaw": "pi"},
     "front": {"ranges": [[0, 0, 1, 1]], "yaw": ["-pi/2", 0.0]}}, "stove_1": {"cook_region": {}}},
    "init": ["On stove_1 kitchen_table_stove_region", "On ${thing}_1 black_bowl_2",
     "On black_bowl_1 kitchen_table_front", "On black_bowl_2 stove_1_cook_region"],
    "obj_of_interest": ["${thing}_1"],
}  # fmt: skip
TASK = {
    "name": "cook_it", "language": "cook it", "with": {"thing": "plate"}, "goal": ["On plate_1 stove_1_cook_region"]
}  # fmt: skip


@pytest.mark.parametrize("task", ALL_TASKS, ids=lambda task: task.id)
def test_generated_bddl_reads_back(task):
    assert bddl.parse(task.bddl_text) == task.problem and bddl.write(task.problem) == task.bddl_text
    assert get_task(task.id) is get_task(f"{task.suite}-{task.index}") is get_task(task.name) is task
    assert task.language == task.language.strip() and "_" not in task.language
    assert pickle.loads(pickle.dumps(task)) == task  # noqa: S301


def test_tasks_mean_what_the_originals_mean(shared):
    for task in ALL_TASKS:
        original = bddl.read(shared / "official" / "bddl_files" / task.suite / f"{task.name}.bddl")
        assert differences(original, bddl.parse(task.bddl_text)) == [], task.id
        assert original.obj_of_interest == task.problem.obj_of_interest, "their order shows in the facade"
        assert task.bddl_language == original.language
    differ = [task for task in ALL_TASKS if task.language.casefold() != task.bddl_language.casefold()]
    assert (len(ALL_TASKS), len(differ)) == (130, 29)


def test_tasks_are_those_that_were_compared():
    """The same, on machines without the originals: the tasks have not changed since they were compared."""
    digests = yaml.safe_load((Path(__file__).parent / "task_digests.yaml").read_text())
    assert {task.id: digest(task) for task in ALL_TASKS} == digests


def digest(task) -> str:
    return hashlib.sha256(f"{task.name}\n{task.bddl_text}".encode()).hexdigest()[:16]


def test_a_user_defined_task(tmp_path):
    file = tmp_path / "KITCHEN_SCENE1_cook_the_plate.bddl"
    file.write_text(bddl.write(build_problem(SCENE, TASK)))
    task = read_task(file)
    assert task.problem == build_problem(SCENE, TASK)
    assert (task.id, task.language, task.bddl_language) == ("file/0", "cook it", "cook it")


@pytest.mark.parametrize("key", ["libero_goal/8", "libero_90/3", "libero_10/0"])
def test_only_a_file_of_the_benchmark_is_told_by_its_name(tmp_path, key):
    """Another name, other words or another goal make it the user's own, which keeps its words."""
    task = get_task(key)
    text, own = task.bddl_text, task.bddl_text.replace(task.bddl_language, "do as I say")
    other = replace(task.problem, goal=Not(task.problem.goal))
    for name, content, told in (
        (task.name, text, task.language),
        ("KITCHEN_SCENE1_abc", text, task.bddl_language),
        (task.name, own, "do as I say"),
        (task.name, bddl.write(other), task.bddl_language),
    ):
        path = tmp_path / f"{name}.bddl"
        path.write_text(content)
        assert read_task(path).language == told


def test_suites_and_orders_are_the_originals(shared):
    facts = json.loads((shared / "official" / "suites.json").read_text())
    assert {*suite_names()} == {*facts["suites"], "libero_100", "libero_130"}
    for name, tasks in facts["suites"].items():
        suite = get_suite(name)
        assert [task.name for task in suite.tasks] == tasks
        if len(suite) == 10:
            assert [[task.index for task in suite.order(i)] for i in range(21)] == facts["task_orders"]


def test_libero_100_is_90_then_10():
    tasks = get_suite("libero_100").tasks
    assert tasks == get_suite("libero_90").tasks + get_suite("libero_10").tasks
    assert get_task("libero_100/95") is get_task("libero_10/5")
    assert len({task.id for task in get_suite("libero_130").tasks}) == 130
    assert get_task("libero_130/30") is get_task("libero_90/0")


@pytest.mark.parametrize("name", suite_names())
def test_orders_are_permutations(name):
    suite = get_suite(name)
    assert suite.order() == suite.tasks
    for i in range(21 if len(suite) == 10 else 1):
        assert sorted(map(suite.tasks.index, suite.order(i))) == list(range(len(suite)))


@pytest.mark.parametrize(("ask", "hint"), [
    (lambda: get_suite("libero_objects"), "Did you mean 'libero_object'? Valid: libero_10, libero_100, libero_130, "),
    (lambda: get_suite("libero_90").order(1), "task order of libero_90 1. Valid: 0"),
    (lambda: get_suite("libero_object").order(-1), "Valid: 0 to 20"),
    (lambda: get_task("libero_object/10"), "index of libero_object '10'"),
    (lambda: get_task("LIBERO_OBJECT"), "unknown suite 'LIBERO_OBJECT'. Did you mean 'libero_object'?"),
    (lambda: get_task("libero_object-12"), "index of libero_object '12'. Valid: 0 to 9"),
    (lambda: get_task("nope"), "libero_100/0 to libero_100/99, libero_130/0 to libero_130/129, "),
    (lambda: get_task("pick_up_the_milk_and_put_it_in_the_basket"),
     "Did you mean 'pick_up_the_milk_and_place_it_in_the_basket'"),
])  # fmt: skip
def test_unknown_names_are_answered_with_the_valid_ones(ask, hint):
    with pytest.raises(UnknownNameError, match="Valid: ") as caught:
        ask()
    assert hint in str(caught.value)


def test_a_task_adds_to_its_scene():
    regions = {"kitchen_table": {"front": None, "back": {"at": [0, 0], "half": 0.1}}}
    goal = "(Or (On plate_1 kitchen_table_back) (Not (Turnon stove_1)))"
    init = [atom.replace("front", "back").replace("$thing", "plate") for atom in SCENE["init"]]
    problem = build_problem(SCENE, {**TASK, "regions": regions, "goal": goal, "init": init})
    assert problem.region("kitchen_table_front") is None
    back = Atom("On", ("plate_1", "kitchen_table_back"))
    assert problem.goal == Or((back, Not(Atom("Turnon", ("stove_1",)))))
    assert Atom("On", ("black_bowl_1", "kitchen_table_back")) in problem.init
    assert SCENE["regions"]["kitchen_table"].keys() == {"stove_region", "front"}


def test_sites_may_be_a_list():
    scene = {**SCENE, "regions": {**SCENE["regions"], "stove_1": ["cook_region", "burner"]}}
    problem = build_problem(scene, {**TASK, "regions": {"stove_1": {"burner": None}}})
    assert problem == build_problem(SCENE, TASK)


def test_what_a_task_need_not_say():
    """Its language are the words of its name; of interest is what the goal speaks of, objects first."""
    scene = {key: value for key, value in SCENE.items() if key != "obj_of_interest"}
    task = {
        "name": "KITCHEN_SCENE1_cook_the_plate",
        "with": {"thing": "plate"},
        "goal": "(Or (On plate_1 stove_1_cook_region) (Not (forall (?x - black_bowl) (On ?x black_bowl_2))))",
    }
    problem = build_problem(scene, task)
    assert problem.language == "cook the plate"
    assert problem.obj_of_interest == ("black_bowl_2", "plate_1", "stove_1")
