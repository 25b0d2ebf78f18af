"""The scripted expert as a policy to be evaluated: what can be done at all."""

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from libero_env.demos.config import GENERATOR
from libero_env.envs.batch import BatchEnv
from libero_env.expert import Expert, Shapes
from libero_env.tasks import Task
from libero_eval.candidates import PolicyUnderTest
from libero_eval.protocols.environment import make_env
from libero_eval.protocols.packaged import SELECTION
from libero_eval.protocols.protocol import Card
from lifelong.evaluation.actors import ACTION_DIM, Actor
from lifelong.evaluation.environments import VectorEnv
from lifelong.evaluation.inputs import Obs
from lifelong.seeding import EVALUATION


class ExpertActor:
    """The scripted expert, one for each simulation; what it does depends on its seed and its simulation alone.

    Args:
        seeds: Seed of the motion style of each expert.
        views: Names of the images that recorded rollouts show.
    """

    action_dim, sees_next = ACTION_DIM, False

    def __init__(self, seeds: Sequence[Sequence[int]], views: tuple[str, ...] = ()):
        self.seeds, self.views = seeds, views
        self._over = np.zeros(len(seeds), bool)

    def watch(self, env: BatchEnv) -> None:
        """Receive the simulations; see `WatchesWorld`."""
        self._env, shapes = env, Shapes(env.scene)
        self._experts = [Expert(env.task, np.random.default_rng(seed), shapes=shapes) for seed in self.seeds]

    def reset(self, num_envs: int) -> None:
        """Take all episodes as running; see `Actor`."""
        self._over = np.zeros(num_envs, bool)

    def note(self, over: np.ndarray, success: np.ndarray) -> None:
        """Take note of which episodes are over; see `TakesNote`."""
        self._over = over

    def act(self, obs: Obs) -> np.ndarray:
        """Return the experts' actions; those that are done or have given up hold still. See `Actor`."""
        actions = np.zeros((len(self._experts), ACTION_DIM))
        for i, expert in enumerate(self._experts):
            if not self._over[i] and not expert.failure_reason:
                actions[i] = expert.act(self._env.views[i])
        return actions


class ExpertPolicy(PolicyUnderTest):
    """The scripted expert, which sees the whole state: how much of a task can be done at all."""

    def __init__(self, args: argparse.Namespace):

        self.args = args
        self.identity = {"policy": "expert", "generator": GENERATOR}
        self.out, self.selection = Path("eval/expert"), SELECTION
        self.cameras = ("agentview",) if args.videos else ()

    def protocol(self, base: Card) -> Card:
        """Return the protocol; see `PolicyUnderTest`."""
        return base

    def env(self, task: Task, count: int, protocol: Card) -> VectorEnv:

        seen = ("rgb",) if self.cameras else ()  # in videos
        return make_env(task, count, protocol, cameras=self.cameras, observations=seen, **self.simulated)

    @contextmanager
    def actor(self, task: Task, states: Sequence[int], protocol: Card) -> Iterator[Actor]:

        seeds = [(self.args.seed, EVALUATION, task.index, state) for state in states]
        yield ExpertActor(seeds, tuple(f"{camera}_rgb" for camera in self.cameras))
