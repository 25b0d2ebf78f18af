"""Where things stand at the start: samples the regions and conditions of a problem's init atoms."""

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass

import mujoco
import numpy as np

from libero_env.errors import PlacementError
from libero_env.geometry import quat_to_mat
from libero_env.objects.model import ROOT_BODY
from libero_env.sim.scene import ROBOT, Scene, fixture_pose, initial_qpos
from libero_env.tasks.problem import Atom, Region

ARM_NOISE = 0.02  # rad, standard deviation of the arm's start around its rest pose, as in the original
_CLEARANCE = 0.001  # m, above the surface
_MAX_TRIES = 500
_CONDITIONS = {"Open": "open", "Close": "close", "Turnon": "turnon", "Turnoff": "turnoff"}
_OVER_SITE = 0.03  # m, how far over a site's box the surface may be that it marks
_INWARD = 0.3  # share of a site's box around its middle in which things are put


@dataclass(frozen=True)
class Start:
    """Where everything stands: `qpos` (nq,), `fixtures` (nfixtures, 7) pos and quat wxyz."""

    qpos: np.ndarray
    fixtures: np.ndarray


def sample_start(scene: Scene, rng: np.random.Generator) -> Start:
    """Fixtures and objects in the regions their init atoms name, joints as the atoms say, nothing touching.

    Objects may hover by a millimetre: settle them before use (`init_states.settle`).

    Raises:
        PlacementError: no free placement in 500 tries, or an init atom that cannot be placed.
    """
    places = _places(scene)
    model = copy(scene.model) if scene.fixtures else scene.model
    data = mujoco.MjData(model)
    data.qpos[:] = initial_qpos(scene)
    data.qpos[:7] += ARM_NOISE * rng.standard_normal(7)
    fixtures = _sample_fixtures(scene, rng)
    if scene.fixtures:
        model.body_pos[scene.fixture_bodies], model.body_quat[scene.fixture_bodies] = (
            fixtures[:, :3],
            fixtures[:, 3:],
        )
    _sample_joints(scene, data, rng)
    touching: set[str] = set()
    for _ in range(_MAX_TRIES):
        for name, place in places.items():
            if not place.flat:
                mujoco.mj_kinematics(model, data)  # what it stands on has been placed
            _place(scene, data, name, place, rng)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        touching = _touching(scene, data)
        if not touching:
            return Start(data.qpos.copy(), fixtures)
    raise PlacementError(
        f"{scene.problem.language!r}: {', '.join(sorted(touching))} still collide after {_MAX_TRIES} tries. "
        "(1) make their regions larger, (2) move the regions apart, (3) use fewer or smaller objects"
    )


def sample_qpos(scene: Scene, rng: np.random.Generator) -> np.ndarray:
    """The positions (nq,) of `sample_start`."""
    return sample_start(scene, rng).qpos


def lowest_point(scene: Scene, name: str, quat: np.ndarray) -> float:
    """Height of an object's lowest collision point over its origin when turned by `quat` (wxyz), m; negative."""
    model, lowest = scene.model, np.inf
    for body in scene.bodies[name]:
        pos, rotation = _in_root_frame(model, body, quat_to_mat(quat))
        start = model.body_geomadr[body]
        for geom in range(start, start + model.body_geomnum[body]):
            if model.geom_contype[geom] == 0 and model.geom_conaffinity[geom] == 0:
                continue
            centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            up = (rotation @ quat_to_mat(model.geom_quat[geom]))[2]
            middle = pos[2] + rotation[2] @ model.geom_pos[geom] + up @ centre
            lowest = min(lowest, middle - np.abs(up) @ half)
    return float(lowest)


def _in_root_frame(model: mujoco.MjModel, body: int, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) and orientation (3, 3) of a body from its root's origin, joints at zero, turned by `turn`."""
    if body == model.body_rootid[body]:
        return np.zeros(3), turn
    pos, mat = _in_root_frame(model, model.body_parentid[body], turn)
    return pos + mat @ model.body_pos[body], mat @ quat_to_mat(model.body_quat[body])


@dataclass(frozen=True)
class Place:
    """What an init atom says about where an object goes.

    Attributes:
        carrier: workspace, object or fixture that it stands on or in.
        region: rectangle on the workspace or named site of the carrier; None for the carrier itself.
        inside: rather in the site than on top of it.
    """

    carrier: str
    region: Region | None
    inside: bool

    @property
    def flat(self) -> bool:
        """On the workspace, so that nothing else has to be placed first."""
        return self.region is not None and bool(self.region.ranges)


def _places(scene: Scene) -> Mapping[str, Place]:
    """Object -> where it goes; what carries others comes first."""
    atoms = [a for a in scene.problem.init if a.args[0] in scene.objects and len(a.args) == 2]
    places = {atom.args[0]: _place_of(scene, atom) for atom in atoms}
    if missing := set(scene.objects) - set(places):
        raise PlacementError(
            f"no init atom says where {', '.join(sorted(missing))} stands; add (On object region)"
        )
    ordered: dict[str, Place] = {}
    while len(ordered) < len(places):
        waiting = set(places) - set(ordered)
        ready = {
            name: place for name, place in places.items() if name in waiting and place.carrier not in waiting
        }
        if not ready:
            raise PlacementError(f"{', '.join(sorted(waiting))} stand on each other in a circle")
        ordered.update(ready)
    return ordered


