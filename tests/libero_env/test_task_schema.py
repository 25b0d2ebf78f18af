"""YAML files of tasks and objects: every wrong value is one line with file and line, in Python one with the key."""

import os

import pytest
import yaml

from libero_cli.main import main
from libero_env.design.template import task_template
from libero_env.errors import BDDLError, InvalidInputError, LiberoError
from libero_env.objects import folder
from libero_env.tasks import bddl, get_task, make_task, read_suite, read_task
from libero_env.tasks.expression import And, Atom
from libero_env.tasks.rules import CONSTANTS, KINDS
from libero_env.tasks.task import Task
from libero_env.validation import validate

TEXT = """\
scene: kitchen
furniture: [wooden_cabinet]
objects:
  - akita_black_bowl
  - plate: 1
place:
  wooden_cabinet_1: {at: [0, -0.3], yaw: pi}
  akita_black_bowl_1: [0, 0]
  plate_1:
    at: [0.05, 0.2]
    half: [0.01, 0.02]
init: [Open wooden_cabinet_1_top_region]
goal:
  - On akita_black_bowl_1 plate_1
  - Up plate_1
language: Put the bowl on the plate
scene_properties: {floor: light-gray}
"""
BAD = [  # old, new, line, message
    ("scene: kitchen", "scene: 5", 1, "scene is 5; expected one of kitchen"),
    ("scene: kitchen", "scene: ../scene.yaml", 1, "is not in the folder of the task's file"),
    ("scene: kitchen", f"scene: {'x' * 300}.yaml", 1, "is not the name of a file"),
    ("plate: 1", "plate: 1000000000", 5, "plate is 1000000000; expected less than or equal to 100"),
    ("- akita_black_bowl", "- ../akita", 4, "is not valid; expected letters"),
    ("[0, 0]", "[0, there]", 8, "'there' is not a finite number; expected one such as 0.25 or -pi/4"),
    ("[0, 0]", "{ranges: [[0, 0, -1, 1]]}", 8, "has swapped corners"),
    ("[0, 0]", "{at: [0, 0], hafl: 0.1}", 8, "hafl is an unknown key"),
    ("[0, 0]", "12", 8, "is 12; expected [x, y], {at: [x, y], half: h}, or the name of what it is on"),
    ("[0, 0]", "'On On On'", 8, "'On On On' is not a place; expected such as plate_1"),
    ("yaw: pi", "yaw: 90", 7, "90 rad is more than two turns; expected radians: 90 degrees are pi/2"),
    ("init: [Open", "init: [Opened", 12, "Opened is not a predicate. Did you mean 'Open'?"),
    ("  - Up plate_1", "  - Up", 15, "not an atom"),
    ("  - Up plate_1", "  - (Or (Up plate_1)", 15, "is not an atom or expression"),
    ("Put the bowl on the plate", '"Put the bowl\\non the plate"', 16, "cannot be written; expected one line"),
    ("Put the bowl on the plate", "x\nname: ../../x", 17, "is not a valid name of a name"),
    ("Put the bowl on the plate", "x\nregions: {kitchen_table: {a: {at: [0, 0]}}}", 1, "it has at, but no half"),
    ("Put the bowl on the plate", "x\nfixtures: {x: nothing}", 17, "fixture category"),
    ("Put the bowl on the plate", "x\ntasks: 5", 17, "expected a list of at most 1000 tasks"),
    ("Put the bowl on the plate", "x\ntasks: [{name: a}, {name: a, init: []}]", 17, "two tasks are named a; give each"),
    ("scene: kitchen", "scene: kitchen\nscene: floor", 2, "the key scene occurs twice"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "line", "message"), BAD, ids=lambda value: str(value)[:40])
def test_a_wrong_value_is_one_line_with_file_and_line(tmp_path, old, new, line, message):
    assert old in TEXT
    path = tmp_path / "mine.yaml"
    path.write_text(TEXT.replace(old, new))
    with pytest.raises(LiberoError) as caught:
        read_suite([path])
    assert message in str(caught.value) and "\n" not in str(caught.value)
    if line > 1 or "scene" in old:
        assert f"{path}:{line}" in str(caught.value), caught.value


