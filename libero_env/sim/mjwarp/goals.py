"""The truth of a goal in all simulations, by kernels.

An atom becomes conditions that a kernel evaluates in every simulation, such as that a body is in a box or that two
entities touch, and a formula over their truths. Atoms with predicates that have no such formula (those of strict
semantics, and users' own) are evaluated on the host, one simulation after the other.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from libero_env.errors import LiberoError, UnknownNameError
from libero_env.objects.model import ROOT_BODY
from libero_env.sim import predicates
from libero_env.sim.mjwarp.simulations import WarpSimulations
from libero_env.sim.mjwarp.truths import (
    HIGH,
    INSIDE,
    JOINT_ABOVE,
    JOINT_BELOW,
    OVER,
    STACKED,
    TOUCH,
    Condition,
    Conditions,
)
from libero_env.sim.predicates import SEMANTICS, evaluate, ground, state_bound
from libero_env.sim.scene import Scene, zone_boxes
from libero_env.sim.state import StateView
from libero_env.tasks.problem import Atom, Expression, Not, Or, Region

Truth = Callable[[np.ndarray], np.ndarray]  # truths of the conditions, (num, n) -> (num,)


class WarpGoals:
    """The truth of a goal in simulations of MuJoCo Warp.

    Args:
        goal: The goal.
        atoms: Atoms whose truth is told.
        views: State view of each simulation.
        semantics: Semantics of the predicates, `original` or `strict`.
        simulations: The simulations.

    Attributes:
        on_host: Atoms that are evaluated on the host.
    """

    def __init__(
        self,
        goal: Expression,
        atoms: Sequence[Atom],
        views: Sequence[StateView],
        semantics: str,
        simulations: WarpSimulations,
    ):
        scene = views[0].scene
        self._goal, self.atoms, self._views, self._semantics = (
            ground(goal, scene),
            tuple(atoms),
            views,
            semantics,
        )
        self._simulations, formulas = simulations, _Formulas(scene, semantics)
        needed = dict.fromkeys([*atoms, *self._goal.atoms()])
        self._formulas = {atom: formulas.make(atom) for atom in needed}
        self.on_host = tuple(atom for atom, formula in self._formulas.items() if formula is None)
        self._conditions = Conditions(simulations, scene, formulas.conditions)

    def check(self, ids: Sequence[int] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whether the goal is reached in simulations, (k,) bool, and the truth of its atoms, (k, natoms)."""
        ids = np.asarray(ids, np.int64)
        truths, found = self._conditions.truths()[ids], dict[Atom, np.ndarray]()
        for atom, formula in self._formulas.items():
            if formula is None:
                on_host = [evaluate(atom, self._views[i], self._semantics) for i in ids]
                found[atom] = np.array(on_host, bool)
            else:
                found[atom] = formula(truths)
        of_atoms = [found[atom] for atom in self.atoms]
        reached = _combine(self._goal, found, len(ids))
        return reached, np.stack(of_atoms, axis=1) if of_atoms else np.zeros((len(ids), 0), bool)


