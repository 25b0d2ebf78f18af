"""The tasks as data: they mean what the original task files mean, and wrong names are answered."""

import hashlib
import json
import pickle
from pathlib import Path

import pytest
import yaml

from libero_env import bddl
from libero_env.bddl import And, Atom, Not, Or
from libero_env.errors import BDDLError, LiberoError, UnknownNameError
from libero_env.tasks import get_suite, get_task, read_task, suite_names
from libero_env.tasks.builder import build_problem
from libero_env.tasks.suites import language_from_name

pytestmark = pytest.mark.unit

ALL_TASKS = [task for name in suite_names() for task in get_suite(name).tasks]
SCENE = {
    "problem": "LIBERO_Kitchen_Tabletop_Manipulation",
    "fixtures": {"kitchen_table": "kitchen_table", "stove_1": "flat_stove"},
    "objects": [{"black_bowl": 2}, "$thing"],
    "regions": {
        "kitchen_table": {
            "stove_region": {"at": [0.1, 0.2], "half": [0.01, 0.02], "yaw": "pi"},
            "front": {"ranges": [[0, 0, 1, 1]], "yaw": ["-pi/2", 0.0]},
        },
        "stove_1": {"cook_region": {}},
    },
    "init": ["On stove_1 kitchen_table_stove_region", "On ${thing}_1 black_bowl_2"],
    "obj_of_interest": ["${thing}_1"],
}
TASK = {
    "name": "cook_it",
    "language": "cook it",
    "with": {"thing": "plate"},
    "goal": ["On plate_1 stove_1_cook_region"],
}


@pytest.mark.parametrize("task", ALL_TASKS, ids=lambda task: task.id)
def test_generated_bddl_reads_back(task):
    assert bddl.parse(task.bddl_text) == task.problem
    assert get_task(task.id) is get_task(f"{task.suite}-{task.index}") is get_task(task.name) is task
    assert task.language == task.language.strip() and "_" not in task.language
    assert pickle.loads(pickle.dumps(task)) == task  # noqa: S301


@pytest.mark.parametrize("task", ALL_TASKS, ids=lambda task: task.id)
def test_tasks_mean_what_the_originals_mean(task, shared):
    original = bddl.read(shared / "official" / "bddl_files" / task.suite / f"{task.name}.bddl")
    assert bddl.differences(original, task.problem) == []


def test_the_facts_can_say_all_130_tasks(shared):
    """Kitchens, cabinets and yaw ranges too: every original, put into scene keys, means the same."""
    files = sorted((shared / "official" / "bddl_files").glob("*/*.bddl"))
    for file in files:
        original = bddl.read(file)
        facts = yaml.safe_load(yaml.safe_dump(facts_of(original), sort_keys=False))
        assert bddl.differences(original, build_problem(facts, {"name": file.stem})) == [], file
    assert len(files) == 130


def facts_of(problem):
    counts: dict[str, int] = {}
    for category in problem.objects.values():
        counts[category] = counts.get(category, 0) + 1
    regions: dict = {}
    for region in problem.regions:
        facts = {"ranges": [list(row) for row in region.ranges]} if region.ranges else {}
        if region.yaw:
            facts["yaw"] = list(region.yaw[0])
        regions.setdefault(region.target, {})[region.name] = facts
    say = lambda atom: " ".join((atom.predicate, *atom.args))  # noqa: E731
    return {
        "problem": problem.name,
        "language": problem.language,
        "fixtures": dict(problem.fixtures),
        "objects": [{category: count} for category, count in counts.items()],
        "regions": regions,
        "init": [say(atom) for atom in problem.init],
        "obj_of_interest": list(problem.obj_of_interest),
        "goal": [say(atom) for atom in problem.goal.parts],
    }


def test_tasks_are_those_that_were_compared():
    """The same, on machines without the originals: the tasks have not changed since they were compared."""
    digests = yaml.safe_load((Path(__file__).parent / "task_digests.yaml").read_text())
    assert {task.id: digest(task) for task in ALL_TASKS} == digests


def digest(task) -> str:
    return hashlib.sha256(f"{task.name}\n{task.bddl_text}".encode()).hexdigest()[:16]


def test_a_task_of_ones_own(tmp_path):
    file = tmp_path / "KITCHEN_SCENE1_cook_the_plate.bddl"
    file.write_text(bddl.write(build_problem(SCENE, TASK)))
    task = read_task(file)
    assert task.problem == build_problem(SCENE, TASK)
    assert (task.id, task.language, task.bddl_language) == ("file/0", "cook the plate", "cook it")


