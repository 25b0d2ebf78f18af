"""Task files are unchanged by parsing and writing, and errors state the line."""

import dataclasses
import math
import pickle

import pytest

from libero_env.errors import BDDLError
from libero_env.tasks import And, Atom, ForAll, Not, Or, bddl, get_task
from libero_env.tasks.problem import Problem, Region, differences, same_meaning
from libero_env.tasks.rules import KINDS
from libero_env.tasks.sexpr import number

TEXT = """
(define (problem LIBERO_Kitchen_Tabletop_Manipulation)  ; a comment
  (:domain robosuite)
  (:requirements :typing)
  (:language put both Moka pots on the stove, it's time)
  (:regions
    (pot_region (:target table) (:ranges ((-0.01 .34 1e-2 0.36) (0 0 1 1))) (:yaw_rotation ((-pi/2 (0.0)))))
    (cook_region (:target stove_1) (:rgba (0 0 1 0.5)))
  )
  (:fixtures table - kitchen_table stove_1 - flat_stove)
  (:objects pot_1 pot_2 - moka_pot
     plate_1 - plate
     pot_3 - moka_pot)
  (:obj_of_interest pot_1)
  (:scene_properties (:floor wooden) (:wall red brick))
  (:init (On pot_1 table_pot_region) (turnon stove_1))
  (:goal (And (On pot_1 stove_1_cook_region)
              (Or (Not (Turnon stove_1)) (forall (?x ?y - moka_pot) (On ?x ?y)))))
)
"""
GOOD = TEXT.replace("(0.0)", "0.0")


def test_every_construct_is_read():
    problem = bddl.parse(GOOD)
    pot = problem.region("table_pot_region")
    assert pot.ranges == ((-0.01, 0.34, 0.01, 0.36), (0.0, 0.0, 1.0, 1.0))
    assert pot.yaw == ((-math.pi / 2, 0.0),)
    assert problem.region("stove_1_cook_region") == Region("cook_region", "stove_1", rgba=(0, 0, 1, 0.5))
    assert problem.language == "put both Moka pots on the stove, it's time"
    assert list(problem.objects) == ["pot_1", "pot_2", "plate_1", "pot_3"]
    assert problem.scene_properties == {"floor": "wooden", "wall": "red brick"}
    assert problem.init[1] == Atom("Turnon", ("stove_1",))
    everything = ForAll((("?x", "moka_pot"), ("?y", "moka_pot")), Atom("On", ("?x", "?y")))
    lit = Atom("On", ("pot_1", "stove_1_cook_region"))
    assert problem.goal == And((lit, Or((Not(Atom("Turnon", ("stove_1",))), everything))))


def assert_round_trip(problem: Problem):
    text = bddl.write(problem)
    again = bddl.parse(text)
    assert again == problem
    assert bddl.write(again) == text
    assert differences(problem, again) == []


def test_words_are_separated_by_one_blank():
    words = {"language": " put  both pots\u2003on the stove", "scene_properties": {"wall": "red  brick"}}
    problem = dataclasses.replace(bddl.parse(GOOD), **words)
    assert problem.language == "put both pots on the stove"
    assert_round_trip(problem)


def test_round_trip_of_all_originals(shared):
    files = sorted((shared / "official" / "bddl_files").glob("*/*.bddl"))
    assert len(files) == 130
    for file in files:
        assert_round_trip(bddl.read(file))


def test_a_problem_travels_between_processes():
    problem = bddl.parse(GOOD)
    assert pickle.loads(pickle.dumps(problem)) == problem  # noqa: S301
    assert hash(problem) == hash(bddl.parse(GOOD))


@pytest.mark.parametrize(("change", "line", "message"), [
    (("(0 0 1 1)", "(0 0 1)"), 7, "(0 0 1) in :ranges; expected a list of 4 numbers"),
    (("-pi/2", "exit"), 7, "exit is not a number; expected a finite number such as 0.25 or -pi/4"),
    (("(:target stove_1)", ""), 8, "region cook_region has no target; expected (:target NAME)"),
    (("plate_1 - plate", "pot_1 - plate"), 12, "pot_1 is declared twice"),
    (("pot_3 - moka_pot", "pot_3"), 13, "pot_3 has no category; expected NAME NAME - CATEGORY"),
    (("plate_1 - plate", "table - plate"), 12, "table is a fixture too"),
    (("On pot_1 table_pot_region", "On pot_1 floor"), 16, "floor is not declared; expected one of "),
    (("(turnon stove_1)", "turnon"), 16, "not an atom: turnon; expected (PREDICATE NAME ...)"),
    (("(:language", "(:languish"), 5, "unknown section ':languish'; expected one of :domain, "),
    (("(:domain robosuite)", "(:goal)"), 17, "a second :goal; expected one (the first is on line 3)"),
    (("(Not (Turnon stove_1))", "(Not)"), 18, "(Not); expected (Not EXPRESSION)"),
    (("(:rgba (0 0 1 0.5))", "(:target table)"), 8, "a second :target in a region; expected one"),
    (("(cook_region (:target stove_1)", "(pot_region (:target table)"), 8, "table_pot_region is declared twice"),
    (("(:floor wooden)", "(:floor wooden) (:floor dark)"), 15, "two properties of one kind; expected each once"),
    (("(turnon stove_1)", "(turn/on stove_1)"), 16, "turn/on is not a predicate; expected letters"),
    (("moka_pot\n", "moka_pot\0\n"), 11, "the character '\\x00'; expected text"),
    (("(Not ", "(" * 70), 18, "more than 64 nested brackets"),
    (("(define", "(defined"), 2, "not a problem; expected (define (problem NAME) ...)"),
    (("(define", ") (define"), 2, "a ) closes nothing; expected as many ( as )"),
    (("(:domain robosuite)", "(:domain robosuite"), 2, "this ( is never closed; expected as many ( as )"),
])  # fmt: skip
def test_errors_name_file_line_and_remedy(change, line, message):
    assert change[0] in GOOD
    with pytest.raises(BDDLError) as caught:
        bddl.parse(GOOD.replace(*change, 1), "kitchen.bddl")
    assert str(caught.value).startswith(f"kitchen.bddl:{line}: ")
    assert message in str(caught.value)


