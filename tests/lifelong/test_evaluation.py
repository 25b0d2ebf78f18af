"""The rollout loop and its environments, with an environment whose outcomes are known."""

import hashlib

import numpy as np
import pytest
import torch
from PIL import Image
from torch import nn

from libero_env.errors import SimulationError
from lifelong.errors import ConfigError
from lifelong.evaluation.environments import EnvPool
from lifelong.evaluation.rollout import rollout, save_animation
from lifelong.types import PolicySpec

SPEC = PolicySpec(views=("agentview_rgb",), image_size=(4, 4), proprio={"x": 1}, language_dim=2)


class Countdown:
    """Simulation i succeeds after `init_state` steps of the policy's unit action, or never for state 0."""

    def __init__(self, num_envs: int):
        self.num_envs, self.closed = num_envs, False

    def _obs(self):
        frames = np.zeros((self.num_envs, 4, 4, 3), np.uint8)
        return {"agentview_rgb": frames, "x": self.done[:, None].astype(float)}

    def reset(self, *, seed=None, options=None):
        self.goal = np.asarray(options["init_state"])
        self.done = np.zeros(self.num_envs)
        self.running = np.ones(self.num_envs, bool)
        return self._obs(), {}

    def step(self, actions):
        assert actions.shape == (self.num_envs, 7) and actions.dtype == np.float64
        self.done += self.running * actions[:, 0]
        reached = self.running & (self.goal > 0) & (self.done >= self.goal)
        self.running &= ~reached
        truncated = np.zeros(self.num_envs, bool)
        return self._obs(), reached * 1.0, reached, truncated, {"success": ~self.running}

    def close(self):
        self.closed = True


class Forward(nn.Module):
    """Returns always the same action and records its calls."""

    spec = SPEC

    def __init__(self):
        super().__init__()
        self.calls, self.draws = 0, []

    def reset(self, num_envs):
        self.calls = 0

    def act(self, observation, generators=None):
        assert not self.training
        assert observation.images.shape == (len(generators), 1, 1, 4, 4, 3)
        assert observation.proprio["x"].shape == (len(generators), 1, 1)
        self.calls += 1
        self.draws.append([torch.rand(1, generator=g).item() for g in generators])
        return torch.ones(len(generators), 7)


def run(states, **kwargs):
    policy = Forward().train()
    arguments = {"language": torch.zeros(2), "horizon": 6, "settle_steps": 2, "precision": "fp32"} | kwargs
    return policy, rollout(policy, Countdown(len(states)), states, **arguments)


def test_success_and_length_of_each_episode():
    policy, rollouts = run([3, 0, 6, 7])
    assert [e.success for e in rollouts.episodes] == [True, False, True, False]
    assert [e.length for e in rollouts.episodes] == [3, 6, 6, 6]
    assert [e.init_state for e in rollouts.episodes] == [3, 0, 6, 7]
    assert rollouts.rate == 0.5
    assert policy.training, "the policy is left in the mode it was in"


def test_a_rollout_ends_when_all_episodes_have_succeeded():
    policy, rollouts = run([1, 2])
    assert policy.calls == 2


def test_an_episodes_random_draws_do_not_depend_on_other_episodes():
    alone, _ = run([5])
    beside, _ = run([2, 5, 3])
    assert [d[0] for d in alone.draws] == [d[1] for d in beside.draws]


def test_the_digest_of_an_episode_is_that_of_its_actions_until_it_ends():
    _, rollouts = run([3, 5])
    expected = [hashlib.sha256(np.ones((n, 7), "<f8").tobytes()).hexdigest()[:16] for n in (3, 5)]
    assert [e.actions for e in rollouts.episodes] == expected


def test_frames_of_the_first_episode_are_recorded_until_it_ends(tmp_path):
    _, rollouts = run([3, 0], record_every=1)
    assert len(rollouts.frames) == 3 and rollouts.frames[0].shape == (4, 4, 3)
    save_animation(rollouts.frames, tmp_path / "videos" / "a.webp", seconds_per_frame=0.1)
    with Image.open(tmp_path / "videos" / "a.webp") as picture:
        assert picture.size == (4, 4)


def test_numbers_of_simulations_and_initial_states_must_match():
    with pytest.raises(ConfigError, match="3 initial states, but the environment has 2"):
        rollout(Forward(), Countdown(2), [1, 2, 3], language=torch.zeros(2), horizon=3)


def test_the_pool_closes_the_least_recently_used_and_all_at_the_end():
    with EnvPool(Countdown, capacity=2) as pool:
        first, second = pool.get(1), pool.get(2)
        assert pool.get(1) is first
        third = pool.get(3)
        assert (first.closed, second.closed, third.closed) == (False, True, False)
    assert first.closed and third.closed


class Diverging(Countdown):
    """Simulations with initial state 7 fail in the second step, and report it until the end, as a `BatchEnv` does."""

    def step(self, actions):
        obs, rewards, terminated, truncated, info = super().step(actions)
        failed = (self.goal == 7) & (self.done >= 2)
        truncated, self.running = self.running & failed, self.running & ~failed
        errors = {int(i): "it has diverged" for i in np.flatnonzero(failed)}
        return obs, rewards, terminated, truncated, {"success": info["success"] & ~failed, "errors": errors}


def test_a_simulation_that_fails_ends_its_own_episode_which_does_not_count():
    arguments = {"language": torch.zeros(2), "horizon": 5, "settle_steps": 0}
    done = rollout(Forward(), Diverging(3), [3, 7, 0], record_every=1, **arguments)
    without = rollout(Forward(), Countdown(2), [3, 0], **arguments)
    assert [e.simulation_error for e in done.episodes] == ["", "it has diverged", ""]
    assert done.counted == without.episodes and done.rate == 0.5 and done.episodes[1].length == 2
    assert done.columns() == without.columns() | {"simulation_errors": ((7, "it has diverged"),)}
    none = rollout(Forward(), Diverging(1), [7], **arguments)
    with pytest.raises(SimulationError, match=r"simulation 0: it has diverged \(initial state 7\)") as caught:
        none.rate  # noqa: B018 - a property
    assert list(caught.value.failed) == [0]
