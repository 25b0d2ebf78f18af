"""What plugs into a `BatchEnv`: it is called at its moments, in order, and its state belongs to an episode's."""

import numpy as np
import pytest

from libero_env import BatchEnv
from libero_env.envs.hooks import HOOKS, Hooks, overridden

pytestmark = pytest.mark.sim
TASK = "libero_object/3"


class Tally(Hooks):
    """Counts the control steps of each episode, holds the arm still, and hides the hand."""

    def __init__(self):
        self.moments, self.count = [], np.zeros(2)

    def attach(self, batch):
        self.moments.append(("attach", batch.num_envs))

    def before_reset(self, ids, states, names):
        self.moments.append(("before_reset", tuple(ids), tuple(names)))
        return states

    def after_reset(self, ids):
        self.moments.append(("after_reset", tuple(ids)))
        self.count[ids] = 0

    def before_step(self, ids, actions):
        return np.zeros_like(actions)

    def observe(self, ids, images, entries):
        if "ee_pos" in entries:
            entries["ee_pos"][:] = 0.0

    def after_step(self, ids):
        self.count[ids] += 1

    def info(self):
        return {"count": self.count.copy()}

    def state(self, i):
        return self.count[i : i + 1]

    def restore(self, i, values):
        self.count[i] = 0 if values is None else values[0]


class Still(Hooks):
    def info(self):
        return {"still": True}


def test_what_does_nothing_is_not_called():
    found = overridden([Hooks(), Still(), Tally()])
    assert {name: len(methods) for name, methods in found.items()} == {n: 1 + (n == "info") for n in HOOKS}


def test_a_part_acts_at_its_moments_and_its_state_belongs_to_the_episode(closing):
    plain, env, part = closing(BatchEnv(TASK, 2, cameras=())), closing(BatchEnv(TASK, 2, cameras=())), Tally()
    env.plug(part)
    for one in (plain, env):
        one.reset(options={"init_state": [4, 7]})
    assert part.moments == [("attach", 2), ("before_reset", (0, 1), (4, 7)), ("after_reset", (0, 1))]
    moves = np.ones((2, 7))
    for _ in range(3):
        obs, *_, info = env.step(moves)
        plain.step(0 * moves)
    assert info["count"].tolist() == [3, 3] and not obs["ee_pos"].any()
    np.testing.assert_array_equal(env.simulations.fields["qpos"], plain.simulations.fields["qpos"])
    kept = env.get_state(1)
    assert len(kept) == len(plain.get_state(1)) + 1
    env.reset(options={"init_state": [0, 0], "reset_mask": np.array([True, False])})
    assert part.count.tolist() == [0, 3]
    env.step(moves)
    env.set_state(1, kept)
    assert part.count.tolist() == [1, 3]
    env.set_state(1, kept[: 1 + env.scene.model.nq + env.scene.model.nv])
    assert part.count.tolist() == [1, 0]
