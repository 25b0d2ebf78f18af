"""Traces of the episodes of a batch, for events and for causes of failure."""

import numpy as np

from libero_env.envs.goals import GoalHooks
from libero_env.envs.hooks import Hooks
from libero_env.sim.state import StateView
from libero_env.sim.watch import EpisodeWatch


class WatchHooks(Hooks):
    """Let an `EpisodeWatch` look at each step.

    Args:
        views: State view of each simulation.
        goals: The goals.

    Attributes:
        watch: Traces of the episodes.
        is_kept: Whether what triggers of events depend on belongs to the state of episodes.
    """

    is_counted = False

    def __init__(self, views: list[StateView], goals: GoalHooks):
        self.watch, self._goals, self.is_kept = EpisodeWatch(views, goals.goals[0].atoms), goals, False
        for i in range(len(views)):
            self.watch.goals[i] = goals.wanted(i)

    def after_reset(self, ids: np.ndarray) -> None:
        """Begin traces."""
        for i in map(int, ids):
            self.restore(i, None)

    def after_step(self, ids: np.ndarray) -> None:
        """Take note of the present states."""
        for i in map(int, ids):
            self.watch.look(i)

    def state(self, i: int) -> np.ndarray:
        """Return what triggers of events depend on."""
        return self.watch.memory(i) if self.is_kept else np.zeros(0)

    def restore(self, i: int, values: np.ndarray | None) -> None:
        """Begin a trace, or go on with one as far as it is kept."""
        self.watch.goals[i] = self._goals.wanted(i)
        self.watch.begin(i)
        if values is not None and self.is_kept:
            self.watch.recall(i, values)
