"""The truth of a goal in all simulations, by kernels.

An atom becomes conditions that a kernel evaluates in every simulation, such as that a body is in a box or that two
entities touch, and a formula over their truths. Atoms with predicates that have no such formula (those of strict
semantics, and users' own) are evaluated on the host, one simulation after the other.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import warp as wp

from libero_env.errors import LiberoError, UnknownNameError
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
    state_bound,
)
from libero_env.sim.scene import Scene, zone_boxes
from libero_env.sim.state import StateView
from libero_env.tasks.problem import Atom, Expression, Not, Or, Region

wp.set_module_options({"enable_backward": False})

TOUCH, STACKED, OVER, INSIDE, HIGH, JOINT_ABOVE, JOINT_BELOW = (wp.constant(kind) for kind in range(7))
NEAR, HEIGHT = wp.constant(wp.float64(ON_XY_DISTANCE)), wp.constant(wp.float64(UP_HEIGHT))
BELOW_BOX = wp.constant(wp.float64(BOX_BELOW))
BELOW_TOP, ABOVE_TOP = wp.constant(wp.float64(ON_BELOW)), wp.constant(wp.float64(ON_ABOVE))
ZERO = wp.constant(wp.float64(0.0))

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


@dataclass(frozen=True)
class Condition:
    """What a kernel evaluates in each simulation.

    Attributes:
        kind: `TOUCH`, `STACKED`, ...
        first: Body, or the address of a joint's position.
        second: Body below, or the site whose box it is; -1 for a box that is fixed.
        bound: Centre of a fixed box (3,), or the bound of a joint, -, -, and half of the box's edges (3,).
        pair: Names of the entities that touch.
    """

    kind: int
    first: int = -1
    second: int = -1
    bound: tuple[float, ...] = (0.0,) * 6
    pair: tuple[str, str] | None = None


@wp.func
def _over(mat: wp.mat33d, offset: wp.vec3d, half: wp.vec3d):
    """Return whether a point is on top of a box, see `libero_env.sim.predicates.is_over`."""
    delta = mat * offset
    high = half[2] - BELOW_TOP < delta[2] and delta[2] < half[2] + ABOVE_TOP
    return high and wp.abs(delta[0]) < half[0] and wp.abs(delta[1]) < half[1]


@wp.func
def _inside(mat: wp.mat33d, centre: wp.vec3d, half: wp.vec3d, point: wp.vec3d):
    """Return whether a point is in a box, see `libero_env.sim.predicates.contains`."""
    turned = mat * half
    inside = True
    for r in range(3):
        low = centre[r] - wp.abs(turned[r])
        if r == 2:
            low = low - BELOW_BOX
        inside = inside and point[r] > low and point[r] < centre[r] + wp.abs(turned[r])
    return inside


@wp.kernel
def find_truths(
    kinds: wp.array[int],
    firsts: wp.array[int],
    seconds: wp.array[int],
    bounds: wp.array2d[wp.float64],
    qpos: wp.array2d[float],
    xpos: wp.array2d[wp.vec3],
    site_xpos: wp.array2d[wp.vec3],
    site_xmat: wp.array2d[wp.mat33],
    truths: wp.array2d[wp.uint8],
):
    """Evaluate all conditions but contacts in every simulation."""
    i, k = wp.tid()
    kind = kinds[k]
    first = firsts[k]
    second = seconds[k]
    truth = False
    if kind == JOINT_ABOVE:
        truth = wp.float64(qpos[i, first]) > bounds[k, 0]
    elif kind == JOINT_BELOW:
        truth = wp.float64(qpos[i, first]) < bounds[k, 0]
    elif kind == HIGH:
        truth = wp.float64(xpos[i, first][2]) >= HEIGHT
    elif kind == STACKED:
        offset = wp.vec3d(xpos[i, first]) - wp.vec3d(xpos[i, second])
        truth = offset[2] >= ZERO and wp.sqrt(offset[0] * offset[0] + offset[1] * offset[1]) < NEAR
    elif kind != TOUCH:
        centre = wp.vec3d(bounds[k, 0], bounds[k, 1], bounds[k, 2])
        half = wp.vec3d(bounds[k, 3], bounds[k, 4], bounds[k, 5])
        mat = wp.identity(3, dtype=wp.float64)
        if second >= 0:
            centre = wp.vec3d(site_xpos[i, second])
            mat = wp.mat33d(site_xmat[i, second])
        point = wp.vec3d(xpos[i, first])
        if kind == OVER:
            truth = _over(mat, point - centre, half)
        else:
            truth = _inside(mat, centre, half, point)
    if truth:
        truths[i, k] = wp.uint8(1)
    else:
        truths[i, k] = wp.uint8(0)


@wp.kernel
def find_contacts(
    kinds: wp.array[int],
    sides: wp.array3d[wp.uint8],
    ncontact: wp.array[int],
    geom: wp.array[wp.vec2i],
    world: wp.array[int],
    geom_body: wp.array[int],
    truths: wp.array2d[wp.uint8],
):
    """Set the truth of each condition of contact that a contact makes true."""
    c = wp.tid()
    if c >= ncontact[0]:
        return
    a = geom_body[geom[c][0]]
    b = geom_body[geom[c][1]]
    for k in range(kinds.shape[0]):
        if kinds[k] == TOUCH:
            one = int(sides[k, 0, a]) * int(sides[k, 1, b])
            other = int(sides[k, 0, b]) * int(sides[k, 1, a])
            if one + other > 0:
                truths[world[c], k] = wp.uint8(1)


class Conditions:
    """Conditions on the device."""

    def __init__(self, simulations: WarpSimulations, scene: Scene, conditions: Sequence[Condition]):
        self._simulations, self._count = simulations, len(conditions)
        sides = np.zeros((len(conditions), 2, scene.model.nbody), np.uint8)
        for k, one in enumerate(conditions):
            for side, name in enumerate(one.pair or ()):
                sides[k, side, scene.bodies[name]] = 1
        with wp.ScopedDevice(simulations.device):
            self._kinds = wp.array([c.kind for c in conditions], dtype=int)
            self._firsts = wp.array([c.first for c in conditions], dtype=int)
            self._seconds = wp.array([c.second for c in conditions], dtype=int)
            bounds = np.array([c.bound for c in conditions], np.float64).reshape(-1, 6)
            self._bounds, self._sides = wp.array(bounds, dtype=wp.float64), wp.array(sides, dtype=wp.uint8)
            self._truths = wp.zeros((simulations.num, len(conditions)), dtype=wp.uint8)

    def truths(self) -> np.ndarray:
        """Return the truth of each condition in each simulation, (num, n) bool."""
        simulations = self._simulations
        if not self._count:
            return np.zeros((simulations.num, 0), bool)
        model, data = simulations.device_model, simulations.device_data
        with wp.ScopedDevice(simulations.device):
            wp.launch(
                find_truths,
                (simulations.num, self._count),
                inputs=[self._kinds, self._firsts, self._seconds, self._bounds],
                outputs=[data.qpos, data.xpos, data.site_xpos, data.site_xmat, self._truths],
            )
            wp.launch(
                find_contacts,
                data.naconmax,
                inputs=[self._kinds, self._sides, data.nacon, data.contact.geom, data.contact.worldid],
                outputs=[model.geom_bodyid, self._truths],
            )
        return self._truths.numpy().astype(bool)


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
