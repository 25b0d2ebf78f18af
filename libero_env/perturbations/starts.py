"""Kinds that change the start of an episode: the joints of the arm, the poses of objects."""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from libero_env.errors import InvalidInputError, PlacementError
from libero_env.geometry import quat_from_axis_angle, quat_multiply
from libero_env.init_states.placement import make_true, settle
from libero_env.mujoco_compat import mujoco
from libero_env.perturbations.kinds import StartChange, direction, sign
from libero_env.sim.back_ends import LoopSimulations
from libero_env.sim.predicates import evaluate
from libero_env.sim.scene import ROBOT, Scene
from libero_env.sim.state import StateView
from libero_env.tasks.expression import And, Atom
from libero_env.tasks.problem import Problem
from libero_env.workspaces import WORKSPACES

_DIRECTIONS = 60  # tries for each object
_BESIDE = 0.12  # [m] between the middles of two objects that stand beside each other
_FULL_STEP, _FULL_TURN = 0.05, np.deg2rad(30.0)  # [m], [rad] at severity 1
# [m, rad, or quaternion units] largest change of a start that is at rest, and of what is not moved
_STILL = 0.01
_LIMIT_MARGIN = 0.02  # [rad] between a sampled joint and the end of its range


@dataclass(frozen=True)
class RobotJoints(StartChange):
    """Joints of the arm.

    Attributes:
        qpos: Positions of the seven joints, [rad].
    """

    qpos: tuple[float, ...]

    def apply(self, scene: Scene, row: np.ndarray) -> np.ndarray | None:
        return _with_arm(row, np.asarray(self.qpos))


@dataclass(frozen=True)
class RobotOffset(StartChange):
    """An offset of the arm's joints that must be within their ranges and without new contacts.

    Attributes:
        offset: What is added to the positions of the seven joints, [rad].
    """

    offset: tuple[float, ...]

    def apply(self, scene: Scene, row: np.ndarray) -> np.ndarray | None:
        model, arm = scene.model, row[1:8] + self.offset
        low, high = model.jnt_range[:7].T
        if not ((arm > low + _LIMIT_MARGIN) & (arm < high - _LIMIT_MARGIN)).all():
            return None
        moved = _with_arm(row, arm)
        return moved if contacts(scene, moved) <= contacts(scene, row) else None


@dataclass(frozen=True)
class ScatteredObjects(StartChange):
    """Each object that stands on the workspace is moved by the same distance and turned, without new contacts.

    What stands on it or lies in it moves along; what the benchmark keeps in its place, fixtures, stays.

    Attributes:
        distance: Distance, [m].
        angle: Angle about the vertical, [rad].
        seed: Seed of the directions.
    """

    distance: float
    angle: float
    seed: int

    def apply(self, scene: Scene, row: np.ndarray) -> np.ndarray | None:
        rng, before, moved = np.random.default_rng(self.seed), contacts(scene, row), row
        for name, load in carried(scene.problem).items():
            for _ in range(_DIRECTIONS):
                step, angle = self.distance * direction(rng, 2), self.angle * sign(rng)
                tried = shifted(scene, moved, (name, *load), step, angle)
                if contacts(scene, tried) <= before:
                    moved = tried
                    break
            else:
                return None
        return moved


@dataclass(frozen=True)
class PutAside(StartChange):
    """Objects of the goal are moved by the same distance, with what stands on them, without new contacts.

    Attributes:
        distance: Distance, [m].
        receptacle: Whether those that others are put on or in are moved, instead of those that are put there.
        seed: Seed of the directions.
    """

    distance: float
    receptacle: bool
    seed: int

    def apply(self, scene: Scene, row: np.ndarray) -> np.ndarray | None:
        rng, loads, moved = np.random.default_rng(self.seed), carried(scene.problem), row
        before = contacts(scene, row)
        names = [name for name in _of_goal(scene)[self.receptacle] if not _touched(scene, name, before)]
        for name in names:
            moved = shifted(scene, moved, (name, *loads.get(name, ())), self.distance * direction(rng, 2))
        return moved if names and contacts(scene, moved) <= before else None


@dataclass(frozen=True)
class Gathered(StartChange):
    """Objects that the goal is not about stand beside one that it is about, without new contacts.

    Attributes:
        count: Number of objects.
        seed: Seed of their choice and of their places.
    """

    count: int
    seed: int

    def apply(self, scene: Scene, row: np.ndarray) -> np.ndarray | None:
        rng, before, moved = np.random.default_rng(self.seed), contacts(scene, row), row
        (wanted, _), idle = _of_goal(scene), _idle(scene)
        if not wanted or not idle:
            return None
        for k in rng.permutation(len(idle))[: self.count]:
            here, there = (1 + scene.pose_address(name) for name in (idle[k], wanted[0]))
            step = row[there : there + 2] + _BESIDE * direction(rng, 2) - row[here : here + 2]
            moved = shifted(scene, moved, (idle[k], *carried(scene.problem)[idle[k]]), step)
        return moved if contacts(scene, moved) <= before else None