ARGUMENTS = {"object": "akita_black_bowl_1", "region": "wooden_cabinet_1_top_region"}
GOAL = "  - On akita_black_bowl_1 plate_1\n  - Up plate_1\n"


def read_goal(folder, goal):
    path = folder / "mine.yaml"
    path.write_text(TEXT.replace(f"goal:\n{GOAL}", f"goal: {goal}\n").replace("light-gray", "rustic_floor"))
    return read_task(path).problem


@pytest.mark.parametrize("name", sorted(KINDS.keys() - {*CONSTANTS}))
def test_every_spelling_of_an_atom_is_the_same_goal(tmp_path, name):
    kinds = [ARGUMENTS["object" if "object" in kind else "region"] for kind in KINDS[name]]
    args = [kinds[0], *("plate_1" if kind == kinds[0] else kind for kind in kinds[1:])]
    expected = And((Atom(name, tuple(args)), Atom("Open", ("wooden_cabinet_1",))))
    for word in (name, name.lower(), name.upper()):
        text = " ".join([word, *args])
        for atom in (text, f"({text})", f"[{', '.join([word, *args])}]"):
            problem = read_goal(tmp_path, f"\n  - {atom}\n  - [Open, wooden_cabinet_1]")
            assert problem.goal == expected, atom
            assert read_goal(tmp_path, atom).goal == And(expected.parts[:1]), atom
        assert read_goal(tmp_path, f"(And ({text}) (open wooden_cabinet_1))") == problem
    assert bddl.parse(bddl.write(problem)) == problem


@pytest.mark.parametrize("within", ["{}", "(Or {} (Up plate_1))", "(Not {})", "(Never {})", "(Count 2 {})",
    "(Then (Up plate_1) {})", "(ForAll (?x - plate) {})", "(And (Or (Never {})))"])  # fmt: skip
@pytest.mark.parametrize(("word", "message"), [("Onn", "Onn is not a predicate. Did you mean 'On'?"),
    ("True", "always holds"), ("false", "never holds")])  # fmt: skip
def test_a_goal_of_no_predicate_is_refused_where_it_is_read(tmp_path, word, message, within):
    goal = within.format(f"({word} akita_black_bowl_1 plate_1)")
    with pytest.raises(InvalidInputError) as caught:
        read_goal(tmp_path, goal)
    assert f"{tmp_path}/mine.yaml:13: (" in str(caught.value) and message in str(caught.value)
    text = get_task("libero_goal/8").bddl_text.replace("(And ", f"(And {goal} ", 1)
    (tmp_path / "mine.bddl").write_text(text)
    with pytest.raises(BDDLError, match=f"mine.bddl:[0-9]+: .*{message[:14]}"):
        read_task(tmp_path / "mine.bddl")


@pytest.mark.parametrize("goal", ["[true, plate_1]", "[True, a, b]", "[[FALSE, a], [Up, plate_1]]", "true"])
def test_a_boolean_is_no_word_of_a_goal(tmp_path, goal):
    told = r"mine.yaml:13: goal.* is (True|\[True|\[False|False).*expected a valid string"
    with pytest.raises(InvalidInputError, match=told):
        read_goal(tmp_path, goal)


def test_scenes_that_include_each_other_end(tmp_path):
    for name, other in (("a", "b"), ("b", "c"), ("c", "a")):
        (tmp_path / f"{name}.yaml").write_text(f"scene: {other}.yaml\n")
    with pytest.raises(InvalidInputError, match=r"c.yaml:1: scenes include each other .*c.yaml -> a.yaml"):
        read_task(tmp_path / "a.yaml")


def test_a_link_does_not_lead_out_of_the_folder(tmp_path):
    own, other = tmp_path / "own", tmp_path / "other"
    own.mkdir(), other.mkdir()
    (other / "scene.yaml").write_text("scene: kitchen\n")
    os.symlink(other / "scene.yaml", own / "scene.yaml")
    (own / "mine.yaml").write_text("scene: scene.yaml\n")
    with pytest.raises(InvalidInputError, match="is not in the folder of the task's file"):
        read_task(own / "mine.yaml")


