"""The start of a perturbed task that belongs to a start of the task without perturbations.

What both tasks have stays where it is, unless its region was moved; then it moves with the region, and what stands on
it moves along. What is new finds a free place in its region, and is simulated until it is at rest.
"""

from collections.abc import Iterator

import mujoco
import numpy as np

from libero_env.errors import PlacementError
from libero_env.init_states.placement import collision_boxes, lowest_point
from libero_env.init_states.settle import settle
from libero_env.init_states.store import split_row
from libero_env.perturbations.drawing import DrawKey
from libero_env.perturbations.starts import contacts, posed
from libero_env.sim.back_ends import LoopSimulations
from libero_env.sim.scene import Scene, zone_boxes
from libero_env.tasks.problem import Problem, Region, atoms_of

_GAP = 0.02  # [m] between a new object and what is there, seen from above
_LIFT = 0.001  # [m] above the surface, from where it settles
_TRIES = 300


class Pairing:
    """Starts of a perturbed scene from those of the scene without perturbations.

    Args:
        base: Scene without perturbations.
        scene: Scene of the perturbed task.
    """

    def __init__(self, base: Scene, scene: Scene):
        self.base, self.scene = base, scene
        self.added = [name for name in scene.objects if name not in base.objects]
        self._shifts = dict(moved(base.problem, scene.problem))
        self._is_same = base.problem.objects == scene.problem.objects and not self._shifts
        self._simulations: LoopSimulations | None = None
        self._known: dict[bytes, np.ndarray] = {}

    def row(self, row: np.ndarray, key: DrawKey) -> np.ndarray:
        """Return the start that belongs to a start of the scene without perturbations.

        Args:
            row: State [time, qpos, qvel, poses of the fixtures] of that scene.
            key: Key of the places of what is new.

        Raises:
            PlacementError: What is new finds no free place, or a moved object collides.
        """
        if self._is_same:
            return row
        name = row.tobytes()
        if name not in self._known:
            self._known[name] = self._paired(row, key)
        return self._known[name].copy()

    def _paired(self, row: np.ndarray, key: DrawKey) -> np.ndarray:
        base, model = self.base, self.scene.model
        qpos, qvel, fixtures = (part[0].copy() for part in split_row(base.model, row[None]))
        now, speed = model.qpos0.copy(), np.zeros(model.nv)
        for j in range(base.model.njnt):
            name = base.model.joint(j).name
            if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) < 0:
                continue  # of an object that the perturbed task does not have
            size, freedom = (7, 6) if base.model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE else (1, 1)
            old, new = base.model.jnt_qposadr[j], model.joint(name).qposadr[0]
            now[new : new + size] = qpos[old : old + size]
            old, new = base.model.jnt_dofadr[j], model.joint(name).dofadr[0]
            speed[new : new + freedom] = qvel[old : old + freedom]
        for name, shift in self._shifts.items():
            address = model.joint(f"{name}_joint0").qposadr[0]
            now[address : address + 2] += shift
        paired = np.concatenate([row[:1], now, speed, fixtures.ravel()])
        if not self.added:
            return paired
        return self._settled(self._with_added(paired, key))

    def _with_added(self, row: np.ndarray, key: DrawKey) -> np.ndarray:
        """Return a state in which each new object hovers over a free place of its region."""
        scene, rng, row = self.scene, key.generator("places"), row.copy()
        surface, offset = scene.workspace.surface_height, np.asarray(scene.workspace.offset)[:2]
        taken = list(self._taken(row))
        for name in self.added:
            region, address = self._region(name), 1 + scene.model.joint(f"{name}_joint0").qposadr[0]
            for _ in range(_TRIES):
                quat = scene.objects[name].rest_quat(rng)
                x0, y0, x1, y1 = region.ranges[rng.integers(len(region.ranges))]
                place = rng.uniform((x0, y0), (x1, y1)) + offset
                row[address : address + 7] = (
                    *place,
                    surface - lowest_point(scene, name, quat) + _LIFT,
                    *quat,
                )
                boxes = list(self._boxes(row, name))
                if _is_free(boxes, taken):
                    taken += boxes
                    break
            else:
                raise PlacementError(
                    f"{scene.problem.language!r}: {name} finds no free place in {region.address} after {_TRIES} tries"
                )
        return row

    def _region(self, name: str) -> Region:
        atom = next(a for a in self.scene.problem.init if a.args[0] == name)
        region = self.scene.problem.region(atom.args[1])
        if region is None or not region.ranges:
            raise PlacementError(f"{name} is new and has no place on {self.scene.workspace_name}")
        return region

    def _taken(self, row: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield centres and half sizes, seen from above, of what is there and of the goal's regions."""
        for name in self.scene.entities:
            if name not in self.added:
                yield from self._boxes(row, name)
        for atom in atoms_of(self.scene.problem.goal):
            region = self.scene.problem.region(atom.args[-1])
            if region is not None and region.ranges and region.target == self.scene.workspace_name:
                for centre, half in zone_boxes(region, self.scene.workspace):
                    yield centre[:2], half[:2]

    def _boxes(self, row: np.ndarray, name: str) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        model, data = posed(self.scene, row)
        mujoco.mj_kinematics(model, data)
        for centre, half, _ in collision_boxes(self.scene, data, name):
            yield centre, half

    def _settled(self, row: np.ndarray) -> np.ndarray:
        """Return a state with the new objects at rest; everything else is as it was."""
        scene, model = self.scene, self.scene.model
        if self._simulations is None:
            self._simulations = LoopSimulations(model, fixture_bodies=scene.fixture_bodies)
        qpos, _, fixtures = split_row(model, row[None])
        rest, settled = settle(self._simulations, 0, qpos[0], scene.nq_robot, fixtures[0]), row.copy()
        for name in self.added:
            address = model.joint(f"{name}_joint0").qposadr[0]
            settled[1 + address : 8 + address] = rest[address : address + 7]
        own = {int(scene.bodies[name][0]) for name in self.added}
        others = {
            int(body) for name in scene.entities if name not in self.added for body in scene.bodies[name]
        }
        if any(pair & own and pair & others for pair in map(set, contacts(scene, settled))):
            raise PlacementError(f"{scene.problem.language!r}: a new object has come to rest against another")
        return settled


def _is_free(boxes: list[tuple[np.ndarray, np.ndarray]], taken: list[tuple[np.ndarray, np.ndarray]]) -> bool:
    """Return whether boxes, seen from above, keep the gap to others."""
    return all((np.abs(a - b) > p + q + _GAP).any() for a, p in boxes for b, q in taken)


def moved(base: Problem, problem: Problem) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the objects whose region was moved, or that stand on one of those, and by how much, (2,) [m]."""
    shifts: dict[str, np.ndarray] = {}
    waiting = [a for a in problem.init if len(a.args) == 2 and a.args[0] in base.objects]
    for atom in waiting:
        before, after = base.region(atom.args[1]), problem.region(atom.args[1])
        if before is not None and after is not None and before.ranges and after.ranges:
            shift = np.array(after.ranges[0][:2]) - before.ranges[0][:2]
            if shift.any():
                shifts[atom.args[0]] = shift
    for _ in waiting:  # what stands on what stands on something
        for atom in waiting:
            region = problem.region(atom.args[1])
            carrier = atom.args[1] if region is None else region.target
            if carrier in shifts:
                shifts.setdefault(atom.args[0], shifts[carrier])
    yield from shifts.items()
