"""User-defined tasks: one YAML file or one call, the resulting task, and errors."""

from dataclasses import replace
from itertools import combinations, product
from math import hypot
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from libero_cli.main import main
from libero_env import LiberoEnv, Task, get_suite, get_task, make_task, read_task
from libero_env.design.preview import contact_sheet
from libero_env.design.template import task_template
from libero_env.errors import LiberoError, PlacementError, UnknownNameError
from libero_env.init_states import store as init_states
from libero_env.sim.scene import build_scene
from libero_env.storage import read_yaml
from libero_env.tasks import And, Atom, Not, Or, bddl, read_suite, suite_names, write_task
from libero_env.tasks.merging import EMPTY
from libero_env.tasks.problem import differences
from libero_env.workspaces import WORKSPACES
from lifelong.errors import ConfigError
from lifelong.settings import BenchmarkSettings

FACTS = {
    "scene": "kitchen",
    "furniture": ["wooden_cabinet"],
    "objects": ["akita_black_bowl", "plate"],
    "place": {"wooden_cabinet_1": {"at": [0, -0.3], "yaw": "pi"}, "akita_black_bowl_1": [0, 0],
     "plate": {"at": [0.05, 0.2], "half": [0.01, 0.02]}},
    "goal": ["On akita_black_bowl_1 plate_1", "Open wooden_cabinet_1_top_region"],
    "language": "Put the bowl on the plate",
}  # fmt: skip
BDDL = """(define (problem LIBERO_Kitchen_Tabletop_Manipulation) (:domain robosuite)
(:language Put the bowl on the plate)
(:regions
 (wooden_cabinet_1_start (:target kitchen_table) (:ranges ((-0.01 -0.31 0.01 -0.29))) (:yaw_rotation ((pi pi))))
 (akita_black_bowl_1_start (:target kitchen_table) (:ranges ((-0.025 -0.025 0.025 0.025))))
 (plate_1_start (:target kitchen_table) (:ranges ((0.04 0.18 0.06 0.22))))
 (top_region (:target wooden_cabinet_1)))
(:fixtures kitchen_table - kitchen_table wooden_cabinet_1 - wooden_cabinet)
(:objects akita_black_bowl_1 - akita_black_bowl plate_1 - plate)
(:obj_of_interest akita_black_bowl_1 plate_1 wooden_cabinet_1)
(:init (On wooden_cabinet_1 kitchen_table_wooden_cabinet_1_start)
 (On akita_black_bowl_1 kitchen_table_akita_black_bowl_1_start) (On plate_1 kitchen_table_plate_1_start))
(:goal (And (On akita_black_bowl_1 plate_1) (Open wooden_cabinet_1_top_region))))"""


def said(**changes) -> dict:
    return {**FACTS, **changes}


def yaml_file(path: Path, facts: dict) -> Path:
    path.write_text(yaml.safe_dump(facts, sort_keys=False))
    return path


def test_short_facts_are_the_task_that_its_bddl_says():
    task = make_task(**FACTS)
    assert differences(task.problem, bddl.parse(BDDL)) == []
    assert (task.name, task.language) == ("put_the_bowl_on_the_plate", "Put the bowl on the plate")


def test_a_file_a_call_and_the_bddl_written_are_the_same(tmp_path):
    task = make_task("bowl", **FACTS)
    read = read_task(yaml_file(tmp_path / "bowl.yaml", FACTS))
    assert read == task and get_task(str(tmp_path / "bowl.yaml")) == task
    again = read_task(write_task(task, tmp_path / "bowl.bddl"))
    assert differences(again.problem, task.problem) == []
    with pytest.raises(LiberoError, match="must end in .bddl"):
        write_task(task, tmp_path / "bowl.txt")


@pytest.mark.parametrize("suite", sorted({*suite_names()} - {"libero_100", "libero_130"}))
def test_the_benchmarks_own_facts_mean_the_same_here(suite):
    """The keys of the suites' files are valid in user-defined files."""
    facts = dict(read_yaml(f"tasks/data/{suite}.yaml"))
    own = facts.pop("tasks")
    for task, of_task in zip(get_suite(suite).tasks, own, strict=True):
        made = make_task(**{**facts, **of_task})
        assert differences(made.problem, replace(task.problem, language=made.problem.language)) == [], task.id


@pytest.mark.parametrize("scene", sorted({*EMPTY, *EMPTY.values()}))
def test_empty_scenes_have_their_workspace_alone(scene):
    task = make_task(scene=scene, objects=["plate"], place={"plate": [0, 0]}, goal="Up plate_1", language="x")
    (category,) = task.problem.fixtures.values()
    assert category in WORKSPACES and list(task.problem.objects) == ["plate_1"]


