"""The start of a perturbed task that belongs to a start of the task without perturbations.

What both tasks have stays where it is, unless its region was moved; then it moves with the region, and what stands on
it moves along. What is new finds a free place in its region, and is simulated until it is at rest.
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from libero_env.errors import PlacementError
from libero_env.init_states.placement import collision_boxes, lowest_point, settle
from libero_env.mujoco_compat import mujoco
from libero_env.perturbations.kinds import SampleKey
from libero_env.perturbations.starts import carried, contacts, posed
from libero_env.sim.back_ends import LoopSimulations
from libero_env.sim.scene import Scene
from libero_env.sim.scene_spec import zone_boxes
from libero_env.tasks.problem import Problem, Region

_GAP = 0.02  # [m] between a new object and what is there, seen from above
_LIFT = 0.001  # [m] above the surface, from where it settles
_TRIES = 300
_ATTEMPTS = 30  # samples of all places
_MAX_KNOWN = 256  # starts that are remembered


class Pairing:
    """Starts of a perturbed scene from those of the scene without perturbations.

    Args:
        base: Scene without perturbations.
        scene: Scene of the perturbed task.
    """

    def __init__(self, base: Scene, scene: Scene):
        self.base, self.scene = base, scene
        old, new = base.problem.objects, scene.problem.objects
        self.added = [name for name in new if name not in old]
        self.exchanged = [name for name in new if name in old and old[name] != new[name]]
        self._shifts = dict(moved(base.problem, scene.problem))
        self._is_same = old == new and not self._shifts
        self._simulations: LoopSimulations | None = None
        self._known: dict[tuple[object, ...], tuple[np.ndarray, int]] = {}

    def row(self, row: np.ndarray, keys: Sequence[SampleKey], first: int = 0) -> tuple[np.ndarray, int]:
        """Return the start that belongs to a start of the scene without perturbations, and the number of its sample.

        Args:
            row: State [time, qpos, qvel, poses of the fixtures] of that scene.
            keys: Key of the poses of what was exchanged, and key of the places of what is new.
            first: Number of the first sample of these places that may be used.

        Raises:
            PlacementError: What is new finds no free place, or a moved object collides.
        """
        if self._is_same:
            return row, 0
        name = row.tobytes(), *(key.words for key in keys), first
        if name not in self._known:
            if len(self._known) == _MAX_KNOWN:
                self._known.clear()
            self._known[name] = self._first_valid(row, keys, first)
        paired, attempt = self._known[name]
        return paired.copy(), attempt

    def _first_valid(self, row: np.ndarray, keys: Sequence[SampleKey], first: int) -> tuple[np.ndarray, int]:
        paired = self._paired(row)
        if self._shifts and self._contacts(self.scene, paired) > self._contacts(self.base, row):
            raise PlacementError(f"{self.scene.problem.language!r}: a moved object touches another")
        if not (self.added or self.exchanged):
            return paired, 0
        for attempt in range(first, first + _ATTEMPTS):
            try:
                generators = [key.generator("places", attempt) for key in keys]
                return self._settled(self._placed(paired, *generators)), attempt
            except PlacementError as error:
                reason = error
        raise reason

    def _contacts(self, scene: Scene, row: np.ndarray) -> int:
        """Return how many pairs of bodies touch in a state, without what is new."""
        new = {int(b) for n in (*self.added, *self.exchanged) for b in scene.bodies.get(n, ())}
        return sum(new.isdisjoint(pair) for pair in contacts(scene, row))

    def _paired(self, row: np.ndarray) -> np.ndarray:
        """Return the start with everything that both scenes have; what is new is at its model's origin."""
        base, model = self.base.model, self.scene.model
        before, after = mujoco.MjData(base), mujoco.MjData(model)
        before.qpos[:], before.qvel[:], fixtures = (part[0] for part in self.base.split_states(row[None]))
        there = {model.joint(j).name for j in range(model.njnt)}  # not of objects that are taken away
        for name in there & {base.joint(j).name for j in range(base.njnt)}:
            old, new = before.joint(name), after.joint(name)
            new.qpos[:], new.qvel[:] = old.qpos, old.qvel
        for name, shift in self._shifts.items():
            address = self.scene.pose_address(name)
            after.qpos[address : address + 2] += shift
        return np.concatenate([row[:1], after.qpos, after.qvel, fixtures.ravel()])

    def _placed(
        self, row: np.ndarray, exchanged_rng: np.random.Generator, rng: np.random.Generator
    ) -> np.ndarray:
        """Return a state in which what was exchanged stands in its place, and what is new over a free place."""
        scene, row = self.scene, row.copy()
        surface = scene.workspace.surface_height
        for name in self.exchanged:  # where the one before stood, on the workspace
            quat, address = scene.objects[name].rest_quat(exchanged_rng), 1 + scene.pose_address(name)
            row[address + 2] = surface - lowest_point(scene, name, quat) + _LIFT
            row[address + 3 : address + 7] = quat
        offset = np.asarray(scene.workspace.offset)[:2]
        taken = _stacked(self._taken(row))
        for name in self.added:
            region, quat = self._region(name), scene.objects[name].rest_quat(rng)
            address = 1 + scene.pose_address(name)
            row[address : address + 7] = (0.0, 0.0, surface - lowest_point(scene, name, quat) + _LIFT, *quat)
            own = _stacked(self._boxes(row, name))  # about the origin
            for _ in range(_TRIES):
                x0, y0, x1, y1 = region.ranges[rng.integers(len(region.ranges))]
                place = rng.uniform((x0, y0), (x1, y1)) + offset
                moved = own + (place, (0.0, 0.0))
                apart = (
                    np.abs(moved[:, None, 0] - taken[None, :, 0])
                    > moved[:, None, 1] + taken[None, :, 1] + _GAP
                )
                if apart.any(axis=-1).all():
                    row[address : address + 2] = place
                    taken = np.concatenate([taken, moved])
                    break
            else:
                raise PlacementError(
                    f"{scene.problem.language!r}: {name} finds no free place in {region.address} after {_TRIES} tries"
                )
        return row

    def _region(self, name: str) -> Region:
        region = self.scene.problem.region(self.scene.problem.places[name])
        if region is None or not region.ranges:
            raise PlacementError(f"{name} is new and has no place on {self.scene.workspace_name}")
        return region

    def _taken(self, row: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield centres and half sizes, seen from above, of what is there and of the goal's regions."""
        for name in self.scene.entities:
            if name not in self.added:
                yield from self._boxes(row, name)
        for atom in self.scene.goal_atoms:
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
        qpos, _, fixtures = scene.split_states(row[None])
        rest, settled = settle(self._simulations, 0, qpos[0], scene.nq_robot, fixtures[0]), row.copy()
        new = [*self.added, *self.exchanged]
        for name in new:
            address = self.scene.pose_address(name)
            settled[1 + address : 8 + address] = rest[address : address + 7]
        own = {int(scene.bodies[name][0]) for name in new}
        others = {int(body) for name in scene.entities if name not in new for body in scene.bodies[name]}
        if any(pair & own and pair & others for pair in map(set, contacts(scene, settled))):
            raise PlacementError(f"{scene.problem.language!r}: a new object has come to rest against another")
        return settled


def _stacked(boxes: Iterable[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return boxes seen from above as an array (n, 2, 2): centre and half size of each."""
    return np.array(list(boxes)).reshape(-1, 2, 2)


def moved(base: Problem, problem: Problem) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the objects whose region was moved, or that stand on one of those, and by how much, (2,) [m]."""
    there, new = base.places, problem.places
    for name, load in carried(base).items():
        before, after = base.region(there[name]), problem.region(new.get(name, there[name]))
        if before is not None and after is not None and before.ranges and after.ranges:
            shift = np.array(after.ranges[0][:2]) - before.ranges[0][:2]
            if shift.any():
                yield from ((one, shift) for one in (name, *load))
