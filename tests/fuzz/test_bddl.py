"""BDDL texts through the parser, and through environment, reset and steps."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from libero_env.design.lint.checks import lint_text
from libero_env.envs.env import LiberoEnv
from libero_env.errors import BDDLError
from libero_env.tasks import bddl, get_task
from libero_env.tasks.problem import differences
from libero_env.tasks.task import Task
from tests.harness.fuzz import examples, survive
from tests.harness.mutations import changed_text

TASKS = ("libero_goal/3", "libero_object/0", "libero_10/2", "libero_90/2", "libero_spatial/4")
TEXTS = [get_task(key).bddl_text for key in TASKS]
SMALL = """(define (problem LIBERO_Floor_Manipulation) (:domain robosuite) (:language put it there)
(:regions (near (:target floor) (:ranges ((-0.1 -0.1 -0.05 -0.05))) (:yaw_rotation ((0 pi/2))))
 (far (:target floor) (:ranges ((0.1 0.1 0.15 0.15)))) (contain_region (:target basket_1)))
(:fixtures floor - floor) (:objects milk_1 butter_1 - milk basket_1 - basket) (:obj_of_interest milk_1)
(:init (On milk_1 floor_near) (On butter_1 milk_1) (On basket_1 floor_far))
(:goal (And (In milk_1 basket_1_contain_region) (Or (Up milk_1) (Not (ForAll (?x - milk) (On ?x basket_1)))))))
"""


NUMBER = re.compile(r"[-+]?\d[\w.+-]*")
TOKEN = re.compile(r"[()]|[^\s()]+|\s+")
EXTREMES = (
    *("0", "1", "-1", "5", "100", "1e5", "1e308", "-1e308", "1e-300", "pi", "-pi/2", "nan"),
    *("1e999", "x"),
)
NAMES = (
    *("robot0_base", "robot", "world", "ee", "table", "floor", "plate_1_lid", "milk_1"),
    *("basket_1_main", "a/b", "?x"),
)
PREDICATES = (
    *("On", "In", "Stack", "Up", "Open", "Close", "Turnon", "Turnoff", "Incontact", "True", "Near"),
    *("And", "Or"),
)


@st.composite
def changed_bddl(draw, texts=(*TEXTS, SMALL, SMALL)):
    """Draw the text of a task with changes of its meaning: numbers, names, predicates, atoms that come and go."""
    text = draw(st.sampled_from(texts))
    if draw(st.integers(0, 9)) == 0:
        return draw(changed_text(text))
    tokens = TOKEN.findall(text)
    words = [i for i, token in enumerate(tokens) if token[0] not in "() \n" and token[0] != ":"]
    numbers = [i for i in words if NUMBER.fullmatch(tokens[i])]
    names = [i for i in words if "_" in tokens[i] and i not in numbers]
    heads = [i for i in words if tokens[i] in PREDICATES]
    for _ in range(draw(st.integers(1, 2))):
        match draw(st.integers(0, 7)):
            case 0:  # swapped corners, or angles
                k = draw(st.integers(0, len(numbers) - 3))
                i, j = numbers[k], numbers[k + draw(st.integers(1, 2))]
                tokens[i], tokens[j] = tokens[j], tokens[i]
            case 1:
                tokens[draw(st.sampled_from(numbers))] = draw(st.sampled_from(EXTREMES))
            case 2:
                tokens[draw(st.sampled_from(names))] = tokens[draw(st.sampled_from(names))]
            case 3:  # everywhere, so that it stays declared
                old, new = tokens[draw(st.sampled_from(names))], draw(st.sampled_from(NAMES))
                tokens = [re.sub(rf"\b{re.escape(old)}\b", lambda _, new=new: new, token) for token in tokens]
            case 4:
                tokens[draw(st.sampled_from(heads))] = draw(st.sampled_from(PREDICATES))
            case 5:  # an argument less or more
                i = draw(st.sampled_from(heads)) + 2
                tokens[i] = draw(st.sampled_from(["", f"{tokens[i]} {tokens[i]}"]))
            case 6:
                tokens[draw(st.sampled_from(words))] = ""
            case _:
                tokens[draw(st.sampled_from(words))] = tokens[draw(st.sampled_from(words))]
    return "".join(tokens)


@given(text=changed_bddl())
@examples(short=150, long=10000)
def test_any_text_is_parsed_or_refused_with_a_line(text):
    def attempt():
        try:
            problem = bddl.parse(text, "fuzz.bddl")
        except BDDLError as error:
            where = re.match(r"fuzz\.bddl:(\d+): .", str(error))
            assert where and 1 <= int(where[1]) <= text.count("\n") + 1, error
            raise
        assert differences(bddl.parse(bddl.write(problem)), problem) == []

    survive("BDDL, parser", attempt)


@given(text=changed_bddl())
@examples(short=30, long=2000)
def test_any_text_has_findings(text):
    survive("BDDL, linter", lambda: lint_text(text, "fuzz.bddl", starts=0))


@pytest.fixture(scope="module")
def warm() -> None:
    """Compile what is compiled at first use, which takes longer than an input may."""
    run(SMALL)


@pytest.mark.sim
@pytest.mark.usefixtures("warm")
@given(text=changed_bddl())
@examples(short=12, long=1500)
def test_any_text_makes_an_environment_or_is_refused(text):
    survive("BDDL, environment", lambda: run(text))


def run(text: str) -> None:
    """Build the scene of a text, reset twice and step."""
    problem = bddl.parse(text, "fuzz.bddl")
    env = LiberoEnv(
        Task("file", 0, "fuzz", "fuzz", problem.language, problem), cameras=(), observations=("objects",)
    )
    try:
        env.reset(seed=0)
        for _ in range(2):
            obs, *_ = env.step(np.zeros(7))
        assert all(np.isfinite(value).all() for value in obs.values())
    finally:
        env.close()
