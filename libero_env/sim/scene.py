"""Scenes: the MuJoCo model of a problem, made of assets and a workspace.

The order of joints is the original's: arm, gripper, then the objects and the fixtures in the order of the task file, so
that states of the original have the same layout. The poses of fixtures belong to the state, not to the model;
`Simulations` has them.
"""

import hashlib
from collections import OrderedDict
from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from threading import RLock
from typing import Any

import numpy as np

from libero_env.assets.arena import Workspace, add_spare_materials
from libero_env.assets.pack import Pack, select_pack
from libero_env.assets.robot import DEFAULT_ROBOT, OPEN_FINGERS, REST_QPOS
from libero_env.errors import LiberoError
from libero_env.mujoco_compat import log_warnings, mujoco
from libero_env.objects.catalog import version_of
from libero_env.objects.model import OPPOSITE_STATES, ROOT_BODY, ObjectModel
from libero_env.sim.scene_spec import default_drawing, scene_spec, workspace_of
from libero_env.tasks.cameras import Camera
from libero_env.tasks.expression import And, Atom, Expression, ForAll
from libero_env.tasks.problem import Problem, ProblemError, Region
from libero_env.tasks.rules import Violation
from libero_env.text import suggest

# (k, state_size) rows [time, qpos, qvel, position and quaternion (wxyz) of each fixture]
InitialStates = np.ndarray
ROBOT = "robot"  # name of arm and gripper in contacts