ON = And((Atom("On", ("plate_1", "akita_black_bowl_1")),))


@pytest.mark.parametrize(("goal", "expected"), [
    ("On plate_1 akita_black_bowl_1 ", ON),
    ("(on plate_1 akita_black_bowl_1)", ON),
    (("On", "plate_1", "akita_black_bowl_1"), ON),
    ([("Up", "plate_1"), "Up plate_1"], And((Atom("Up", ("plate_1",)), Atom("Up", ("plate_1",))))),
    ("(Or (Open wooden_cabinet_1_top_region) (Not (Up plate_1)))",  # a place that is not declared
     Or((Atom("Open", ("wooden_cabinet_1_top_region",)), Not(Atom("Up", ("plate_1",)))))),
    ("Not (Up plate_1)", Not(Atom("Up", ("plate_1",)))),
])  # fmt: skip
def test_goals_may_be_in_any_notation(goal, expected):
    assert make_task(**said(goal=goal)).problem.goal == expected


def test_objects_are_added_to_a_scene_and_those_of_the_scene_can_be_moved():
    place = {"plate_2": [0.1, 0.1], "butter_1": "plate_2", "butter_2": "In wooden_cabinet_1_top_region"}
    objects, place = ["plate", {"butter": 2}], place | {"plate_1": [-0.1, 0.25]}
    facts = {"scene": "kitchen_scene1", "objects": objects, "place": place, "goal": "On butter_2 plate_2"}
    problem = make_task(**facts, language="x").problem
    assert dict(problem.objects) == {
        "akita_black_bowl_1": "akita_black_bowl", "plate_1": "plate", "plate_2": "plate", "butter_1": "butter",
        "butter_2": "butter"
    }  # fmt: skip
    assert Atom("On", ("butter_1", "plate_2")) in problem.init
    assert Atom("In", ("butter_2", "wooden_cabinet_1_top_region")) in problem.init
    assert [a.args[1] for a in problem.init if a.args[0] == "plate_1"] == ["kitchen_table_plate_1_start"]
    assert {"butter_2", "plate_2"} == set(problem.obj_of_interest)


def test_a_scene_may_be_a_file_beside_the_task(tmp_path):
    base = {"fixtures": {"floor": "floor"}, "objects": ["milk"], "init": ["On milk_1 floor_middle"]}
    base["regions"] = {"floor": {"middle": {"at": [0, 0], "half": 0.02}}}
    yaml_file(tmp_path / "base.yaml", base)
    scene = {"scene": "base.yaml", "objects": ["$other"], "place": {"$other": [0, 0.2]}}
    yaml_file(tmp_path / "my_scene.yaml", scene)
    facts = {"scene": "my_scene.yaml", "goal": "Up milk_1", "with": {"other": "butter"}}
    task = read_task(yaml_file(tmp_path / "lift.yaml", facts))
    assert task.language == "lift" and task.problem.name == "LIBERO_Floor_Manipulation"
    assert list(task.problem.objects) == ["milk_1", "butter_1"]
    assert Atom("On", ("milk_1", "floor_middle")) in task.problem.init
    assert Atom("On", ("butter_1", "floor_butter_1_start")) in task.problem.init
    yaml_file(tmp_path / "list.yaml", facts | {"with": {"other": ["butter", "milk"]}})
    with pytest.raises(LiberoError, match=r"the key \['butter', 'milk'\] is not a text"):
        read_task(tmp_path / "list.yaml")


@pytest.mark.parametrize(("changes", "message"), [
    ({"scene": "kitchn"}, "Did you mean 'kitchen'"),
    ({"scene": None}, "it has no scene; add one of kitchen"),
    ({"scene": "mine.yaml"}, "mine.yaml is missing"),
    ({"objects": ["akita_black_bowl", "plat"]}, "Did you mean 'plate'"),
    ({"objects": ["akita_black_bowl", "plate", "milk"]}, "milk_1 has no place.*`milk_1: \\[0, 0\\]`"),
    ({"place": {"cup_1": [0, 0]}}, "object or fixture to place of task 'cup_1'"),
    ({"goal": "Open wooden_cabinet_1_top_regio"}, "Did you mean 'top_region'"),
    ({"goal": "In plate_1 akita_black_bowl_1_inside"}, "Valid: none"),
    ({"goal": None}, "it has no goal"),
    ({"language": None}, "neither a name nor a language"),
    ({"with": {"x": 1}}, "neither the task nor its scene uses the parameter x; leave it out"),
    ({"with": {"thre": 1, "there": [0, 0]}, "place": {**FACTS["place"], "akita_black_bowl_1": "$there"}}, "'there'?"),
    ({"regions": {"kitchen_table": {"mat": {"half": 0.1}}}}, "it has half, but no at; add such as at: \\[0, 0.2\\]"),
    ({"regions": {"kitchen_table": {"mat": {"at": [0, 0], "half": 0.1, "ranges": [[0, 0, 1, 1]]}}}}, "both at and"),
    ({"place": {**FACTS["place"], "plate_1": {"ranges": [[0, 0, 0.1, 0.1]], "half": 0.3}}}, "it has half, but no at"),
])  # fmt: skip
def test_errors_state_what_is_valid(changes, message):
    with pytest.raises(LiberoError, match=message):
        make_task(**said(**changes))


