"""What works by the means of a backend: simulations of a model, goals in them, and their observer."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from libero_env.doors import doors, enter
from libero_env.mujoco_compat import mujoco
from libero_env.sim.back_ends import BatchSimulations, LoopSimulations
from libero_env.sim.backend import MUJOCO, Backend
from libero_env.sim.history import History
from libero_env.sim.observations import Observer
from libero_env.sim.predicates import OF_ALL, SEMANTICS, evaluate, find_predicate, ground
from libero_env.sim.scene import Scene
from libero_env.sim.simulation import Batch, Indices, Simulations
from libero_env.sim.state import StateView
from libero_env.tasks.expression import Atom, Expression


class Goals:
    """Whether one goal holds in simulations of its scene.

    They are looked at one after the other; predicates of `OF_ALL` in all simulations of MuJoCo Warp at once.

    Args:
        atoms: Atoms that `check` evaluates, such as `Scene.goal_atoms`.
        views: State view of each simulation.
        semantics: Semantics of the predicates, `original` or `strict`.

    Attributes:
        one_by_one: Atoms that are evaluated one simulation after the other.
        history: What the goal's conditions over time remember of each simulation's episode.
    """

    def __init__(self, goal: Expression, atoms: Sequence[Atom], views: Sequence[StateView], semantics: str):
        scene, self._simulations = views[0].scene, views[0].simulations
        self.history = History(ground(goal, scene), len(views))
        self.atoms, self._views = tuple(atoms), views
        self._semantics, self._all = semantics, StateView(scene, self._simulations, slice(None))
        self._needed = tuple(dict.fromkeys([*atoms, *self.history.goal.atoms()]))
        of_all = OF_ALL if self._simulations.backend.is_warp else ()
        self.one_by_one = tuple(
            atom for atom in self._needed if find_predicate(atom.predicate, semantics) not in of_all
        )

    def check(self, ids: Sequence[int] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whether the goal is reached in simulations, (k,) bool, and which atoms hold, (k, natoms).

        The present state is a moment of the episode for conditions over time; looking at it again changes nothing.
        """
        ids, held = np.asarray(ids, np.int64), self._held(np.asarray(ids, np.int64))
        of_atoms = np.reshape([held[atom] for atom in self.atoms], (len(self.atoms), len(ids)))
        return self.history.look(ids, held), of_atoms.T.astype(bool)

    def missing(self, i: int) -> list[Expression]:
        """Return what the episode in simulation i lacks now; see `History.missing`."""
        held = self._held(np.array([i]))
        return self.history.missing(i, {atom: bool(values[0]) for atom, values in held.items()})

    def _held(self, ids: np.ndarray) -> dict[Atom, np.ndarray]:
        """Return whether each atom holds in simulations, (k,)."""
        held = dict[Atom, np.ndarray]()
        for atom in self._needed:
            if atom in self.one_by_one:
                held[atom] = np.array([evaluate(atom, self._views[i], self._semantics) for i in ids], bool)
            else:
                values = SEMANTICS[self._semantics][atom.predicate](self._all, *atom.args)
                held[atom] = np.broadcast_to(values, self._simulations.num)[ids]
        return held


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
    if backend is not None and backend.name != MUJOCO:
        backend.require_installed()
        return enter("backends", backend.name)(model, num, fixture_bodies, backend)
    if num > 1 and Batch is not None:
        return BatchSimulations(model, num, threads, fixture_bodies)
    return LoopSimulations(model, num, fixture_bodies)


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
    name = simulations.backend.name
    kind = enter("observers", name) if name in doors("observers") else Observer
    return kind(scene, simulations, **options)
