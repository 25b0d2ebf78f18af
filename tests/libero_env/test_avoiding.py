"""The expert that avoids: the hand keeps clear, what is pushed goes around, and the rest is as without."""

import numpy as np
import pytest

from libero_env import BatchEnv, Expert
from libero_env.expert.guard import Guard
from libero_env.expert.planning.detour import Detour
from libero_env.mujoco_compat import mujoco
from libero_env.sim.predicates import Box
from libero_env.sim.watch import EpisodeWatch


def costs_of(env, act, steps):
    """Return the costs of what `act` does with a view, and whether the goal was reached."""
    env.reset(options={"init_state": [2]})
    watch, success = EpisodeWatch(env.views, env.goals.atoms), False
    for _ in range(steps):
        success = env.step(act(env.views[0])[None])[-1]["success"][0]
        watch.look(0)
        if success:
            break
    return watch.costs[0], success


def distance_to_cabinet(env):
    """Return the distance of the palm from the cabinet, [m]."""
    model, data, geoms = env.simulations.model, env.simulations.data(0), env.scene.collision_geoms
    palm = model.geom("gripper0_hand_collision").id
    ends = np.zeros(6)
    return min(mujoco.mj_geomDistance(model, data, palm, g, 1.0, ends) for g in geoms["wooden_cabinet_1"])


@pytest.mark.sim
def test_a_hand_that_is_driven_into_a_cabinet_stops_before_it_and_slides_along():
    into = np.array([0.5, -0.7, -0.5, 0.0, 0.0, 0.0, -1.0])
    with BatchEnv("libero_goal/6", 1, cameras=(), horizon=200) as env:
        hit, _ = costs_of(env, lambda view: into, 40)
        guard = Guard(env.views[0], env.task.problem.goal)
        assert hit.hits > 10
        ends = []  # a part of the cabinet may be moved: the hand comes nearer, as gently
        for handled in (None, "wooden_cabinet_1"):
            cost, _ = costs_of(env, lambda view, what=handled: guard.steer(view, into, what), 40)
            ends.append(distance_to_cabinet(env))
            assert cost.exceeded == () and cost.press < 50, cost
        assert ends[0] > 0.007 > 0.005 > ends[1] > 0, ends
        far = np.array([0.2, 0.1, 0.3, 0.1, 0.0, 0.0, 1.0])
        env.reset(options={"init_state": [2]})
        np.testing.assert_allclose(guard.steer(env.views[0], far, ""), far, atol=1e-12)


@pytest.mark.sim
def test_a_plate_is_pushed_around_what_stands_in_its_way():
    with BatchEnv("libero_goal/5", 1, cameras=(), horizon=400) as env:
        for avoid, moved in ((False, ("cream_cheese_1",)), (True, ())):
            expert = Expert(env.task, np.random.default_rng(0), avoid=avoid)
            cost, success = costs_of(env, expert.act, 300)
            assert success and cost.moved == moved and (not avoid or not cost.exceeded), cost


def way(wall, start=(0.0, 0.0)):
    """Follow the way of a disc of 5 cm to a square 30 cm away, past points; return its positions, (N, 2)."""
    square = Box(np.array([0.0, 0.3, 0.0]), np.eye(3), np.array([0.03, 0.03, 0.0]))
    wall = np.reshape(wall, (-1, 2))
    detour, path = Detour(np.array(start), wall, np.full(len(wall), 0.05), [square]), [np.array(start)]
    while np.linalg.norm(step := detour.path(path[-1])) > 0.01 and len(path) < 100:
        path.append(path[-1] + 0.5 * step)
    return np.array(path)


def test_the_way_is_straight_where_it_is_free_and_goes_around_a_wall():
    assert np.abs(way([])[:, 0]).max() < 0.02 and way([])[-1][1] > 0.265
    wall = np.column_stack([np.linspace(-0.1, 0.02, 13), np.full(13, 0.15)])
    around = way(wall)
    assert around[:, 0].max() > 0.07 and around[-1][1] > 0.265, "it goes by the shorter side"
    assert np.linalg.norm(around[:, None] - wall, axis=-1).min() > 0.055


def test_a_place_that_is_taken_is_gone_to_all_the_same():
    corners = [(x, y) for x in (-0.03, 0.0, 0.03) for y in (0.27, 0.3, 0.33)]
    assert np.abs(way(corners)[-1] - [0.0, 0.3]).max() < 0.03