@dataclass(frozen=True)
class Obstacle(StartChange):
    """An object that the goal is not about stands between one that it is about and its place, without new contacts.

    Attributes:
        aside: Distance from the straight line, near its middle, [m].
        seed: Seed of the choice and of the place.
    """

    aside: float
    seed: int

    def apply(self, scene: Scene, row: np.ndarray) -> np.ndarray | None:
        rng, idle = np.random.default_rng(self.seed), _idle(scene)
        ways = [a.args for a in scene.goal_atoms if len(a.args) == 2 and a.args[0] in scene.problem.objects]
        ends = [(name, owner) for name, address in ways if (owner := scene.owner(address)) in scene.entities]
        if not idle or not ends:
            return None
        name, (start, end) = idle[rng.integers(len(idle))], (_middle(scene, row, n) for n in ends[0])
        way, here = end - start, _middle(scene, row, name)
        across = np.array([-way[1], way[0]]) / max(float(np.linalg.norm(way)), 1e-9)
        step = start + rng.uniform(0.4, 0.6) * way + sign(rng) * self.aside * across - here
        moved = shifted(scene, row, (name, *carried(scene.problem)[name]), step)
        return moved if contacts(scene, moved) <= contacts(scene, row) else None


@dataclass(frozen=True)
class PartOfGoal(StartChange):
    """Some of the atoms of the goal that are missing hold, with what they are about at rest; all else stays.

    Attributes:
        share: Share of the missing atoms, at least one and not all; a start that lacks only one stays as it is.
        seed: Seed of their choice and of the positions.
    """

    share: float
    seed: int

    def apply(self, scene: Scene, row: np.ndarray) -> np.ndarray | None:
        rng, before = np.random.default_rng(self.seed), contacts(scene, row)
        simulations = LoopSimulations(scene.model, 1, scene.fixture_bodies)
        view, (qpos, qvel, fixtures) = StateView(scene, simulations), scene.split_states(row[None])
        simulations.reset([0], qpos, qvel, fixtures=fixtures)
        atoms = scene.goal_atoms
        missing = [atoms[k] for k in rng.permutation(len(atoms)) if not evaluate(atoms[k], view)]
        chosen = missing[: max(1, round(self.share * (len(missing) - 1)))] if len(missing) > 1 else []
        (model, data), moved = posed(scene, row), row.copy()
        made = np.array([a for atom in chosen for a in make_true(scene, data, atom, rng)], int)
        moved[1 + made] = data.qpos[made]
        root = model.body_rootid
        if any(root[a] != root[b] for a, b in contacts(scene, moved) - before):
            return None
        try:
            rest = settle(simulations, 0, moved[1 : 1 + model.nq], scene.nq_robot, fixtures[0])
            moved[1 + made] = rest[made]
            settle(simulations, 0, moved[1 : 1 + model.nq], scene.nq_robot, fixtures[0])
        except PlacementError:
            return None
        change = np.abs(simulations.fields["qpos"][0] - moved[1 : 1 + model.nq])[scene.nq_robot :]
        return moved if change.max() < _STILL and all(evaluate(atom, view) for atom in chosen) else None


def _of_goal(scene: Scene) -> tuple[list[str], list[str]]:
    """Return the objects that a goal wants somewhere, and those that it wants them on or in."""
    atoms, objects = scene.goal_atoms, scene.problem.objects
    wanted = dict.fromkeys(atom.args[0] for atom in atoms if atom.args[0] in objects)
    owners = (scene.owner(name) for atom in atoms for name in atom.args[1:])
    return list(wanted), list(dict.fromkeys(name for name in owners if name and name in objects))


def _idle(scene: Scene) -> list[str]:
    """Return the objects on the workspace that the goal is not about, nor what they carry."""
    used = {name for names in _of_goal(scene) for name in names}
    return [name for name, load in carried(scene.problem).items() if not used & {name, *load}]


def _middle(scene: Scene, row: np.ndarray, name: str) -> np.ndarray:
    """Return where an object or a fixture stands in a state, (2,) [m]."""
    if name in scene.objects:
        return row[1 + scene.pose_address(name) :][:2]
    return scene.split_states(row[None])[2][0, list(scene.fixtures).index(name), :2]


