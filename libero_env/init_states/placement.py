"""New initial states: samples of the regions and conditions of a problem's init atoms, simulated until nothing moves.

They are checked against the task: its init atoms hold, its goal does not.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from libero_env.errors import PlacementError
from libero_env.geometry import quat_from_axis_angle, quat_to_mat
from libero_env.mujoco_compat import mujoco
from libero_env.objects.model import OPPOSITE_STATES, ROOT_BODY
from libero_env.sim.back_ends import LoopSimulations
from libero_env.sim.predicates import evaluate
from libero_env.sim.scene import ROBOT, InitialStates, Scene, initial_qpos
from libero_env.sim.scene_spec import fixture_pose
from libero_env.sim.simulation import Simulations
from libero_env.sim.state import StateView
from libero_env.tasks.expression import Atom
from libero_env.tasks.problem import Region
from libero_env.tasks.rules import BUILTIN_PREDICATES

ARM_NOISE = 0.02  # [rad] standard deviation of the arm's joints around the rest pose, as in the original
_CLEARANCE = 0.001  # [m] above the surface
_MAX_TRIES = 500
_USUAL_GEOMS = 1500  # that may touch; scenes with more have fewer tries, each of which takes longer
_OVER_SITE = 0.03  # [m] height over a site's box at which the surface that it marks may be
_STILL_CHANGE = 2e-4  # [m, or quaternion units] largest change of an object at rest in half a second
_MAX_HALF_SECONDS = 10
_MAX_SAMPLES = 20
_USUAL_FREEDOMS = 250  # of a scene; those with more have fewer samples, each of which takes longer
_TOLERANCE = 0.02  # [m] distance by which an object may slide out of its rectangle
_SITE_FRACTION = 0.3  # of the edges of a site's box, around its middle, in which objects are placed


@dataclass(frozen=True)
class Start:
    """A start of an episode.

    Attributes:
        qpos: Positions, (nq,).
        fixtures: Pose of each fixture, (nfixtures, 7): position, quaternion wxyz.
    """

    qpos: np.ndarray
    fixtures: np.ndarray


def sample_start(
    scene: Scene,
    rng: np.random.Generator,
    fixtures: np.ndarray | None = None,
    model: mujoco.MjModel | None = None,
) -> Start:
    """Sample a start: entities in the regions of their init atoms, joints as in the atoms, no contact.

    Objects hover by a millimetre and are not at rest; see `libero_env.init_states.placement`.

    Args:
        fixtures: Poses of the fixtures, (nfixtures, 7); None samples them.
        model: Model of a simulation, which is faster; by default a copy of the scene's.

    Raises:
        PlacementError: No placement without contact was found in 500 tries, or an init atom cannot be placed. Scenes of
            unusual size have fewer tries.
    """
    places, qpos = _places(scene), initial_qpos(scene)
    qpos[:7] += ARM_NOISE * rng.standard_normal(7)
    if fixtures is None:
        problem, name, workspace = scene.problem, scene.workspace_name, scene.workspace
        poses = [fixture_pose(problem, name, workspace, *item, rng) for item in scene.fixtures.items()]
        fixtures = np.array(poses).reshape(-1, 7)
    touching: set[str] = set()
    solid = sum(len(geoms) for geoms in scene.collision_geoms.values())
    tries = fewer(_MAX_TRIES, solid, _USUAL_GEOMS)
    with scene.posed(fixtures, model) as posed:
        data = mujoco.MjData(posed)
        data.qpos[:] = qpos
        for atom in scene.problem.init:
            if atom.predicate.lower() in OPPOSITE_STATES:
                make_true(scene, data, atom, rng)
        for _ in range(tries):
            for name, place in places.items():
                if not place.flat:
                    mujoco.mj_kinematics(posed, data)  # its carrier has been placed
                _place(scene, data, name, place, rng)
            mujoco.mj_kinematics(posed, data)
            mujoco.mj_collision(posed, data)
            touching = _touching_entities(scene, data)
            if not touching:
                return Start(data.qpos.copy(), fixtures)
    raise PlacementError(
        f"{scene.problem.language!r}: {', '.join(sorted(touching))} still collide after {tries} tries. "
        "(1) make their regions larger, (2) move the regions apart, (3) use fewer or smaller objects"
    )


def fewer(tries: int, size: int, usual: int) -> int:
    """Return a number of tries that takes about the same time in a scene of any size; `tries` up to the usual size."""
    return tries if size <= usual else max(3, int(tries * (usual / size) ** 2))


def lowest_point(scene: Scene, name: str, quat: np.ndarray) -> float:
    """Return the height of an object's lowest collision point over its origin, m, when rotated by `quat` (wxyz)."""
    model, lowest = scene.model, np.inf
    frames = {body: _in_root_frame(model, body, quat_to_mat(quat)) for body in scene.bodies[name]}
    for geom in scene.collision_geoms[name]:
        pos, rotation = frames[model.geom_bodyid[geom]]
        centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        up = (rotation @ quat_to_mat(model.geom_quat[geom]))[2]
        middle = pos[2] + rotation[2] @ model.geom_pos[geom] + up @ centre
        lowest = min(lowest, middle - np.abs(up) @ half)
    return float(lowest)