@pytest.mark.parametrize("text", ["", "words", "(define (problem x))", "(define)", "()", "((("])
def test_text_that_is_not_a_task_is_rejected(text):
    with pytest.raises(BDDLError, match=r"empty.bddl:1: .*; expected "):
        bddl.parse(text, "empty.bddl")


def test_bytes_that_are_no_text_are_refused(tmp_path):
    file = tmp_path / "kitchen.bddl"
    file.write_bytes(GOOD.encode().replace(b"Moka", b"M\xf6ka"))
    with pytest.raises(BDDLError, match=r"kitchen.bddl:5: the byte 0xf6; expected UTF-8 text"):
        bddl.read(file)
    file.write_bytes(b"\xef\xbb\xbf" + GOOD.encode())  # an editor's byte order mark
    assert bddl.read(file) == bddl.parse(GOOD)


def test_numbers_are_arithmetic_and_nothing_else():
    assert number("-pi/4") == -math.pi / 4
    assert number("2*np.pi+.5") == 2 * math.pi + 0.5
    assert number("6*pi/7 - pi/100") == 6 * math.pi / 7 - math.pi / 100
    assert number("1 - 2*-3/4 + +1") == 1 - 2 * -3 / 4 + 1
    assert number("-2.5e-3") == -0.0025
    words = "open pi() [1] 'a' 1j True a.b 2**9 *1 1_0 0x1 ٣ nan __import__('os') 1e999 1e300*1e300 pi/0"
    for text in (*words.split(), "", "1 2", "9" * 5000, "-" * 100_000 + "1"):
        with pytest.raises(ValueError):
            number(text)


@pytest.mark.parametrize(("change", "where"), [
    ({"language": "other words"}, "language"),
    ({"objects": dict(sorted(bddl.parse(GOOD).objects.items()))}, "objects"),
    ({"init": ()}, "init"),
    ({"goal": Atom("On", ("pot_2", "stove_1_cook_region"))}, "goal"),
    ({"regions": bddl.parse(GOOD).regions[:1], "goal": Atom("Up", ("pot_1",))}, "region stove_1_cook_region"),
])  # fmt: skip
def test_differences_are_found(change, where):
    problem = bddl.parse(GOOD)
    changed = dataclasses.replace(problem, **change)
    assert any(line.startswith(where) for line in differences(problem, changed))
    assert problem != changed and not same_meaning(problem, changed)


def test_order_without_meaning_does_not_count():
    problem = bddl.parse(GOOD)
    turned = {"init": problem.init[::-1], "regions": problem.regions[::-1]}
    turned["goal"] = And(problem.goal.parts[::-1])
    assert same_meaning(problem, dataclasses.replace(problem, **turned))


def test_sections_and_words_of_others_are_kept(monkeypatch):
    for name in ("Open_ratio", "At_speed"):
        monkeypatch.setitem(KINDS, name, None)
    text = get_task("libero_object/0").bddl_text
    goal = "(:goal (And (Open_ratio milk_1 0.5) (Not (At_speed milk_1 -1e-2 steady))))"
    own = text[: text.index("(:goal")] + f"(:camera (agentview 1 2)) {goal})"
    with pytest.warns(UserWarning, match="the section :camera is unknown and has no effect"):
        problem = bddl.parse(own)
    assert problem.unknown_sections == ("(:camera (agentview 1 2))",)
    assert [atom.args for atom in problem.goal.atoms()] == [("milk_1", "0.5"), ("milk_1", "-1e-2", "steady")]
    with pytest.warns(UserWarning, match="camera"):
        assert bddl.parse(bddl.write(problem)) == problem
    with pytest.raises(BDDLError, match="milk_3 is not declared. Did you mean 'milk_1'"):
        bddl.parse(text[: text.index("(:goal")] + "(:goal (Open_ratio milk_3 0.5)))")
