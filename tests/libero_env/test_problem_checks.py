"""Problems that no scene can be built from are refused: by the parser with a line, by the environment with the task."""

import dataclasses
import math
import pickle

import numpy as np
import pytest

from libero_env.design.certify import certify
from libero_env.design.lint.checks import lint_text
from libero_env.envs.env import LiberoEnv
from libero_env.errors import BDDLError, InvalidInputError, LiberoError, PlacementError
from libero_env.sim.predicates import register_predicate
from libero_env.tasks import bddl, make_task
from libero_env.tasks.expression import And, Atom, ForAll, Not, Or
from libero_env.tasks.problem import Problem, Region
from libero_env.tasks.rules import MAX_ENTITIES
from libero_env.tasks.task import Task

TEXT = """(define (problem LIBERO_Kitchen_Tabletop_Manipulation) (:domain robosuite)
(:language put the bowl on the plate)
(:regions
 (bowl_place (:target kitchen_table) (:ranges ((-0.03 -0.02 0.03 0.02))) (:yaw_rotation ((0 pi/2))))
 (plate_place (:target kitchen_table) (:ranges ((0.04 0.18 0.06 0.22))))
 (cabinet_place (:target kitchen_table) (:ranges ((-0.01 -0.31 0.01 -0.29))) (:yaw_rotation ((pi pi))))
 (top_region (:target wooden_cabinet_1)))
(:fixtures kitchen_table - kitchen_table wooden_cabinet_1 - wooden_cabinet)
(:objects bowl_1 bowl_2 - akita_black_bowl plate_1 - plate)
(:obj_of_interest bowl_1)
(:init (On bowl_1 kitchen_table_bowl_place)
 (On plate_1 kitchen_table_plate_place)
 (On bowl_2 plate_1)
 (On wooden_cabinet_1 kitchen_table_cabinet_place))
(:goal (And (Not (On bowl_1 plate_1))
 (Open wooden_cabinet_1_top_region))))
"""
GOAL = TEXT[TEXT.index("(:goal") :]
FAULTS = [  # old, new, line, message
    ("(-0.03 -0.02 0.03 0.02)", "(0.03 -0.02 -0.03 0.02)", 4, "swapped corners; expected (X0 Y0 X1 Y1) with X0 <= X1"),
    ("(-0.03 -0.02 0.03 0.02)", "(-1e308 -0.02 1e308 0.02)", 4, "is -1e+308; expected greater than or equal to -10"),
    ("(0 pi/2)", "(pi/2 0)", 4, "LOW <= HIGH"),
    ("(0 pi/2)", "(0 1e300)", 4, "expected less than or equal to 100"),
    ("(On bowl_1 plate_1)", "(On bowl_1)", 15, "(On bowl_1) has 1 name; expected 2: On takes 2 names"),
    ("(On bowl_1 plate_1)", "(In bowl_1 plate_1)", 15, "plate_1 is an object; expected a region there"),
    ("(On bowl_1 plate_1)", "(On bowl_1 bowl_1)", 15, "is of bowl_1 and itself"),
    ("(On plate_1 kitchen_table_plate_place)", "(On plate_1 bowl_2)", 12, "by way of others, on itself"),
    ("(On bowl_2 plate_1)", "(On bowl_2 plate_1) (On bowl_2 kitchen_table_plate_place)", 13, "is placed 2 times"),
    ("(Open wooden", "(On) (Open wooden", 16, "not an atom"),
    (GOAL, "(:goal (And)))", 15, "an empty And is always true"),
    (GOAL, "(:goal (ForAll (?x - milk) (Up ?x))))", 15, "no object is a milk"),
    (GOAL, "(:goal (ForAll (bowl_1 - plate) (Up bowl_1))))", 15, "the variable 'bowl_1'; expected a new name"),
    (GOAL, f"(:goal {'(ForAll (?x ?y - akita_black_bowl) ' * 8}(Up ?x){')' * 10}", 15, "stand for 65536 atoms"),
    ("bowl_2 - akita", " ".join(f"b{i}" for i in range(MAX_ENTITIES)) + " bowl_2 - akita", 9, "at most 100"),
    ("(top_region (:target wooden_cabinet_1))", "(top_region (:target wooden_cabinet_1) (:ranges ((0 0 1 1))))", 7,
     "ranges are for the workspace only"),
    ("(plate_place (:target kitchen_table) (:ranges ((0.04 0.18 0.06 0.22))))", "(plate_place (:target kitchen_table))",
     5, "has no extent"),
    ("((0 pi/2))", "((0 pi/2) (1 2))", 4, "has 2 ranges of yaw; expected one"),
    ("(:target wooden_cabinet_1)", "(:target wooden_cabinet_1) (:yaw_rotation ((0 1)))", 7, "but no rectangle"),
    ("1 kitchen_table_cabinet_place)", "1 plate_1)", 14, "does not place it: a fixture stands on a rectangle"),
]  # fmt: skip
NAMES = (
    *("robot0_base", "robot", "world", "gripper0", "mount0_x", "ee", "a/b", "../x", "x" * 200),
    *("-x", "a\u202eb"),
)


