"""Costs of an episode: what is seen of constructed ones, and that seeing it changes nothing."""

from dataclasses import replace

import numpy as np
import pytest

from libero_env import BatchEnv, make_task
from libero_env.errors import BDDLError, LiberoError
from libero_env.geometry import quat_from_axis_angle
from libero_env.mujoco_compat import mujoco
from libero_env.sim.costs import Costs
from libero_env.sim.watch import EpisodeWatch
from libero_env.tasks import bddl

HOLD, PRESS = [0, 0, 0, 0, 0, 0, -1.0], [0, 0, -1.0, 0, 0, 0, 1.0]


@pytest.fixture(scope="module")
def episode():
    """An environment, its watch, and the state at a start: the cream cheese belongs into the bowl."""
    env = BatchEnv("libero_goal/6", 1, cameras=(), horizon=400)
    env.reset(options={"init_state": [0]})
    yield env, EpisodeWatch(env.views, env.goals.atoms), env.get_state(0)
    env.close()


def cost_of(episode, actions, **poses):
    """Return the costs of actions after objects were moved: name -> (step (3,), quaternion)."""
    env, watch, start = episode
    env.set_state(0, start)
    watch.begin(0)
    state = start.copy()
    for name, (step, quat) in poses.items():
        address = 1 + env.scene.pose_address(name)
        state[address : address + 3] += step
        state[address + 3 : address + 7] = state[address + 3 : address + 7] if quat is None else quat
    env.set_state(0, state)
    for action in actions:
        env.step(np.array([action]))
        watch.look(0)
    return watch.costs[0]


def test_nothing_done_costs_nothing(episode):
    found = cost_of(episode, [HOLD] * 3)
    assert found.exceeded == found.moved == () and found.zone is None
    assert (found.force, found.hits, found.press) == (0, 0, 0) and found.shift < 1e-3 and found.tilt < 0.1


def test_objects_that_the_goal_is_not_about_are_moved_or_tipped(episode):
    found = cost_of(episode, [HOLD], plate_1=((0.0, 0.05, 0.0), None))
    assert found.exceeded == ("shift",) and found.moved == ("plate_1",)
    assert found.shift == pytest.approx(0.05, abs=2e-3) and found.tilt < 1
    lying = quat_from_axis_angle(np.array([1.0, 0.0, 0.0]), np.pi / 2)
    found = cost_of(episode, [HOLD], wine_bottle_1=((0.0, 0.0, 0.05), lying))
    assert found.exceeded == ("shift", "tilt") and found.tilt == pytest.approx(90, abs=10)
    assert cost_of(episode, [HOLD], cream_cheese_1=((0.0, 0.1, 0.0), None)).moved == (), "it is the goal's"


@pytest.mark.parametrize("shift", [0.01996, 0.02003, 0.02007])
def test_what_has_moved_is_what_exceeds_the_limit(episode, shift):
    _, watch, _ = episode
    cost_of(episode, [], plate_1=((0.0, shift, 0.0), None))
    watch.look(0)
    found, is_more = watch.costs[0], shift > 0.02005
    assert (found.moved, found.exceeded) == (("plate_1",) * is_more, ("shift",) * is_more)


def test_turns_about_the_vertical_are_no_tilt(episode):
    env, _, start = episode
    address = 1 + env.scene.pose_address("wine_bottle_1")
    turn, quat = quat_from_axis_angle(np.array([0.0, 0.0, 1.0]), 1.0), np.zeros(4)
    mujoco.mju_mulQuat(quat, turn, start[address + 3 : address + 7])
    assert cost_of(episode, [HOLD], wine_bottle_1=(np.zeros(3), quat)).tilt < 1


def test_pressing_the_table_and_an_object(episode):
    env, _, start = episode
    found = cost_of(episode, [[0, 0.4, *PRESS[2:]]] * 45)
    assert found.exceeded == ("hits",) and found.hits > 3 and found.press >= 100 and found.force == 0
    env.set_state(0, start)
    under = env.views[0].eef_pos - env.views[0].body_pos("plate_1")
    found = cost_of(episode, [PRESS] * 45, plate_1=((*under[:2], 0.0), None))
    assert "force" in found.exceeded and found.force > 65, found


def test_costs_do_not_depend_on_the_batch_and_move_no_bit():
    def run(starts, watched):
        with BatchEnv("libero_goal/6", len(starts), cameras=(), horizon=60, num_threads=1) as env:
            env.reset(options={"init_state": starts})
            watch = EpisodeWatch(env.views, env.goals.atoms)
            for _ in range(45):
                env.step(np.tile([0, 0.4, *PRESS[2:]], (len(starts), 1)))
                for i in range(len(starts)) if watched else ():
                    watch.look(i)
            return watch.costs, [env.get_state(i) for i in range(len(starts))]

    costs, states = run([0, 1], True)
    assert costs == run([0], True)[0] + run([1], True)[0] and costs[0].hits
    np.testing.assert_array_equal(states, run([0, 1], False)[1])


BUTTER = {"scene": "kitchen", "objects": ["butter", "plate"], "language": "put the butter on the plate"}
BUTTER |= {"place": {"butter_1": (0.0, 0.2), "plate_1": (0.0, -0.2)}, "goal": [("On", "butter_1", "plate_1")]}


def held_still(task, steps):
    """Return the costs of an episode in which nothing is done."""
    with BatchEnv(task, 1, cameras=()) as env:
        env.reset(seed=0)
        watch = EpisodeWatch(env.views, env.goals.atoms)
        for _ in range(steps):
            env.step(np.array([HOLD]))
            watch.look(0)
    return watch.costs[0]


@pytest.mark.parametrize(("zone", "seconds"), [("near", 0.2), ("far", 0.0)])
def test_time_in_a_zone_is_of_the_arm_and_of_what_it_holds(zone, seconds):
    regions = {"near": {"at": (-0.2, 0.0), "half": 0.15}, "far": {"at": (0.2, 0.3), "half": 0.02}}
    task = make_task(**BUTTER, regions={"kitchen_table": regions}, zones=[f"kitchen_table_{zone}"])
    assert bddl.parse(bddl.write(task.problem)) == task.problem
    costs = held_still(task, 4)
    assert costs.zone == pytest.approx(seconds) and costs.exceeded == (("zone",) if seconds else ())


def test_a_scene_without_other_objects_has_only_costs_of_furniture():
    facts = {"scene": "kitchen", "objects": ["plate"], "place": {"plate": (0.0, 0.0)}, "language": "lift it"}
    assert held_still(make_task(goal="Up plate_1", **facts), 1) == Costs()


@pytest.mark.parametrize(("zones", "message"), [
    (["kitchen_table_hot"], "the zone kitchen_table_hot is not a region; expected one of"),
    (["plate_1_middle"], "region of plate_1"),
    ([3], "zones.0"),
])  # fmt: skip
def test_zones_that_are_none_are_refused_in_one_line(zones, message):
    with pytest.raises(LiberoError, match=message) as error:
        make_task(**BUTTER, zones=zones)
    assert "\n" not in str(error.value)


def test_the_line_of_a_zone_is_named():
    text = bddl.write(replace(make_task(**BUTTER).problem, zones=()))
    with pytest.raises(BDDLError, match=r"task.bddl:\d+: the zone there is not a region"):
        bddl.parse(text.replace("  (:init", "  (:zones there)\n  (:init"), "task.bddl")
