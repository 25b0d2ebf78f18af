"""The truth of a goal and of its atoms in many simulations."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from libero_env.sim.predicates import evaluate
from libero_env.sim.simulation import Simulations
from libero_env.sim.state import StateView
from libero_env.tasks.problem import And, Atom, Expression


class Goals(Protocol):
    """The truth of one goal in simulations of its scene.

    Attributes:
        atoms: Atoms whose truth `check` returns.
    """

    atoms: tuple[Atom, ...]

    def check(self, ids: Sequence[int] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whether the goal is reached in simulations, (k,) bool, and the truth of its atoms, (k, natoms)."""


class ViewedGoals:
    """The truth of a goal as the predicates say, one simulation after the other.

    Args:
        goal: The goal.
        atoms: Atoms whose truth is told.
        views: State view of each simulation.
        semantics: Semantics of the predicates, `original` or `strict`.
    """

    def __init__(self, goal: Expression, atoms: Sequence[Atom], views: Sequence[StateView], semantics: str):
        self._goal, self.atoms, self._views, self._semantics = goal, tuple(atoms), views, semantics
        parts = goal.parts if isinstance(goal, And) else (goal,)
        self._is_conjunction = all(part in self.atoms for part in parts)  # no atom is evaluated twice then

    def check(self, ids: Sequence[int] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whether the goal is reached in simulations, (k,) bool, and the truth of its atoms, (k, natoms)."""
        reached, truths = np.zeros(len(ids), bool), np.zeros((len(ids), len(self.atoms)), bool)
        for k, i in enumerate(ids):
            view = self._views[i]
            truths[k] = [evaluate(atom, view, self._semantics) for atom in self.atoms]
            if self._is_conjunction:
                reached[k] = truths[k].all()
            else:
                reached[k] = evaluate(self._goal, view, self._semantics)
        return reached, truths


def make_goals(
    goal: Expression,
    atoms: Sequence[Atom],
    views: Sequence[StateView],
    semantics: str,
    simulations: Simulations,
) -> Goals:
    """Return the truth of a goal in simulations, by the means of their back end.

    Args:
        goal: The goal.
        atoms: Atoms whose truth `check` returns, such as `Scene.goal_atoms`.
        views: State view of each simulation.
        semantics: Semantics of the predicates, `original` or `strict`.
        simulations: The simulations.
    """
    if simulations.back_end.is_warp:
        from libero_env.sim.mjwarp.goals import WarpGoals  # with the extra `warp` only

        return WarpGoals(goal, atoms, views, semantics, simulations)  # type: ignore[arg-type]
    return ViewedGoals(goal, atoms, views, semantics)