@pytest.mark.parametrize(("old", "new", "line", "message"), FAULTS, ids=lambda value: str(value)[:30])
def test_the_parser_and_the_linter_name_the_line(old, new, line, message):
    assert old in TEXT
    text = TEXT.replace(old, new)
    with pytest.raises(BDDLError) as caught:
        bddl.parse(text, "mine.bddl")
    assert str(caught.value).startswith(f"mine.bddl:{line}: ") and message in str(caught.value)
    assert any(f.line == line and f.level == "error" for f in lint_text(text, "mine.bddl", starts=0))


@pytest.mark.parametrize("name", NAMES)
def test_names_of_the_robot_and_those_that_are_no_names_are_refused(name):
    with pytest.raises(BDDLError, match=r"mine\.bddl:9: .*the name "):
        bddl.parse(TEXT.replace("bowl_1", name), "mine.bddl")


def test_a_region_is_not_also_an_object():
    text = TEXT.replace("bowl_2", "kitchen_table_plate_place")
    with pytest.raises(BDDLError, match="is both a region of kitchen_table and an object"):
        bddl.parse(text)


def test_a_file_that_is_too_large_is_refused(tmp_path):
    path = tmp_path / "large.bddl"
    path.write_text("; " + "x" * (1 << 21))
    with pytest.raises(BDDLError, match="expected a task file of at most 1048576"):
        bddl.read(path)


PROBLEM = bddl.parse(TEXT)


@pytest.mark.parametrize(("changes", "message"), [
    ({"language": 3}, "Problem: language is 3; expected a valid string"),
    ({"language": "a\nb"}, "expected one line without ( ) and ;"),
    ({"init": (Atom("On", ("bowl_1", "nowhere")),)}, "(On bowl_1 nowhere): nowhere is not declared"),
    ({"goal": "Up bowl_1"}, "goal is 'Up bowl_1'; expected an instance of Expression"),
    ({"name": "a b"}, "the name 'a b' is not valid"),
], ids=str)  # fmt: skip
def test_a_problem_made_in_python_is_checked(changes, message):
    with pytest.raises(InvalidInputError) as caught:
        dataclasses.replace(PROBLEM, **changes)
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)  # noqa: S301


@pytest.mark.parametrize("make", [
    lambda: Region("a", "kitchen_table", ((0.0, 0.0, 1.0),)),
    lambda: Region("a", "kitchen_table", ((0.0, 0.0, math.nan, 1.0),)),
    lambda: Atom("On", ()),
    lambda: Not("Up bowl_1"),
    lambda: Or([Atom("Up", ("bowl_1",))]),
    lambda: ForAll(("?x", "plate"), Atom("Up", ("?x",))),
    lambda: And(tuple(Atom("Up", ("bowl_1",)) for _ in range(2000))),
])  # fmt: skip
def test_parts_of_a_problem_are_checked_when_they_are_made(make):
    with pytest.raises(InvalidInputError):
        make()


def test_a_goal_has_a_largest_depth():
    goal = Atom("Up", ("bowl_1",))
    with pytest.raises(InvalidInputError, match="the goal is too large; expected at most 64 levels"):
        for _ in range(100):
            goal = Not(goal)
    assert goal.levels == 64 and Problem("p", "x", goal, PROBLEM.fixtures, PROBLEM.objects)


