"""Where things stand at the start: samples the regions of a problem's init atoms."""

import mujoco
import numpy as np

from libero_env.errors import PlacementError
from libero_env.problem import Atom, Region
from libero_env.scene import Scene, initial_qpos

ARM_NOISE = 0.02  # rad, standard deviation of the arm's start around its rest pose, as in the original
_CLEARANCE = 0.001  # m, above the surface
_MAX_TRIES = 500


def sample_qpos(scene: Scene, rng: np.random.Generator) -> np.ndarray:
    """Positions (nq,) with every object in the region its init atom names and nothing touching anything else.

    Objects may hover by a millimetre: settle them before use (`init_states.settle`).

    Raises:
        PlacementError: no free placement in 500 tries, or an init atom that cannot be placed.
    """
    regions = {atom.args[0]: _region(scene, atom) for atom in scene.problem.init if atom.args[0] in scene.objects}
    if missing := set(scene.objects) - set(regions):
        raise PlacementError(f"no init atom says where {', '.join(sorted(missing))} stands; add (On object region)")
    data = mujoco.MjData(scene.model)
    data.qpos[:] = initial_qpos(scene)
    data.qpos[:7] += ARM_NOISE * rng.standard_normal(7)
    touching: set[str] = set()
    for _ in range(_MAX_TRIES):
        for name, region in regions.items():
            _place(scene, data, name, region, rng)
        mujoco.mj_kinematics(scene.model, data)
        mujoco.mj_collision(scene.model, data)
        touching = _touching(scene, data)
        if not touching:
            return data.qpos.copy()
    raise PlacementError(
        f"{scene.problem.language!r}: {', '.join(sorted(touching))} still collide after {_MAX_TRIES} tries. "
        "(1) make their regions larger, (2) move the regions apart, (3) use fewer or smaller objects"
    )


def lowest_point(scene: Scene, name: str, quat: np.ndarray) -> float:
    """Height of an object's lowest collision point over its origin when turned by `quat` (wxyz), m; negative."""
    model = scene.model
    body = model.body(f"{name}_main").id
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, quat)
    rotation = rotation.reshape(3, 3)
    lowest = np.inf
    for geom in range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body]):
        if model.geom_contype[geom] == 0 and model.geom_conaffinity[geom] == 0:
            continue
        local = np.zeros(9)
        mujoco.mju_quat2Mat(local, model.geom_quat[geom])
        centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        up = (rotation @ local.reshape(3, 3))[2]
        middle = rotation[2] @ model.geom_pos[geom] + up @ centre
        lowest = min(lowest, middle - np.abs(up) @ half)
    return float(lowest)


def _region(scene: Scene, atom: Atom) -> Region:
    region = scene.problem.region(atom.args[-1]) if len(atom.args) == 2 else None
    if atom.predicate != "On" or region is None or not region.ranges or region.target != scene.workspace.name:
        text = f"({atom.predicate} {' '.join(atom.args)})"
        raise PlacementError(f"init atom {text} cannot be placed; expected (On object {scene.workspace.name}_region)")
    return region


def _place(scene: Scene, data: mujoco.MjData, name: str, region: Region, rng: np.random.Generator) -> None:
    x0, y0, x1, y1 = region.ranges[rng.integers(len(region.ranges))]
    quat = scene.objects[name].rest_quat(rng)
    if region.yaw:
        turn, turned = np.zeros(4), np.zeros(4)
        mujoco.mju_axisAngle2Quat(turn, np.array([0.0, 0.0, 1.0]), rng.uniform(*region.yaw[0]))
        mujoco.mju_mulQuat(turned, turn, quat)
        quat = turned
    ox, oy, _ = scene.workspace.offset
    height = scene.workspace.region_height - lowest_point(scene, name, quat) + _CLEARANCE
    address = scene.model.joint(f"{name}_joint0").qposadr[0]
    data.qpos[address : address + 7] = (rng.uniform(x0, x1) + ox, rng.uniform(y0, y1) + oy, height, *quat)


def _touching(scene: Scene, data: mujoco.MjData) -> set[str]:
    """Objects in contact with another object or the robot."""
    model = scene.model
    roots = model.body_rootid[model.geom_bodyid[data.contact.geom[: data.ncon]]]
    found = set()
    for a, b in roots:
        names = {model.body(int(body)).name for body in (a, b)}
        if a != b and not names & {"world", "floor"}:
            found |= {name.removesuffix("_main") for name in names}
    return found