class _Formulas:
    """Formulas of atoms, and the conditions that they are over."""

    def __init__(self, scene: Scene, semantics: str):
        self._scene, self._table = scene, SEMANTICS[semantics]
        self.conditions: list[Condition] = []
        self._makers: dict[Any, Callable[..., Truth]] = {
            predicates.on: self._on,
            predicates.in_: self._in,
            predicates.up: self._up,
            predicates.touching: self._touch,
            predicates.stack: self._stack,
            predicates.open_: lambda name: self._joints(name, "open", "close", any_of),
            predicates.close: lambda name: self._joints(name, "close", "open", all_of),
            predicates.turn_on: lambda name: self._joints(name, "turnon", "turnoff", any_of),
            predicates.turn_off: lambda name: self._joints(name, "turnoff", "turnon", all_of),
        }

    def make(self, atom: Atom) -> Truth | None:
        """Return the formula of an atom; None where it has none, or where the host says what is wrong with it."""
        maker = self._makers.get(self._table.get(atom.predicate))
        try:
            return None if maker is None else maker(*atom.args)
        except LiberoError:
            return None

    def _add(self, condition: Condition) -> Truth:
        if condition not in self.conditions:
            self.conditions.append(condition)
        k = self.conditions.index(condition)
        return lambda truths: truths[:, k]

    def _body(self, name: str) -> int:
        if name not in self._scene.entities:
            raise UnknownNameError("object or fixture", name, self._scene.entities)
        return self._scene.model.body(f"{name}_{ROOT_BODY}").id

    def _region(self, address: str) -> Region:
        region = self._scene.problem.region(address)
        if region is None:
            raise UnknownNameError("region", address, [r.address for r in self._scene.problem.regions])
        return region

    def _boxes(self, kind: int, body: int, address: str) -> Truth:
        """Return whether a body is in, or on, any box of a region."""
        region, scene = self._region(address), self._scene
        if region.ranges:
            boxes = [
                Condition(kind, body, bound=(*centre, *half))
                for centre, half in zone_boxes(region, scene.workspace)
            ]
        else:
            site = mujoco.mj_name2id(scene.model, mujoco.mjtObj.mjOBJ_SITE, address)
            if site < 0:
                raise UnknownNameError("region", address, scene.joints)
            boxes = [Condition(kind, body, site, (0.0, 0.0, 0.0, *scene.model.site_size[site]))]
        return any_of([self._add(box) for box in boxes])

    def _touch(self, first: str, second: str) -> Truth:
        for name in (first, second):
            if name not in self._scene.bodies:
                raise UnknownNameError("object or fixture", name, self._scene.bodies)
        return self._add(Condition(TOUCH, pair=(first, second)))

    def _on(self, entity: str, target: str) -> Truth:
        body = self._body(entity)
        if target in self._scene.entities:
            stacked = self._add(Condition(STACKED, body, self._body(target)))
            return all_of([stacked, self._touch(entity, target)])
        over, region = self._boxes(OVER, body, target), self._region(target)
        return over if region.ranges else all_of([over, self._touch(entity, region.target)])

    def _in(self, entity: str, region: str) -> Truth:
        return self._boxes(INSIDE, self._body(entity), region)

    def _up(self, entity: str) -> Truth:
        return self._add(Condition(HIGH, self._body(entity)))

    def _stack(self, entity: str, target: str) -> Truth:
        owner = self._scene.owner(target)
        if owner is None:
            return lambda truths: np.zeros(len(truths), bool)
        parts = [self._touch(entity, owner), self._on(entity, target)]
        return all_of(parts if target in self._scene.entities else [*parts, self._in(entity, target)])

    def _joints(
        self, address: str, state: str, opposite: str, joined: Callable[[Sequence[Truth]], Truth]
    ) -> Truth:
        scene, owner = self._scene, self._scene.owner(address)
        if owner is None or address not in scene.joints:
            raise UnknownNameError("object, fixture or region of one", address, scene.joints)
        found = []
        for joint in scene.joints[address]:
            bound, upwards = state_bound(scene.entities[owner], state, opposite)
            if state == "turnon":  # its bound belongs to the range
                bound = float(np.nextafter(bound, -np.inf if upwards else np.inf))
            kind = JOINT_ABOVE if upwards else JOINT_BELOW
            address_of = int(scene.model.jnt_qposadr[joint])
            found.append(
                self._add(Condition(kind, address_of, bound=(float(bound), 0.0, 0.0, 0.0, 0.0, 0.0)))
            )
        return joined(found)


def any_of(parts: Sequence[Truth]) -> Truth:
    """Return the disjunction of formulas."""
    return lambda truths: np.any([part(truths) for part in parts] or [np.zeros(len(truths), bool)], axis=0)


def all_of(parts: Sequence[Truth]) -> Truth:
    """Return the conjunction of formulas."""
    return lambda truths: np.all([part(truths) for part in parts] or [np.ones(len(truths), bool)], axis=0)


def _combine(expression: Expression, of_atoms: Mapping[Atom, np.ndarray], count: int) -> np.ndarray:
    """Return whether a goal without quantifiers holds, from the same of its atoms, (count,) bool."""

    def holds(node: Expression, parts: Iterator[np.ndarray]) -> np.ndarray:
        match node:
            case Atom():
                return of_atoms[node]
            case Or():
                return np.any([*parts] or [np.zeros(count, bool)], axis=0)
            case Not():
                return ~next(parts)
        return np.all([*parts] or [np.ones(count, bool)], axis=0)

    return expression.fold(holds)
