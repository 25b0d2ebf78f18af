"""Why an episode failed: every branch of the decision tree, and what is seen of constructed episodes."""

from copy import deepcopy

import numpy as np
import pytest

from libero_env import BatchEnv, Expert
from libero_env.sim.causes import Failure, Missing, Trace, explain
from libero_env.sim.watch import LIFTED, EpisodeWatch, over
from libero_env.tasks.expression import Atom

OWN = ["milk"]


@pytest.mark.parametrize(
    ("trace", "missing", "cause", "what", "astray"),
    [(*row, *[()] * (5 - len(row))) for row in [
        (Trace(), Missing("milk"), "never reached", ""),
        (Trace(lifted={"soup": None}), Missing("milk"), "wrong object", "soup"),
        (Trace(touched={"milk"}), Missing("milk"), "missed grasp", ""),
        (Trace(impacts=[(3, "table", 150.0), (4, "shelf", 90.0)]), Missing("milk"), "collided", "table"),
        (Trace(held={"milk": 9}, touched={"milk"}, impacts=[(3, "table", 150.0)]), Missing("milk"), "missed grasp", ""),
        (Trace(held={"milk": 9}, impacts=[(12, "table", 150.0)]), Missing("milk"), "collided", "table"),
        (Trace(touching={"milk"}), Missing("milk"), "out of time", ""),
        (Trace(touched={"milk"}, impacts=[(3, "milk", 150.0)]), Missing("milk"), "missed grasp", ""),  # a hard push
        (Trace(slipped={"milk": True}), Missing("milk", place="table"), "dropped", "table"),
        (Trace(slipped={"milk": False}), Missing("milk", place="plate"), "wrong place", "plate"),
        (Trace(slipped={"milk": False}), Missing("milk", is_over=True, place="plate"), "wrong place", "plate"),
        (Trace(slipped={"milk": False}), Missing("milk", is_over=True), "out of time", ""),  # it still falls
        (Trace(in_hand="milk"), Missing("milk"), "out of time", ""),
        (Trace(in_hand="milk"), Missing("milk", is_over=True), "not released", ""),
        (Trace(slipped={"milk": False}), Missing("milk", has_held=True, place="table"), "undone", "table"),
        (Trace(), Missing("milk"), "wrong object", "soup", ["shelf", "soup"]),
        (Trace(shut_at={"milk": None}), Missing("milk"), "missed grasp", "", ["soup"]),
        (Trace(lifted={"soup": None}), Missing("milk"), "wrong object", "soup", ["shelf"]),
    ]],
)  # fmt: skip
def test_each_branch_of_the_decision_tree(trace, missing, cause, what, astray):
    found = explain(trace, [missing], OWN, astray)
    assert (found.cause, found.of, found.what) == (cause, "milk", what)
    assert found.newtons == (150.0 if cause == "collided" else 0.0)


def test_of_several_missing_atoms_the_one_that_came_furthest_is_named():
    trace = Trace(slipped={"soup": True})
    assert explain(trace, [Missing("milk"), Missing("soup")], ["milk", "soup"]).of == "soup"
    assert explain(trace, [], []) == Failure("out of time"), "such as a goal with Not"


@pytest.fixture(scope="module")
def lifting():
    """The expert's episode up to where it has lifted the cream cheese, and the state there."""
    env = BatchEnv("libero_goal/6", 1, cameras=(), horizon=400)  # the cream cheese into the bowl
    env.reset(options={"init_state": [0]})
    watch, expert = EpisodeWatch(env.views, env.goals.atoms), Expert(env.task, np.random.default_rng(0))
    before = env.get_state(0)
    while "cream_cheese_1" not in watch.traces[0].lifted:
        env.step(expert.act(env.views[0])[None])
        watch.look(0)
    yield env, watch, env.get_state(0), before
    env.close()


def failed(lifting, actions, state=None):
    """Return the failure after actions from where the object is in the hand."""
    env, watch, held, _ = lifting
    kept = deepcopy(watch.traces[0])
    env.set_state(0, held if state is None else state)
    for action in actions:
        env.step(np.array([action], float))
        watch.look(0)
    found, watch.traces[0] = watch.failure(0, [False], env.missing(0)), kept
    return found


HOLD, OPEN = [0, 0, 0, 0, 0, 0, 1], [0, 0, 0, 0, 0, 0, -1]


def test_in_the_hand_released_elsewhere_and_slipped(lifting):
    env, watch, held, _ = lifting
    assert env.views[0].body_pos("cream_cheese_1")[2] > watch._heights[0]["cream_cheese_1"] + LIFTED
    found = failed(lifting, [HOLD] * 2)
    assert (found.cause, found.of, found.handled) == ("out of time", "cream_cheese_1", ("cream_cheese_1",))
    found = failed(lifting, [OPEN] * 15)
    assert (found.cause, found.what) == ("wrong place", "main_table")
    address = 1 + env.scene.pose_address("cream_cheese_1")
    slipped = held.copy()
    slipped[address + 2] -= 0.06  # out of the closed fingers
    assert failed(lifting, [HOLD] * 2, slipped).cause == "dropped"
    falling = held.copy()
    falling[address : address + 3] = env.views[0].body_pos(env.goals.atoms[0].args[1]) + [0, 0, 0.25]
    assert failed(lifting, [OPEN] * 2, falling).cause == "out of time", "it falls into the bowl"