def _place_of(scene: Scene, atom: Atom) -> Place:
    target, region = atom.args[1], scene.problem.region(atom.args[1])
    if atom.predicate in ("On", "In"):
        if target in scene.entities:
            return Place(target, None, inside=False)
        targets = {scene.workspace_name} if region is not None and region.ranges else set(scene.entities)
        if region is not None and region.target in targets:
            return Place(region.target, region, atom.predicate == "In")
    raise PlacementError(
        f"init atom ({atom.predicate} {' '.join(atom.args)}) cannot be placed; expected On or In, and as the place "
        f"{scene.workspace_name}_<region>, an object, a fixture, or a named site of one"
    )


def _sample_fixtures(scene: Scene, rng: np.random.Generator) -> np.ndarray:
    poses = [
        fixture_pose(scene.problem, scene.workspace_name, scene.workspace, name, item, rng)
        for name, item in scene.fixtures.items()
    ]
    return np.array(poses).reshape(-1, 7)


def _sample_joints(scene: Scene, data: mujoco.MjData, rng: np.random.Generator) -> None:
    """Joints of what is to be open, closed, turned on or off."""
    for atom in scene.problem.init:
        if (state := _CONDITIONS.get(atom.predicate)) is None:
            continue
        owner = scene.owner(atom.args[0])
        ranges = scene.entities[owner].articulation if owner is not None else {}
        joints = scene.joints.get(atom.args[0], ())
        if state not in ranges or not joints:
            raise PlacementError(
                f"init atom ({atom.predicate} {atom.args[0]}): it has no joint that can be {state!r}"
            )
        for joint in joints:
            low, high = np.clip(sorted(ranges[state]), *scene.model.jnt_range[joint])
            data.qpos[scene.model.jnt_qposadr[joint]] = rng.uniform(low, high)


def _place(scene: Scene, data: mujoco.MjData, name: str, place: Place, rng: np.random.Generator) -> None:
    if place.flat:
        assert place.region is not None
        x0, y0, x1, y1 = place.region.ranges[rng.integers(len(place.region.ranges))]
        quat = _turned(scene.objects[name].rest_quat(rng), place.region, rng)
        ox, oy, _ = scene.workspace.offset
        surface = scene.workspace.surface_height
        x, y = rng.uniform(x0, x1) + ox, rng.uniform(y0, y1) + oy
    else:
        quat = scene.objects[name].rest_quat(rng)
        x, y, surface = _on_thing(scene, data, place, rng)
    height = surface - lowest_point(scene, name, quat) + _CLEARANCE
    address = scene.model.joint(f"{name}_joint0").qposadr[0]
    data.qpos[address : address + 7] = (x, y, height, *quat)


def _turned(quat: np.ndarray, region: Region, rng: np.random.Generator) -> np.ndarray:
    if not region.yaw:
        return quat
    turn, turned = np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, np.array([0.0, 0.0, 1.0]), rng.uniform(*region.yaw[0]))
    mujoco.mju_mulQuat(turned, turn, quat)
    return turned


def _on_thing(
    scene: Scene, data: mujoco.MjData, place: Place, rng: np.random.Generator
) -> tuple[float, float, float]:
    """A point (x, y) over the middle of an object, or around the middle of a site, and the height of what is there."""
    if place.region is None:
        x, y = data.xpos[scene.model.body(f"{place.carrier}_{ROOT_BODY}").id][:2]
        return float(x), float(y), max(top for _, _, top in _solids(scene, data, place.carrier))
    site = scene.model.site(place.region.address).id
    mat = data.site_xmat[site].reshape(3, 3)
    half = np.abs(mat @ scene.model.site_size[site])
    x, y, z = data.site_xpos[site] + (*(_INWARD * half[:2] * rng.uniform(-1.0, 1.0, 2)), 0.0)
    highest = z if place.inside else z + half[2] + _OVER_SITE
    under = [
        top
        for centre, reach, top in _solids(scene, data, place.carrier)
        if (np.abs(centre - (x, y)) <= reach).all() and top <= highest
    ]
    return float(x), float(y), max(under, default=float(z - half[2]))


def _solids(scene: Scene, data: mujoco.MjData, name: str):
    """Collision shapes of a thing as seen from above: centre (2,), half extents (2,), height of the top; m."""
    model = scene.model
    for body in scene.bodies[name]:
        start = model.body_geomadr[body]
        for geom in range(start, start + model.body_geomnum[body]):
            if model.geom_contype[geom] or model.geom_conaffinity[geom]:
                mat = data.geom_xmat[geom].reshape(3, 3)
                half = np.abs(mat) @ model.geom_aabb[geom, 3:]
                centre = data.geom_xpos[geom] + mat @ model.geom_aabb[geom, :3]
                yield centre[:2], half[:2], float(centre[2] + half[2])


def _touching(scene: Scene, data: mujoco.MjData) -> set[str]:
    """Objects in contact with another object, a fixture or the robot."""
    model = scene.model
    roots = model.body_rootid[model.geom_bodyid[data.contact.geom[: data.ncon]]]
    owners = {int(scene.bodies[name][0]): name for name in scene.entities} | {
        int(scene.bodies[ROBOT][0]): ROBOT
    }
    found = set()
    for a, b in roots:
        names = {owners.get(int(body), "") for body in (a, b)}
        if a != b and (names & set(scene.objects)) and "" not in names:
            found |= names
    return found