def _in_root_frame(model: mujoco.MjModel, body: int, root_mat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return position (3,) and orientation (3, 3) of a body relative to its root's origin, with joints at zero."""
    if body == model.body_rootid[body]:
        return np.zeros(3), root_mat
    pos, mat = _in_root_frame(model, model.body_parentid[body], root_mat)
    return pos + mat @ model.body_pos[body], mat @ quat_to_mat(model.body_quat[body])


@dataclass(frozen=True)
class Place:
    """Place of an object, from an init atom.

    Attributes:
        carrier: Workspace, object or fixture that the object is on or in.
        region: Rectangle on the workspace or named site of the carrier; None for the carrier itself.
        inside: Whether the object is in the site and not on top of it.
    """

    carrier: str
    region: Region | None
    inside: bool

    @property
    def flat(self) -> bool:
        """Whether it is on the workspace, so that no other object has to be placed first."""
        return self.region is not None and bool(self.region.ranges)


def _places(scene: Scene) -> Mapping[str, Place]:
    """Return the place of each object, by name; carriers of other objects come first."""
    atoms = [
        a
        for a in scene.problem.init
        if a.args[0] in scene.objects and len(a.args) == 2 and a.predicate in BUILTIN_PREDICATES
    ]
    places = {atom.args[0]: _place_of(scene, atom) for atom in atoms}
    if missing := set(scene.objects) - set(places):
        raise PlacementError(f"no init atom places {', '.join(sorted(missing))}; add (On object region)")

    def carriers(name: str) -> int:  # below it; a `Problem` places nothing on itself by way of others
        return 1 + carriers(places[name].carrier) if name in places else 0

    return {name: places[name] for name in sorted(places, key=carriers)}


def _place_of(scene: Scene, atom: Atom) -> Place:
    target, region = atom.args[1], scene.problem.region(atom.args[1])
    if atom.predicate in ("On", "In"):
        if target in scene.entities:
            return Place(target, None, inside=False)
        targets = {scene.workspace_name} if region is not None and region.ranges else set(scene.entities)
        if region is not None and region.target in targets:
            return Place(region.target, region, atom.predicate == "In")
    raise PlacementError(
        f"init atom {atom} cannot be placed; expected On or In, and as the place "
        f"{scene.workspace_name}_<region>, an object, a fixture, or a named site of one"
    )


def make_true(scene: Scene, data: mujoco.MjData, atom: Atom, rng: np.random.Generator) -> list[int]:
    """Sample positions with which an atom holds, of joints or of an object, and return their addresses in `data.qpos`.

    Raises:
        PlacementError: It is another kind of atom, or there is no such joint or place.
    """
    state, name = atom.predicate.lower(), atom.args[0]
    if state not in OPPOSITE_STATES:
        mujoco.mj_kinematics(scene.model, data)
        _place(scene, data, name, _place_of(scene, atom), rng)
        address = scene.pose_address(name)
        return list(range(address, address + 7))
    owner = scene.owner(name)
    ranges = scene.entities[owner].articulation if owner is not None else {}
    joints = scene.joints.get(name, ())
    if state not in ranges or not joints:
        raise PlacementError(
            f"init atom ({atom.predicate} {name}): {name} has no joint with a state {state!r}"
        )
    for joint in joints:
        low, high = np.clip(sorted(ranges[state]), *scene.model.jnt_range[joint])
        data.qpos[scene.model.jnt_qposadr[joint]] = rng.uniform(low, high)
    return scene.model.jnt_qposadr[list(joints)].tolist()


def _place(scene: Scene, data: mujoco.MjData, name: str, place: Place, rng: np.random.Generator) -> None:
    """Sample the pose of an object and write it to `data.qpos`."""
    if place.flat:
        assert place.region is not None
        x0, y0, x1, y1 = place.region.ranges[rng.integers(len(place.region.ranges))]
        quat = scene.objects[name].rest_quat(rng)
        if place.region.yaw:
            yaw = quat_from_axis_angle(np.array([0.0, 0.0, 1.0]), rng.uniform(*place.region.yaw[0]))
            mujoco.mju_mulQuat(quat, yaw, quat.copy())
        ox, oy, _ = scene.workspace.offset
        surface = scene.workspace.surface_height
        x, y = rng.uniform(x0, x1) + ox, rng.uniform(y0, y1) + oy
    else:
        quat = scene.objects[name].rest_quat(rng)
        x, y, surface = _sample_on_carrier(scene, data, place, rng)
    height = surface - lowest_point(scene, name, quat) + _CLEARANCE
    address = scene.pose_address(name)
    data.qpos[address : address + 7] = (x, y, height, *quat)


def _sample_on_carrier(
    scene: Scene, data: mujoco.MjData, place: Place, rng: np.random.Generator
) -> tuple[float, float, float]:
    """Sample a point (x, y) over an object, or around the middle of a site, and return it with the surface's height."""
    if place.region is None:
        x, y = data.xpos[scene.model.body(f"{place.carrier}_{ROOT_BODY}").id][:2]
        return float(x), float(y), max(top for _, _, top in collision_boxes(scene, data, place.carrier))
    site = scene.model.site(place.region.address).id
    mat = data.site_xmat[site].reshape(3, 3)
    half = np.abs(mat @ scene.model.site_size[site])
    x, y, z = data.site_xpos[site] + (*(_SITE_FRACTION * half[:2] * rng.uniform(-1.0, 1.0, 2)), 0.0)
    highest = z if place.inside else z + half[2] + _OVER_SITE
    under = [
        top
        for centre, reach, top in collision_boxes(scene, data, place.carrier)
        if (np.abs(centre - (x, y)) <= reach).all() and top <= highest
    ]
    return float(x), float(y), max(under, default=float(z - half[2]))


def collision_boxes(
    scene: Scene, data: mujoco.MjData, name: str
) -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
    """Yield the collision geoms of an entity seen from above: centre (2,), half size (2,), height of the top; m."""
    model = scene.model
    for geom in scene.collision_geoms[name]:
        mat = data.geom_xmat[geom].reshape(3, 3)
        half = np.abs(mat) @ model.geom_aabb[geom, 3:]
        centre = data.geom_xpos[geom] + mat @ model.geom_aabb[geom, :3]
        yield centre[:2], half[:2], float(centre[2] + half[2])


def _touching_entities(scene: Scene, data: mujoco.MjData) -> set[str]:
    """Return the names of objects in contact with other entities or the robot, and of these."""
    model = scene.model
    roots = model.body_rootid[model.geom_bodyid[data.contact.geom[: data.ncon]]]
    owners = {int(scene.bodies[name][0]): name for name in (*scene.entities, ROBOT)}
    touching: set[str] = set()
    for a, b in roots:
        names = {owners.get(int(body), "") for body in (a, b)}
        if a != b and (names & set(scene.objects)) and "" not in names:
            touching |= names
    return touching


def settle(
    simulations: Simulations, i: int, qpos: np.ndarray, nq_robot: int, fixtures: np.ndarray
) -> np.ndarray:
    """Simulate until the objects of one simulation are at rest, while the arm holds its pose.

    Args:
        simulations: Simulations, with a controller whose zero action holds the pose.
        i: Index of the simulation.
        qpos: Positions to start from, (nq,).
        fixtures: Poses of the fixtures, (nfixtures, 7).

    Returns:
        Positions at rest, (nq,), with those of the robot as they were.

    Raises:
        PlacementError: An object still moves after five seconds.
    """
    hold = np.zeros((simulations.num, 7))
    simulations.reset([i], qpos[None], np.zeros((1, simulations.model.nv)), fixtures=fixtures[None])
    for _ in range(_MAX_HALF_SECONDS):
        before = simulations.fields["qpos"][i].copy()
        for _ in range(10):
            simulations.step([i], hold)
        after = simulations.fields["qpos"][i].copy()
        if np.abs(after - before)[nq_robot:].max(initial=0.0) < _STILL_CHANGE:
            after[:nq_robot] = qpos[:nq_robot]
            return after
    raise PlacementError(
        f"objects still move after {_MAX_HALF_SECONDS * 0.5:.0f} s; do their regions lie on a surface?"
    )


def sample_settled(
    scene: Scene,
    simulations: Simulations,
    i: int,
    rng: np.random.Generator,
    fixtures: np.ndarray | None = None,
    *,
    only_places: bool = False,
) -> Start:
    """Sample a start that is at rest, where the init atoms are true and the goal is false.

    Args:
        i: Index of the simulation to settle the objects in.
        fixtures: Poses of the fixtures, (nfixtures, 7); None samples them.
        only_places: Whether the goal and predicates of the user's own are not looked at.

    Raises:
        PlacementError: As `sample_start`; or no sample of 20 comes to rest where it should. Scenes of unusual size have
            fewer samples.
    """
    view, reason = StateView(scene, simulations, i), ""
    samples = fewer(_MAX_SAMPLES, scene.model.nv, _USUAL_FREEDOMS)
    for _ in range(samples):
        start = sample_start(scene, rng, fixtures, simulations.model)
        try:
            qpos = settle(simulations, i, start.qpos, scene.nq_robot, start.fixtures)
        except PlacementError as error:
            reason = str(error)
            continue
        simulations.reset([i], qpos[None], np.zeros((1, simulations.model.nv)))
        if not (reason := "; ".join(start_errors(view, only_places))):
            return Start(qpos, start.fixtures)
    raise PlacementError(
        f"{scene.problem.language!r}: none of {samples} sampled starts agrees with the task: {reason}"
    )


def sample_states(scene: Scene, generators: Sequence[np.random.Generator]) -> InitialStates:
    """Return new placements of a scene at rest, one from each generator.

    Raises:
        PlacementError: The objects do not fit, or do not come to rest.
    """
    speed = np.zeros(scene.model.nv)
    with closing(LoopSimulations(scene.model, 1, scene.fixture_bodies)) as simulations:
        starts = [sample_settled(scene, simulations, 0, rng) for rng in generators]
    return np.stack([np.concatenate([[0.0], s.qpos, speed, s.fixtures.ravel()]) for s in starts])


def start_errors(view: StateView, only_places: bool = False) -> list[str]:
    """Return why a state is not a valid start: init atoms that are false, a goal that is true.

    Args:
        only_places: Whether the goal and predicates of the user's own are not looked at.
    """
    faults = []
    for atom in view.scene.problem.init:
        stands = atom.args[0] in view.scene.fixtures and atom.predicate in ("On", "In")
        if stands or (only_places and atom.predicate not in BUILTIN_PREDICATES):
            continue
        region = view.scene.problem.region(atom.args[-1])
        if atom.predicate == "On" and region is not None:
            is_true = _rests_on(view, atom.args[0], region)
        else:
            is_true = evaluate(atom, view)
        if not is_true:
            faults.append(f"{atom} does not hold")
    if not only_places and evaluate(view.scene.problem.goal, view):
        faults.append("the goal holds already")
    return faults


def _rests_on(view: StateView, name: str, region: Region) -> bool:
    """Return whether an object is over a region, seen from above, and touches its target; unlike `On` at any height."""
    if region.ranges:
        point = view.body_pos(name)[:2] - np.asarray(view.scene.workspace.offset)[:2]
        low, high = np.split(np.array(region.ranges), 2, axis=1)
        return bool(((point > low - _TOLERANCE) & (point < high + _TOLERANCE)).all(axis=1).any())
    half = np.abs(view.site_mat(region.address) @ view.scene.model.site(region.address).size)
    near = np.abs(view.body_pos(name) - view.site_pos(region.address))[:2] < half[:2]
    return bool(near.all()) and view.in_contact(name, region.target)