def test_another_goal_that_was_reached_instead_is_named(lifting):
    env, _, held, _ = lifting
    address, plate = 1 + env.scene.pose_address("cream_cheese_1"), env.views[0].body_pos("plate_1")
    moved = held.copy()
    moved[address : address + 3] = plate + [0, 0, 0.03]
    found = failed(lifting, [OPEN] * 10, moved)
    assert "(On cream_cheese_1 plate_1)" in found.instead
    bowl = env.goals.atoms[0]
    assert not over(env.views[0], bowl)
    moved[address : address + 3] = env.views[0].body_pos("akita_black_bowl_1") + [0, 0, 0.1]
    env.set_state(0, moved)
    assert over(env.views[0], bowl)


def test_a_hard_press_on_the_table_is_a_collision_and_watching_moves_no_bit(lifting):
    env, watch, _, before = lifting
    ends = []
    for watched in (False, True):
        env.set_state(0, before)
        watch.begin(0)
        for _ in range(45):
            env.step(np.array([[0, 0.4, -1, 0, 0, 0, 1]], float))
            if watched:
                watch.look(0)
        ends.append(env.get_state(0))
    np.testing.assert_array_equal(*ends)
    found = watch.failure(0, [False], env.missing(0))
    assert found.cause == "collided" and found.newtons > 100, found


@pytest.fixture(scope="module")
def butter():
    """An environment whose goal is about the butter, with the pudding, much alike, beside it."""
    with BatchEnv("libero_object/6", 1, cameras=(), horizon=200) as env:
        env.reset(options={"init_state": [0]})
        yield env, env.get_state(0), EpisodeWatch(env.views, env.goals.atoms)


def put(env, state, name, place):
    """Put an object of a state there, and what was there to where it was."""
    here = slice(a := 1 + env.scene.pose_address(name), a + 3)
    for other in env.scene.objects:
        there = slice(b := 1 + env.scene.pose_address(other), b + 3)
        if other != name and np.linalg.norm(state[there] - place) < 0.03:
            state[there] = state[here]
    state[here] = place


@pytest.mark.parametrize(("below", "cause", "what"), [
    ("butter_1", "missed grasp", ""),
    ("chocolate_pudding_1", "wrong object", "chocolate_pudding_1"),
    (None, "never reached", ""),
])  # fmt: skip
def test_fingers_that_shut_beside_an_object_missed_it_or_went_for_another(butter, below, cause, what):
    env, before, watch = butter
    env.set_state(0, before)
    expert, view = Expert(env.task, np.random.default_rng(0)), env.views[0]
    while below and np.linalg.norm(view.eef_pos - view.body_pos("butter_1")) > 0.055:
        env.step(expert.act(view)[None])
    if below:
        state = env.get_state(0)
        put(env, state, below, view.body_pos("butter_1"))
        env.set_state(0, state)
    watch.begin(0)
    for _ in range(10):
        env.step(np.array([HOLD], float))
        watch.look(0)
    assert not watch.traces[0].touched and [*watch.traces[0].shut_at] == [below] * bool(below)
    found = watch.failure(0, [False], env.missing(0))
    assert (found.cause, found.of, found.what) == (cause, "butter_1", what)


@pytest.mark.parametrize("pushed", [False, True])
def test_what_was_held_or_pushed_without_the_goals_object_is_the_wrong_one(butter, pushed):
    env, before, _ = butter
    env.set_state(0, before)
    expert, view = Expert(env.task, np.random.default_rng(0)), env.views[0]
    goal = Atom("In", ("chocolate_pudding_1", "basket_1_contain_region"))  # the expert is after the butter
    watch = EpisodeWatch(env.views, [goal])
    side = view.eef_mat[:, 0]  # on which a finger is

    def is_there():
        return pushed and np.linalg.norm(view.eef_pos - view.body_pos("butter_1")) < 0.055

    while not is_there() and "butter_1" not in watch.traces[0].held:
        env.step(expert.act(view)[None])
        watch.look(0)
    if pushed:
        state = env.get_state(0)
        put(env, state, "butter_1", view.body_pos("butter_1") + 0.08 * side)
        env.set_state(0, state)
        for move in [np.array([0, 0, -0.5])] * 5 + [side] * 12:
            env.step(np.array([[*move, *OPEN[3:]]]))
            watch.look(0)
        assert "butter_1" in watch.costs[0].moved
    assert ("butter_1" in watch.traces[0].held) is not pushed and not watch.traces[0].lifted
    found = watch.failure(0, [False], [goal])
    assert (found.cause, found.of, found.what) == ("wrong object", "chocolate_pudding_1", "butter_1")
