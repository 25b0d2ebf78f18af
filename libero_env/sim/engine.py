"""What works by the means of a backend: simulations of a model, goals in them, and their observer."""

from collections.abc import Sequence
from typing import Any, Protocol

import mujoco
import numpy as np

from libero_env.sim.backend import Backend
from libero_env.sim.observations import Observer
from libero_env.sim.predicates import evaluate
from libero_env.sim.scene import Scene
from libero_env.sim.simulation import Batch, BatchSimulations, Indices, LoopSimulations, Simulations
from libero_env.sim.state import StateView
from libero_env.tasks.problem import And, Atom, Expression


class Goals(Protocol):
    """Whether one goal holds in simulations of its scene.

    Attributes:
        atoms: Atoms that `check` evaluates.
    """

    atoms: tuple[Atom, ...]

    def check(self, ids: Sequence[int] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whether the goal is reached in simulations, (k,) bool, and which atoms hold, (k, natoms)."""


class ViewedGoals:
    """Whether a goal holds as the predicates say, one simulation after the other.

    Args:
        goal: The goal.
        atoms: Atoms that `check` evaluates.
        views: State view of each simulation.
        semantics: Semantics of the predicates, `original` or `strict`.
    """

    def __init__(self, goal: Expression, atoms: Sequence[Atom], views: Sequence[StateView], semantics: str):
        self._goal, self.atoms, self._views, self._semantics = goal, tuple(atoms), views, semantics
        parts = goal.parts if isinstance(goal, And) else (goal,)
        self._is_conjunction = all(part in self.atoms for part in parts)  # no atom is evaluated twice then

    def check(self, ids: Sequence[int] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whether the goal is reached in simulations, (k,) bool, and which atoms hold, (k, natoms)."""
        reached, held = np.zeros(len(ids), bool), np.zeros((len(ids), len(self.atoms)), bool)
        for k, i in enumerate(ids):
            view = self._views[i]
            held[k] = [evaluate(atom, view, self._semantics) for atom in self.atoms]
            if self._is_conjunction:
                reached[k] = held[k].all()
            else:
                reached[k] = evaluate(self._goal, view, self._semantics)
        return reached, held


def make_simulations(
    model: mujoco.MjModel,
    num: int,
    threads: int = 0,
    fixture_bodies: Indices = (),
    backend: Backend | None = None,
) -> Simulations:
    """Return `num` simulations of a model; MuJoCo's are batched where it offers that and there are several.

    Args:
        model: Model to simulate; it is copied.
        num: Number of simulations.
        threads: Number of threads of the batch; 0 is one for each core.
        fixture_bodies: Indices of the fixed bodies whose pose differs between simulations.
        backend: Backend of the physics; by default `mujoco`.

    Raises:
        LiberoError: The backend is not installed, has no such device, or cannot simulate the model.
    """
    if backend is not None and backend.is_warp:
        backend.require_installed()
        from libero_env.sim.mjwarp.simulations import WarpSimulations  # with the extra `warp` only

        return WarpSimulations(model, num, fixture_bodies, backend)
    if num > 1 and Batch is not None:
        return BatchSimulations(model, num, threads, fixture_bodies)
    return LoopSimulations(model, num, fixture_bodies)


def make_goals(
    goal: Expression,
    atoms: Sequence[Atom],
    views: Sequence[StateView],
    semantics: str,
    simulations: Simulations,
) -> Goals:
    """Return a goal in simulations, evaluated by the means of their backend.

    Args:
        goal: The goal.
        atoms: Atoms that `check` evaluates, such as `Scene.goal_atoms`.
        views: State view of each simulation.
        semantics: Semantics of the predicates, `original` or `strict`.
        simulations: The simulations.
    """
    if simulations.backend.is_warp:
        from libero_env.sim.mjwarp.goals import WarpGoals  # with the extra `warp` only

        return WarpGoals(goal, atoms, views, semantics, simulations)  # type: ignore[arg-type]
    return ViewedGoals(goal, atoms, views, semantics)


def make_observer(scene: Scene, simulations: Simulations, **options: Any) -> Observer:
    """Return an observer that renders by the means of the simulations' backend.

    Args:
        scene: Scene that is simulated.
        simulations: Simulations to observe.
        **options: Further arguments of `Observer`.

    Raises:
        UnknownNameError: An observation or a camera does not exist.
        LiberoError: The backend does not offer an observation.
    """
    kind = Observer
    if simulations.backend.is_warp:
        from libero_env.sim.mjwarp.pictures import WarpObserver as kind  # with the extra `warp` only
    return kind(scene, simulations, **options)
