"""The Panda arm with its two-finger gripper: robosuite's MJCF, with simplified visual meshes.

robosuite is used as a data package only, and never imported: the files of an installed release, or else those that are
fetched into the cache, where the robot's 64 are kept.
"""

import hashlib
import importlib.util
import logging
import re
import shutil
import subprocess
import tempfile
from collections import defaultdict
from collections.abc import Sequence
from functools import cache
from itertools import count
from pathlib import Path

import numpy as np

from libero_env.assets.published import installer
from libero_env.assets.simplify import MeshSource, merge_and_simplify
from libero_env.errors import MissingPackageError
from libero_env.mujoco_compat import delete, mujoco
from libero_env.objects.model import add_visual
from libero_env.paths import cache_dir
from libero_env.storage.caches import cached_folder
from libero_env.storage.files import atomic_folder

ROBOTS = ("libero", "robosuite-1.4.1")
DEFAULT_ROBOT = "libero"
ROBOSUITE_VERSION = "1.4.1"
ARM_JOINTS = tuple(f"robot0_joint{i}" for i in range(1, 8))
FINGER_JOINTS = ("gripper0_finger_joint1", "gripper0_finger_joint2")
GRIP_SITE = "gripper0_grip_site"
# [rad] initial and null-space posture
REST_QPOS = (0.0, -0.161037389, 0.0, -2.44459747, 0.0, 2.2267522, np.pi / 4)
OPEN_FINGERS = (0.020833, -0.020833)  # [m] initial finger positions
ARMATURE = tuple(5.0 / (i + 1) for i in range(7))  # [kg m^2] robosuite adds it to joint i of the MJCF
FRICTIONLOSS = 0.1  # [N m] robosuite adds it to every joint

_ARM_FILE, _GRIPPER_FILE = "robots/panda/robot.xml", "grippers/panda_gripper.xml"
# sha256 of each model in robosuite 1.4.0, 1.4.1, 1.5.0 to 1.5.2 (its reformatted robot has one site more), and of all
# meshes, which are the same in these releases but for carriage returns
_MODELS = {
    _ARM_FILE: ("1b83897bbdd1", "b57bfca47667", "67f62e98681d"),
    _GRIPPER_FILE: ("066fd7ae45af",),
    "mounts/rethink_mount.xml": ("7a7b2593020c",),
}
_MESHES = "88b324b09aeb0ddd"
_log = logging.getLogger(__name__)
_ABSENT = "the robot's model files are missing"
_REMEDY = (
    "libero assets install robot where there is a network and a package index, or pip install --no-deps "
    + (f"robosuite=={ROBOSUITE_VERSION}")
)
_WRIST, _WRIST_GEOM = "link7", "link7_collision"  # body, and its collision mesh in robosuite 1.4.1
_FACES_PER_GEOM = 260  # triangles of a simplified visual mesh

_VisualKey = tuple[str, tuple[float, ...]]  # name of the body and colour, rgba


@cache
def robot_assets() -> Path:
    """Return the folder of the robot's model files: robosuite's, or else fetched once from the package index.

    Raises:
        MissingPackageError: They are neither there nor can be fetched.
        LiberoError: The cache cannot be written.
    """
    if folder := installed_robot():
        return folder
    folder = robot_cache()
    cached_folder(folder, lambda: _fetch(folder))
    return folder


def robot_cache() -> Path:
    """Return the folder into which the robot's model files are fetched."""
    return cache_dir() / "robot" / f"robosuite-{ROBOSUITE_VERSION}"


def installed_robot() -> Path | None:
    """Return the folder of an installed robosuite (1.4.0 to 1.5.2), None where its files are absent or others."""
    spec = importlib.util.find_spec("robosuite")
    if spec is None or spec.origin is None:
        return None
    folder = Path(spec.origin).parent / "models" / "assets"
    return folder if _files(folder) else None


def robot_file(name: str) -> Path:
    """Return a model file by its name in robosuite 1.4, whose `mounts` are `bases` in 1.5.

    Raises:
        MissingPackageError: See `robot_assets`.
    """
    root = robot_assets()
    return root / (name if (root / name).exists() else name.replace("mounts/", "bases/", 1))


def _files(folder: Path) -> dict[str, Path]:
    """Return the robot's files by their names in robosuite 1.4; empty where a model is unknown or a file is missing."""
    mounts = "mounts" if (folder / "mounts").is_dir() else "bases"
    found: dict[str, Path] = {}
    for model, digests in _MODELS.items():
        found[model] = folder / model.replace("mounts", mounts, 1)
        try:
            text = _content(found[model])
        except OSError:
            return {}
        if hashlib.sha256(text).hexdigest()[:12] not in digests:
            return {}
        for mesh in sorted(set(re.findall(r'file="([^"]*)"', text.decode()))):
            found[f"{model.rpartition('/')[0]}/{mesh}"] = found[model].parent / mesh
    return found if all(path.is_file() for path in found.values()) else {}


def _content(path: Path) -> bytes:
    """Return the content of a file without carriage returns, which only robosuite 1.4 has."""
    return path.read_bytes().replace(b"\r", b"")


def _fetch(folder: Path) -> None:
    """Fetch robosuite with pip or uv, and keep the robot's files.

    Raises:
        MissingPackageError: There is neither pip nor uv, it failed, or the files are not those of the release.
    """
    package = f"robosuite=={ROBOSUITE_VERSION}"
    command = installer(_REMEDY)
    _log.warning("fetching the robot's model files (%s, 190 MB, once) from the package index", package)
    with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
        options = ["--quiet", "--no-deps", "--no-cache-dir", "--target", scratch, package]
        done = subprocess.run([*command, *options], capture_output=True, text=True, check=False)
        if done.returncode:
            reason = (done.stderr.strip() or f"status {done.returncode}").splitlines()[-1]
            raise MissingPackageError(f"{_ABSENT}, and cannot be fetched ({reason})", _REMEDY)
        files = _files(Path(scratch, "robosuite", "models", "assets"))
        meshes = b"".join(_content(path) for name, path in files.items() if name not in _MODELS)
        if hashlib.sha256(meshes).hexdigest()[:16] != _MESHES:
            raise MissingPackageError(f"{_ABSENT}: {package} of the package index has other ones", _REMEDY)
        with atomic_folder(folder) as part:
            for name, path in files.items():
                (part / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, part / name)


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
        MissingPackageError: See `robot_assets`.
    """
    arm, gripper = load_robosuite(_ARM_FILE), load_robosuite(_GRIPPER_FILE)
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


def load_robosuite(name: str) -> mujoco.MjSpec:
    """Return one of robosuite's models, with angles in radians and absolute paths of its meshes."""
    path = robot_file(name)
    spec = mujoco.MjSpec.from_file(str(path))
    if (added := spec.site("right_center")) is not None:  # in robosuite 1.5
        delete(spec, added)
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
            add_visual(spec.body(body), f"visual{i}", mesh, rgba=rgba)
    for geom in visuals:
        delete(spec, geom)
    used = {g.meshname for g in spec.geoms}
    for item in [*(m for m in spec.meshes if m.name not in used), *spec.materials]:
        delete(spec, item)