@dataclass(frozen=True)
class Scene:
    """A compiled task. The model is shared by all environments of the task and must not be written to.

    Attributes:
        problem: Content of the task file.
        pack: Asset pack of the models.
        workspace: Table or floor.
        workspace_name: Name of the workspace in the task file, such as `main_table`.
        objects: Movable objects by name, in the order of the task file.
        fixtures: Fixtures by name, without the workspace, in the order of the task file.
        drawing: How images are drawn, one of `DRAWINGS`.
        robot: Model of the arm, one of `libero_env.assets.robot.ROBOTS`.
        spare_materials: Whether the model has materials that nothing has, see `build_scene`.
    """

    problem: Problem
    pack: Pack
    workspace: Workspace
    workspace_name: str
    model: mujoco.MjModel
    objects: Mapping[str, ObjectModel]
    fixtures: Mapping[str, ObjectModel]
    drawing: str
    robot: str
    spare_materials: bool = False

    @property
    def nq_robot(self) -> int:
        """Number of position coordinates that belong to arm and gripper; objects follow."""
        return len(REST_QPOS) + len(OPEN_FINGERS)

    @property
    def entities(self) -> dict[str, ObjectModel]:
        """Objects and fixtures by name."""
        return {**self.objects, **self.fixtures}

    @cached_property
    def fixture_poses(self) -> np.ndarray:
        """Default poses of the fixtures, in the middle of their regions, (nfixtures, 7): position, quaternion wxyz."""
        return np.concatenate([self.model.body_pos, self.model.body_quat], axis=1)[self.fixture_bodies]

    @property
    def fixture_bodies(self) -> np.ndarray:
        """Indices of the fixtures' root bodies, (nfixtures,)."""
        return np.array([self.model.body(f"{name}_{ROOT_BODY}").id for name in self.fixtures], np.int64)

    @cached_property
    def bodies(self) -> Mapping[str, np.ndarray]:
        """Indices of the bodies of each object and fixture, of the workspace and of `robot`."""
        model = self.model
        root = {n: model.body(f"{n}_{ROOT_BODY}").id for n in self.entities}
        found = {name: np.flatnonzero(model.body_rootid == body) for name, body in root.items()}
        names = [model.body(b).name for b in range(model.nbody)]
        robot = [b for b, name in enumerate(names) if name.startswith(("robot0_", "gripper0_"))]
        rest = np.setdiff1d(np.arange(model.nbody), np.concatenate([*found.values(), robot]))
        return {**found, ROBOT: np.array(robot), self.workspace_name: rest}

    @cached_property
    def joints(self) -> Mapping[str, tuple[int, ...]]:
        """Indices of the articulated joints of each object, fixture and site; for a site those of its own body."""
        model = self.model
        moving = [j for j in range(model.njnt) if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_FREE]
        owners: dict[str, tuple[int, ...]] = {}
        for name in self.entities:
            bodies = set(self.bodies[name].tolist())
            own = [j for j in moving if int(model.jnt_bodyid[j]) in bodies]
            owners[name] = tuple(own)
            for site in range(model.nsite):
                if (body := int(model.site_bodyid[site])) in bodies:
                    owners[model.site(site).name] = tuple(j for j in own if model.jnt_bodyid[j] == body)
        return owners

    @cached_property
    def collision_geoms(self) -> Mapping[str, np.ndarray]:
        """Indices of the geoms that touch others, by the names of `bodies`."""
        solid = (self.model.geom_contype | self.model.geom_conaffinity) != 0
        owned = {name: np.isin(self.model.geom_bodyid, bodies) for name, bodies in self.bodies.items()}
        return {name: np.flatnonzero(solid & own) for name, own in owned.items()}

    def pose_address(self, name: str) -> int:
        """Return the index in qpos of the pose of a movable object: position and quaternion wxyz, (7,)."""
        return int(self.model.joint(f"{name}_joint0").qposadr[0])

    @contextmanager
    def posed(self, fixtures: np.ndarray, model: mujoco.MjModel | None = None) -> Iterator[mujoco.MjModel]:
        """Give fixtures poses, (nfixtures, 7), in a model of the scene, which has its own again afterwards.

        Args:
            model: Model of a simulation; by default a copy of the scene's, which takes as long as it is large.
        """
        bodies = self.fixture_bodies
        model = copy(self.model) if model is None and bodies.size else model or self.model
        own = model.body_pos[bodies], model.body_quat[bodies]
        try:
            if bodies.size:
                model.body_pos[bodies], model.body_quat[bodies] = fixtures[:, :3], fixtures[:, 3:]
            yield model
        finally:
            if bodies.size:
                model.body_pos[bodies], model.body_quat[bodies] = own

    @cached_property
    def digest(self) -> str:
        """Digest, 16 hex digits, of what initial states depend on: joints, shapes and masses of entities."""
        model = self.model
        parts: list[tuple] = [(model.joint(j).name, int(model.jnt_type[j])) for j in range(model.njnt)]
        if self.workspace.own:
            parts.append((self.workspace.name, self.workspace.own))
        for name, item in self.entities.items():
            if item.digest:
                parts.append((name, item.digest))
            for body in self.bodies[name]:
                for g in range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body]):
                    if model.geom_contype[g] and model.geom_type[g] != mujoco.mjtGeom.mjGEOM_MESH:
                        values = (*model.geom_size[g], *model.geom_pos[g], *model.geom_quat[g])
                        parts.append((name, int(model.geom_type[g]), *(f"{value:.5f}" for value in values)))
                parts.append((name, f"{model.body_mass[body]:.6f}"))
        return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]

    @cached_property
    def goal_atoms(self) -> tuple[Atom, ...]:
        """Atoms of the goal; a quantifier has those of each object that it stands for."""
        return ground(self.problem.goal, self).atoms()

    @property
    def state_size(self) -> int:
        """Length of an initial state."""
        return 1 + self.model.nq + self.model.nv + 7 * len(self.fixtures)

    def check_states(self, states: np.ndarray, source: object = "") -> None:
        """Check that rows (k, n) begin with [time, qpos, qvel] of this scene, as those of the original do.

        Args:
            source: Where they come from, for the message.

        Raises:
            LiberoError: They are too short.
        """
        size = 1 + self.model.nq + self.model.nv
        if states.ndim != 2 or states.shape[1] < size:
            where = f"{source}: " if source else ""
            raise LiberoError(
                f"{where}states of {states.shape[-1]} numbers; this task's begin with {size} of [time, qpos, qvel]. "
                "Are they of another task, or of other models?"
            )

    def split_states(self, states: InitialStates) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Split states into qpos (k, nq), qvel (k, nv) and fixtures (k, nfixtures, 7), none where they have no poses.

        Raises:
            LiberoError: They have another length.
        """
        self.check_states(states)
        _, qpos, qvel, fixtures = np.split(states, np.cumsum([1, self.model.nq, self.model.nv]), axis=1)
        if fixtures.shape[1] % 7:
            raise LiberoError(f"a state of {states.shape[1]} numbers; the poses at its end have 7 each")
        return qpos, qvel, fixtures.reshape(len(states), -1, 7)

    def owner(self, address: str) -> str | None:
        """Return the object or fixture of a name or of a region's address; None if it belongs to neither."""
        if address in self.entities:
            return address
        region = self.problem.region(address)
        return region.target if region is not None and region.target in self.entities else None

    def is_place(self, region: Region) -> bool:
        """Return whether a region has rectangles on the workspace, or is a site of its target's model."""
        site = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_SITE, region.address)
        return bool(region.ranges) or site >= 0


