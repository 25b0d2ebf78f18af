"""The goals of a batch: success, progress, and rewards of its simulations, and what conditions over time remember."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from libero_env.envs.config import EnvConfig
from libero_env.envs.hooks import Hooks
from libero_env.errors import InvalidInputError
from libero_env.sim.engine import Goals
from libero_env.sim.rewards import Reward
from libero_env.sim.state import StateView
from libero_env.tasks.expression import And, Atom, Expression, Or


class GoalHooks(Hooks):
    """Which simulations have reached their goal.

    Args:
        goals: Goal of the task, then those that it may be changed into.
        views: State view of each simulation.
        config: Semantics of the predicates, and the reward.

    Attributes:
        goals: The goals; all have the same atoms.
        which: Index of the goal of each simulation, (num_envs,).
        success: Whether it is reached, (num_envs,) bool; that of the last moment of episodes that are over.
        rewards: Rewards of the last step, (num_envs,).
    """

    def __init__(self, goals: Sequence[Expression], views: Sequence[StateView], config: EnvConfig):
        self.reward, self._views, num = Reward(config.reward, config.reward_scale), views, len(views)
        if self.reward.kind == "staged":
            _require_stages(goals)
        own = views[0].scene.goal_atoms
        every = tuple(dict.fromkeys([*own, *(atom for goal in goals[1:] for atom in goal.atoms())]))
        self.goals = [Goals(goal, every, views, config.semantics) for goal in goals]
        self.which, self.success, self.rewards = np.zeros(num, np.int64), np.zeros(num, bool), np.zeros(num)
        self._progress = np.zeros((num, len(every)), bool)

    def attach(self, batch: Any) -> None:
        """Get to know the environment."""
        self._errors = batch.errors

    def of(self, i: int) -> Goals:
        """Return the goal of simulation i."""
        return self.goals[self.which[i]]

    def wanted(self, i: int) -> tuple[Atom, ...]:
        """Return the atoms that the goal of simulation i wants."""
        return self.of(i).history.goal.wanted()

    def check(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whether each simulation has reached its goal, (k,) bool, and which atoms hold, (k, natoms)."""
        reached, held = self.goals[0].check(ids)
        for k, goal in enumerate(self.goals[1:], 1):
            if (changed := self.which[ids] == k).any():
                reached[changed] = goal.check(ids[changed])[0]
        return reached, held

    def forget(self, ids: np.ndarray) -> None:
        """Begin the conditions over time of the goals anew."""
        for goal in self.goals:
            goal.history.begin(ids)

    def after_reset(self, ids: np.ndarray) -> None:
        """Look at the first moment of episodes."""
        self.forget(ids)
        self.success[ids], self._progress[ids] = self.check(ids)

    def after_step(self, ids: np.ndarray) -> None:
        """Look at a moment of episodes, and reward it."""
        self.rewards[:] = 0.0
        self.success[ids], self._progress[ids] = self.check(ids)
        self.success[list(self._errors)] = False
        for i in ids:
            if i not in self._errors:
                args = self._views[i], bool(self.success[i]), self.goals[0].atoms, list(self._progress[i])
                self.rewards[i] = self.reward(*args)

    def info(self) -> dict[str, Any]:
        """Return `success` (num_envs,) bool and `progress` (num_envs, natoms) bool."""
        return {"success": self.success.copy(), "progress": self._progress.copy()}

    def state(self, i: int) -> np.ndarray:
        """Return what the conditions over time remember."""
        return np.concatenate([goal.history.memory[i].ravel() for goal in self.goals])

    def restore(self, i: int, values: np.ndarray | None) -> None:
        """Go on with an episode, which has not succeeded; the present state is the first moment of one that begins."""
        self.success[i] = False
        if values is None:
            self.forget(np.array([i]))
            if self.state(i).size:
                self.check(np.array([i]))
            return
        for goal in self.goals:
            memory = goal.history.memory[i]
            memory[:], values = values[: memory.size].reshape(memory.shape), values[memory.size :]


def _require_stages(goals: Sequence[Expression]) -> None:
    """Raise unless the atoms of a goal that hold are stages on the way to it."""
    changes, goal = len(goals) > 1, goals[-1]
    staged = goal.fold(lambda node, parts: isinstance(node, Atom | And | Or) and all(parts))
    if changes or not staged:
        what = f"an event makes {goal} the goal" if changes else f"{goal} is more than atoms, And and Or"
        raise InvalidInputError(
            f"reward=staged counts the atoms of one goal that hold, but {what}; leave reward=sparse"
        )