def test_suites_and_orders_are_the_originals(shared):
    facts = json.loads((shared / "official" / "suites.json").read_text())
    for name in suite_names():
        suite = get_suite(name)
        assert [task.name for task in suite.tasks] == facts["suites"][name]
        assert [[task.index for task in suite.order(i)] for i in range(21)] == facts["task_orders"]


@pytest.mark.parametrize("name", suite_names())
def test_orders_are_permutations(name):
    suite = get_suite(name)
    assert suite.order() == suite.tasks
    for i in range(21 if len(suite) == 10 else 1):
        assert sorted(task.index for task in suite.order(i)) == list(range(len(suite)))


@pytest.mark.parametrize(
    ("ask", "hint"),
    [
        (lambda: get_suite("libero_objects"), "Did you mean 'libero_object'? Valid: libero_object"),
        (lambda: get_suite("libero_object").order(21), "task order of libero_object 21"),
        (lambda: get_suite("libero_object").order(-1), "Valid: 0, 1, "),
        (lambda: get_task("libero_object/10"), "index of libero_object '10'"),
        (lambda: get_task("libero_object/-1"), "index of libero_object '-1'"),
        (
            lambda: get_task("pick_up_the_milk_and_put_it_in_the_basket"),
            "Did you mean 'pick_up_the_milk_and_place_it_in_the_basket'",
        ),
    ],
)
def test_unknown_names_are_answered_with_the_valid_ones(ask, hint):
    with pytest.raises(UnknownNameError, match="Valid: ") as caught:
        ask()
    assert hint in str(caught.value)


def test_language_of_names_with_a_scene():
    assert language_from_name("KITCHEN_SCENE10_close_the_top_drawer") == "close the top drawer"
    assert language_from_name("pick_up_the_milk") == "pick up the milk"


def test_a_scene_with_fixtures_yaw_and_parameters():
    problem = build_problem(SCENE, TASK)
    assert list(problem.objects) == ["black_bowl_1", "black_bowl_2", "plate_1"]
    assert list(problem.objects.values()) == ["black_bowl", "black_bowl", "plate"]
    assert problem.region("kitchen_table_stove_region").ranges == (pytest.approx((0.09, 0.18, 0.11, 0.22)),)
    assert problem.region("kitchen_table_stove_region").yaw == ((3.141592653589793, 3.141592653589793),)
    assert problem.region("kitchen_table_front").yaw == ((-1.5707963267948966, 0.0),)
    assert problem.init[1] == Atom("On", ("plate_1", "black_bowl_2"))
    assert bddl.parse(bddl.write(problem)) == problem


def test_a_task_adds_to_its_scene():
    regions = {"kitchen_table": {"front": None, "back": {"at": [0, 0], "half": 0.1}}}
    goal = "(Or (On plate_1 kitchen_table_back) (Not (Turnon stove_1)))"
    problem = build_problem(SCENE, {**TASK, "regions": regions, "goal": goal, "init": []})
    assert problem.region("kitchen_table_front") is None
    back = Atom("On", ("plate_1", "kitchen_table_back"))
    assert problem.goal == Or((back, Not(Atom("Turnon", ("stove_1",)))))
    assert problem.init == ()
    assert SCENE["regions"]["kitchen_table"].keys() == {"stove_region", "front"}


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"goals": []}, UnknownNameError, "key of task cook_it or its scene 'goals'. Did you mean 'goal'?"),
        ({"with": {}}, UnknownNameError, "parameter of task cook_it in '$thing'"),
        ({"goal": ["On plate_1 table"]}, BDDLError, "table is not declared; expected one of black_bowl_1"),
        ({"language": None, "goal": "Turnon"}, BDDLError, "not an atom"),
        ({"regions": {"stove_1": {"cook_region": {"hlaf": 1}}}}, UnknownNameError, "Did you mean 'half'?"),
    ],
)
def test_wrong_facts_are_refused(change, error, message):
    with pytest.raises(error) as caught:
        build_problem(SCENE, {**TASK, **change})
    assert message in str(caught.value)


def test_a_task_without_goal_is_refused():
    with pytest.raises(LiberoError, match="neither it nor its scene says 'goal'"):
        build_problem(SCENE, {"name": "cook_it", "language": "cook it", "with": {"thing": "plate"}})
    assert build_problem(SCENE, TASK).goal == And((Atom("On", ("plate_1", "stove_1_cook_region")),))
