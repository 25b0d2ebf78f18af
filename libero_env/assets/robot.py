"""The Panda arm with its two-finger gripper: robosuite's MJCF, with light visual meshes.

robosuite is used as a data package only: its files are found through the installed distribution and never imported.
"""

import hashlib
import importlib.util
from collections import defaultdict
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np

from libero_env.errors import LiberoError
from libero_env.geometry import quat_to_mat
from libero_env.mujoco_compat import delete
from libero_env.paths import cache_dir
from libero_env.storage import atomic_path

ARM_JOINTS = tuple(f"robot0_joint{i}" for i in range(1, 8))
FINGER_JOINTS = ("gripper0_finger_joint1", "gripper0_finger_joint2")
GRIP_SITE = "gripper0_grip_site"
# Where the arm starts and what its null space pulls towards, rad; fingers in metres.
REST_QPOS = (0.0, -0.161037389, 0.0, -2.44459747, 0.0, 2.2267522, np.pi / 4)
OPEN_FINGERS = (0.020833, -0.020833)
# Dynamics that robosuite gives every arm on top of the MJCF (joint i of 7).
ARMATURE = tuple(5.0 / (i + 1) for i in range(7))
FRICTIONLOSS = 0.1

_FACES_PER_GEOM = 260
_CACHE_VERSION = 2


def robosuite_assets() -> Path:
    """Folder of robosuite's MJCF files.

    Raises:
        LiberoError: robosuite is not installed.
    """
    spec = importlib.util.find_spec("robosuite")
    if spec is None or spec.origin is None:
        raise LiberoError(
            "robosuite is not installed; it supplies the robot's model: pip install robosuite==1.4.1"
        )
    return Path(spec.origin).parent / "models" / "assets"


def add_panda(spec: mujoco.MjSpec, pos_world: Sequence[float]) -> None:
    """Add the arm with its gripper to a scene, base at pos_world (3,) m, names as the original benchmark has them.

    Bodies, joints and sites of the arm start with `robot0_`, those of the gripper with `gripper0_`; the root body is
    `robot0_base`.
    """
    root = robosuite_assets()
    arm = _load(root / "robots/panda/robot.xml")
    gripper = _load(root / "grippers/panda_gripper.xml")
    _replace_visuals(arm, "arm")
    _replace_visuals(gripper, "gripper")
    for i in range(7):
        joint = arm.joint(f"joint{i + 1}")
        joint.armature, joint.frictionloss = ARMATURE[i], FRICTIONLOSS
    spec.attach(arm, prefix="robot0_", frame=spec.worldbody.add_frame(pos=pos_world))
    spec.attach(gripper, prefix="gripper0_", frame=spec.body("robot0_right_hand").add_frame())


def _load(path: Path) -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.degree = False
    for mesh in spec.meshes:  # absolute paths survive being attached to another spec
        mesh.file = str(path.parent / mesh.file)
    return spec


def _replace_visuals(spec: mujoco.MjSpec, name: str) -> None:
    """Swap the visual meshes for simplified ones, one for each body and colour."""
    groups: dict[tuple[str, tuple[float, ...]], list] = defaultdict(list)
    visuals = [g for g in spec.geoms if g.group == 1 and g.type == mujoco.mjtGeom.mjGEOM_MESH]
    for geom in visuals:
        rgba = spec.material(geom.material).rgba if geom.material else geom.rgba
        groups[geom.parent.name, tuple(np.round(rgba, 3))].append(geom)
    meshes = _simplified(spec, name, groups)
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
                group=1,
                contype=0,
                conaffinity=0,
                mass=0.0,
            )
    for geom in visuals:
        delete(spec, geom)
    used = {g.meshname for g in spec.geoms}
    for item in [m for m in spec.meshes if m.name not in used] + list(spec.materials):
        delete(spec, item)


def _simplified(spec: mujoco.MjSpec, name: str, groups: dict) -> list[tuple[np.ndarray, np.ndarray]]:
    """Vertices and faces of each group in its body's frame, from the cache where it has them."""
    parts = [(g.meshname, *g.pos, *g.quat) for geoms in groups.values() for g in geoms]
    digest = hashlib.sha256(repr((_CACHE_VERSION, _FACES_PER_GEOM, name, parts)).encode()).hexdigest()[:16]
    return _simplified_cached(
        digest, tuple(tuple(_source(spec, g) for g in geoms) for geoms in groups.values())
    )


def _source(spec: mujoco.MjSpec, geom: mujoco.MjsGeom) -> tuple[str, tuple[float, ...], tuple[float, ...]]:
    return spec.mesh(geom.meshname).file, tuple(geom.pos), tuple(geom.quat)


@lru_cache(maxsize=8)
def _simplified_cached(digest: str, groups: tuple) -> list[tuple[np.ndarray, np.ndarray]]:
    path = cache_dir() / "meshes" / f"panda-{digest}.npz"
    if path.exists():
        with np.load(path) as stored:
            return [(stored[f"v{i}"], stored[f"f{i}"]) for i in range(len(groups))]
    meshes = [_merge_and_simplify(sources) for sources in groups]
    arrays = {k: a for i, (v, f) in enumerate(meshes) for k, a in ((f"v{i}", v), (f"f{i}", f))}
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **arrays)
    return meshes


def _merge_and_simplify(sources: tuple) -> tuple[np.ndarray, np.ndarray]:
    import trimesh  # only needed the first time on a machine

    parts = []
    for file, pos, quat_wxyz in sources:
        mesh = trimesh.load(file, force="mesh", process=True, skip_materials=True)
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = quat_to_mat(np.asarray(quat_wxyz)), pos
        parts.append(mesh.apply_transform(pose))
    whole = trimesh.util.concatenate(parts)
    if len(whole.faces) > _FACES_PER_GEOM:
        whole = whole.simplify_quadric_decimation(face_count=_FACES_PER_GEOM)
    whole.update_faces(whole.nondegenerate_faces())
    whole.remove_unreferenced_vertices()
    return np.asarray(whole.vertices, np.float64), np.asarray(whole.faces, np.int32)