def ground(expression: Expression, scene: Scene) -> Expression:
    """Return a goal with quantifiers replaced by conjunctions over the objects of a scene."""
    if isinstance(expression, ForAll):
        variables, categories = zip(*expression.variables, strict=True)
        names = [[n for n, item in scene.objects.items() if item.category == one] for one in categories]
        bindings = (dict(zip(variables, chosen, strict=True)) for chosen in product(*names))
        return And(tuple(ground(_bind(expression.body, binding), scene) for binding in bindings))
    return expression.map(lambda part: ground(part, scene))


def _bind(expression: Expression, binding: Mapping[str, str]) -> Expression:
    """Replace variables by the names of objects."""
    if isinstance(expression, Atom):
        return Atom(expression.predicate, tuple(binding.get(arg, arg) for arg in expression.args))
    return expression.map(lambda part: _bind(part, binding))


def build_scene(
    problem: Problem,
    pack: Pack | None = None,
    *,
    drawing: str | None = None,
    robot: str = DEFAULT_ROBOT,
    spare_materials: bool = False,
    cameras: Sequence[Camera] = (),
) -> Scene:
    """Compile a problem; the result is cached for the process.

    Args:
        problem: Problem to compile.
        pack: Asset pack of the models; by default that of `select_pack`.
        drawing: One of `DRAWINGS`; by default that of `default_drawing`.
        robot: One of `libero_env.assets.robot.ROBOTS`.
        spare_materials: Whether the model also has the styles of all floors, walls and tables as materials, for a
            `libero_env.sim.appearance.Appearance`. Nothing else depends on it.
        cameras: Cameras that are added, besides those of the problem.

    Raises:
        ProblemError: A region is not a site of its target's model, or a goal has a state that the model does not have.
        UnknownNameError: A category of objects or fixtures has no model, or the body of a camera does not exist.
        InvalidInputError: An added camera has the name of another.
        LiberoError: MuJoCo refuses the models, such as those with the same names.
    """
    pack = pack or select_pack()
    drawing = drawing or default_drawing(pack)
    return _build_scene(problem, pack, drawing, robot, spare_materials, tuple(cameras))