def test_a_scene_in_a_folder_below_may_name_one_beside_the_task(tmp_path):
    (tmp_path / "scenes").mkdir()
    (tmp_path / "base.yaml").write_text("scene: kitchen\nobjects: [plate]\nplace: {plate: [0, 0]}\n")
    (tmp_path / "scenes" / "two.yaml").write_text("scene: ../base.yaml\n")
    (tmp_path / "mine.yaml").write_text("scene: scenes/two.yaml\ngoal: Up plate_1\n")
    assert list(read_task(tmp_path / "mine.yaml").problem.objects) == ["plate_1"]


def test_parameters_of_a_scene_have_types_too():
    told = r"task, in grocery_floor: regions\.floor\.target_object_region\.at is 'x'"
    with pytest.raises(LiberoError, match=told):
        make_task(scene="grocery_floor", language="x", **{"with": {
            "target": "milk", "other": ["butter"] * 5, "target_at": "x", "first_other_at": [0, 0]
        }})  # fmt: skip


@pytest.mark.parametrize(
    "name", ["", "..", ".x", "a/b", "a\\b", "a\0b", "a\nb", " x", "x" * 201, "\u202ex", 5]
)
def test_a_task_has_a_name_that_files_can_have(name):
    task = make_task("x", scene="table", objects="plate", place={"plate": [0, 0]}, goal="Up plate_1")
    with pytest.raises(InvalidInputError, match="is not a valid name of a task"):
        Task("file", 0, name, "x", "x", task.problem)
    with pytest.raises(InvalidInputError, match="is not a valid name of a suite"):
        Task(name, 0, "x", "x", "x", task.problem)


def test_a_template_is_a_task_whatever_the_language_is(tmp_path, capsys):
    for language in ("open: it", "yes", "# no", "5", "[a", "it's 'here'", "put it - there"):
        text, task = task_template(language=language)
        assert task.language == language and make_task(**yaml.safe_load(text)) == task
    assert main(["tasks", "new", "../escaped", "--out", str(tmp_path / "a")]) == 2
    assert "is not the name of a task" in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.yaml"))
    assert main(["tasks", "new", "x", "--goal", "On", "--out", str(tmp_path)]) == 2
    assert "--goal 'On' is not an atom" in capsys.readouterr().err


OBJECT = (
    "bottom_offset: [0, 0, -0.03]\ntop_offset: [0, 0, 0.03]\nhorizontal_radius: 0.04\nrotation: {z: [0, 1]}\n"
)
MODEL = '<mujoco><worldbody><body name="main"><geom name="g0" size="0.02"/></body></worldbody></mujoco>'


@pytest.mark.parametrize(("old", "new", "line", "message"), [
    ("-0.03]", "deep]", 1, "bottom_offset.2 is 'deep'; expected a valid number"),
    ("0, 0.03]", "0, -0.3]", 2, "its highest point is below its lowest"),
    ("{z: [0, 1]}", "{z: [1, 0]}", 4, "is no range"),
    ("rotation: {z: [0, 1]}", "name: other", 4, "the name 'other' is not that of its folder thing"),
    ("rotation: {z: [0, 1]}", "grasp: {width: null}", 4, "reason is missing"),
    (OBJECT, "- 1\n", 1, "expected an object"),
    (OBJECT, "a: [", 2, "not valid YAML"),
])  # fmt: skip
def test_the_properties_of_an_object_have_types(tmp_path, old, new, line, message):
    own = tmp_path / "thing"
    own.mkdir()
    (own / "object.xml").write_text(MODEL)
    (own / "object.yaml").write_text(OBJECT)
    assert folder.load(own, "thing").horizontal_radius == 0.04
    (own / "object.yaml").write_text(OBJECT.replace(old, new))
    with pytest.raises(InvalidInputError) as caught:
        folder.load(own, "thing")
    assert message in str(caught.value)
    assert f"{own / 'object.yaml'}:{line}: " in str(caught.value)


def test_faults_in_one_branch_of_a_union_have_their_own_path():
    with pytest.raises(InvalidInputError, match=r"^a\.1 is 'x'; expected a valid integer$"):
        validate(dict[str, list[int] | None], {"a": [0, "x"]})
