"""Whether a goal holds in all simulations of MuJoCo Warp at once, in NumPy on the fields that the host has of them.

Atoms with predicates that are not among those of the original (of strict semantics, and users' own) are evaluated one
simulation after the other.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from libero_env.errors import UnknownNameError
from libero_env.objects.model import ROOT_BODY
from libero_env.sim import predicates
from libero_env.sim.mjwarp.simulations import WarpSimulations
from libero_env.sim.predicates import (
    BOX_BELOW,
    ON_ABOVE,
    ON_BELOW,
    ON_XY_DISTANCE,
    SEMANTICS,
    UP_HEIGHT,
    evaluate,
    ground,
    reaches_state,
    region_boxes,
    region_of,
)
from libero_env.sim.scene import zone_boxes
from libero_env.sim.state import StateView
from libero_env.tasks.problem import Atom, Expression, Not, Or

Held = np.ndarray  # whether something holds in each simulation, (num,) bool


class WarpGoals:
    """Whether a goal holds in simulations of MuJoCo Warp.

    Args:
        goal: The goal.
        atoms: Atoms that `check` evaluates.
        views: State view of each simulation.
        semantics: Semantics of the predicates, `original` or `strict`.
        simulations: The simulations.

    Attributes:
        one_by_one: Atoms that are evaluated one simulation after the other.
    """

    def __init__(
        self,
        goal: Expression,
        atoms: Sequence[Atom],
        views: Sequence[StateView],
        semantics: str,
        simulations: WarpSimulations,
    ):
        self._scene, self._simulations, self._views = views[0].scene, simulations, views
        self._goal, self.atoms, self._semantics = ground(goal, self._scene), tuple(atoms), semantics
        of_all: dict[Any, Callable[..., Any]] = {
            predicates.on: self._on,
            predicates.in_: self._in,
            predicates.up: lambda name: self._pos(name)[:, 2] >= UP_HEIGHT,
            predicates.touching: self._touch,
            predicates.stack: self._stack,
            predicates.open_: lambda name: self._joints(name, "open").any(axis=0),
            predicates.close: lambda name: self._joints(name, "close").all(axis=0),
            predicates.turn_on: lambda name: self._joints(name, "turnon").any(axis=0),
            predicates.turn_off: lambda name: self._joints(name, "turnoff").all(axis=0),
        }
        table = SEMANTICS[semantics]
        needed = dict.fromkeys([*atoms, *self._goal.atoms()])
        self._predicates = {atom: of_all.get(table.get(atom.predicate)) for atom in needed}
        self.one_by_one = tuple(atom for atom, predicate in self._predicates.items() if predicate is None)

    def check(self, ids: Sequence[int] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whether the goal is reached in simulations, (k,) bool, and which atoms hold, (k, natoms)."""
        ids, held = np.asarray(ids, np.int64), dict[Atom, np.ndarray]()
        for atom, predicate in self._predicates.items():
            if predicate is None:
                held[atom] = np.array([evaluate(atom, self._views[i], self._semantics) for i in ids], bool)
            else:
                held[atom] = predicate(*atom.args)[ids]
        of_atoms = [held[atom] for atom in self.atoms]
        reached = _combine(self._goal, held, len(ids))
        return reached, np.stack(of_atoms, axis=1) if of_atoms else np.zeros((len(ids), 0), bool)

    def _pos(self, name: str) -> np.ndarray:
        """Return the origin of the root body of an object or fixture, (num, 3)."""
        if name not in self._scene.entities:
            raise UnknownNameError("object or fixture", name, self._scene.entities)
        return self._simulations.fields["xpos"][:, self._scene.model.body(f"{name}_{ROOT_BODY}").id]

    def _boxes(self, address: str) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Return the boxes of a region: centre (num, 3), orientation (num, 3, 3) and half size (3,)."""
        region, num, fields = (
            region_of(self._views[0], address),
            self._simulations.num,
            self._simulations.fields,
        )
        if region.ranges:
            flat = zone_boxes(region, self._scene.workspace)
            return [(np.tile(c, (num, 1)), np.tile(np.eye(3), (num, 1, 1)), half) for c, half in flat]
        (box,) = region_boxes(self._views[0], address)
        site = self._scene.model.site(address).id
        return [
            (fields["site_xpos"][:, site], fields["site_xmat"][:, site].reshape(num, 3, 3), box.half_size)
        ]

    def _touch(self, first: str, second: str) -> Held:
        """Return whether geoms of two entities touch, see `StateView.in_contact`."""
        for name in (first, second):
            if name not in self._scene.bodies:
                raise UnknownNameError("object or fixture", name, self._scene.bodies)
        geoms, worlds = self._simulations.contacts
        bodies, touching = self._scene.model.geom_bodyid[geoms], np.zeros(self._simulations.num, bool)
        one, other = (np.isin(bodies, self._scene.bodies[name]) for name in (first, second))
        touching[worlds[(one & other[:, ::-1]).any(axis=1)]] = True
        return touching

    def _on(self, entity: str, target: str) -> Held:
        point = self._pos(entity)
        if target in self._scene.entities:
            offset = point - self._pos(target)
            near = np.sqrt(offset[:, 0] ** 2 + offset[:, 1] ** 2) < ON_XY_DISTANCE
            return (offset[:, 2] >= 0.0) & near & self._touch(entity, target)
        over = np.zeros(self._simulations.num, bool)
        for centre, mat, size in self._boxes(target):
            x, y, z = ((mat @ (point - centre)[..., None])[..., 0]).T
            level = (size[2] - ON_BELOW < z) & (z < size[2] + ON_ABOVE)
            over |= level & (np.abs(x) < size[0]) & (np.abs(y) < size[1])
        region = region_of(self._views[0], target)
        return over if region.ranges else over & self._touch(entity, region.target)

    def _in(self, entity: str, region: str) -> Held:
        inside, point = np.zeros(self._simulations.num, bool), self._pos(entity)
        for centre, mat, size in self._boxes(region):
            half = np.abs(mat @ size)
            low = centre - half - (0.0, 0.0, BOX_BELOW)
            inside |= ((point > low) & (point < centre + half)).all(axis=1)
        return inside

    def _stack(self, entity: str, target: str) -> Held:
        owner = self._scene.owner(target)
        if owner is None:
            return np.zeros(self._simulations.num, bool)
        stacked = self._touch(entity, owner) & self._on(entity, target)
        return stacked if target in self._scene.entities else stacked & self._in(entity, target)

    def _joints(self, address: str, state: str) -> np.ndarray:
        """Return whether each joint of an entity or of a region's part is in a state, (njoints, num) bool."""
        scene, qpos = self._scene, self._simulations.fields["qpos"]
        owner = scene.owner(address)
        if owner is None or address not in scene.joints:
            raise UnknownNameError("object, fixture or region of one", address, scene.joints)
        positions = [qpos[:, scene.model.jnt_qposadr[joint]] for joint in scene.joints[address]]
        held = [reaches_state(scene.entities[owner], position, state) for position in positions]
        return np.array(held, bool).reshape(len(positions), self._simulations.num)


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