def _compile_scene(
    problem: Problem,
    pack: Pack,
    drawing: str,
    robot: str,
    spare_materials: bool = False,
    cameras: Sequence[Camera] = (),
) -> Scene:
    name, workspace = workspace_of(problem)
    entities = {n: pack.build(c) for n, c in {**problem.objects, **problem.fixtures}.items() if n != name}
    spec = scene_spec(problem, pack, entities, drawing=drawing, robot=robot, cameras=cameras)
    if spare_materials:
        add_spare_materials(spec)
    log_warnings()
    try:
        model = spec.compile()
    except ValueError as error:  # such as `repeated name 'table_visual' in geom`
        text = " ".join(str(error).split())
        remedy = "; rename the object that it begins with" if "repeated name" in text else ""
        raise LiberoError(
            f"task {problem.language!r}: MuJoCo cannot build its scene: {text}{remedy}"
        ) from error
    objects = {n: entities[n] for n in problem.objects}
    fixtures = {n: entities[n] for n in problem.fixtures if n != name}
    scene = Scene(problem, pack, workspace, name, model, objects, fixtures, drawing, robot, spare_materials)
    _check_sites(scene)
    _check_states(scene)
    return scene


def _check_sites(scene: Scene) -> None:
    """Check that a region in an atom, which has no rectangle, is a site of its target's model."""
    problem, model = scene.problem, scene.model
    for args in (*(atom.args for atom in (*problem.init, *problem.goal.atoms())), problem.zones):
        for region in filter(None, map(problem.region, args)):
            if scene.is_place(region):
                continue
            prefix = f"{region.target}_"
            sites = [model.site(i).name for i in range(model.nsite)]
            own = [s.removeprefix(prefix) for s in sites if s.startswith(prefix) and not s.endswith("_site")]
            near = suggest(region.name, own)
            what = f"{region.target} has no region {region.name!r}{'.' if near else ''}{near}"
            expected = f"one of {', '.join(own)}" if own else f"{region.target} itself, which has no regions"
            violation = Violation("no-site", what, expected, ":regions", region.address)
            raise ProblemError(problem, violation)


def _check_states(scene: Scene) -> None:
    """Check that what a goal wants open or turned on has a range for that state, if it has a joint at all."""
    for i, atom in enumerate(scene.problem.goal.atoms()):
        state, owner = atom.predicate.lower(), scene.owner(atom.args[0]) if atom.args else None
        if state not in OPPOSITE_STATES or owner is None or not scene.joints.get(atom.args[0]):
            continue
        if state not in (known := scene.entities[owner].articulation):
            what = f"{atom}: the state {state!r} of a {scene.entities[owner].category} is not defined"
            violation = Violation(
                "no-joint", what, f"one of {', '.join(sorted(known)) or 'no state'}", ":goal", i
            )
            raise ProblemError(scene.problem, violation)


class _SceneCache:
    """Compiled scenes, the least recently used of which are dropped beyond a size, but for some.

    One of the builtin models has 6 MB, and 9 in memory, one of the original's 300.
    """

    def __init__(self, max_bytes: int = 1 << 28, kept: int = 3):
        self._max_bytes, self._kept, self._bytes = max_bytes, kept, 0
        self._scenes: OrderedDict[Hashable, Scene] = OrderedDict()
        self._lock = RLock()

    def __call__(self, *key: Any) -> Scene:
        """Return the scene of arguments of `_compile_scene`; it is compiled if it is not there, or objects are new."""
        arguments, problem = key, key[0]
        categories = {*problem.objects.values(), *problem.fixtures.values()}
        key = (*arguments, frozenset((category, version_of(category)) for category in categories))
        with self._lock:
            if key not in self._scenes:
                self._scenes[key] = scene = _compile_scene(*arguments)
                self._bytes += mujoco.mj_sizeModel(scene.model)
            self._scenes.move_to_end(key)
            while self._bytes > self._max_bytes and len(self._scenes) > self._kept:
                self._bytes -= mujoco.mj_sizeModel(self._scenes.popitem(last=False)[1].model)
            return self._scenes[key]


_build_scene = _SceneCache()


def initial_qpos(scene: Scene) -> np.ndarray:
    """Return positions (nq,) with the arm at rest, the gripper open and all objects at the origin of their models."""
    qpos = scene.model.qpos0.copy()
    qpos[: scene.nq_robot] = REST_QPOS + OPEN_FINGERS
    return qpos
