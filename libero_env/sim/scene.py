"""Scenes: the MuJoCo model of a problem, made of assets and a workspace.

The order of joints is the original's: arm, gripper, then the objects and the fixtures in the order of the task file, so
that states of the original have the same layout. The poses of fixtures belong to the state, not to the model;
`Simulations` has them.
"""

import hashlib
from collections import OrderedDict
from collections.abc import Hashable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from threading import RLock
from typing import Any

import numpy as np

from libero_env.assets.arena import Workspace, add_mount, add_spare_materials, load_workspace
from libero_env.assets.original import OriginalPack
from libero_env.assets.pack import Pack, select_pack
from libero_env.assets.robot import DEFAULT_ROBOT, OPEN_FINGERS, REST_QPOS, add_panda
from libero_env.errors import LiberoError, UnknownNameError
from libero_env.mujoco_compat import log_warnings, mujoco, set_damping
from libero_env.objects.catalog import version_of
from libero_env.objects.model import OPPOSITE_STATES, ROOT_BODY, ObjectModel
from libero_env.tasks.cameras import Camera, require_own_names
from libero_env.tasks.problem import And, Atom, Expression, ForAll, Problem, ProblemError, Region, Violation
from libero_env.text import suggest
from libero_env.timing import TIMESTEP
from libero_env.workspaces import WORKSPACES

# (k, state_size) rows [time, qpos, qvel, position and quaternion (wxyz) of each fixture]
InitialStates = np.ndarray
FAST, FAITHFUL = DRAWINGS = ("fast", "faithful")
ROBOT = "robot"  # name of arm and gripper in contacts
BUFFER_SIDE = 1024  # [pixels] size of the offscreen buffer, which larger images enlarge
_FIXTURE_LIFT = 0.01  # [m] height of fixtures over the underside of the table top, as in the original
_ZONE_HEIGHT = 0.014  # [m] of the box over a flat region


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

    def model_with(self, fixtures: np.ndarray) -> mujoco.MjModel:
        """Return a copy of the model with poses of the fixtures, (nfixtures, 7); without any, the model itself."""
        if not self.fixtures:
            return self.model
        model = copy(self.model)
        model.body_pos[self.fixture_bodies] = fixtures[:, :3]
        model.body_quat[self.fixture_bodies] = fixtures[:, 3:]
        return model

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


def default_drawing(pack: Pack) -> str:
    """Return how images of a pack's scenes are drawn by default: the original's faithfully, all others fast."""
    return FAITHFUL if isinstance(pack, OriginalPack) and pack.lod is None else FAST


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
    """Compiled scenes, the least recently used of which are dropped beyond a size: one of the original has 300 MB."""

    def __init__(self, max_bytes: int = 1 << 30):
        self._max_bytes, self._bytes = max_bytes, 0
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
            while self._bytes > self._max_bytes and len(self._scenes) > 1:
                self._bytes -= mujoco.mj_sizeModel(self._scenes.popitem(last=False)[1].model)
            return self._scenes[key]


_build_scene = _SceneCache()


def scene_spec(
    problem: Problem,
    pack: Pack | None = None,
    entities: Mapping[str, ObjectModel] | None = None,
    *,
    drawing: str | None = None,
    robot: str = DEFAULT_ROBOT,
    cameras: Sequence[Camera] = (),
) -> mujoco.MjSpec:
    """Return a new, editable model of a problem's scene.

    Args:
        problem: Problem to build.
        pack: Asset pack of the models; by default that of `select_pack`.
        entities: Models of objects and fixtures by name; by default those of the pack.
        drawing: One of `DRAWINGS`; by default that of `default_drawing`.
        robot: One of `libero_env.assets.robot.ROBOTS`.
        cameras: Cameras that are added, besides those of the problem.

    Raises:
        UnknownNameError: A category of objects or fixtures has no model, or the body of a camera does not exist.
        InvalidInputError: An added camera has the name of another.
    """
    pack = pack or select_pack()
    name, workspace = workspace_of(problem)
    spec = mujoco.MjSpec()
    spec.modelname = "libero"
    faithful = (drawing or default_drawing(pack)) == FAITHFUL
    _set_options(spec, samples=4 if faithful else 0)
    pack.add_arena(spec, workspace, problem.scene_properties)
    add_panda(spec, workspace.robot_base_pos, robot, detailed=faithful)
    add_mount(spec, workspace, detailed=faithful)
    _add_zones(spec, problem, name, workspace)
    for entity, category in problem.objects.items():
        item = pack.build(category) if entities is None else entities[entity]
        joint = item.spec.body(ROOT_BODY).add_joint(name="joint0", type=mujoco.mjtJoint.mjJNT_FREE)
        set_damping(joint, item.joint_damping)
        spec.attach(item.spec, prefix=f"{entity}_", frame=spec.worldbody.add_frame())
    for entity, category in problem.fixtures.items():
        if entity != name:
            item = pack.build(category) if entities is None else entities[entity]
            body, pose = item.spec.body(ROOT_BODY), fixture_pose(problem, name, workspace, entity, item)
            body.pos, body.quat = pose[:3], pose[3:]
            spec.attach(item.spec, prefix=f"{entity}_", frame=spec.worldbody.add_frame())
    if faithful and isinstance(pack, OriginalPack):
        pack.restore_drawing(spec, workspace, problem.scene_properties)
    _add_cameras(spec, (*problem.cameras, *cameras))
    return spec