def test_what_is_added_gets_a_number_that_is_free():
    places = {name: place for name, place in FACTS["place"].items() if not name.startswith("wooden")}
    for given, free in ((2, 3), (1, 2)):
        at = {f"wooden_cabinet_{given}": [0, 0.4], f"wooden_cabinet_{free}": [0, -0.3]}
        changes = {"fixtures": {f"wooden_cabinet_{given}": "wooden_cabinet"}, "goal": "Up plate_1"}
        made = make_task(**said(**changes, place=places | at))
        assert at.keys() < made.problem.fixtures.keys()


def test_the_tasks_of_files_form_a_suite(tmp_path):
    several = {key: value for key, value in FACTS.items() if key not in ("goal", "language")}
    lifts = {"lift_plate": "Up plate_1", "lift_bowl": "Up akita_black_bowl_1"}
    several["tasks"] = [{"name": name, "goal": goal} for name, goal in lifts.items()]
    files = [yaml_file(tmp_path / "b.yaml", FACTS), yaml_file(tmp_path / "a.yaml", several)]
    files.append(write_task(make_task(**FACTS), tmp_path / "c.bddl"))
    suite = read_suite(files)
    assert [task.id for task in suite.tasks] == ["own/0", "own/1", "own/2", "own/3"]
    assert [task.name for task in suite.tasks] == ["b", "lift_plate", "lift_bowl", "c"]
    assert suite.tasks[1].language == "lift plate"
    with pytest.raises(LiberoError, match="named b; rename"):
        read_suite([files[0], files[0]])
    with pytest.raises(LiberoError, match="contains 2 tasks"):
        read_task(files[1])


def test_the_settings_of_a_run_take_files(tmp_path):
    files = [str(yaml_file(tmp_path / f"{name}.yaml", FACTS)) for name in "xyz"]
    settings = BenchmarkSettings("own", files=files, tasks=["z", 0])
    assert [(task.name, task.id) for task in settings.sequence()] == [("z", "own/2"), ("x", "own/0")]
    assert len(BenchmarkSettings("own", files=files).sequence()) == 3
    with pytest.raises(ConfigError, match="give a list of task files"):
        BenchmarkSettings("own").sequence()
    with pytest.raises(LiberoError, match=r"files is .*at least 1 item"):
        BenchmarkSettings("own", files=[])
    with pytest.raises(ConfigError, match="use benchmark=own"):
        BenchmarkSettings("libero_goal", files=files).sequence()
    with pytest.raises(UnknownNameError):
        BenchmarkSettings("own", files=files, tasks=["w"]).sequence()


@pytest.mark.parametrize("options", [
    {},
    {"objects": ["butter", "basket"]},
    {"scene": "floor", "objects": ["milk", "butter", "ketchup", "basket"]},
    {"furniture": ["wooden_cabinet"], "objects": ["butter"], "goal": ["Open wooden_cabinet_1_top_region"]},
    {"scene": "kitchen_scene1", "objects": ["butter"], "goal": ["On butter_1 plate_1"]},
    {"scene": "kitchen_scene1", "objects": ["plate"], "goal": ["On plate_2 plate_1"]},
    {"scene": "kitchen_table"},
], ids=str)  # fmt: skip
def test_templates_are_tasks_with_space_between_objects(options):
    text, task = task_template(**options)
    assert make_task(**yaml.safe_load(text)) == task
    if options.get("objects", ())[-1:] == ["basket"]:
        assert task.problem.goal.parts[-1].args[1] == "basket_1_contain_region"
    middles = [(x0 + x1, y0 + y1) for r in task.problem.regions for x0, y0, x1, y1 in r.ranges]
    assert len(middles) == len(task.problem.objects) + len(task.problem.fixtures) - 1
    assert min(hypot(a[0] - b[0], a[1] - b[1]) / 2 for a, b in combinations(middles, 2)) >= 0.13