def test_a_users_predicate_takes_as_many_names_as_its_function():
    register_predicate("near", lambda view, a, b: True)
    text = TEXT.replace("(On bowl_1 plate_1)", "(Near bowl_1 kitchen_table)")
    assert bddl.parse(text).goal.parts[0] == Not(Atom("Near", ("bowl_1", "kitchen_table")))
    with pytest.raises(BDDLError, match="Near takes 2 names"):
        bddl.parse(text.replace("(Near bowl_1 kitchen_table)", "(Near bowl_1)"))
    register_predicate("near", lambda view, *names: True)
    assert bddl.parse(text.replace("(Near bowl_1 kitchen_table)", "(Near bowl_1)"))


@pytest.mark.sim
def test_a_predicate_has_numbers_and_words_of_the_task_file(closing):
    """Two places 0.1 and 0.2 m apart along the axes: their distance is between 0.2 and 0.25 m."""

    def within(view, entity, target, distance: float, where):
        found = np.linalg.norm((view.body_pos(entity) - view.body_pos(target))[:2]) < distance
        return bool(found) == (where == "inside")

    register_predicate("within", within)
    definition = {
        "scene": "kitchen", "objects": ["plate", "butter"], "language": "x",
        "place": {"plate_1": {"at": [0, 0], "half": 0}, "butter_1": {"at": [0.1, 0.2], "half": 0}},
    }  # fmt: skip
    goals = [("Within", "butter_1", "plate_1", d, w) for d in (0.2, 0.25) for w in ("inside", "outside")]
    made = make_task(goal=[*goals, "Up plate_1"], **definition)
    assert make_task(goal=goals[0], **definition).problem.goal.parts == (
        Atom(*goals[0][:1], tuple(map(str, goals[0][1:]))),
    )
    assert bddl.parse(made.bddl_text) == made.problem
    env = closing(LiberoEnv(made, cameras=()))
    progress = env.reset(seed=0)[1]["progress"]
    assert list(progress.values()) == [False, True, True, False, False]
    assert "(Within butter_1 plate_1 0.2 outside)" in progress
    with pytest.raises(InvalidInputError, match="plate_1 is not a number; expected one such as 0.05"):
        make_task(goal=("Within", "butter_1", "plate_1", "plate_1", "inside"), **definition)


def task(text: str) -> Task:
    problem = bddl.parse(text)
    return Task("file", 0, "mine", "mine", problem.language, problem)


@pytest.mark.sim
@pytest.mark.parametrize(("old", "new", "message"), [
    ("top_region", "upper_region", "wooden_cabinet_1 has no region 'upper_region'. Did you mean"),
    ("(On bowl_2 plate_1)", "(On bowl_2 plate_1_lid)", "plate_1 has no region 'lid'; expected plate_1 itself"),
    ("(Open wooden_cabinet_1_top_region)", "(Turnon wooden_cabinet_1)", "'turnon' of a wooden_cabinet is not"),
    ("bowl_2", "wooden_cabinet_1_cabinet_top", "repeated name"),
])  # fmt: skip
def test_what_the_models_lack_is_one_error_everywhere(old, new, message, tmp_path):
    text = TEXT.replace(old, new)
    if "lid" in new:
        text = text.replace("(top_region (:t", "(lid (:target plate_1)) (top_region (:t")
    broken = task(text)
    with pytest.raises(LiberoError) as caught:
        LiberoEnv(broken, cameras=())
    assert message in str(caught.value)
    (found,) = [f for f in lint_text(text, "mine.bddl", starts=1) if f.level == "error"]
    assert message.partition(";")[0] in str(found)
    (certificate,) = certify([broken], 1, out=tmp_path, progress=False)
    assert message in certificate.outcomes[0].reason


@pytest.mark.sim
def test_the_task_runs_as_long_as_nothing_is_wrong_and_placement_ends_in_seconds(closing):
    env = closing(LiberoEnv(task(TEXT), cameras=()))
    env.reset(seed=0)
    assert env.step(np.zeros(7))[4]["progress"]
    env = closing(LiberoEnv(task(TEXT.replace("(-0.03 -0.02 0.03 0.02)", "(0.05 0.2 0.05 0.2)")), cameras=()))
    with pytest.raises(PlacementError, match="still collide after 500 tries"):
        env.reset(seed=0)