def _touched(scene: Scene, name: str, touching: set[tuple[int, int]]) -> bool:
    robot, own = set(scene.bodies[ROBOT].tolist()), set(scene.bodies[name].tolist())
    return any(robot & set(pair) and own & set(pair) for pair in touching)


def carried(problem: Problem) -> dict[str, list[str]]:
    """Return the objects that stand on the workspace, each with those that stand on it or lie in it."""
    places: dict[str, str] = {}
    for name, address in problem.places.items():
        if name in problem.objects:
            region = problem.region(address)
            places[name] = address if region is None else region.target
    roots: dict[str, list[str]] = {
        name: [] for name, on in places.items() if problem.fixtures.get(on) in WORKSPACES
    }
    for name in places:
        below = name
        while places.get(below) in places:
            below = places[below]
        if below != name and below in roots:
            roots[below].append(name)
    return roots


def shifted(
    scene: Scene, row: np.ndarray, names: Sequence[str], step: np.ndarray, angle: float = 0.0
) -> np.ndarray:
    """Return a state in which objects are moved by (2,) [m] and turned about the vertical through the first, [rad]."""
    moved, turn = row.copy(), quat_from_axis_angle(np.array([0.0, 0.0, 1.0]), angle)
    addresses = [1 + scene.pose_address(name) for name in names]
    centre = row[addresses[0] : addresses[0] + 2].copy()
    cosine, sine = np.cos(angle), np.sin(angle)
    for a in addresses:
        x, y = row[a : a + 2] - centre
        moved[a : a + 2] = centre + (cosine * x - sine * y, sine * x + cosine * y) + step
        if angle:
            moved[a + 3 : a + 7] = quat_multiply(turn[None], row[a + 3 : a + 7][None])[0]
    return moved


def _with_arm(row: np.ndarray, arm: np.ndarray) -> np.ndarray:
    moved = row.copy()
    moved[1 : 1 + len(arm)] = arm
    return moved


_geometry: "WeakKeyDictionary[mujoco.MjModel, tuple[mujoco.MjModel, mujoco.MjData]]" = WeakKeyDictionary()


def contacts(scene: Scene, row: np.ndarray) -> set[tuple[int, int]]:
    """Return the pairs of bodies that touch in a state [time, qpos, qvel, poses of the fixtures]."""
    model, data = posed(scene, row)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)
    bodies: Sequence[Sequence[int]] = np.sort(model.geom_bodyid[data.contact.geom[: data.ncon]]).tolist()
    return {(a, b) for a, b in bodies}


def posed(scene: Scene, row: np.ndarray) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return a copy of the model with the poses of the fixtures, and data with the positions."""
    if scene.model not in _geometry:
        model = copy(scene.model)  # a value that held its key would never be freed
        _geometry[scene.model] = model, mujoco.MjData(model)
    model, data = _geometry[scene.model]
    qpos, _, fixtures = scene.split_states(row[None])
    if scene.fixtures:
        model.body_pos[scene.fixture_bodies] = fixtures[0, :, :3]
        model.body_quat[scene.fixture_bodies] = fixtures[0, :, 3:]
    data.qpos[:] = qpos[0]
    return model, data


def _part_of_goal(share: float, rng: np.random.Generator, scene: Scene) -> PartOfGoal:
    goal = scene.problem.goal
    if not (isinstance(goal, And) and len(goal.parts) > 1 and all(isinstance(p, Atom) for p in goal.parts)):
        raise InvalidInputError(
            f"{scene.problem.language!r}: perturbation partial: no part of the goal {goal} can hold alone; expected an "
            "And of several atoms"
        )
    return PartOfGoal(share, _seed(rng))


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(2**63))


SAMPLERS: dict[str, Callable[[float, np.random.Generator, Scene], StartChange]] = {
    "robot": lambda radians, rng, scene: RobotOffset(tuple((radians * direction(rng, 7)).tolist())),
    "object_pose": lambda metres, rng, scene: ScatteredObjects(
        metres, _FULL_TURN * metres / _FULL_STEP, _seed(rng)
    ),
    "object": lambda metres, rng, scene: PutAside(metres, False, _seed(rng)),
    "receptacle": lambda metres, rng, scene: PutAside(metres, True, _seed(rng)),
    "distractor": lambda count, rng, scene: Gathered(int(count), _seed(rng)),
    "obstacle": lambda nearness, rng, scene: Obstacle((1 - nearness) * _BESIDE, _seed(rng)),
    "partial": _part_of_goal,
}