@pytest.mark.sim
def test_starts_of_a_file_are_kept_by_what_it_says(tmp_path, monkeypatch):
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path))
    monkeypatch.setattr(Task, "num_starts", 2)
    facts = said(furniture=[], place={"plate": [0, 0.2], "akita_black_bowl": [0, 0]}, goal="Up plate_1")
    task = make_task("one", **facts)
    moved = make_task("one", **{**facts, "place": {"plate": [0, 0.35], "akita_black_bowl": [0, 0]}})
    paths = [init_states.cache_init_states(t) for t in (task, replace(task, suite="own", index=3), moved)]
    assert paths[0] == paths[1] != paths[2] and len([*paths[0].parent.iterdir()]) == 2
    found = []
    for one in (task, moved):
        scene = build_scene(one.problem)
        qpos, _, _ = scene.split_states(init_states.load_init_states(one, scene))
        found.append(qpos[:, scene.model.joint("plate_1_joint0").qposadr[0] + 1])
    assert len(found[0]) == 2 and (found[1] - found[0] > 0.07).all()


FAR = [{"at": [0.3, 0.3], "half": 0.1}, {"ranges": [[0.2, 0.2, 0.4, 0.4]]}]
NEAR = [{"at": [0, 0], "half": 0.1}, {"ranges": [[-0.1, -0.1, 0.1, 0.1]]}]


@pytest.mark.parametrize(("keys", "own"), [*product(FAR, NEAR)])
def test_a_region_of_a_task_replaces_that_of_its_scene(keys, own):
    scene = {"scene": "kitchen", "regions": {"kitchen_table": {"mat": keys}}}
    problem = make_task(**said(scene=scene, regions={"kitchen_table": {"mat": own}})).problem
    assert problem.region("kitchen_table_mat").ranges == ((-0.1, -0.1, 0.1, 0.1),)


@pytest.mark.sim
def test_what_init_says_of_a_fixture_holds_at_the_start(closing):
    env = closing(LiberoEnv(make_task(**said(init_also=["Up wooden_cabinet_1"])), cameras=()))
    with pytest.raises(PlacementError, match="Up wooden_cabinet_1.* does not hold"):
        env.reset(seed=0)


def test_the_video_does_not_replace_the_pictures(tmp_path, capsys):
    path = tmp_path / "a.webp"
    assert main(["tasks", "preview", "libero_object/0", "--out", str(path), "--video"]) == 2
    assert "would be both the pictures and the video" in capsys.readouterr().err and not path.exists()


def test_a_new_task_replaces_no_file_of_the_user(tmp_path, capsys):
    mine = tmp_path / "mine.bddl"
    mine.write_text("by hand")
    assert main(["tasks", "new", "mine", "--bddl", "--out", str(tmp_path)]) == 2
    assert f"{mine} exists already" in capsys.readouterr().err
    assert [*tmp_path.iterdir()] == [mine] and mine.read_text() == "by hand"
    assert main(["tasks", "new", "mine", "--out", str(tmp_path)]) == 0


@pytest.mark.sim
def test_a_task_runs_by_the_name_of_its_file_and_is_rendered(tmp_path, capsys):
    options = ["--scene", "floor", "--objects", "butter", "basket", "--bddl", "--out", str(tmp_path)]
    assert main(["tasks", "new", "first", *options]) == 0
    path, told = tmp_path / "first.yaml", capsys.readouterr().out
    assert "put the butter in the basket" in told
    assert f"first.bddl: {read_task(tmp_path / 'first.bddl').language}\n" in told
    assert read_task(tmp_path / "first.bddl").problem == read_task(path).problem
    assert main(["tasks", "show", str(path)]) == 0
    assert bddl.parse(capsys.readouterr().out) == read_task(path).problem
    assert main(["tasks", "lint", str(path), "--starts", "0"]) == 0
    assert "0 errors, 0 warnings" in capsys.readouterr().out
    with LiberoEnv(str(path), cameras=()) as env:
        env.reset(seed=0)
        progress = env.step(np.zeros(7))[4]["progress"]
    assert progress == {"(In butter_1 basket_1_contain_region)": False}
    views = {"cameras": ("agentview", "birdview"), "size": 32}
    with Image.open(contact_sheet(read_task(path), tmp_path / "sheet.png", starts=2, **views)) as opened:
        picture = np.asarray(opened)
    assert picture.shape == (64, 64, 3) and (picture[:32] != picture[32:]).any()
    path.write_text(path.read_text() + "cameras: {top: {pos: [0, 0, 2], lookat: [0.1, 0, 0]}}\n")
    with Image.open(contact_sheet(read_task(path), tmp_path / "own.png", starts=1, size=32)) as opened:
        assert opened.size == (4 * 32, 32)  # three cameras, and the task's own
