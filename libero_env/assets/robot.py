"""The Panda arm with its two-finger gripper: robosuite's MJCF, with simplified visual meshes.

robosuite is used as a data package only: its files are found through the installed distribution and never imported.
"""

import importlib.metadata
import importlib.util
from collections import defaultdict
from collections.abc import Sequence
from itertools import count
from pathlib import Path

import numpy as np

from libero_env.assets.simplify import MeshSource, merge_and_simplify
from libero_env.errors import MissingPackageError
from libero_env.mujoco_compat import delete, mujoco
from libero_env.objects.model import VISUAL_GEOM

ROBOTS = ("libero", "robosuite-1.4.1")
DEFAULT_ROBOT = "libero"
ROBOSUITE_VERSION = "1.4.1"
ROBOSUITE_REMEDY = f"pip install --no-deps robosuite=={ROBOSUITE_VERSION}"
ARM_JOINTS = tuple(f"robot0_joint{i}" for i in range(1, 8))
FINGER_JOINTS = ("gripper0_finger_joint1", "gripper0_finger_joint2")
GRIP_SITE = "gripper0_grip_site"
REST_QPOS = (
    0.0,
    -0.161037389,
    0.0,
    -2.44459747,
    0.0,
    2.2267522,
    np.pi / 4,
)  # [rad] initial and null-space posture
OPEN_FINGERS = (0.020833, -0.020833)  # [m] initial finger positions
ARMATURE = tuple(5.0 / (i + 1) for i in range(7))  # [kg m^2] robosuite adds it to joint i of the MJCF
FRICTIONLOSS = 0.1  # [N m] robosuite adds it to every joint

_ARM_FILE, _GRIPPER_FILE = "robots/panda/robot.xml", "grippers/panda_gripper.xml"
_WRIST, _WRIST_GEOM = "link7", "link7_collision"  # body, and its collision mesh in robosuite 1.4.1
_FACES_PER_GEOM = 260  # triangles of a simplified visual mesh

_VisualKey = tuple[str, tuple[float, ...]]  # name of the body and colour, rgba


def robosuite_assets() -> Path:
    """Return the folder of robosuite's MJCF files.

    Raises:
        MissingPackageError: Robosuite is not installed, or its model files are missing.
    """
    spec = importlib.util.find_spec("robosuite")
    if spec is None or spec.origin is None:
        raise _not_installed()
    assets = Path(spec.origin).parent / "models" / "assets"
    for name in (_ARM_FILE, _GRIPPER_FILE, "mounts/rethink_mount.xml"):  # which robosuite 1.5 has not
        if not (assets / name).is_file():
            missing = f"the robot's model files are missing: {assets / name} does not exist"
            raise MissingPackageError(
                missing, ROBOSUITE_REMEDY.replace("--no-deps", "--no-deps --force-reinstall")
            )
    return assets


def robosuite_version() -> str:
    """Return the version of the installed robosuite.

    Raises:
        MissingPackageError: Robosuite is not installed.
    """
    try:
        return importlib.metadata.version("robosuite")
    except importlib.metadata.PackageNotFoundError as error:
        raise _not_installed() from error


def add_panda(
    spec: mujoco.MjSpec, pos_world: Sequence[float], robot: str = DEFAULT_ROBOT, detailed: bool = False
) -> None:
    """Add the arm with its gripper to a scene, with the names of the original benchmark.

    Bodies, joints and sites of the arm start with `robot0_`, those of the gripper with `gripper0_`; the root body is
    `robot0_base`.

    Args:
        spec: Scene to extend.
        pos_world: Position of the base, (3,) [m].
        robot: One of `ROBOTS`.
        detailed: Whether it has robosuite's visual meshes and materials, not one simplified mesh for each colour.

    Raises:
        MissingPackageError: Robosuite, which supplies the models, is not installed.
    """
    root = robosuite_assets()
    arm, gripper = load_robosuite(root / _ARM_FILE), load_robosuite(root / _GRIPPER_FILE)
    _set_wrist_collision(arm, robot)
    if detailed:
        unnamed = count()
        for geom in (g for part in (arm, gripper) for g in part.geoms if g.group == 1):
            geom.mass = 0.0
            geom.name = geom.name or f"g{next(unnamed)}_vis"  # as robosuite calls them
    else:
        _replace_visuals(arm, "arm")
        _replace_visuals(gripper, "gripper")
    for i in range(7):
        joint = arm.joint(f"joint{i + 1}")
        joint.armature, joint.frictionloss = ARMATURE[i], FRICTIONLOSS
    spec.attach(arm, prefix="robot0_", frame=spec.worldbody.add_frame(pos=list(pos_world)))
    spec.attach(gripper, prefix="gripper0_", frame=spec.body("robot0_right_hand").add_frame())


def _set_wrist_collision(arm: mujoco.MjSpec, robot: str) -> None:
    """Remove the collision mesh of link 7, or add it, whichever robosuite is installed."""
    existing = arm.geom(_WRIST_GEOM)
    if robot == DEFAULT_ROBOT and existing is not None:
        delete(arm, existing)
    elif robot != DEFAULT_ROBOT and existing is None:
        mesh = mujoco.mjtGeom.mjGEOM_MESH
        arm.body(_WRIST).add_geom(name=_WRIST_GEOM, type=mesh, meshname=_WRIST, group=0)


def _not_installed() -> MissingPackageError:
    reason = "the robot's model files are missing: the package robosuite is not installed"
    return MissingPackageError(reason, ROBOSUITE_REMEDY)


def load_robosuite(path: Path) -> mujoco.MjSpec:
    """Return one of robosuite's models, with angles in radians and absolute paths of its meshes."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.degree = False
    for mesh in spec.meshes:  # absolute paths survive being attached to another spec
        mesh.file = str(path.parent / mesh.file)
    return spec


def _replace_visuals(spec: mujoco.MjSpec, name: str) -> None:
    """Replace the visual meshes by simplified ones, one for each body and colour."""
    groups: dict[_VisualKey, list[MeshSource]] = defaultdict(list)
    visuals = [g for g in spec.geoms if g.group == 1 and g.type == mujoco.mjtGeom.mjGEOM_MESH]
    for geom in visuals:
        rgba = spec.material(geom.material).rgba if geom.material else geom.rgba
        file = spec.mesh(geom.meshname).file
        source = MeshSource(geom.meshname, file, tuple(geom.pos), tuple(geom.quat))
        groups[geom.parent.name, tuple(np.round(rgba, 3))].append(source)
    meshes = merge_and_simplify("panda", name, tuple(map(tuple, groups.values())), _FACES_PER_GEOM)
    for i, (body, rgba) in enumerate(groups):
        vertices, faces = meshes[i]
        if len(faces):
            mesh = spec.add_mesh(name=f"visual{i}", uservert=vertices.ravel(), userface=faces.ravel())
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            spec.body(body).add_geom(
                name=f"visual{i}",
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=mesh.name,
                rgba=rgba,
                **VISUAL_GEOM,
            )
    for geom in visuals:
        delete(spec, geom)
    used = {g.meshname for g in spec.geoms}
    for item in [*(m for m in spec.meshes if m.name not in used), *spec.materials]:
        delete(spec, item)