def workspace_of(problem: Problem) -> tuple[str, Workspace]:
    """Return the name of the fixture that is the workspace of a problem, and the workspace.

    Raises:
        UnknownNameError: None of the fixtures is a workspace.
    """
    for name, category in problem.fixtures.items():
        if category in WORKSPACES:
            return name, load_workspace(category)
    raise UnknownNameError("workspace among the fixtures", list(problem.fixtures.values()), WORKSPACES)


def fixture_pose(
    problem: Problem,
    workspace_name: str,
    workspace: Workspace,
    name: str,
    item: ObjectModel,
    rng: np.random.Generator | None = None,
) -> np.ndarray:
    """Return the pose of a fixture in the region of its init atom.

    Args:
        problem: Problem that has the fixture.
        workspace: Table or floor.
        rng: Generator to sample the region with; without it the middle of the region is taken.

    Returns:
        Position and quaternion wxyz, (7,).
    """
    region = problem.region(problem.places.get(name, ""))
    height = _FIXTURE_LIFT - workspace.parameters.get("table_thickness", 0.05) - item.bottom_offset[2]
    if region is None or not region.ranges or region.target != workspace_name:
        x, y, yaw = 0.0, 0.0, 0.0
    elif rng is None:
        x0, y0, x1, y1 = region.ranges[0]
        x, y, yaw = (x0 + x1) / 2, (y0 + y1) / 2, float(np.mean(region.yaw[0])) if region.yaw else 0.0
    else:
        x0, y0, x1, y1 = region.ranges[rng.integers(len(region.ranges))]
        x, y = rng.uniform(x0, x1), rng.uniform(y0, y1)
        yaw = rng.uniform(*region.yaw[0]) if region.yaw else 0.0
    pos = np.add(workspace.offset, (x, y, height))
    return np.array([*pos, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


def zone_boxes(region: Region, workspace: Workspace) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the flat box over each rectangle of a region: centre (3,) and half size (3,), world frame, m."""
    origin = np.array(workspace.zone_origin)
    return [
        (origin + ((x0 + x1) / 2, (y0 + y1) / 2, 0.0), np.array([x1 - x0, y1 - y0, _ZONE_HEIGHT]) / 2)
        for x0, y0, x1, y1 in region.ranges
    ]


def initial_qpos(scene: Scene) -> np.ndarray:
    """Return positions (nq,) with the arm at rest, the gripper open and all objects at the origin of their models."""
    qpos = scene.model.qpos0.copy()
    qpos[: scene.nq_robot] = REST_QPOS + OPEN_FINGERS
    return qpos


def _set_options(spec: mujoco.MjSpec, samples: int) -> None:
    spec.compiler.degree = False
    option = spec.option
    option.timestep = TIMESTEP
    option.impratio = 20.0
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.density, option.viscosity = 1.2, 2e-5
    visual = spec.visual
    visual.map.znear = 0.001
    visual.quality.offsamples = samples  # four double the cost of an image
    visual.quality.shadowsize = 0  # no light casts a shadow, in the original neither
    visual.global_.offwidth = visual.global_.offheight = BUFFER_SIDE
    visual.headlight.ambient, visual.headlight.diffuse = [0.1] * 3, [0.4] * 3
    visual.headlight.specular = [0.5] * 3


def _add_cameras(spec: mujoco.MjSpec, cameras: Sequence[Camera]) -> None:
    """Add cameras to a complete scene; they come last, and change nothing for the others."""
    require_own_names(cameras, [camera.name for camera in spec.cameras])
    bodies = {body.name: body for body in spec.bodies}
    for camera in cameras:
        body = bodies.get(camera.body) or bodies.get(f"{camera.body}_{ROOT_BODY}")
        if body is None:
            valid = [name.removesuffix(f"_{ROOT_BODY}") for name in bodies]
            raise UnknownNameError(f"body of camera {camera.name}", camera.body, valid)
        added = body.add_camera(name=camera.name, pos=camera.pos, fovy=camera.fovy)
        if camera.quat is not None:
            added.quat = np.array(camera.quat) / np.linalg.norm(camera.quat)
        else:
            added.alt.type, added.alt.xyaxes = mujoco.mjtOrientation.mjORIENTATION_XYAXES, camera.axes()


def _add_zones(spec: mujoco.MjSpec, problem: Problem, name: str, workspace: Workspace) -> None:
    """Add a hidden site for each region on the workspace, so that it can be found by its address."""
    for region in problem.regions:
        if region.target == name and region.ranges:
            centre, half = zone_boxes(region, workspace)[0]
            spec.worldbody.add_site(
                name=region.address,
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=centre,
                size=np.maximum(half, 1e-4),
                rgba=(0.0, 0.0, 0.0, 0.0),
                group=3,
            )
